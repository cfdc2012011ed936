"""D and its adjoint, Kaiser-Squires, smoothing and masks, against plain NumPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.ndimage import distance_transform_edt

from jaxlens import weak
from jaxlens.grid import Grid

SHAPES = [((6, 6), 2.0), ((7, 5), 1.0), ((8, 6), 1.5), ((5, 8), 2.0)]


def numpy_shear(kappa: np.ndarray, padded: tuple[int, int], band: str) -> np.ndarray:
    """gamma of a convergence field by full complex transforms."""
    k_y, k_x = np.meshgrid(*(np.fft.fftfreq(p) for p in padded), indexing="ij")
    k2 = k_x**2 + k_y**2
    d = np.divide((k_x + 1j * k_y) ** 2, k2, out=np.zeros(padded, complex), where=k2 > 0)
    if band == "disc":
        d[np.sqrt(k2) >= 0.5 - 1e-9] = 0.0
    nyquist = (k_y == -0.5) | (k_x == -0.5)
    d[nyquist] = np.real(d[nyquist])  # the stated convention
    full = np.zeros(padded)
    full[: kappa.shape[0], : kappa.shape[1]] = kappa
    hat = np.fft.fft2(full)
    c, s = (np.real(np.fft.ifft2(part * hat)) for part in (np.real(d), np.imag(d)))
    return (c + 1j * s)[: kappa.shape[0], : kappa.shape[1]]


@pytest.mark.parametrize("band", ["disc", "none"])
@pytest.mark.parametrize(("shape", "padding"), SHAPES)
def test_operator_is_the_numpy_one_and_its_adjoint_is_exact(
    shape: tuple[int, int], padding: float, band: str
):
    rng = np.random.default_rng(1)
    op = weak.ShearOperator.of(shape, padding, band)
    kappa = jnp.asarray(rng.normal(size=shape))
    gamma = jnp.asarray(rng.normal(size=shape) + 1j * rng.normal(size=shape))
    image = weak.shear_of(kappa, padding=padding, band=band)
    assert_allclose(image, numpy_shear(np.asarray(kappa), op.padded, band), atol=1e-14)
    back, b_mode = weak.kaiser_squires(gamma, padding=padding, band=band)
    assert_allclose(back, op.values(op.adjoint(gamma)), atol=1e-14)
    assert_allclose(b_mode, op.values(op.adjoint(-1j * gamma)), atol=1e-14)
    left, right = jnp.sum((image * jnp.conj(gamma)).real), jnp.sum(kappa * back)
    assert_allclose(left, right, rtol=1e-12, atol=1e-13)
    # The same in the space of modes, where the solver works.
    x = jnp.asarray(rng.normal(size=op.adjoint(gamma).shape))
    assert_allclose(
        jnp.sum((op.shear(x) * jnp.conj(gamma)).real), jnp.sum(x * op.adjoint(gamma)), rtol=1e-12, atol=1e-13
    )


def test_kaiser_squires_inverts_the_shear_of_a_periodic_field():
    y, x = np.meshgrid(np.arange(12), np.arange(10), indexing="ij")
    kappa = jnp.asarray(np.cos(2 * np.pi * (x / 10 + y / 12)) + 0.5 * np.sin(2 * np.pi * 2 * y / 12))
    gamma = weak.shear_of(kappa, padding=1.0)
    e_mode, b_mode = weak.kaiser_squires(gamma, padding=1.0)
    assert_allclose(e_mode, kappa, atol=1e-14)
    assert_allclose(b_mode, 0.0, atol=1e-14)
    e_mode, b_mode = weak.kaiser_squires(1j * gamma, padding=1.0)  # turned by 45 degrees: B alone
    assert_allclose(e_mode, 0.0, atol=1e-14)
    assert_allclose(b_mode, kappa, atol=1e-14)


@pytest.mark.parametrize("kind", ["complex", "real"])
def test_smoothing_is_the_weighted_mean(kind: str):
    rng = np.random.default_rng(2)
    grid = Grid((9, 6), 10.0)
    weight = rng.uniform(0.0, 2.0, grid.shape) * (rng.uniform(size=grid.shape) > 0.3)
    values = rng.normal(size=grid.shape) + (1j * rng.normal(size=grid.shape) if kind == "complex" else 0.0)
    y, x = (a.ravel() for a in np.meshgrid(np.arange(9), np.arange(6), indexing="ij"))
    distance2 = (y[:, None] - y[None]) ** 2 + (x[:, None] - x[None]) ** 2
    kernel = np.exp(-0.5 * distance2 / 1.5**2)  # 15 arcsec are 1.5 pixels of standard deviation
    expected = (kernel @ (values * weight).ravel()) / (kernel @ weight.ravel())
    ours = weak.smooth(jnp.asarray(values), grid, 15.0, jnp.asarray(weight))
    assert_allclose(ours.ravel(), expected, rtol=1e-12)
    assert_allclose(weak.smooth(jnp.full(grid.shape, 0.7), grid, 15.0), 0.7, rtol=1e-14)
    assert_allclose(weak.smooth(jnp.asarray(values), grid, 15.0, jnp.zeros(grid.shape)), 0.0)


def test_smoothing_far_from_all_data_is_zero_with_finite_derivative():
    grid = Grid((1, 400), 1.0)
    weight = jnp.zeros(grid.shape).at[0, 0].set(1.0)
    value = lambda g: jnp.sum(weak.smooth(g, grid, 1.0, weight))
    g = jnp.ones(grid.shape)
    assert weak.smooth(g, grid, 1.0, weight)[0, -1] == 0.0
    assert np.isfinite(jax.grad(value)(g)).all()


def test_cosine_mask_follows_the_distance():
    weight = np.random.default_rng(3).uniform(size=(20, 17)) > 0.1
    d = np.asarray(distance_transform_edt(weight), float)
    expected = 0.5 * (1.0 - np.cos(np.pi * np.minimum(d, 3.0) / 3.0))
    assert_allclose(weak.cosine_mask(jnp.asarray(weight, float), 3.0), expected, atol=1e-14)


def test_sigmoid_mask_is_smooth_at_zero():
    g = jnp.array([[0.0 + 0.0j, 0.5 + 0.0j, 0.0 - 2.0j]])
    mask = weak.sigmoid_mask(g)
    assert_allclose(mask[0], [1.0, 0.5, 0.0], atol=1e-4)
    slope = jax.grad(lambda a: jnp.sum(weak.sigmoid_mask(a * g)))(1.0)
    assert np.isfinite(slope)


@pytest.mark.parametrize("dtype", [jnp.complex64, jnp.complex128])
def test_sigmoid_mask_has_a_derivative_far_beyond_its_limit(dtype: type):
    slope = jax.grad(lambda size: jnp.sum(weak.sigmoid_mask(size * jnp.ones((1, 1), dtype))).real)
    for size in (6.0, 40.0, 1e3):
        assert float(slope(jnp.asarray(size, jnp.finfo(dtype).dtype))) == 0.0 or size < 40.0
        assert np.isfinite(slope(jnp.asarray(size, jnp.finfo(dtype).dtype)))


def test_wrong_options_are_refused_by_name():
    with pytest.raises(ValueError, match=r"`padding` is 0\.5"):
        weak.ShearOperator.of((8, 8), 0.5)
    with pytest.raises(ValueError, match="`band` is 'ring'"):
        weak.ShearOperator.of((8, 8), 2.0, "ring")
    with pytest.raises(ValueError, match="`width` is -1"):
        weak.smooth(jnp.ones((4, 4)), Grid((4, 4), 1.0), -1.0)
    with pytest.raises(ValueError, match=r"`values` has shape \(4, 4\)"):
        weak.smooth(jnp.ones((4, 4)), Grid((4, 5), 1.0), 1.0)
