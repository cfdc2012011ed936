"""What is measured of one pair of reconstructions."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Bool

from jaxlens._types import Array, Float, Int, Map
from jaxlens.mass_sheet import Distribution, distribution_and_bandwidth, ratio, regauge
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


class _Ranges(eqx.Module):
    """lambda of one map against a reference, and its distribution in each range.

    Attributes:
        found: the distributions, `(range,)`.
        lam, weight: the map, `(y, x)` each.
        samples: values and whether each counts, `(m,)`, of every range.
        width: bandwidth of each range, `(range,)`.
    """

    found: Distribution
    lam: Map
    weight: Map
    samples: list[tuple[Array, Array]]
    width: Array


def _in_ranges(kappa: Map, reference: Map, setup: Setup) -> _Ranges:
    made = ratio(kappa, reference, setup.weight)
    samples = [setup.sample(made.lam, made.weight, k) for k in range(len(setup.pixels))]
    each = [distribution_and_bandwidth(*sample) for sample in samples]
    found, width = jax.tree.map(lambda *parts: jnp.stack(parts), *each)
    return _Ranges(found, made.lam, made.weight, samples, width)


def measure(
    kappas: dict[str, Map], setup: Setup, good: Array, empty: Array, clean: Map | None = None
) -> tuple[Measured, Map]:
    """The numbers of one pair of reconstructions, and the corrected A2 map `(y, x)`; see `measure_all`."""
    return measure_all(kappas, setup, good, empty, clean)[:2]


def measure_all(
    kappas: dict[str, Map], setup: Setup, good: Array, empty: Array, clean: Map | None = None
) -> tuple[Measured, Map, Array]:
    """Everything of one pair of reconstructions.

    Args:
        kappas: reconstructions A2 and K2, `(y, x)` each.
        setup: from `prepare`.
        good, empty: what is known of the draw, `()`.
        clean: aligned A2 map without noise, `(y, x)`, see `aligned_clean`; None if this is it.

    Returns:
        The numbers; the corrected A2 map `(y, x)`; and the densities on `setup.pdf_x`, `(2 + range, k)`:
        lambda_map of A2 and of K2 in the last range, then lambda_rec in each.
    """
    rings = setup.rings
    kappa = kappas["A2"]
    a2, k2 = (_in_ranges(kappas[name], setup.kappa_true, setup) for name in ("A2", "K2"))
    rec = _in_ranges(kappa, setup.kappa_sl, setup)
    lam = getattr(rec.found, setup.correct_by)[0]
    corrected = regauge(kappa, lam)
    shape = shape_errors(kappa, setup.kappa_sl, setup.kappa_true, rings)
    compared = aligned(kappa, setup.kappa_sl, rings)
    rest = jnp.zeros_like(kappa) if clean is None else compared - clean
    found = Measured(
        good=good,
        empty=empty,
        a2=a2.found,
        k2=k2.found,
        rec=rec.found,
        a2_profile=profile_in(a2.lam, rings, a2.weight),
        k2_profile=profile_in(k2.lam, rings, k2.weight),
        rec_profile=profile_in(rec.lam, rings, rec.weight),
        kappa=profile_in(corrected, rings),
        lam=lam,
        rmse=rmse_in(corrected - setup.kappa_true, rings),
        shape=shape.wl,
        noise2=mean_in(rest**2, rings),
        moments=moments(compared, setup.kappa_sl, rings, setup.bias),
    )
    last = len(setup.pixels) - 1
    shown = [(a2, last), (k2, last), *((rec, which) for which in range(last + 1))]
    densities = [_density(*one.samples[which], one.width[which], setup.pdf_x) for one, which in shown]
    return found, corrected, jnp.stack(densities)


def _density(values: Array, counted: Array, h: Array, x: Array) -> Array:
    """Kernel density of a sample at evenly spaced `x (k,)`, `(k,)`.

    Sharing the sample out on the grid widens the kernel; its width makes up for that.
    """
    step, number = (x[-1] - x[0]) / (len(x) - 1), jnp.arange(len(x))
    place = (values - x[0]) / step
    inside = counted & (place >= 0.0) & (place <= len(x) - 1.0)
    times = inside.astype(place.dtype)
    left = jnp.clip(place, 0.0, len(x) - 2.0).astype(jnp.int32)
    share = jnp.clip(place - left.astype(place.dtype), 0.0, 1.0)
    counts = jnp.zeros_like(x).at[left].add(times * (1.0 - share)).at[left + 1].add(times * share)
    # Linear sharing adds a variance of step^2/6 on average.
    var = jnp.maximum(h**2 - step**2 / 6.0, 0.25 * step**2)
    kernel = jnp.exp(-0.5 * (number * step) ** 2 / var) / jnp.sqrt(2.0 * jnp.pi * var)
    apart = jnp.abs(number[:, None] - number[None, :])
    return kernel[apart] @ counts / jnp.maximum(jnp.sum(counted).astype(x.dtype), 1.0)


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
