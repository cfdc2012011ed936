"""The galaxies behind a simulated cluster, and the noisy shear maps that they make."""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxlens import weak
from jaxlens._types import Array, Bool, Complex, Float, Int, RandomKey
from jaxlens.cosmology import LensPlane
from jaxlens.simulate._shear import ShearSettings, TrueField, reduced_shear
from jaxlens.simulate._sources import capacity


class ShearBin(eqx.Module):
    """One bin of source redshift of a mock.

    Attributes:
        z_s: redshift of its galaxies.
        kappa: true convergence, `(y, x)`.
        g: true reduced shear, `(y, x)`.
        shear: what is observed: mean ellipticities, the mask as weight (0 also in empty pixels), counts.
    """

    z_s: float = eqx.field(static=True)
    kappa: Float[Array, "y x"]
    g: Complex[Array, "y x"]
    shear: weak.ShearMap


class GalaxyCatalogue(eqx.Module):
    """The galaxies of all bins. NumPy arrays.

    Attributes:
        theta: positions, `(n, 2)`, arcsec.
        eps: observed ellipticities, `(n,)`.
        z: redshifts, `(n,)`.
        use: False in masked pixels, `(n,)`.
    """

    theta: Float[np.ndarray, "n 2"]
    eps: Complex[np.ndarray, " n"]
    z: Float[np.ndarray, " n"]
    use: Bool[np.ndarray, " n"]

    def __len__(self) -> int:
        return len(self.z)


def intrinsic_ellipticities(key: RandomKey, n: int, sigma_eps: float) -> Complex[Array, " n"]:
    """Isotropic complex ellipticities, each component normal with `sigma_eps`, |eps| below 0.999.

    |eps| is Rayleigh distributed, drawn by the inverse of its truncated cumulative distribution: the same as
    drawing again where |eps| is too large (0.02 % of galaxies for 0.24, our choice; the estimator of the
    shear has no proof beyond |eps| = 1).

    A sampler of its own, since `weak.shape_noise` makes maps alone, of Gaussians without an end: a catalogue
    needs every galaxy with |eps| < 1, and as many random numbers whatever the counts, so that mocks share
    compiled programs.

    Args:
        key: used once.
        n: number of galaxies.
        sigma_eps: standard deviation of each component before truncation.
    """
    u, turn = jax.random.uniform(key, (2, n))
    inside = -np.expm1(-0.5 * (0.999 / sigma_eps) ** 2) if sigma_eps > 0.0 else 1.0
    size = sigma_eps * jnp.sqrt(-2.0 * jnp.log1p(-inside * u))
    return jax.lax.complex(size * jnp.cos(2.0 * jnp.pi * turn), size * jnp.sin(2.0 * jnp.pi * turn))


class _Draws(eqx.Module):
    """What chance decides: counts `(b, y, x)`, and for each place its ellipticity and place in its pixel."""

    counts: Int[Array, "b y x"]
    eps: Complex[Array, " n"]
    place: Float[Array, "n 2"]


@partial(jax.jit, static_argnames=("room", "sigma_eps"))
def _draw(key_counts: Array, key_eps: Array, mean: Array, room: int, sigma_eps: float) -> _Draws:
    shape_key, place_key = jax.random.split(key_eps)
    return _Draws(
        counts=jax.random.poisson(key_counts, mean, dtype=jnp.int32),
        eps=intrinsic_ellipticities(shape_key, room, sigma_eps),
        place=jax.random.uniform(place_key, (room, 2)),
    )


def mean_counts(settings: ShearSettings, plane: LensPlane) -> Float[Array, "b y x"]:
    """Expected galaxies of every bin in every pixel, `(b, y, x)`."""
    whole = weak.mean_counts(
        settings.grid,
        plane,
        density=settings.density_arcmin2,
        depletion=settings.depletion,
        scale_kpc=settings.scale_kpc,
    )
    return jnp.stack([one.share * whole for one in settings.bins])


def shear_field(
    key_counts: RandomKey,
    key_eps: RandomKey,
    found: TrueField,
    plane: LensPlane,
    settings: ShearSettings,
) -> tuple[tuple[ShearBin, ...], GalaxyCatalogue]:
    """Noisy, masked shear maps of every bin, and the galaxies whose mean ellipticities they are.

    Counts are Poisson; each galaxy lies uniformly in its pixel, has an intrinsic ellipticity and is sheared
    exactly by its pixel's g, also where |g| > 1 (`weak.observed_ellipticity`). The galaxies of masked
    pixels are in the catalogue with `use` False, so that the catalogue makes the same map. Without
    noise (`sigma_eps` 0) the maps are the true g of pixels that hold a galaxy.

    Args:
        key_counts: of the Poisson counts; used once.
        key_eps: of ellipticities and places; used once.
        found: the true field.
        plane: the lens plane.
        settings: pixels, mask, galaxies.

    Raises:
        RuntimeError: if more galaxies were drawn than there is room for (a chance below 1e-12).
    """
    mean = mean_counts(settings, plane)
    room = capacity(float(mean.sum()))
    drawn = _draw(key_counts, key_eps, mean, room, settings.sigma_eps)
    counts = np.asarray(drawn.counts)
    total = int(counts.sum())
    if total > room:
        raise RuntimeError(f"{total} galaxies were drawn but there is room for {room}; take another seed.")
    maps = [reduced_shear(found, float(plane.dls_ds(one.z_s)), settings) for one in settings.bins]
    pixel = np.repeat(np.arange(counts.size), counts.ravel())
    bins, row, column = np.unravel_index(pixel, counts.shape)
    g = np.stack([np.asarray(one) for _, one in maps])
    mask = np.abs(g) <= settings.g_max
    at = np.pad(g.ravel()[pixel], (0, room - total))
    eps = np.asarray(jax.jit(weak.observed_ellipticity)(drawn.eps, jnp.asarray(at)))[:total]
    parts = (np.bincount(pixel, part, counts.size) for part in (np.real(eps), np.imag(eps)))
    sums = next(parts) + 1j * next(parts)
    hat = (sums / np.maximum(counts.ravel(), 1)).reshape(counts.shape)
    left = np.stack([column, row], axis=1) - 0.5 * settings.pixels
    galaxies = GalaxyCatalogue(
        theta=settings.grid.pixel * (left + np.asarray(drawn.place)[:total]),
        eps=eps,
        z=np.array([one.z_s for one in settings.bins])[bins],
        use=mask.ravel()[pixel],
    )
    weight = (mask & (counts > 0)).astype(float)
    made = tuple(
        ShearBin(
            z_s=one.z_s,
            kappa=maps[k][0],
            g=maps[k][1],
            shear=weak.ShearMap(jnp.asarray(hat[k]), jnp.asarray(weight[k]), jnp.asarray(counts[k])),
        )
        for k, one in enumerate(settings.bins)
    )
    return made, galaxies
