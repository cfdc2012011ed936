"""Counter-images: against glafic's image finder, closed forms for the errors, and the command."""

from pathlib import Path
from typing import Any

import glafic_configs
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from astropy.table import Table
from conftest import CommandRun
from numpy.testing import assert_allclose, assert_array_equal
from support import table
from typer.testing import CliRunner

from jaxlens import cli, io, posterior, prediction, units
from jaxlens.lens import Component, Lens
from jaxlens.profiles import SIE


def test_all_images_of_a_source_with_magnifications_and_delays_equal_glafic() -> None:
    ref = table("glafic/images_composite_A.csv")
    # The source with most images among those at z = 3.
    at_3 = ref["zs"] == 3.0
    source = ref["source_id"][at_3][np.argmax(ref["n_img"][at_3])]
    mine = {name: column[ref["source_id"] == source] for name, column in ref.items()}
    order = np.argsort(mine["tdelay_day"])
    given = np.array([mine["x"][order[-2]], mine["y"][order[-2]]])
    lens = glafic_configs.lens("composite_A")
    found = prediction.counter_images(lens, glafic_configs.plane(), given, 3.0, half_width=80.0)
    # Its list need not be complete (a finest cell of 0.125 arcsec): ours has two more, a faint pair.
    assert len(order) == 5 and len(found.mu) == 7 and found.complete
    apart = np.hypot(found.theta[:, :1] - mine["x"][order], found.theta[:, 1:] - mine["y"][order])
    same = apart.argmin(axis=0)
    assert len(set(same)) == 5 and apart.min(axis=0).max() < 1e-5  # its positions have six digits
    assert_allclose(found.mu[same], mine["mu"][order], rtol=1e-4)
    assert_allclose(found.delay[same], mine["tdelay_day"][order], rtol=1e-5, atol=1e-3)
    assert found.given == same[-2]
    # The parity of its table is the sign of its magnification.
    assert [found.kind[k] == "saddle" for k in same] == (mine["mu"][order] < 0.0).tolist()
    assert found.kind[0] == "minimum"
    assert found.n_draws == 0 and np.isnan(found.mu_error).all()


@pytest.mark.long
def test_a_cored_sphere_has_a_minimum_a_saddle_and_a_maximum() -> None:
    """On the axis of an isothermal sphere with a core s: beta = x - r b (sqrt(x^2 + s^2) - s)/x."""
    b, s, x = 10.0, 0.5, 9.0
    plane = glafic_configs.plane()
    lens = Lens(one=Component(SIE(b=b, r_core=s)))
    found = prediction.counter_images(lens, plane, np.array([x, 0.0]), 2.0)
    ratio = float(plane.dls_ds(2.0))
    beta = x - ratio * b * (np.hypot(x, s) - s) / x
    # (x - beta) x + r b s = r b sqrt(x^2 + s^2), squared: a cubic with x divided out.
    cubic = [1.0, -2.0 * beta, beta**2 + 2.0 * ratio * b * s - (ratio * b) ** 2, -2.0 * ratio * b * s * beta]
    roots = np.roots(cubic)
    assert np.abs(roots.imag).max() < 1e-12
    assert_allclose(np.sort(found.theta[:, 0]), np.sort(roots.real), atol=1e-7)
    # Outside, on the other side, and at the peak of the mass, which is seen last.
    assert found.kind == ("minimum", "saddle", "maximum")
    assert found.theta[0, 0] == found.theta[:, 0].max() and found.theta[1, 0] == found.theta[:, 0].min()


def test_the_error_of_the_position_joins_the_errors(isothermal: tuple[Lens, Lens, np.ndarray]) -> None:
    """The counter-image of x is at x - 2 r b, so that its place along the axis moves as far as x."""
    lens, _, _ = isothermal
    plane = glafic_configs.plane()
    at, ratio = np.array([6.0, 0.0]), float(plane.dls_ds(2.0))
    found = prediction.counter_images(lens, plane, at, 2.0, sigma=0.02)
    assert found.n_draws == prediction.N_POSITIONS and found.found.tolist() == [1.0, 1.0]
    # 256 draws know a standard deviation to 4 %, half a width of 68 % to 6 %.
    assert_allclose(found.theta_error[found.given], 0.02, rtol=0.2)
    assert_allclose(found.theta_error[1 - found.given, 0], 0.02, rtol=0.2)
    # The direction turns by dy/x, seen at 2 r b - x on the other side.
    assert_allclose(found.theta_error[1 - found.given, 1], 0.02 * (2.0 * ratio * 10.0 - 6.0) / 6.0, rtol=0.2)
    with pytest.raises(ValueError, match="`sigma` is -1, not a position error"):
        prediction.counter_images(lens, plane, at, 2.0, sigma=-1.0)


