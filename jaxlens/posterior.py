"""Draws of a fitted lens: made, written, and read back without the fit.

They are **Laplace draws**: normal about the best fit, not samples of the posterior. Where the posterior is
not normal they fit the images far worse than it allows, and errors made of them are too large; each draw
comes with its chi^2, and `Quality` says when that is so.

The file `posterior.npz` holds `n_draws`; for every field of the lens that differs between the draws, an array
`(draws, n)` (`(draws, n, 2)` for centres) under the name `component/field`: the fields of the profile,
`centre` and `pa`, in the units of `model.toml` beside it, where everything else stands; and the source-plane
chi^2 of every draw (`chi2`), of the best fit (`chi2_best`), and how far it should rise (`expected_rise`).
There are no pickled objects in it, so any program can read it, and nothing of the fit is needed to rebuild a
lens.
"""

import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxlens import lens as _lens
from jaxlens import radial
from jaxlens._draws import FAR, N_DRAWS, Draws, Quality, draw_lenses, draw_numbers, draws
from jaxlens._types import Array, Float, Points, ScalarLike, Values
from jaxlens.cosmology import LensPlane
from jaxlens.io import atomic
from jaxlens.lens import Component, Lens

__all__ = [
    "FAR",
    "MASS_RADII_KPC",
    "MODEL",
    "N_DRAWS",
    "POSTERIOR",
    "Draws",
    "Quality",
    "draw_lenses",
    "draw_numbers",
    "draws",
    "kappa_draws",
    "kappa_moments",
    "mass_table",
    "masses",
    "read_posterior",
    "read_quality",
    "write_posterior",
]

MODEL, POSTERIOR = "model.toml", "posterior.npz"
"""Files of a result directory: the best lens, and its draws."""

MASS_RADII_KPC = (25.0, 50.0, 75.0, 100.0, 150.0, 200.0, 250.0, 300.0)
"""Radii of `masses.ecsv`, kpc."""

_PLAIN = ("n_draws", "chi2", "chi2_best", "expected_rise")
# Names in the file that are no fields of the lens.


@jax.jit
def kappa_draws(draws: Lens, theta: Points, dls_ds: ScalarLike = 1.0) -> Array:
    """Convergence of every draw, one after the other, `(draws, ...)`.

    Memory: 8 bytes for each draw and position; `kappa_moments` needs two maps, however many draws there are.

    Args:
        draws: a lens with a leading axis of draws on every array, see `draw_lenses`.
        theta: positions, `(..., 2)`, arcsec.
        dls_ds: distance ratio of the source.
    """
    return jax.lax.map(lambda one: dls_ds * _lens.kappa(one, theta), draws)


@jax.jit
def kappa_moments(draws: Lens, theta: Points, dls_ds: ScalarLike = 1.0) -> tuple[Values, Values]:
    """Mean and standard deviation (n - 1) of the convergence over the draws, each `(...)`, in one pass.

    Args:
        draws: a lens with a leading axis of draws on every array, at least two.
        theta: positions, `(..., 2)`, arcsec.
        dls_ds: distance ratio of the source.
    """

    def step(state: tuple[Array, Array, Array], one: Lens) -> tuple[tuple[Array, Array, Array], None]:
        count, mean, squares = state
        value = dls_ds * _lens.kappa(one, theta)
        count = count + 1.0
        change = value - mean  # Welford: no difference of large sums
        mean = mean + change / count
        return (count, mean, squares + change * (value - mean)), None

    zero = jnp.zeros(theta.shape[:-1], theta.dtype)
    (count, mean, squares), _ = jax.lax.scan(step, (jnp.zeros((), theta.dtype), zero, zero), draws)
    return mean, jnp.sqrt(squares / (count - 1.0))


@eqx.filter_jit
def masses(
    draws: Lens,
    plane: LensPlane,
    radius: Float[Array, " r"],
    *,
    centre: tuple[ScalarLike, ScalarLike] = (0.0, 0.0),
) -> Float[Array, "d r"]:
    """Projected mass inside circles of every draw, Msun; its spread over the draws is the error of the mass.

    The errors of the numbers of a lens say little about it: haloes, galaxies and members trade mass with one
    another, while the images fix the sum.

    Args:
        draws: a lens with a leading axis of draws, of `draw_lenses` or `read_posterior`.
        plane: its plane.
        radius: radii, `(r,)`, arcsec; divide kpc by `plane.kpc_per_arcsec`.
        centre: of the circles, arcsec.
    """
    # One draw after another: a circle of all draws and members at once would be gigabytes.
    return jax.lax.map(lambda one: radial.mass_within(one, plane, radius, centre=centre), draws)


