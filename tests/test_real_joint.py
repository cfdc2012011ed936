"""Images and shear map in one fit, and how many galaxies would show a transition."""

import dataclasses
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

from jaxlens import (
    analysis_lambda,
    calibration_real,
    density_real,
    joint_real,
    maps_real,
    mass_sheet,
    radial,
    strong,
    weak,
    workflow_lambda,
    workflow_real,
)
from jaxlens._nulls_weak import null_maps
from jaxlens.grid import Grid
from jaxlens.lens import Component, Lens
from jaxlens.profiles import Sheet


class Field(NamedTuple):
    """The full sample of Abell S1063 with the published model in the place of the fit."""

    sample: workflow_real.Sample
    lens: Lens
    invert: maps_real.Inversion
    model: maps_real.Maps
    clean: jax.Array
    own: jax.Array
    inner: jax.Array
    expected: float
    data: joint_real.MapData


@pytest.fixture(scope="module")
def cluster() -> workflow_real.Cluster:
    return workflow_real.load("as1063")


@pytest.fixture(scope="module")
def field(cluster: workflow_real.Cluster) -> Field:
    sample, lens = cluster.samples[0], cluster.published
    assert lens is not None
    grid = sample.field.grid
    invert = maps_real.Inversion.of(sample)
    model = maps_real.maps_of(lens, grid, sample.field.smoothing)
    clean = maps_real.reduced(model, sample.dls_ds)
    own = invert.many(clean[None])[0]
    radius = np.hypot(*np.moveaxis(np.asarray(grid.theta), -1, 0)) * float(cluster.plane.kpc_per_arcsec) * 0.7
    known = np.asarray(sample.field.shear.weight) > 0.0
    inner = jnp.asarray(np.where(known & (radius >= 100.0) & (radius < 300.0), 1.0, 0.0))
    expected = float(mass_sheet.median(own, sample.dls_ds * model.smooth, inner))
    data = joint_real.map_data(sample, invert, model, own, inner, expected)
    return Field(sample, lens, invert, model, clean, own, inner, expected, data)


@pytest.fixture(scope="module")
def rings(cluster: workflow_real.Cluster, field: Field) -> radial.Annuli:
    """Annuli of 50 kpc/h."""
    sample = field.sample
    pair = workflow_lambda.Pair(
        "", np.asarray(field.own), np.asarray(sample.dls_ds * field.model.smooth), None, None,
        (np.asarray(sample.field.shear.weight) > 0.0).astype(float), sample.field.grid, cluster.plane, None,
        30.0, sample.dls_ds, sample.dls_ds, {},
    )  # fmt: skip
    return analysis_lambda.rings_of(pair, workflow_lambda.Options(r_min=50.0, r_max=2050.0))


def turned(sample: workflow_real.Sample, seed: int, pairs: int) -> jax.Array:
    """Maps of galaxies turned at random."""
    keys, one = jax.random.split(jax.random.key(seed), pairs), sample.field
    return null_maps(keys, one.shear, one.grid, one.factor, sample.setup.galaxies).g


class Linear(maps_real.Inversion):
    """A reconstruction that is linear in g: its real part."""

    def one(self, g: jax.Array) -> jax.Array:
        return g.real


def test_a_linear_map_is_solved_in_closed_form():
    """With kappa_wl = g/m and a known model, m and m lambda enter linearly: generalised least squares."""
    rng = np.random.default_rng(3)
    grid = Grid((4, 5), 15.0)
    weight = jnp.ones(grid.shape)
    invert = Linear(weight, weak.dense_inverse(weight, grid, scheme="A2"), grid, 30.0)
    k, ratio, m0, width, place = 0.3, 0.8, 0.5, 0.1, np.array([0, 3, 4, 7, 11, 12, 18, 19])
    noise = 0.02 * (np.eye(8) + 0.5) @ rng.normal(size=(8, 8))
    covariance = noise @ noise.T + 1e-4 * np.eye(8)
    bias = rng.normal(0.0, 0.3, 8)
    g = np.zeros(20)
    m_true, lam_true = 0.56, 1.2
    g[place] = m_true * (1.0 + lam_true * (ratio * k - 1.0) + bias) + 0.01 * rng.normal(size=8)
    data = joint_real.MapData(
        jnp.asarray(g.reshape(4, 5) + 0j), invert, jnp.asarray(place), jnp.linalg.cholesky(covariance),
        jnp.asarray(bias), jnp.asarray(ratio), jnp.array([m0, width]),
    )  # fmt: skip
    # One image of one system says nothing; a narrow prior holds the convergence of the sheet.
    images = strong.ImageCatalogue([[1.0, 2.0]], [0], [2.0], [0.5])
    problem = strong.Problem(
        lambda params: strong.Prediction(Lens(sheet=Component(Sheet(params["k"][None]))), jnp.array([ratio])),
        {"k": strong.Box(0.0, 1.0)},
        images,
        priors=(strong.NormalPrior("k", k, 1e-7),),
    )
    fit = strong.fit(problem, n_starts=1, start={"k": k})
    found = joint_real.infer(problem, fit, data, lam_expected=1.0)

    root = np.linalg.inv(np.linalg.cholesky(covariance)) / m0
    design = np.vstack(
        [root @ np.stack([1.0 + bias, np.full(8, ratio * k - 1.0)], axis=1), [1.0 / width, 0.0]]
    )
    target = np.append(root @ g[place], m0 / width)
    m, product = np.linalg.lstsq(design, target, rcond=None)[0]
    chain = np.array([[0.0, 1.0], [m, product / m]])  # (m, m lambda) by (lambda, m)
    errors = np.linalg.inv((design @ chain).T @ (design @ chain))
    assert found.converged
    # The prior of k and the tolerance of the last step leave 1e-6.
    assert_allclose([found.lam, found.m], [product / m, m], rtol=1e-5)
    assert_allclose([found.lam_error, found.m_error], np.sqrt(np.diag(errors)), rtol=1e-5)
    assert found.correlation == pytest.approx(errors[0, 1] / np.sqrt(errors[0, 0] * errors[1, 1]), abs=1e-5)
    alone = (design @ chain)[:, :1]
    assert found.lam_error_fixed == pytest.approx(
        float(np.linalg.inv(alone.T @ alone)[0, 0] ** 0.5), rel=1e-5
    )


