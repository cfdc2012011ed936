"""Counter-images of one image: where else the source is seen, how magnified, and when.

Errors come from draws of the lens (`jaxlens.posterior`), where there are any.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxlens import io, lens_equation
from jaxlens import lens as lensing
from jaxlens._types import Array, Float, Points
from jaxlens.cosmology import LensPlane
from jaxlens.io import Reference
from jaxlens.lens import Lens
from jaxlens.posterior import MODEL, POSTERIOR, read_posterior

_LEAST = 60.0  # smallest half width of the window that is searched, arcsec (our choice)
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
) -> CounterImages:
    """The images of the source whose image is at `theta`.

    The source is theta traced back through the lens (through each draw's own lens for the errors). An
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

    Returns:
        The images. Not differentiable (it selects images).

    Raises:
        ValueError: if the source is not behind the lens, or `theta` is outside the window or not finite.
        TypeError: in single precision.
    """
    at = np.asarray(theta, float)
    if not np.isfinite(at).all():
        raise ValueError(f"`theta` is {at.tolist()}; give finite numbers of arcsec.")
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
    beta = lensing.ray_trace(lens, where, ratio)
    width = half_width or max(_LEAST, 2.0 * distance)
    images = _search(lens, beta, ratio, width)
    for _ in range(_TIMES if half_width is None else 0):
        if _odd(images):
            break
        width *= _WIDER
        images = _search(lens, beta, ratio, width)
    if not (valid := np.asarray(images.valid)).any():
        raise ValueError(
            f"`theta` is {at.tolist()}, where this lens has no image; is it a centre without a core?"
        )
    best = images.theta[valid]
    mu, delay, trace = (np.asarray(v) for v in _properties(lens, plane, best, ratio, jnp.asarray(z_s)))
    spread = _spread(draws, plane, where, best, mu, ratio, z_s)
    kinds = ["saddle" if m < 0 else "minimum" if t > 0 else "maximum" for m, t in zip(mu, trace, strict=True)]
    given = int(np.argmin(np.linalg.norm(np.asarray(best) - at, axis=1)))
    spread["theta_error"][given] = np.nan
    return CounterImages(
        beta=np.asarray(beta),
        theta=np.asarray(best),
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
    draws: Lens, plane: LensPlane, where: Array, best: Points, ratio: Array, z_s: Array
) -> tuple[Array, Array, Array, Array]:
    def one(lens: Lens) -> tuple[Array, Array, Array, Array]:
        beta = lensing.ray_trace(lens, where, ratio)
        theta, hit = lens_equation.images_from(lens, best, jnp.broadcast_to(beta, best.shape), ratio)
        mu, delay, _ = _properties(lens, plane, theta, ratio, z_s)
        return theta, hit, mu, delay

    return jax.lax.map(one, draws)


def _spread(
    draws: Lens | None,
    plane: LensPlane,
    where: Array,
    best: Array,
    mu: np.ndarray,
    ratio: Array,
    z_s: float,
) -> dict[str, Any]:
    """Errors of all images from the draws."""
    k = len(mu)
    if draws is None:
        none = np.full(k, np.nan)
        return {
            "theta_error": np.full((k, 2), np.nan),
            "mu_error": none,
            "delay_error": none,
            "found": none,
            "n_draws": 0,
        }
    theta, hit, mus, delay = (
        np.asarray(v) for v in _each_draw(draws, plane, where, best, ratio, jnp.asarray(z_s))
    )
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


# --- files ------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Model:
    """What a `model.toml`, or the result directory that holds it, says.

    Attributes:
        path: the file.
        lens, plane: of the file.
        reference: (RA, Dec) of the origin in degrees, or None.
        draws: the posterior beside it, or None.
    """

    path: Path
    lens: Lens
    plane: LensPlane
    reference: Reference | None
    draws: Lens | None


def load(source: str | Path) -> Model:
    """Read a `model.toml`, or a result directory with its posterior.

    Raises:
        FileNotFoundError: if there is none.
        ValueError: naming file, key, value and remedy.
    """
    path = Path(source)
    if path.is_dir():
        path = path / MODEL
        if not path.exists():
            raise FileNotFoundError(
                f"{source} holds no {MODEL}; give a result directory of `jaxlens strong`, or a {MODEL}."
            )
    lens, plane = io.read_lens(path)
    posterior = path.with_name(POSTERIOR)
    draws = read_posterior(posterior, lens) if path.name == MODEL and posterior.exists() else None
    return Model(path, lens, plane, io.read_lens_reference(path), draws)


def position(
    model: Model, *, x: float | None, y: float | None, ra: float | None, dec: float | None
) -> np.ndarray:
    """The position `(2,)` in arcsec from x and y, or from RA and Dec in degrees.

    Raises:
        ValueError: unless exactly one pair is given, or if RA and Dec cannot be used.
    """
    if (x is None) != (y is None) or (ra is None) != (dec is None) or (x is None) == (ra is None):
        raise ValueError("Give the position once: --x and --y in arcsec, or --ra and --dec in degrees.")
    if x is not None and y is not None:
        return np.array([x, y])
    assert ra is not None and dec is not None
    if model.reference is None:
        raise ValueError(
            f"{model.path} has no reference point (keys ra_deg, dec_deg), about which RA and Dec would be "
            "projected; give --x and --y in arcsec."
        )
    theta = io.offsets(np.array([ra]), np.array([dec]), model.reference)[0]
    if not np.hypot(*theta) < 3600.0:
        raise ValueError(
            f"--ra {ra} --dec {dec} is more than a degree from the reference point {model.reference}; "
            "are they in degrees?"
        )
    return theta


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