def mass_table(
    lens: Lens, draws: Lens, plane: LensPlane, theta: np.ndarray, radii_kpc: Sequence[float] = MASS_RADII_KPC
) -> dict[str, np.ndarray]:
    """Columns of `masses.ecsv`: projected mass about the origin, its spread over draws, images inside.

    The error is the standard deviation of the draws, lo and hi are their 16th and 84th percentile. A mass
    beyond all images is an extrapolation by the profiles of the model, whatever its error.

    Args:
        lens: the best lens.
        draws: see `masses`.
        plane: their plane.
        theta: observed images, `(i, 2)`, arcsec.
        radii_kpc: radii, kpc.
    """
    radius = jnp.asarray(radii_kpc) / plane.kpc_per_arcsec
    # The best lens as one more draw: its mass by the same program.
    every = jax.tree.map(lambda one, more: np.concatenate([more, np.asarray(one)[None]]), lens, draws)
    *many, best = np.asarray(masses(every, plane, radius))
    many = np.stack(many)
    low, high = np.percentile(many, [15.865, 84.135], axis=0)
    return {
        "r_kpc": np.array(radii_kpc),
        "r_arcsec": np.asarray(radius),
        "mass_msun": best,
        "mass_error_msun": many.std(axis=0),
        "mass_lo_msun": low,
        "mass_hi_msun": high,
        "n_images": np.sum(np.linalg.norm(theta, axis=1)[:, None] < np.asarray(radius), axis=0),
    }


def write_posterior(path: str | Path, lens: Lens, draws: Lens, quality: Quality | None = None) -> None:
    """Write the fields in which draws differ from the lens; see the head of this module.

    Args:
        path: the file (`.npz`); replaced in one step.
        lens: the lens of `model.toml`.
        draws: the same with a leading axis of draws.
        quality: how well they fit, if it is known.
    """
    fields: dict[str, Any] = {"n_draws": np.array(len(jax.tree.leaves(draws)[0]))}
    if quality is not None:
        fields |= {name: np.asarray(value) for name, value in quality._asdict().items()}
    for name, component in lens.components.items():
        for field, value in _fields(component).items():
            many = np.asarray(_fields(draws.components[name])[field])
            if not np.array_equal(many, np.broadcast_to(np.asarray(value), many.shape)):
                fields[f"{name}/{field}"] = many
    with atomic(path) as temporary:
        np.savez_compressed(temporary, **fields)


def _read(path: Path) -> dict[str, np.ndarray]:
    """All arrays of a file of draws."""
    if not path.exists():
        raise FileNotFoundError(f"{path} does not exist; fit the cluster again to make it.")
    try:
        with np.load(path, allow_pickle=False) as file:
            return {name: file[name] for name in file.files}
    except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise ValueError(f"{path} is not a file of draws ({error}); fit the cluster again.") from error


def read_quality(path: str | Path) -> Quality | None:
    """How well the draws of a file fit; None if it does not say.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is not such a file.
    """
    found = _read(Path(path))
    if not all(name in found for name in Quality._fields):
        return None
    return Quality(found["chi2"], float(found["chi2_best"]), float(found["expected_rise"]))


def read_posterior(path: str | Path, lens: Lens) -> Lens:
    """The draws of a result directory: `lens` with a leading axis on every array.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is not such a file, or belongs to another lens.
    """
    every = _read(Path(path))
    found = {name: value for name, value in every.items() if name not in _PLAIN}
    counts = {len(value) for value in found.values()} | {
        int(n) for n in every.get("n_draws", np.zeros(0)).flat
    }
    known = {f"{name}/{field}" for name, one in lens.components.items() for field in _fields(one)}
    if len(counts) != 1 or not set(found) <= known:
        raise ValueError(
            f"{path} holds {', '.join(sorted(found)) or 'nothing'}, which are not fields of the lens beside "
            "it; fit the cluster again."
        )
    (n,) = counts
    components = {}
    for name, component in lens.components.items():
        fields = {}
        for field, value in _fields(component).items():
            many = found.get(f"{name}/{field}")
            if many is not None and many.shape[1:] != value.shape:
                raise ValueError(
                    f"{path}: {name}/{field} has shape {many.shape}, but the lens beside it {value.shape}; "
                    "fit the cluster again."
                )
            fields[field] = jnp.broadcast_to(value, (n, *value.shape)) if many is None else jnp.asarray(many)
        components[name] = eqx.tree_at(
            lambda one: [
                *(getattr(one.params, f) for f in one.params.__dataclass_fields__),
                one.centre,
                one.pa,
            ],
            component,
            list(fields.values()),
        )
    return eqx.tree_at(lambda one: one.components, lens, components)


def _fields(component: Component) -> dict[str, Array]:
    params = component.params
    own = {field: getattr(params, field) for field in params.__dataclass_fields__}
    return {**own, "centre": component.centre, "pa": component.pa}
