"""Problems of round size: the fits of many clusters then share compiled programs.

A program belongs to the shapes of its arrays and to the names of its systems. What fills a problem up has
no say: systems at D_LS/D_S = 0, which are seen where they are whatever the model, and members without light.
"""

from dataclasses import replace

import jax.numpy as jnp

from jaxlens._types import Array
from jaxlens.strong._chi2 import SIGMA, ImageCatalogue, Problem
from jaxlens.strong._model import ClusterModel, MemberSet

GROUP = 32
"""Images, systems and members are filled up to a multiple of this."""

_FAINT, _FAR = 1e-12, 1e4
# L/L_ref of a member that fills up, and where it stands, arcsec: it adds 1e-12 of the mass of one of L_ref.


def rounded_images(images: ImageCatalogue) -> ImageCatalogue:
    """The catalogue filled up, without names; its own images and systems come first.

    What fills it up stands at the corner of the field of the images, inside the window that is searched for
    predicted ones.
    """
    more, systems = _spare(images.n_images, images.n_systems)
    corner = jnp.max(images.theta, axis=0)
    # The first `systems` of them open one each, the rest share the last.
    own = images.n_systems + jnp.minimum(jnp.arange(more), systems - 1)
    return ImageCatalogue(
        theta=jnp.concatenate([images.theta, jnp.broadcast_to(corner, (more, 2))]),
        source=jnp.concatenate([images.source, own.astype(images.source.dtype)]),
        z_s=_last(images.z_s, systems),
        sigma_pos=_last(images.sigma_pos, more),
    )


def _spare(n_images: int, n_systems: int) -> tuple[int, int]:
    """Images and systems that fill up: no system without an image, no image without a system."""
    more, systems = -n_images % GROUP, -n_systems % GROUP
    if more and not systems:
        systems = GROUP
    while more < systems:
        more += GROUP
    return more, systems


def _last(values: Array, times: int) -> Array:
    return jnp.pad(values, (0, times), mode="edge")


def rounded(problem: Problem) -> Problem:
    """The same fit with round numbers of images, systems and members.

    Free numbers, priors and chi^2 are the same to rounding. The prediction and the lens of the fit hold what
    fills them up, after the rest; `images` have no names. Whatever counts images (degrees of freedom,
    `criteria`, `rescale`) is to be asked of the problem itself.

    Args:
        problem: of a `ClusterModel`, with position errors that are not free.

    Raises:
        ValueError: if its model is another, or a factor on the position errors is free.
    """
    model = problem.build
    if not isinstance(model, ClusterModel):
        raise ValueError("`problem.build` is not a ClusterModel: how to fill it up is not known.")
    if SIGMA in problem.bounds:
        raise ValueError(
            "The factor on the position errors is free: its best value counts the images, which change here."
        )
    images = rounded_images(problem.images)
    free = any(name.startswith("dls_ds.") for name in problem.bounds)
    build = replace(
        model,
        members=None if model.members is None else _filled(model.members),
        groups=tuple(_filled(one) for one in model.groups),
        dls_ds=jnp.pad(model.dls_ds, (0, images.n_systems - problem.images.n_systems)),
        systems=model.systems if free else (),
    )
    return replace(problem, build=build, images=images)


def _filled(one: MemberSet) -> MemberSet:
    spare = -len(one.luminosity) % GROUP
    pad = lambda values, value: jnp.pad(values, (0, spare), constant_values=value)
    return replace(
        one,
        theta=jnp.pad(one.theta, ((0, spare), (0, 0)), constant_values=_FAR),
        luminosity=pad(one.luminosity, _FAINT),
        e=pad(one.e, 0.0),
        pa=pad(one.pa, 0.0),
    )
