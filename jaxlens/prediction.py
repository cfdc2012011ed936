"""Counter-images of one image: where else the source is seen, how magnified, and when.

Errors come from draws of the lens (`jaxlens.posterior`), where there are any.
"""

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxlens import io, lens_equation
from jaxlens import lens as lensing
from jaxlens._fitted import Model, load, position
from jaxlens._types import Array, Float, Points
from jaxlens.cosmology import LensPlane
from jaxlens.io import Reference
from jaxlens.lens import Lens

__all__ = ["N_POSITIONS", "CounterImages", "Model", "counter_images", "load", "position", "table"]

N_POSITIONS = 256
"""Places that are drawn for the error of a position when the lens has no draws."""

_LEAST = 60.0  # smallest half width of the window that is searched, arcsec (our choice)
_SAME = 1e-5
# A solution this close to a position is that position, arcsec: the solver's last step is 1e-10, and it makes
# one of solutions that are 1e-6 apart.

_WIDER, _TIMES = 1.6, 3  # by which it grows, and how often, while the number of images is not odd


@dataclass(frozen=True)
class CounterImages:
    """All images of one source, earliest first. NumPy arrays.

    Attributes:
        beta: the source, `(2,)`, arcsec.
        theta: positions, `(k, 2)`, arcsec.
        mu: signed magnifications, `(k,)`.
        delay: arrival time after the first image, `(k,)`, days.
        kind: `minimum`, `saddle` or `maximum` of the arrival time, `(k,)`.
        given: index of the image that was asked about.
        complete: whether no search overflowed and the images add up to what the lens demands.
        theta_error, mu_error, delay_error: half the width that holds 68 % of the draws, `(k, 2)`, `(k,)`,
            `(k,)`; NaN without draws. The position of the image that was asked about has none (NaN): the
            source is that place traced back through each draw, so that every draw has it exactly there.
        found: share of draws that have the image, `(k,)`; NaN without draws. The other errors are of those.
        n_draws: number of draws.
    """

    beta: np.ndarray
    theta: np.ndarray
    mu: np.ndarray
    delay: np.ndarray
    kind: tuple[str, ...]
    given: int
    complete: bool
    theta_error: np.ndarray
    mu_error: np.ndarray
    delay_error: np.ndarray
    found: np.ndarray
    n_draws: int


def counter_images(
    lens: Lens,
    plane: LensPlane,
    theta: Float[Any, "2"],
    z_s: float,
    *,
    draws: Lens | None = None,
    half_width: float | None = None,
    sigma: float = 0.0,
    seed: int = 0,
) -> CounterImages:
    """The images of the source whose image is at `theta`.

    The source is theta traced back through the lens (through each draw's own lens for the errors). Without
    `sigma` the given image has no error of position: it is at theta in every draw. An
    image of a draw is the one that Newton's method reaches from the image of the best lens, if it has the
    same parity.

    Args:
        lens: the lens.
        plane: its plane.
        theta: position of the known image, `(2,)`, arcsec.
        z_s: redshift of the source.
        draws: the lens with a leading axis of draws on every array, or None.
        half_width: half the side of the window about the origin that is searched, arcsec; without it, at
            least 60 arcsec and twice the distance of `theta`, and wider while an image must be missing.
        sigma: error of the position on each axis, arcsec: every draw traces back a place of its own, normal
            about `theta`, so that the errors of all images hold it (of `N_POSITIONS` places without draws).
        seed: of these places.

    Returns:
        The images. Not differentiable (it selects images).

    Raises:
        ValueError: if `sigma` is negative, the source is not behind the lens, `theta` is outside the window
            or not finite, or the images of its source are elsewhere (at a centre without a core, or on a
            critical curve).
        TypeError: in single precision.
    """
    at = np.asarray(theta, float)
    if not np.isfinite(at).all():
        raise ValueError(f"`theta` is {at.tolist()}; give finite numbers of arcsec.")
    if not (sigma >= 0.0 and np.isfinite(sigma)):
        raise ValueError(f"`sigma` is {sigma:g}, not a position error; give arcsec, or leave it out.")
    if not z_s > float(plane.z_l):
        raise ValueError(
            f"`z_s` is {z_s:g}, not behind the lens at z = {float(plane.z_l):g}; give the source's redshift."
        )
    distance = float(np.abs(at).max())
    if half_width is not None and distance > half_width:
        raise ValueError(
            f"`theta` is {at.tolist()}, outside the window of half width {half_width:g}; widen it."
        )
    ratio = plane.dls_ds(z_s)
    where = jnp.asarray(at)
    beta = _traced(lens, where, ratio)
    width = half_width or max(_LEAST, 2.0 * distance)
    images = _search(lens, beta, ratio, width)
    for _ in range(_TIMES if half_width is None else 0):
        if _odd(images):
            break
        width *= _WIDER
        images = _search(lens, beta, ratio, width)
    valid = np.asarray(images.valid)
    # Selected on the host: programs of padded arrays serve every number of images.
    padded = np.where(valid[:, None], np.asarray(images.theta), at)
    best = padded[valid]
    apart = np.linalg.norm(best - at, axis=1)
    if not (apart < _SAME).any():
        nearest = f"; the nearest image of its source is {apart.min():.3g} arcsec away" if len(apart) else ""
        raise ValueError(
            f"`theta` is {at.tolist()}, where this lens has no image{nearest}. Is it a centre without a "
            "core, or on a critical curve? Give another position."
        )
    behind = jnp.asarray(float(z_s))
    mu, delay, trace = (
        np.asarray(v)[valid] for v in _properties(lens, plane, jnp.asarray(padded), ratio, behind)
    )
    spread = _none(len(mu))
    if draws is not None or sigma > 0.0:
        if draws is None:
            draws = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (N_POSITIONS, *leaf.shape)), lens)
        n = len(jax.tree.leaves(draws)[0])
        places = jnp.asarray(at + sigma * np.random.default_rng(seed).standard_normal((n, 2)))
        drawn = _each_draw(draws, plane, places, jnp.asarray(padded), ratio, behind)
        spread = _spread([np.asarray(v)[:, valid] for v in drawn], mu)
    kinds = ["saddle" if m < 0 else "minimum" if t > 0 else "maximum" for m, t in zip(mu, trace, strict=True)]
    given = int(np.argmin(apart))
    if sigma == 0.0:
        spread["theta_error"][given] = np.nan
    return CounterImages(
        beta=np.asarray(beta),
        theta=best,
        mu=mu,
        delay=delay - delay[0],
        kind=tuple(kinds),
        given=given,
        complete=bool(images.parity_ok) and not bool(images.overflow) and _odd(images),
        **spread,
    )


