"""Reconstruction: NumPy least squares, dense against CG, masks, divergence, derivatives, batches."""

import re
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from _mock import half_width, two_clumps  # pyright: ignore[reportMissingImports]
from numpy.testing import assert_allclose, assert_array_equal
from test_weak_operator import numpy_shear

from jaxlens import weak
from jaxlens.grid import Grid
from jaxlens.weak import _schemes, _settings

N = 10
GRID = Grid((N, N - 1), 10.0)
TIGHT: dict[str, Any] = {"cg_tol": 1e-12, "power_steps": 0}


def small(seed: int = 0, dtype: Any = complex) -> weak.ShearMap:
    """Random reduced shear below 0.5 with a masked block and uneven weights."""
    rng = np.random.default_rng(seed)
    g = 0.25 * (rng.uniform(-1, 1, GRID.shape) + 1j * rng.uniform(-1, 1, GRID.shape))
    weight = rng.uniform(0.5, 1.5, GRID.shape)
    weight[4:6, 3:5] = 0.0
    return weak.ShearMap(
        jnp.asarray(g, dtype), jnp.asarray(weight, jnp.finfo(dtype).dtype), jnp.ones(GRID.shape, int)
    )


@pytest.fixture(scope="module")
def mock():
    return two_clumps(n=24, oversample=4)


@pytest.mark.parametrize("scheme", ["A1", "A2"])
def test_akra_is_the_least_squares_solution(scheme: str):
    """An explicit matrix of D on all band modes of the torus, solved by NumPy, iterated in a plain loop."""
    shear, ridge = small(), 1e-2
    padded = (2 * N, 2 * (N - 1))
    columns = []
    for pixel in np.eye(padded[0] * padded[1]):
        gamma = numpy_shear(pixel.reshape(padded), padded, "disc")[:N, : N - 1].ravel()
        columns.append(np.concatenate([np.real(gamma), np.imag(gamma)]))
    d = np.array(columns).T
    w = np.asarray(shear.weight)
    w = w / w[w > 0].mean()
    if scheme == "A2":
        w = w * np.asarray(weak.cosine_mask(jnp.asarray(w))) ** 2
    w2 = np.concatenate([w.ravel()] * 2)
    inverse = np.linalg.solve(d.T @ (w2[:, None] * d) + ridge * np.eye(d.shape[1]), d.T * w2)
    kappa = np.zeros(GRID.shape)
    for _ in range(3):
        gamma = (np.asarray(shear.g) * (1.0 - kappa)).ravel()
        kappa = (inverse @ np.concatenate([np.real(gamma), np.imag(gamma)])).reshape(padded)[:N, : N - 1]
    ours = weak.reconstruct(shear, GRID, scheme=scheme, n_iter=3, ridge=ridge, smoothing=0.0, **TIGHT)
    assert_allclose(ours.kappa, kappa, atol=1e-9)
    table = weak.dense_inverse(shear.weight, GRID, scheme=scheme, ridge=ridge)
    dense = weak.reconstruct(
        shear, GRID, scheme=scheme, n_iter=3, ridge=ridge, smoothing=0.0, inverse=table, power_steps=0
    )
    assert_allclose(dense.kappa, kappa, atol=1e-11)
    assert_allclose(dense.kappa_b, ours.kappa_b, atol=1e-9)


@pytest.mark.parametrize(("dtype", "limit"), [(jnp.complex128, 1e-8), (jnp.complex64, 1e-5)])
def test_cg_agrees_with_the_dense_map(mock, dtype: Any, limit: float):
    shear = mock.shear()
    shear = weak.ShearMap(shear.g.astype(dtype), shear.weight.astype(jnp.finfo(dtype).dtype), shear.n_gal)
    inverse = weak.dense_inverse(shear.weight, mock.grid)
    cg = weak.reconstruct(
        shear, mock.grid, cg_tol=1e-9 if limit < 1e-6 else 1e-6, cg_steps=120, power_steps=0
    )
    dense = weak.reconstruct(shear, mock.grid, inverse=inverse, power_steps=0)
    assert cg.kappa.dtype == dense.kappa.dtype == jnp.finfo(dtype).dtype
    error = np.abs(np.asarray(cg.kappa - dense.kappa))[mock.weight > 0]
    assert error.max() < limit