def test_the_covariance_is_that_of_turned_galaxies(field: Field):
    sample, data = field.sample, field.data
    nulls = turned(sample, 5, 200)
    off = np.asarray(field.invert.many(field.clean[None] + nulls / sample.calibration[0]) - field.own[None])
    off = off.reshape(len(off), -1)[:, np.asarray(data.place)]
    measured = off.T @ off / len(off)
    stated = np.asarray(data.root @ data.root.T) - np.eye(len(measured)) * float(jnp.mean(data.bias**2))
    # 400 maps know a variance to 7 %; second order of the noise adds a few per cent.
    assert np.median(np.diag(measured) / np.diag(stated)) == pytest.approx(1.0, abs=0.06)
    scale = np.sqrt(np.outer(np.diag(stated), np.diag(stated)))
    assert np.abs((measured - stated) / scale).max() < 0.3
    whitened = np.linalg.solve(np.asarray(data.root), off.T)
    # The floor <b^2> keeps the erased modes below 1.
    assert 0.1 < np.mean(whitened**2) < 1.0


def test_noise_does_not_draw_the_calibration(field: Field):
    """The mean slope of chi^2 by m over noise maps is 0 at the truth; -2 N/m with a fixed covariance."""
    sample, data = field.sample, field.data
    mean = sample.calibration[0]
    nulls = turned(sample, 6, 100)

    def slopes(null: jax.Array) -> jax.Array:
        one = eqx.tree_at(lambda d: d.g, data, mean * field.clean + null)
        right = lambda m: jnp.sum(joint_real.rows_of(field.model.smooth, field.expected, m, one) ** 2)
        fixed = lambda m: right(m) * (mean / m) ** 2
        return jnp.stack([jax.grad(right)(mean), jax.grad(fixed)(mean)])

    found = np.asarray(jax.jit(lambda all: jax.lax.map(slopes, all))(nulls))
    middle, error = found.mean(axis=0), found.std(axis=0) / np.sqrt(len(found))
    assert abs(middle[0]) < 4.0 * error[0]
    assert middle[1] < -10.0 * error[1]
    assert abs(middle[0]) < 0.1 * abs(middle[1])


@pytest.mark.long
def test_slopes_are_those_of_differences(cluster: workflow_real.Cluster, field: Field):
    problem = cluster.strong.problem
    u = jnp.zeros(strong.total_size(problem.bounds))
    v = jnp.concatenate([u, jnp.array([1.1, 0.45])])
    rows = jax.jit(lambda at: joint_real.residuals(at, problem, field.data))
    values, jacobian = jax.jit(lambda at: joint_real.slopes(rows, at))(v)
    assert_allclose(values, rows(v), rtol=1e-10, atol=1e-10)
    rng = np.random.default_rng(0)
    for direction in (*rng.normal(size=(2, len(v))), np.eye(len(v))[-1], np.eye(len(v))[-2]):
        step = jnp.asarray(direction)
        numeric = (rows(v + 2e-6 * step) - rows(v - 2e-6 * step)) / 4e-6
        # Central differences: 4e-12 of the third derivative, large near critical curves; rounding of 1e-7.
        assert_allclose(jacobian @ step, numeric, atol=1e-5 * float(jnp.abs(numeric).max()))