@pytest.fixture(scope="module")
def isothermal() -> tuple[Lens, Lens, np.ndarray]:
    """An isothermal sphere of 10 arcsec, and draws of its strength."""
    lens = Lens(one=Component(SIE(b=10.0)))
    b = 10.0 + 0.5 * np.random.default_rng(7).standard_normal(200)
    draws = jax.vmap(lambda strength: Lens(one=Component(SIE(b=strength))))(jnp.asarray(b))
    return lens, draws, b


def test_errors_are_those_of_the_draws(isothermal: tuple[Lens, Lens, np.ndarray], tmp_path: Path) -> None:
    lens, draws, b = isothermal
    plane = glafic_configs.plane()
    ratio = float(plane.dls_ds(2.0))
    found = prediction.counter_images(lens, plane, np.array([12.0, 0.0]), 2.0, draws=draws)
    assert found.complete  # two images and one that the singular centre has swallowed
    assert_allclose(found.theta, [[12.0, 0.0], [12.0 - 2.0 * ratio * 10.0, 0.0]], atol=1e-8)
    assert found.given == 0 and found.kind == ("minimum", "saddle")
    assert found.n_draws == 200
    # The counter-image is at 12 - 2 r b, exists while that is negative, and comes r b beta later.
    here = 12.0 - 2.0 * ratio * b
    exists = here < 0.0
    assert_allclose(found.found, [1.0, exists.mean()])

    def half_width(values: np.ndarray) -> float:
        low, high = np.percentile(values[exists], [15.865, 84.135])
        return 0.5 * (high - low)

    assert np.isnan(found.theta_error[0]).all()  # the given image is where it was asked for, in every draw
    assert_allclose(found.theta_error[1, 0], half_width(here), rtol=1e-6)
    assert_allclose(found.mu_error[1], half_width(here / (here + ratio * b)), rtol=1e-5)
    delay = 2.0 * ratio * b * (12.0 - ratio * b) * float(plane.time_delay_scale(2.0))
    assert_allclose(found.delay_error[1], half_width(delay), rtol=1e-6)

    # The mass of an isothermal sphere is pi Sigma_cr (b r), in Msun with r and b in Mpc.
    mass = posterior.masses(draws, plane, jnp.array([4.0, 9.0]), centre=(0.0, 0.0))
    mpc = float(plane.d_l) * units.ARCSEC
    expected = np.pi * float(plane.sigma_cr_inf) * b[:, None] * mpc**2 * np.array([4.0, 9.0])
    assert_allclose(mass, expected, rtol=1e-9)

    quality = posterior.Quality(np.arange(200.0), 3.0, 5.0)
    posterior.write_posterior(tmp_path / "posterior.npz", lens, draws, quality)
    with np.load(tmp_path / "posterior.npz", allow_pickle=False) as file:
        named = [name for name in file.files if "/" in name]
        assert named == ["one/b"]  # nothing else differs
    again = posterior.read_quality(tmp_path / "posterior.npz")
    assert again is not None and again.rise == 99.5 - 3.0 and again.expected_rise == 5.0
    assert again.warning is not None and "chi2 rises by 96.5 (median)" in again.warning
    back = posterior.read_posterior(tmp_path / "posterior.npz", lens)
    for old, new in zip(jax.tree.leaves(draws), jax.tree.leaves(back), strict=True):
        assert_array_equal(np.broadcast_to(old, new.shape), new)


def test_draws_that_are_all_the_best_lens_read_back(tmp_path: Path) -> None:
    lens = Lens(one=Component(SIE(b=10.0)))
    draws = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (5, *leaf.shape)), lens)
    posterior.write_posterior(tmp_path / "posterior.npz", lens, draws)
    back = posterior.read_posterior(tmp_path / "posterior.npz", lens)
    assert_array_equal(back.components["one"].params.b, np.full((5, 1), 10.0))
    assert posterior.read_quality(tmp_path / "posterior.npz") is None


def test_the_warning_of_draws_waits_for_more_than_the_expected_rise() -> None:
    spread = np.random.default_rng(1).chisquare(22, 64)
    assert posterior.Quality(2.9 + spread, 2.9, 22.0).warning is None
    assert posterior.Quality(2.9 + 4.0 * spread, 2.9, 22.0).warning is not None
    # A draw whose images cannot be traced counts as one that does not fit.
    lost = np.where(np.arange(64) < 40, np.nan, spread)
    assert posterior.Quality(lost, 2.9, 22.0).warning is not None