def test_noiseless_akra_is_a_delta_function_and_ks_is_not(mock):
    """Pixels of 20 arcsec here; benchmarks/weak_accuracy.py has the 48 x 48 figures."""
    widths = {}
    for smoothing in (0.0, 15.0):
        for scheme in ("A2", "K2"):
            made = weak.reconstruct(
                mock.shear(), mock.grid, scheme=scheme, ridge=1e-3, smoothing=smoothing, power_steps=0
            )
            widths[scheme, smoothing] = half_width(mock.lam(made.kappa))
    assert widths["A2", 0.0] < 5e-4
    assert widths["K2", 0.0] > 3.0 * widths["A2", 0.0]
    assert widths["K2", 15.0] > 3.0 * widths["A2", 15.0]


def test_divergence_is_loud_and_the_disc_converges():
    """Uniform shear drives the checkerboard modes, nearly degenerate without the band."""
    grid = Grid((12, 12), 10.0)
    shear = weak.ShearMap(jnp.full(grid.shape, 0.45 + 0j), jnp.ones(grid.shape), jnp.ones(grid.shape, int))
    options: dict[str, Any] = {"n_iter": 20, "smoothing": 0.0, "scheme": "A1", "ridge": 1e-4}
    good = weak.reconstruct(shear, grid, **options, cg_tol=1e-6)
    assert good.converged and float(good.change[-1]) < 1e-6 and float(good.spectral_radius) < 0.8
    bad = weak.reconstruct(shear, grid, band="none", **options, cg_tol=1e-6, cg_steps=2000)
    assert not bad.converged
    assert float(bad.spectral_radius) > 1.5


def test_gmres_solves_what_the_iteration_cannot(mock):
    everything = mock.shear(np.ones(mock.grid.shape))
    options: dict[str, Any] = {"ridge": 1e-3, "smoothing": 0.0, "cg_tol": 1e-8, "cg_steps": 2000}
    picard = weak.reconstruct(everything, mock.grid, n_iter=20, **options)
    assert not picard.converged and float(picard.spectral_radius) > 1.0
    krylov = weak.reconstruct(everything, mock.grid, solver="gmres", tol=1e-4, **options)
    assert krylov.converged
    assert half_width(mock.lam(krylov.kappa)) < 0.005


@pytest.mark.parametrize("scheme", list(weak.SCHEMES))
def test_a_masked_value_has_no_influence(scheme: str):
    shear = small()
    kappa0 = jnp.full(GRID.shape, 0.1) if scheme == "A3" else None
    plain = weak.reconstruct(shear, GRID, scheme=scheme, kappa0=kappa0)
    for value in (1e30, np.nan, np.inf * 1j):
        wild = eqx.tree_at(lambda s: s.g, shear, shear.g.at[4:6, 3:5].set(value))
        made = weak.reconstruct(wild, GRID, scheme=scheme, kappa0=kappa0)
        for one, other in zip(jax.tree.leaves(plain), jax.tree.leaves(made), strict=True):
            assert_array_equal(one, other)
    slope = jax.grad(lambda g: jnp.sum(weak.reconstruct(eqx.tree_at(lambda s: s.g, shear, g), GRID).kappa))
    assert np.isfinite(slope(shear.g)).all()


def test_the_fixed_point_does_not_depend_on_the_start():
    shear = small()
    a2 = weak.reconstruct(shear, GRID, n_iter=30, **TIGHT)
    kappa0 = jnp.asarray(np.random.default_rng(5).uniform(0.0, 0.5, GRID.shape))
    a3 = weak.reconstruct(shear, GRID, scheme="A3", kappa0=kappa0, n_iter=30, **TIGHT)
    krylov = weak.reconstruct(shear, GRID, solver="gmres", tol=1e-8, **TIGHT)
    assert a2.converged and a3.converged and krylov.converged
    assert_allclose(a3.kappa, a2.kappa, atol=1e-9)
    assert_allclose(krylov.kappa, a2.kappa, atol=1e-7)  # the Krylov tolerance 1e-10, and its stopping rule


@pytest.mark.parametrize("solver", ["picard", "gmres"])
def test_derivatives_agree_with_differences(solver: str):
    shear = small()
    rng = np.random.default_rng(7)
    out = jnp.asarray(rng.normal(size=GRID.shape))
    step_g = jnp.asarray(rng.normal(size=GRID.shape) + 1j * rng.normal(size=GRID.shape))
    step_w = jnp.asarray(rng.normal(size=GRID.shape)) * (shear.weight > 0)

    @jax.jit
    def value(t: jax.Array, u: jax.Array) -> jax.Array:
        moved = weak.ShearMap(shear.g + t * step_g, shear.weight + u * step_w, shear.n_gal)
        made = weak.reconstruct(moved, GRID, solver=solver, smoothing=8.0, tol=1e-10, **TIGHT)
        return jnp.sum(out * made.kappa)

    zero, h = jnp.zeros(()), 1e-4
    slopes = jax.grad(value, argnums=(0, 1))(zero, zero)
    numeric = [
        (8 * (value(*(h * e)) - value(*(-h * e))) - (value(*(2 * h * e)) - value(*(-2 * h * e)))) / (12 * h)
        for e in jnp.eye(2)
    ]
    assert_allclose(slopes, numeric, rtol=1e-6)


