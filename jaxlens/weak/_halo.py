"""A spherical NFW halo fitted to a profile of tangential shear."""

import math
from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx

from jaxlens import lens as _lens
from jaxlens._types import Array, Bool, Float, Int, Scalar, ScalarLike, Values
from jaxlens.cosmology import LensPlane
from jaxlens.lens import Component, Lens
from jaxlens.profiles import nfw
from jaxlens.weak._catalogue import Depth
from jaxlens.weak._profile import TangentialProfile

LOG_MASS, LOG_C = (11.0, 17.0), (-1.0, 2.0)
"""Ranges of log10 M/Msun and log10 c outside of which a fit has found nothing."""

TOLERANCE = 1e-6
"""Of log10 M and log10 c between steps; at 1e-7 the differences of chi^2 drown in rounding."""


class Prior(NamedTuple):
    """A normal prior.

    Attributes:
        mean, sigma: of the number itself; sigma = 0 holds it fixed.
    """

    mean: float
    sigma: float

    def checked(self, name: str) -> "Prior":
        """Itself, if it can be used."""
        if not (math.isfinite(self.mean) and 0.0 <= self.sigma < math.inf):
            raise ValueError(f"`{name}` is {self}; give a finite mean and a sigma >= 0 (0 holds it fixed).")
        return self


class HaloFit(eqx.Module):
    """Mass and concentration of a halo by its shear.

    Attributes:
        mass: M_Delta, `()`, Msun, without h.
        concentration: r_Delta/r_s, `()`.
        calibration: factor on the shear of the model, `()`.
        covariance: of (log10 mass, log10 concentration, calibration), `(3, 3)`; rows of a fixed
            number are 0.
        chi2: of the bins, `()`, priors not included.
        n_dof: bins with galaxies less free numbers without a prior, `()`.
        converged: whether the optimum was found and lies in a sensible range, `()`. If not, the numbers
            are where the search ended.
        steps: of Levenberg-Marquardt, `()`.
    """

    mass: Scalar
    concentration: Scalar
    calibration: Scalar
    covariance: Float[Array, "3 3"]
    chi2: Scalar
    n_dof: Int[Array, ""]
    converged: Bool[Array, ""]
    steps: Int[Array, ""]

    @property
    def errors(self) -> tuple[Array, Array, Array]:
        """1-sigma errors of mass [Msun], concentration and calibration (linear, from the covariance)."""
        spread = jnp.sqrt(jnp.diagonal(self.covariance))
        ln10 = jnp.log(10.0)
        return self.mass * ln10 * spread[0], self.concentration * ln10 * spread[1], spread[2]


@partial(jax.jit, static_argnames="definition")
def halo_shear(
    r: Values,
    mass: ScalarLike,
    concentration: ScalarLike,
    plane: LensPlane,
    depth: Depth,
    *,
    definition: str | float = 200.0,
) -> Values:
    """Tangential reduced shear of a spherical NFW halo, averaged over the sources' redshifts.

    g_t = b gamma_t/(1 - f b kappa), b = <D_LS/D_S>, f = <b^2>/<b>^2 (Seitz & Schneider 1997), with gamma_t
    and kappa of the package's NFW. Between the critical curves, where |g_t| > 1, galaxies show 1/g_t.

    Args:
        r: radii, `(...)`, arcsec.
        mass: M_Delta, Msun.
        concentration: r_Delta/r_s.
        plane: the lens plane.
        depth: moments of the sources' D_LS/D_S.
        definition: overdensity as for `profiles.nfw.from_mass`; 200 is M_200c, `"bryan_norman"` the
            virial mass.

    Returns:
        g_t, `(...)`, or 1/g_t where that is less: between -1 and 1.
    """
    halo = Lens(halo=Component(nfw.from_mass(mass, concentration, plane, definition=definition)))
    kappa, gamma = _lens.kappa_and_gamma(halo, jnp.stack([r, jnp.zeros_like(r)], axis=-1))
    shear, rest = -depth.mean * gamma.real, 1.0 - depth.factor * depth.mean * kappa
    plain = jnp.abs(shear) <= jnp.abs(rest)
    return jnp.where(plain, shear, rest) / jnp.where(plain, rest, shear)


@partial(jax.jit, static_argnames="definition")
def fitted_shear(
    fit: HaloFit,
    r: Float[Array, " b"],
    plane: LensPlane,
    depth: Depth,
    *,
    definition: str | float = 200.0,
) -> tuple[Float[Array, " b"], Float[Array, " b"]]:
    """The shear of a fit and its 1-sigma error, propagated linearly from the covariance, each `(b,)`.

    Args:
        fit: the fit.
        r: radii, `(b,)`, arcsec.
        plane, depth, definition: as for `fit_halo`.
    """

    def model(u: Array) -> Array:
        return u[2] * halo_shear(r, 10.0 ** u[0], 10.0 ** u[1], plane, depth, definition=definition)

    u = jnp.stack([jnp.log10(fit.mass), jnp.log10(fit.concentration), fit.calibration])
    slope = jax.jacfwd(model)(u)
    variance = jnp.sum(jnp.matmul(slope, fit.covariance, precision="highest") * slope, axis=1)
    return model(u), jnp.sqrt(jnp.maximum(variance, 0.0))


