"""What is measured of one pair of reconstructions."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Bool

from jaxlens._types import Array, Float, Int, Map
from jaxlens.mass_sheet import Distribution, bandwidth, distribution, ratio, regauge
from jaxlens.monte_carlo._setup import Setup
from jaxlens.radial import RadialProfile, mean_in, profile_in, rmse_in
from jaxlens.transition import Moments, aligned, moments, shape_errors


class Measured(eqx.Module):
    """Numbers of a realisation (`*n` is empty), or of n of them; those of a bad one are NaN.

    Attributes:
        good: converged, finite, and all galaxies had room, `(*n,)`.
        empty: unmasked pixels without a galaxy, `(*n,)`.
        a2, k2: distribution of lambda_map of either method in each range, `(*n, range)`.
        rec: that of lambda_rec (A2).
        a2_profile, k2_profile, rec_profile: the same in annuli, `(*n, b)`.
        kappa: the corrected A2 map in annuli, `(*n, b)`.
        lam: lambda_P that corrected it, `(*n,)`.
        rmse: its error against the truth, `(*n, b)`.
        shape: that of the A2 map regauged to the truth, `(*n, b)`.
        noise2: mean square of the difference of the aligned map from that without noise, `(*n, b)`.
        moments: of its difference from the strong-lensing map, see `transition.moments`.
    """

    good: Bool[Array, "*n"]
    empty: Int[Array, "*n"]
    a2: Distribution
    k2: Distribution
    rec: Distribution
    a2_profile: RadialProfile
    k2_profile: RadialProfile
    rec_profile: RadialProfile
    kappa: RadialProfile
    lam: Float[Array, "*n"]
    rmse: Float[Array, "*n b"]
    shape: Float[Array, "*n b"]
    noise2: Float[Array, "*n b"]
    moments: Moments


def _stack(parts: list[Distribution]) -> Distribution:
    return jax.tree.map(lambda *each: jnp.stack(each), *parts)


def _in_ranges(kappa: Map, reference: Map, setup: Setup) -> tuple[Distribution, Map, Map]:
    found = ratio(kappa, reference, setup.weight)
    each = [distribution(*setup.sample(found.lam, found.weight, k)) for k in range(len(setup.pixels))]
    return _stack(each), found.lam, found.weight


def measure(
    kappas: dict[str, Map], setup: Setup, good: Array, empty: Array, clean: Map | None = None
) -> tuple[Measured, Map]:
    """Everything of one pair of reconstructions.

    Args:
        kappas: reconstructions A2 and K2, `(y, x)` each.
        setup: from `prepare`.
        good, empty: what is known of the draw, `()`.
        clean: aligned A2 map without noise, `(y, x)`, see `aligned_clean`; None if this is it.

    Returns:
        The numbers, and the corrected A2 map `(y, x)`.
    """
    rings = setup.rings
    a2, k2 = kappas["A2"], kappas["K2"]
    a2_all, a2_lam, a2_weight = _in_ranges(a2, setup.kappa_true, setup)
    k2_all, k2_lam, k2_weight = _in_ranges(k2, setup.kappa_true, setup)
    rec_all, rec_lam, rec_weight = _in_ranges(a2, setup.kappa_sl, setup)
    lam = getattr(rec_all, setup.correct_by)[0]
    corrected = regauge(a2, lam)
    shape = shape_errors(a2, setup.kappa_sl, setup.kappa_true, rings)
    compared = aligned(a2, setup.kappa_sl, rings)
    rest = jnp.zeros_like(a2) if clean is None else compared - clean
    found = Measured(
        good=good,
        empty=empty,
        a2=a2_all,
        k2=k2_all,
        rec=rec_all,
        a2_profile=profile_in(a2_lam, rings, a2_weight),
        k2_profile=profile_in(k2_lam, rings, k2_weight),
        rec_profile=profile_in(rec_lam, rings, rec_weight),
        kappa=profile_in(corrected, rings),
        lam=lam,
        rmse=rmse_in(corrected - setup.kappa_true, rings),
        shape=shape.wl,
        noise2=mean_in(rest**2, rings),
        moments=moments(compared, setup.kappa_sl, rings, setup.bias),
    )
    return found, corrected


def noiseless(setup: Setup) -> tuple[Measured, Map]:
    """`measure` of the maps without noise: the reference of all comparisons, and the corrected A2 map.

    The `clean` of `measure` is another map, `aligned_clean`.
    """
    return _noiseless(without_galaxies(setup))


@eqx.filter_jit
def _noiseless(setup: Setup) -> tuple[Measured, Map]:
    return measure(setup.clean, setup, jnp.ones((), bool), jnp.zeros((), jnp.int32))


def without_galaxies(setup: Setup) -> Setup:
    """The setup with room for no galaxies: what it measures is then one program for any number of them."""
    return replace(setup, capacity=0)


@eqx.filter_jit
def aligned_clean(setup: Setup) -> Map:
    """The A2 map without noise with the mass sheet of the strong-lensing map, `(y, x)`."""
    return aligned(setup.clean["A2"], setup.kappa_sl, setup.rings)


def pdfs(kappas: dict[str, Map], setup: Setup) -> Array:
    """Densities on `setup.pdf_x`: lambda_map of A2 and of K2 in the last range, then lambda_rec in each.

    `(2 + range, k)`. Sharing the sample out on the grid widens the kernel; its width makes up for that.
    """
    x = setup.pdf_x
    step = (x[-1] - x[0]) / (len(x) - 1)
    apart = (x[:, None] - x[None, :]) ** 2

    def one(kappa: Map, reference: Map, which: int) -> Array:
        found = ratio(kappa, reference, setup.weight)
        values, weight = setup.sample(found.lam, found.weight, which)
        place = (values - x[0]) / step
        times = jnp.where((place >= 0.0) & (place <= len(x) - 1.0), weight, 0.0)
        left = jnp.clip(place, 0.0, len(x) - 2.0).astype(jnp.int32)
        share = jnp.clip(place - left.astype(place.dtype), 0.0, 1.0)
        counts = jnp.zeros_like(x).at[left].add(times * (1.0 - share)).at[left + 1].add(times * share)
        h = bandwidth(values, weight)
        # Linear sharing adds a variance of step^2/6 on average.
        var = jnp.maximum(h**2 - step**2 / 6.0, 0.25 * step**2)
        kernel = jnp.exp(-0.5 * apart / var) / jnp.sqrt(2.0 * jnp.pi * var)
        return kernel @ counts / jnp.maximum(jnp.sum(weight), 1.0)

    count = len(setup.pixels)
    maps = [one(kappas[name], setup.kappa_true, count - 1) for name in ("A2", "K2")]
    return jnp.stack(maps + [one(kappas["A2"], setup.kappa_sl, which) for which in range(count)])