def test_a_batch_is_the_same_bytes_in_any_division():
    many = jax.tree.map(lambda *a: jnp.stack(a), *(small(seed) for seed in range(70)))
    weight = small().weight
    many = eqx.tree_at(lambda s: s.weight, many, jnp.tile(weight, (70, 1, 1)).at[3, 0, 0].set(0.0))
    inverse = weak.dense_inverse(weight, GRID)
    whole = weak.reconstruct_many(many, GRID, inverse=inverse)
    part = weak.reconstruct_many(jax.tree.map(lambda a: a[37:69], many), GRID, inverse=inverse)
    assert_array_equal(whole.kappa[37:69], part.kappa)
    assert_array_equal(np.flatnonzero(whole.mask_differs), [3])
    assert whole.converged.all()
    smaller = weak.reconstruct_many(many, GRID, inverse=inverse, block=16)
    assert_allclose(smaller.kappa, whole.kappa, atol=1e-12)
    with pytest.raises(ValueError, match="`block` is 0"):
        weak.reconstruct_many(many, GRID, inverse=inverse, block=0)
    first = jax.tree.map(lambda a: a[:4], many)
    single = weak.reconstruct_many(first, GRID, cg_tol=1e-10)
    one = weak.reconstruct(jax.tree.map(lambda a: a[1], many), GRID, **TIGHT)
    assert_allclose(whole.kappa[1], one.kappa, atol=1e-9)
    assert_allclose(single.kappa[1], one.kappa, atol=1e-8)
    assert not np.allclose(single.kappa[3], whole.kappa[3], atol=1e-6)  # its own mask, in the second pass


def test_regauge_undoes_a_mass_sheet():
    kappa = jnp.linspace(0.0, 2.0, 7)
    assert_allclose(weak.regauge(1.0 + 1.15 * (kappa - 1.0), 1.15), kappa, rtol=1e-14, atol=1e-15)


def broken(**parts: Any) -> weak.ShearMap:
    """A shear map with a value replaced at row 1, column 2."""
    shear = small()
    for name, value in parts.items():
        shear = eqx.tree_at(lambda s, n=name: getattr(s, n), shear, getattr(shear, name).at[1, 2].set(value))
    return shear


@pytest.mark.parametrize(
    ("shear", "options", "message"),
    [
        (lambda: broken(g=2e3), {}, "`shear.g` is (2000+0j) at row 1, column 2; |g| above 1000"),
        (lambda: broken(g=np.nan), {}, "at row 1, column 2; give such a pixel weight 0"),
        (lambda: broken(weight=-1.0), {}, "`shear.weight` is -1.0 at row 1, column 2"),
        (lambda: broken(weight=np.nan), {}, "`shear.weight` is nan at row 1, column 2"),
        (lambda: eqx.tree_at(lambda s: s.weight, small(), jnp.zeros(GRID.shape)), {}, "0 in every pixel"),
        (small, {"scheme": "B1"}, "`scheme` is 'B1'; give one of K1, K2, A1, A2, A3"),
        (small, {"scheme": "A3"}, "give `kappa0`"),
        (small, {"solver": "newton"}, "`solver` is 'newton'"),
        (small, {"mask": "round"}, "`mask` is 'round'"),
        (small, {"ridge": 0.0}, "`ridge` is 0.0"),
        (small, {"n_iter": 0}, "`n_iter` is 0"),
    ],
)
def test_bad_input_is_refused_by_name(shear: Any, options: dict[str, Any], message: str):
    with pytest.raises(ValueError, match=re.escape(message)):
        weak.reconstruct(shear(), GRID, **options)


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"ridge": -1.0}, ValueError, "`ridge` is -1.0"),
        ({"ridge": 0.0}, ValueError, "`ridge` is 0.0"),
        ({"n_iter": 0}, ValueError, "`n_iter` is 0"),
        ({"smoothing": -1.0}, ValueError, "`smoothing` is -1.0"),
        ({"cg_tol": 2.0}, ValueError, "`cg_tol` is 2.0"),
        ({"cg_steps": 0}, ValueError, "`cg_steps` is 0"),
        ({"mask": "round"}, ValueError, "`mask` is 'round'"),
    ],
)
def test_every_entry_refuses_the_same(options: dict[str, Any], error: type[Exception], message: str):
    shear = small()
    many = jax.tree.map(lambda a: a[None], shear)
    entries = [
        lambda: weak.reconstruct(shear, GRID, **options),
        lambda: weak.reconstruct_many(many, GRID, **options),
    ]
    if set(options) <= {"ridge", "smoothing"}:
        entries.append(lambda: weak.residual_b_mode(many, many.g.real, GRID, **options))
    for entry in entries:
        with pytest.raises(error, match=re.escape(message)):
            entry()


