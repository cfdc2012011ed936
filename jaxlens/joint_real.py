"""lambda, the calibration of the shapes and the strong-lensing model from one least-squares problem.

What is compared. Reduced shear is invariant under the mass-sheet transformation: gamma/(1 - kappa) of the
model against the shapes would hold no lambda at all. The images fix kappa_sl(u), a model whose profiles
end; the reconstruction from the shapes is a convergence whose mass sheet is a convention of its padding and
ridge. So the rows are, for the pixels of an annulus,

    d(u, lambda, m) = kappa_wl[g/m] - {1 + lambda [kappa_sl(u) - 1]} - b,     r = (m/m_0) L^-1 d,   C = L L^T

with g the measured mean ellipticities, m their calibration (it enters before the reconstruction, which is not
linear in g/m), kappa_wl five iterations of scheme A2, kappa_sl smoothed alike, and b the error of the
method: the reconstruction of the model's own reduced shear less 1 + lambda_0 (kappa_sl - 1), both at the
model of the images alone. A model that is right and a map without noise give lambda = lambda_0, what the
convention makes of "no mass sheet", and m = the true calibration.

C is the covariance of the map for m = m_0, the mean of the prior: K V K^T + <b^2>, K = d kappa_wl/d g at the
model's reduced shear and V that of ellipticities turned at random, which are independent between pixels.
<b^2>, on the diagonal, keeps modes that the smoothing has erased from counting: the method is not known
better.

The factor m/m_0. The noise of g/m is n/m, so the covariance of the map is (m_0/m)^2 C. With C alone a large
m would shrink the noise, and the fit would be drawn there: by N (sigma_m/m_0)^2 of itself for N modes of
noise, more than its own error. As a density of g, the determinant of C cancels that of d kappa/d g, so that
no term in ln m remains.
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxlens import strong
from jaxlens._types import Array, Float, Int, Map, Scalar, ScalarLike
from jaxlens.lens import Lens
from jaxlens.maps_real import Inversion, Maps, ellipticity_variance, maps_of, reduced
from jaxlens.workflow_real import Sample

STEPS, HALVINGS = 20, 8
"""Most Gauss-Newton steps, and halvings of one that does not lower chi^2."""

DECREMENT = 1e-6
"""Expected fall of chi^2 below which the fit has ended: a thousandth of a standard deviation."""


class MapData(eqx.Module):
    """The shear map as data of the joint fit; see the head of this module.

    Attributes:
        g: mean ellipticities before calibration, `(y, x)`.
        invert: the reconstruction.
        place: pixels of the annulus, places in the flattened map, `(p,)`.
        root: L, `(p, p)`.
        bias: b, `(p,)`.
        dls_ds: D_LS/D_S of the map, `()`.
        calibration: m_0 and the standard deviation of its prior, `(2,)`.
    """

    g: Array
    invert: Inversion
    place: Int[Array, " p"]
    root: Float[Array, "p p"]
    bias: Float[Array, " p"]
    dls_ds: Scalar
    calibration: Float[Array, "2"]


class Joint(NamedTuple):
    """Result of `infer`.

    Attributes:
        lam, m: mass-sheet factor of the map against the model, and calibration of the shapes.
        lam_error, m_error: Laplace errors, everything else free.
        correlation: of both.
        lam_error_fixed: error of lambda if m were known.
        u: numbers of the strong-lensing model, `(n,)`.
        shift: by how many of the errors of the images alone they moved, the largest.
        covariance: of (u, lambda, m), `(n + 2, n + 2)`.
        chi2_images: of the images, without priors.
        chi2_map, n_map: of the pixels of the map, and their number; neighbours are alike, but whitened.
        lam_expected: lambda_0.
        converged: whether the last step expected less than `DECREMENT`.
    """

    lam: float
    m: float
    lam_error: float
    m_error: float
    correlation: float
    lam_error_fixed: float
    u: np.ndarray
    shift: float
    covariance: np.ndarray
    chi2_images: float
    chi2_map: float
    n_map: int
    lam_expected: float
    converged: bool


@eqx.filter_jit
def noise_covariance(invert: Inversion, g: Array, variance: Map, place: Int[Array, " p"]) -> Array:
    """K V K^T of pixels of the reconstruction of g `(y, x)`, `(p, p)`; V for both components alike."""

    def pixels(parts: Array) -> Array:
        return invert.one(jax.lax.complex(parts[0], parts[1])).ravel()[place]

    columns = jax.jacrev(pixels)(jnp.stack([g.real, g.imag]))
    scaled = columns * jnp.sqrt(variance)[None, None]
    flat = scaled.reshape(len(place), -1)
    return flat @ flat.T


def map_data(
    sample: Sample, invert: Inversion, model: Maps, own: Map, inner: Map, lam_expected: float
) -> MapData:
    """The data of one sample.

    Args:
        sample: the galaxies.
        invert: their reconstruction.
        model: maps of the lens of the images alone.
        own: reconstruction of its reduced shear, `(y, x)`.
        inner: 1 in the pixels to be compared, `(y, x)`.
        lam_expected: lambda_0.
    """
    mean, width = sample.calibration
    ratio = sample.dls_ds
    place = jnp.asarray(np.flatnonzero(np.asarray(inner).ravel() > 0.0))
    bias = (own - 1.0 - lam_expected * (ratio * model.smooth - 1.0)).ravel()[place]
    variance = ellipticity_variance(sample) / mean**2
    noise = noise_covariance(invert, reduced(model, ratio), variance, place)
    total = noise + jnp.mean(bias**2) * jnp.eye(len(place))
    return MapData(
        g=jnp.asarray(sample.field.shear.g),
        invert=invert,
        place=place,
        root=jnp.linalg.cholesky(total),
        bias=bias,
        dls_ds=jnp.asarray(ratio),
        calibration=jnp.array([mean, width]),
    )


def rows_of(smooth: Map, lam: ScalarLike, m: ScalarLike, data: MapData) -> Float[Array, " p"]:
    """r of the head of this module, `(p,)`, from the smoothed convergence `(y, x)` for D_LS/D_S = 1."""
    expected = 1.0 + lam * (data.dls_ds * smooth - 1.0)
    apart = (data.invert.one(data.g / m) - expected).ravel()[data.place] - data.bias
    return jax.scipy.linalg.solve_triangular(data.root, apart, lower=True) * (m / data.calibration[0])


def map_residuals(lens: Lens, lam: ScalarLike, m: ScalarLike, data: MapData) -> Float[Array, " p"]:
    """The same from a lens; differentiable in lens, lambda and m."""
    return rows_of(maps_of(lens, data.invert.grid, data.invert.smoothing).smooth, lam, m, data)


def residuals(v: Array, problem: strong.Problem, data: MapData) -> Array:
    """All rows: images and priors of the model, pixels of the map, prior of the calibration.

    Args:
        v: numbers of the model, lambda, m, `(n + 2,)`.
        problem: the images.
        data: the map.
    """
    u, lam, m = v[:-2], v[-2], v[-1]
    mean, width = data.calibration
    return jnp.concatenate(
        [
            strong.residuals(u, problem),
            map_residuals(problem.predict(u).lens, lam, m, data),
            ((m - mean) / jnp.maximum(width, 1e-9))[None],  # a width of 0 holds m
        ]
    )


def slopes(rows: Callable[[Array], Array], v: Array) -> tuple[Array, Array]:
    """Rows `(k,)` and their Jacobian `(k, n)` by forward mode; nothing of the way is kept."""

    def twice(at: Array) -> tuple[Array, Array]:
        values = rows(at)
        return values, values

    jacobian, values = jax.jacfwd(twice, has_aux=True)(v)
    return values, jacobian


def gauss_newton(
    jacobian: Callable[[Array], tuple[Array, Array]], v: Array
) -> tuple[Array, Array, Array, bool]:
    """Minimum of the sum of squares from v `(n,)`, rows and J^T J there, and whether it has converged.

    Args:
        jacobian: rows `(k,)` and their Jacobian `(k, n)` at v, see `slopes`.
        v: start, near the minimum.
    """
    r, columns = jacobian(v)
    for _ in range(STEPS):
        step = jnp.linalg.lstsq(columns, r)[0]
        fall = float(jnp.sum((columns @ step) ** 2))
        if fall < DECREMENT:
            return v, r, columns.T @ columns, True
        for halving in range(HALVINGS):
            trial = v - step * 0.5**halving
            new, slope = jacobian(trial)
            if float(new @ new) < float(r @ r):
                v, r, columns = trial, new, slope
                break
        else:
            break
    return v, r, columns.T @ columns, False


@eqx.filter_jit
def _slopes(v: Array, problem: strong.Problem, data: MapData) -> tuple[Array, Array]:
    return slopes(lambda at: residuals(at, problem, data), v)


def infer(problem: strong.Problem, fit: strong.StrongFit, data: MapData, lam_expected: float) -> Joint:
    """Gauss-Newton on images and map together, from the fit of the images alone, with Laplace errors.

    Redshifts of the galaxies are held. Numbers of the model at their bound are held in the errors.

    Args:
        problem: the images.
        fit: their fit.
        data: the map.
        lam_expected: lambda_0, see the head of this module.
    """
    start = jnp.concatenate([fit.u, jnp.array([lam_expected]), data.calibration[:1]])
    v, rows, information, converged = gauss_newton(lambda at: _slopes(at, problem, data), start)
    held = jnp.concatenate([strong.edge(problem.bounds, v[:-2]), jnp.zeros(2, bool)])
    covariance = np.asarray(strong.without_edges(strong.laplace_covariance(information), held))
    error = np.sqrt(np.diag(covariance))
    before = np.sqrt(np.diag(np.asarray(fit.covariance)))
    rows = np.asarray(rows)
    n_map = len(data.place)
    images = 2 * problem.images.n_images
    moved = np.abs(np.asarray(v[:-2] - fit.u)) / np.maximum(before, 1e-12)
    lam_var, m_var, mixed = covariance[-2, -2], covariance[-1, -1], covariance[-2, -1]
    return Joint(
        lam=float(v[-2]),
        m=float(v[-1]),
        lam_error=float(error[-2]),
        m_error=float(error[-1]),
        correlation=float(mixed / max(error[-2] * error[-1], 1e-30)),
        lam_error_fixed=float(np.sqrt(max(lam_var - mixed**2 / max(m_var, 1e-30), 0.0))),
        u=np.asarray(v[:-2]),
        shift=float(np.max(np.where(np.asarray(held)[:-2], 0.0, moved), initial=0.0)),
        covariance=covariance,
        chi2_images=float(np.sum(rows[:images] ** 2)),
        chi2_map=float(np.sum(rows[-1 - n_map : -1] ** 2)),
        n_map=n_map,
        lam_expected=lam_expected,
        converged=converged,
    )