def fit_halo(
    profile: TangentialProfile,
    plane: LensPlane,
    depth: Depth,
    *,
    definition: str | float = 200.0,
    concentration: Prior | None = None,
    calibration: Prior | None = None,
    sigma: Float[Array, " b"] | None = None,
    start: tuple[float, float] = (5e14, 4.0),
    max_steps: int = 100,
) -> HaloFit:
    """Fit M and c of a spherical NFW to a tangential profile by Levenberg-Marquardt.

    The free numbers are log10 M, log10 c and, if its prior has a width, the calibration of the shapes. Bins
    are independent; the model is evaluated at their mean radius. A field smaller than r_s hardly constrains
    c: give it a prior. Errors are those of the linearised model at the optimum.

    Args:
        profile: tangential shear, `(b,)` bins.
        plane: the lens plane.
        depth: moments of the sources' D_LS/D_S.
        definition: overdensity that M and c refer to: 200 for M_200c, `"bryan_norman"` for the virial mass.
        concentration: normal prior on log10 c; none: free; a sigma of 0 fixes it.
        calibration: normal prior on the factor between the measured shear and that of the model; none: 1.
        sigma: errors of the bins, `(b,)`, e.g. from `bootstrap`; else those of the profile.
        start: mass [Msun] and concentration to start from.
        max_steps: reaching it is not an error but `converged = False`.

    Returns:
        The fit. Bins with an infinite error have no influence.

    Raises:
        TypeError: in single precision, in which the derivatives are too coarse to converge.
        ValueError: for a prior with a negative or infinite sigma.
    """
    if profile.g_t.dtype != jnp.float64:
        raise TypeError(
            f"The profile is {profile.g_t.dtype}; the fit needs float64. "
            'Add `jax.config.update("jax_enable_x64", True)` before the first array is made.'
        )
    factor = (Prior(1.0, 0.0) if calibration is None else calibration).checked("calibration")
    log_c = None if concentration is None else concentration.checked("concentration")
    # What has no prior needs none of its numbers.
    priors = jnp.asarray([log_c or Prior(0.0, 1.0), factor], profile.g_t.dtype)
    begin = jnp.append(jnp.log10(jnp.asarray(start, profile.g_t.dtype)), priors[1, 0])
    if log_c is not None and log_c.sigma == 0.0:
        begin = begin.at[1].set(log_c.mean)
    return _fit(
        profile,
        profile.sigma_t if sigma is None else sigma,
        plane,
        depth,
        begin,
        priors,
        definition,
        tuple(name for name, prior in (("c", log_c), ("f", factor)) if prior is None or prior.sigma > 0.0),
        log_c is not None,
        max_steps,
    )


@partial(jax.jit, static_argnums=(6, 7, 8, 9))
def _fit(
    profile: TangentialProfile,
    sigma: Array,
    plane: LensPlane,
    depth: Depth,
    start: Array,
    priors: Array,
    definition: str | float,
    free: tuple[str, ...],
    known_c: bool,
    max_steps: int,
) -> HaloFit:
    """The fit; `start` is (log10 M, log10 c, calibration), `priors` are those of the latter two."""
    used = jnp.isfinite(sigma) & (profile.count > 0)
    # A bin without weight: residual exactly 0, never 0 times infinity.
    per_sigma = jnp.where(used, 1.0 / jnp.where(used, sigma, 1.0), 0.0)
    places = np.array([0] + [1] * ("c" in free) + [2] * ("f" in free))
    bound = [place for place in places[1:] if place == 2 or known_c]

    def whole(u: Array) -> Array:
        return start.at[places].set(u)

    def bins(u: Array) -> Array:
        log_m, log_c, factor = whole(u)
        model = halo_shear(profile.r, 10.0**log_m, 10.0**log_c, plane, depth, definition=definition)
        return (profile.g_t - factor * model) * per_sigma

    def rows(u: Array) -> Array:
        off = [(whole(u)[place] - priors[place - 1, 0]) / priors[place - 1, 1] for place in bound]
        return jnp.concatenate([bins(u), *(one[None] for one in off)])

    solver = optx.LevenbergMarquardt(rtol=TOLERANCE, atol=TOLERANCE)
    solution = optx.least_squares(
        lambda u, _: rows(u), solver, start[places], options={"jac": "fwd"}, max_steps=max_steps, throw=False
    )
    log_m, log_c, factor = whole(solution.value)

    def twice(u: Array) -> tuple[Array, Array]:
        found = rows(u)
        return found, found

    jacobian, found = jax.jacfwd(twice, has_aux=True)(solution.value)
    normal = jnp.matmul(jacobian.T, jacobian, precision="highest")
    covariance = jnp.zeros((3, 3), start.dtype).at[np.ix_(places, places)].set(jnp.linalg.inv(normal))
    converged = (
        (solution.result == optx.RESULTS.successful)
        & (log_m > LOG_MASS[0])
        & (log_m < LOG_MASS[1])
        & (log_c > LOG_C[0])
        & (log_c < LOG_C[1])
        & jnp.all(jnp.isfinite(covariance))
    )
    return HaloFit(
        mass=10.0**log_m,
        concentration=10.0**log_c,
        calibration=factor,
        covariance=covariance,
        chi2=jnp.sum(found[: len(per_sigma)] ** 2),
        n_dof=jnp.sum(used) - (len(places) - len(bound)),
        converged=converged,
        steps=solution.stats["num_steps"],
    )