def test_settings_are_numbers_of_any_kind_and_no_programs():
    """NumPy scalars give what Python numbers give; a new value of one compiles nothing."""
    shear = small()
    some: dict[str, Any] = {"n_iter": 2, "power_steps": 0}
    plain = weak.reconstruct(shear, GRID, ridge=2e-2, smoothing=12.0, **some)
    with pytest.MonkeyPatch.context() as patch:
        # Tracing the iteration again is what a new program would do.
        patch.setattr(_schemes, "picard", lambda *_: pytest.fail("compiled again"))
        numpy: dict[str, Any] = {"ridge": np.float64(2e-2), "smoothing": np.float64(12.0), "n_iter": 2}
        again = weak.reconstruct(shear, GRID, power_steps=0, **numpy)
        other = weak.reconstruct(shear, GRID, ridge=0.3, smoothing=20.0, tol=1e-2, cg_tol=1e-3, **some)
    assert_array_equal(again.kappa, plain.kappa)
    assert type(again.ridge) is float and again.ridge == 2e-2
    assert other.ridge == 0.3 and float(jnp.abs(other.kappa - plain.kappa).max()) > 1e-3
    with pytest.raises(TypeError, match="`ridge` is traced by jit, grad or vmap"):
        jax.jit(lambda ridge: _settings.real("ridge", ridge))(0.1)


def test_a_linear_solve_that_stops_early_is_not_converged():
    shear = small()
    few = weak.reconstruct(shear, GRID, ridge=1e-6, cg_steps=2, n_iter=2, power_steps=0, tol=10.0)
    assert not few.converged and float(few.residual.min()) > 1e-2
    good = weak.reconstruct(shear, GRID, n_iter=2, power_steps=0, tol=10.0)
    assert good.converged and float(good.residual.max()) < 1.1e-4


def test_a_dense_map_of_other_settings_is_refused():
    shear = small()
    some: dict[str, Any] = {"n_iter": 2, "power_steps": 0}
    inverse = weak.dense_inverse(shear.weight, GRID)
    wrong: list[tuple[dict[str, Any], str]] = [
        ({"ridge": 0.1}, "has the ridge 0.01, but `ridge` is 0.1"),
        ({"scheme": "A1"}, "has a cosine mask, but binary is asked for"),
    ]
    for options, message in wrong:
        with pytest.raises(ValueError, match=message):
            weak.reconstruct(shear, GRID, inverse=inverse, **options)
    other = eqx.tree_at(lambda s: s.weight, shear, shear.weight.at[2, 7].set(0.0))
    with pytest.raises(ValueError, match=r"another mask than `shear.weight` in 1 pixels, the first at row 2"):
        weak.reconstruct(other, GRID, inverse=inverse)
    # Inside a program the values are not known: the result says it.
    made = jax.jit(lambda s: weak.reconstruct(s, GRID, inverse=inverse, tol=10.0, **some).converged)
    assert made(shear) and not made(other)


def test_wrong_grids_and_tables_are_refused():
    with pytest.raises(ValueError, match=r"`grid.shape` is \(5, 5\)"):
        weak.reconstruct(small(), Grid((5, 5), 10.0))
    inverse = weak.dense_inverse(small().weight, GRID)
    with pytest.raises(ValueError, match="`inverse` was made for"):
        weak.reconstruct(small(), GRID, inverse=inverse, padding=3.0)
    with pytest.raises(ValueError, match="no fixed dense map"):
        weak.dense_inverse(small().weight, GRID, mask="sigmoid")
    with pytest.raises(ValueError, match="a dense map is limited"):
        weak.dense_inverse(jnp.ones((90, 90)), Grid((90, 90), 10.0))