def _search(lens: Lens, beta: Array, ratio: Array, width: float) -> lens_equation.ImageSet:
    tiling = lens_equation.tile(lens, half_width=width)
    return lens_equation.solve(lens, beta, ratio, tiling=tiling)


_traced = jax.jit(lensing.ray_trace)


def _odd(images: lens_equation.ImageSet) -> bool:
    return (int(images.valid.sum()) + int(images.hidden)) % 2 == 1


@jax.jit
def _properties(
    lens: Lens, plane: LensPlane, theta: Points, ratio: Array, z_s: Array
) -> tuple[Array, Array, Array]:
    """mu, arrival time [days] and trace of A at images `(k, 2)`."""
    a = lensing.jacobian(lens, theta, ratio)
    det = a[:, 0, 0] * a[:, 1, 1] - a[:, 0, 1] * a[:, 1, 0]
    return 1.0 / det, lensing.time_delay(lens, theta, plane, z_s), a[:, 0, 0] + a[:, 1, 1]


@jax.jit
def _each_draw(
    draws: Lens, plane: LensPlane, places: Float[Array, "d 2"], best: Points, ratio: Array, z_s: Array
) -> tuple[Array, Array, Array, Array]:
    """Images, whether they were found, mu and arrival time of every draw, each asked about its own place."""

    def one(given: tuple[Lens, Array]) -> tuple[Array, Array, Array, Array]:
        lens, where = given
        beta = lensing.ray_trace(lens, where, ratio)
        theta, hit = lens_equation.images_from(lens, best, jnp.broadcast_to(beta, best.shape), ratio)
        mu, delay, _ = _properties(lens, plane, theta, ratio, z_s)
        return theta, hit, mu, delay

    return jax.lax.map(one, (draws, places))


def _none(k: int) -> dict[str, Any]:
    """Errors of k images without draws."""
    errors = {name: np.full(k, np.nan) for name in ("mu_error", "delay_error", "found")}
    return {"theta_error": np.full((k, 2), np.nan), **errors, "n_draws": 0}


def _spread(drawn: list[np.ndarray], mu: np.ndarray) -> dict[str, Any]:
    """Errors of all images from what `_each_draw` found."""
    theta, hit, mus, delay = drawn
    hit = hit & (np.sign(mus) == np.sign(mu))
    # Delays are relative to the image that is first in the best lens, so both must be there.
    both = hit & hit[:, :1]
    return {
        "theta_error": np.stack([_half_width(theta[..., axis], hit) for axis in (0, 1)], axis=1),
        "mu_error": _half_width(mus, hit),
        "delay_error": _half_width(delay - delay[:, :1], both),
        "found": hit.mean(axis=0),
        "n_draws": len(hit),
    }


def _half_width(values: np.ndarray, keep: np.ndarray) -> np.ndarray:
    """Half the distance between the 16th and the 84th percentile of each column; NaN below three values."""
    out = np.full(values.shape[1], np.nan)
    for k in range(values.shape[1]):
        column = values[keep[:, k], k]
        if len(column) > 2:
            low, high = np.percentile(column, [15.865, 84.135])
            out[k] = 0.5 * (high - low)
    return out


def table(found: CounterImages, reference: Reference | None = None) -> dict[str, np.ndarray]:
    """Columns of the table that is printed and written, one row for each image."""
    columns = {
        "image": np.arange(1, len(found.mu) + 1),
        "x_arcsec": found.theta[:, 0],
        "y_arcsec": found.theta[:, 1],
    }
    if reference is not None:
        columns["ra_deg"], columns["dec_deg"] = io.sky(found.theta, reference)
    columns |= {
        "mu": found.mu,
        "kind": np.array(found.kind),
        "delay_days": found.delay,
        "given": np.arange(len(found.mu)) == found.given,
    }
    if found.n_draws:
        columns |= {
            "x_error_arcsec": found.theta_error[:, 0],
            "y_error_arcsec": found.theta_error[:, 1],
            "mu_error": found.mu_error,
            "delay_error_days": found.delay_error,
            "found": found.found,
        }
    return columns