@pytest.mark.long
def test_a_perfect_map_leaves_the_fit_where_it_is(cluster: workflow_real.Cluster, field: Field, as1063_run):
    problem, fit = cluster.strong.problem, as1063_run.outcome.fit
    lens = problem.predict(fit.u).lens
    sample = field.sample
    model = maps_real.maps_of(lens, sample.field.grid, sample.field.smoothing)
    clean = maps_real.reduced(model, sample.dls_ds)
    own = field.invert.many(clean[None])[0]
    mean = sample.calibration[0]
    shear = weak.ShearMap(mean * clean, sample.field.shear.weight, sample.field.shear.n_gal)
    perfect = dataclasses.replace(sample, field=dataclasses.replace(sample.field, shear=shear))
    data = joint_real.map_data(perfect, field.invert, model, own, field.inner, field.expected)
    found = joint_real.infer(problem, fit, data, field.expected)
    assert found.converged
    assert found.lam == pytest.approx(field.expected, abs=1e-6)
    assert found.m == pytest.approx(mean, abs=1e-6)
    assert found.chi2_map < 1e-8
    assert found.shift < 1e-3
    # The map adds to what is known of the calibration, and knows lambda better when that is given.
    assert 0.0 < found.m_error < sample.calibration[1]
    assert 0.0 < found.lam_error_fixed < found.lam_error


def test_the_first_density_that_is_enough():
    shares = lambda *found: density_real.Search(
        100.0, np.array([1.0, 2.0, 4.0]), np.array(found), np.zeros(3), 40
    )
    assert shares(0.1, 0.7, 0.6).needed == 200.0
    assert shares(0.1, 0.68, 0.6).needed is None


def test_fields_with_subhaloes_are_judged_by_the_rule(field: Field, rings: radial.Annuli):
    """Nearly without noise: q from NumPy sums, and the rule written out."""
    sample, n = field.sample, 6
    ratio = sample.dls_ds
    sl = ratio * field.model.smooth
    bias = np.asarray(mass_sheet.regauge(field.own, field.expected) - sl)
    draws = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (n, *leaf.shape)), field.lens)
    key = jax.random.key(2)
    noise = jnp.zeros((n, *sample.field.grid.shape), complex)
    found = density_real.search(
        key, field.invert, draws, sl, noise, ratio, rings, field.inner, jnp.zeros(len(rings.r)),
        jnp.asarray(bias), 133.0, n, (1.0,),
    )  # fmt: skip
    has, early = [], []
    for one in jax.random.split(key, n):
        lens = Lens({**field.lens.components, "clumps": density_real.clumps(one)})
        g = maps_real.reduced(maps_real.maps_of(lens, sample.field.grid, 30.0), ratio)
        wl = np.asarray(field.invert.many(g[None])[0])
        lam = np.median(((wl - 1.0) / (np.asarray(sl) - 1.0))[np.asarray(field.inner) > 0.0])
        d = 1.0 + (wl - 1.0) / lam - np.asarray(sl) - bias
        cell = np.asarray(rings.cell) // rings.n_sectors
        q = np.array(
            [np.mean(d[cell == i] ** 2) / np.mean(bias[cell == i] ** 2) for i in range(len(rings.r))]
        )
        padded, ones = np.pad(q, 1), np.pad(np.ones(len(q)), 1)
        weigh = lambda a: 0.25 * a[:-2] + 0.5 * a[1:-1] + 0.25 * a[2:]
        q = weigh(padded) / weigh(ones)
        has.append(any(q[i] < 1.0 and (q[i + 1 : i + 4] >= 1.0).all() for i in range(len(q) - 3)))
        early.append(bool((q[:3] > 1.0).all()))
    assert found.found[0] == pytest.approx(np.mean(has))
    assert found.inside[0] == pytest.approx(np.mean(early))
    assert found.fields == n


def test_slopes_find_a_calibration_that_changes(field: Field, rings: radial.Annuli):
    sample, b = field.sample, len(rings.r)
    cell = np.asarray(rings.cell) // rings.n_sectors
    m = np.linspace(0.3, 0.6, b + 1)[np.minimum(cell, b)]

    def seen(g: jax.Array) -> calibration_real.Slopes:
        shear = weak.ShearMap(g, sample.field.shear.weight, sample.field.shear.n_gal)
        one = dataclasses.replace(sample, field=dataclasses.replace(sample.field, shear=shear))
        return calibration_real.slopes(one, field.clean, rings)

    found = seen(jnp.asarray(m) * field.clean)
    assert_allclose(found.value, np.linspace(0.3, 0.6, b + 1)[:-1], rtol=1e-12)
    assert found.value.min() < found.mean < found.value.max()
    assert found.chi2 == pytest.approx(np.sum(((found.value - found.mean) / found.error) ** 2), rel=1e-12)
    scatter = np.std([seen(null).value for null in turned(sample, 7, 100)], axis=0)
    # 200 maps know a scatter to 5 %, and eight or nine annuli are looked at.
    assert_allclose(scatter / found.error, 1.0, atol=0.16)