@pytest.mark.parametrize(
    ("theta", "z_s", "width", "said"),
    [
        ((np.nan, 1.0), 2.0, None, "`theta` is"),
        ((1.0, 1.0), 0.3, None, "not behind the lens"),
        ((99.0, 1.0), 2.0, 50.0, "outside the window"),
        ((0.0, 0.0), 2.0, None, "has no image; the nearest image of its source is"),
    ],
)
def test_questions_without_an_answer(theta: Any, z_s: float, width: float | None, said: str) -> None:
    lens = Lens(one=Component(SIE(b=10.0)))
    with pytest.raises(ValueError, match=said):
        prediction.counter_images(lens, glafic_configs.plane(), np.array(theta), z_s, half_width=width)


# --- the command ------------------------------------------------------------------------------------


def predict(*arguments: str) -> Any:
    result = CliRunner().invoke(cli.app, ["predict", *arguments, "--no-cache"], env={"COLUMNS": "100"})
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result


def test_the_command_predicts_from_a_result_directory(as1063_run: CommandRun, tmp_path: Path) -> None:
    out = tmp_path / "images.ecsv"
    # Image 1.1 of the catalogue by its RA and Dec.
    result = predict(
        str(as1063_run.out), "--ra", "342.1945", "--dec", "-44.526998", "--z", "1.2279", "--out", str(out)
    )
    assert result.exit_code == 0, result.stderr
    assert "saddle" in result.stdout and "*3" in result.stdout and "±" in result.stdout
    assert "64 draws" in result.stderr
    written = Table.read(out)
    assert np.isnan(written["x_error_arcsec"][2]) and np.all(written["x_error_arcsec"][:2] > 0.0)
    assert "NaN for the given image" in written["x_error_arcsec"].description
    # The observed counter-images 1.2 and 1.3; 0.6 arcsec is the residual of this system.
    for x, y in ((-32.5412, 6.9264), (-8.2893, 34.8912)):
        assert np.hypot(written["x_arcsec"] - x, written["y_arcsec"] - y).min() < 1.0
    assert written["given"].tolist() == [False, False, True]
    assert np.all(written["mu_error"] > 0.0) and written.meta["draws"] == 64
    # The draws scatter about the best lens as the covariance of the fit says.
    lens, _ = io.read_lens(as1063_run.out / "model.toml")
    draws = posterior.read_posterior(as1063_run.out / "posterior.npz", lens)
    members = np.asarray(draws.components["members"].params.b[:, 0])
    best = float(lens.components["members"].params.b[0])
    assert abs(np.median(members) / best - 1.0) < 0.2 and members.std() > 0.0


MISTAKES = {
    "no such model": (("nowhere", "--x", "1", "--y", "1", "--z", "2"), "nowhere does not exist"),
    "no model in it": (("{folder}", "--x", "1", "--y", "1", "--z", "2"), "holds no model.toml"),
    "one coordinate": (("{model}", "--x", "1", "--z", "2"), "Give the position once"),
    "two positions": (("{model}", "--x", "1", "--y", "1", "--ra", "1", "--dec", "1", "--z", "2"), "once"),
    "no reference": (("{model}", "--ra", "1", "--dec", "1", "--z", "2"), "no reference point"),
    "z_s <= z_l": (("{model}", "--x", "1", "--y", "1", "--z", "0.2"), "not behind the lens"),
    "outside": (("{model}", "--x", "99", "--y", "1", "--z", "2", "--half-width", "50"), "outside the window"),
    "NaN": (("{model}", "--x", "nan", "--y", "1", "--z", "2"), "give finite numbers"),
    "draws of another lens": (("{other}", "--x", "1", "--y", "1", "--z", "2"), "not fields of the lens"),
    "broken draws": (("{broken}", "--x", "1", "--y", "1", "--z", "2"), "is not a file of draws"),
}


@pytest.mark.parametrize(("arguments", "said"), MISTAKES.values(), ids=list(MISTAKES))
def test_a_mistake_is_explained_and_nothing_written(
    arguments: tuple[str, ...], said: str, tmp_path: Path
) -> None:
    lens = Lens(one=Component(SIE(b=10.0)))
    places = {name: tmp_path / name for name in ("folder", "model", "other", "broken")}
    for name, place in places.items():
        place.mkdir()
        if name != "folder":
            io.write_lens(place / "model.toml", lens, glafic_configs.plane())
    fields: dict[str, Any] = {"two/b": np.ones((3, 1))}
    np.savez_compressed(places["other"] / "posterior.npz", **fields)
    (places["broken"] / "posterior.npz").write_text("not an archive")
    before = sorted(tmp_path.rglob("*"))
    result = predict(*(one.format(**places) for one in arguments), "--out", str(tmp_path / "a.ecsv"))
    assert result.exit_code == 2
    assert said in " ".join(result.stderr.split())
    assert "Traceback" not in result.stderr
    assert sorted(tmp_path.rglob("*")) == before
