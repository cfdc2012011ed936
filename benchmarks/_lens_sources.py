"""A rich cluster, and sources about caustics, for `lens_equation.py`."""

import jax.numpy as jnp
import numpy as np
from _plain_fields import members_of

from jaxlens import critical
from jaxlens.cosmology import LensPlane
from jaxlens.grid import Grid
from jaxlens.lens import Component, Lens
from jaxlens.profiles import DPIE, Shear, hernquist, nfw

HALF_WIDTH = 100.0
"""Half the window of the search, arcsec."""


def rich_cluster(plane: LensPlane, n: int = 300) -> Lens:
    """A merging halo, two BCGs and `n` elliptical members with cores of 0.05 arcsec."""
    m = members_of(n, seed=3)
    params = DPIE(0.6 * m["b"], m["r_core"], m["r_cut"], m["e"])
    return Lens(
        halo=Component(
            nfw.from_mass(jnp.array([9e14, 5e14]), jnp.array([5.0, 5.5]), plane, e=jnp.array([0.35, 0.2])),
            jnp.array([[-6.0, 1.0], [9.0, -3.0]]),
            jnp.array([0.3, 1.1]),
        ),
        bcg=Component(
            hernquist.from_mass(jnp.array([3e12, 2e12]), jnp.array([6.0, 5.0]), plane, e=0.2),
            jnp.array([[-6.0, 1.0], [9.0, -3.0]]),
            jnp.array([0.4, 1.0]),
        ),
        members=Component(params, np.stack([m["x"], m["y"]], axis=1), m["pa"]),
        shear=Component(Shear(gamma=0.03), pa=0.7),
    )


def ratios(plane: LensPlane, n: int) -> np.ndarray:
    """Distance ratios of n sources at redshifts 1 to 10."""
    return np.array(plane.dls_ds(jnp.asarray(np.random.default_rng(8).uniform(1.0, 10.0, n))))


def draw(model: Lens, ratio: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Source positions `(n, 2)`, and their distance ratios `(n,)`."""
    rng, n, ratio = np.random.default_rng(7), len(ratio), ratio.copy()
    grid = Grid.square(2.0 * HALF_WIDTH, 0.4)
    # The sources near caustics share one redshift; the others one square.
    ratio[n // 2 :] = np.median(ratio)
    loops = np.concatenate([one.beta for one in critical.curves(model, grid, float(ratio[-1])).items])
    low, high = loops.min(axis=0), loops.max(axis=0)
    beta = rng.uniform(low, high, (n, 2))
    near = loops[rng.integers(len(loops), size=n - n // 2)]
    beta[n // 2 :] = near + rng.normal(scale=0.1, size=near.shape)
    return beta, ratio
