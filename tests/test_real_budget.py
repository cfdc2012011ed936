"""The noise that the transition of a real cluster is measured against."""

import jax
import jax.numpy as jnp
import numpy as np
from numpy.testing import assert_allclose

from jaxlens import mass_sheet, radial, weak
from jaxlens.budget_real import aligned_variance, excess_of
from jaxlens.grid import Grid

GRID = Grid((26, 26), 40.0)  # positions are taken as kpc/h
RADIUS = GRID.radius
RINGS = radial.annuli(GRID.theta, jnp.arange(100.0, 501.0, 50.0))
INNER = ((RADIUS >= 100.0) & (RADIUS < 300.0)).astype(float)
SL = 0.5 / (1.0 + RADIUS / 150.0)
CLEAN = mass_sheet.transform(SL, 1.2)


def noise(n: int) -> jnp.ndarray:
    """White, then smoothed by two pixels, as the shear of a real field is."""
    white = np.random.default_rng(0).normal(size=(n, *GRID.shape))
    return 0.05 * jnp.stack([weak.smooth(jnp.asarray(one), GRID, 80.0) for one in white])


def test_each_map_loses_its_own_sheet():
    noisy = CLEAN[None] + noise(40)
    found = aligned_variance(noisy, CLEAN, SL, RINGS, INNER)
    cell, inside = np.asarray(RINGS.cell) // RINGS.n_sectors, np.asarray(INNER) > 0.0
    lost = []
    for kappa in np.asarray(noisy):
        lam = np.median(((kappa - 1.0) / np.asarray(SL - 1.0))[inside])
        lost.append((1.0 + (kappa - 1.0) / lam - np.asarray(SL)) ** 2)
    expected = [1.2**2 * np.mean([one[cell == b] for one in lost]) for b in range(len(RINGS.r))]
    assert_allclose(found, expected, rtol=1e-9)
    # Where the sheet is measured a map takes part of its noise for it; far outside that is added.
    raw = radial.mean_in(jnp.mean((noisy - CLEAN[None]) ** 2, axis=0), RINGS)
    assert np.all(np.asarray(found / raw)[:3] < 0.95)


def test_without_an_error_of_the_model_the_ratio_is_zero_on_average():
    """With the variance of the map itself it would be low inside: no scale of q is its own then."""
    noisy = CLEAN[None] + noise(200)
    sigma2 = aligned_variance(noisy, CLEAN, SL, RINGS, INNER)
    none = jnp.zeros(GRID.shape)
    ratios = jax.jit(
        lambda sigma2: jnp.mean(
            jax.lax.map(lambda one: excess_of(one, SL, RINGS, INNER, sigma2, none).q, noisy), axis=0
        )
    )
    q = np.asarray(ratios(sigma2))
    # 200 maps of about 1 in each annulus, few independent pixels each: 0.1 is two standard errors.
    assert np.abs(q).max() < 0.1
    raw = radial.mean_in(jnp.mean((noisy - CLEAN[None]) ** 2, axis=0), RINGS)
    assert float(ratios(raw)[1]) < -0.1
