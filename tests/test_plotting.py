"""Figures: what they show and say, that both files appear, and that nothing global is touched."""

import subprocess
import sys
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse, Rectangle
from matplotlib.quiver import Quiver, QuiverKey
from matplotlib.text import Annotation, Text
from PIL import Image

from jaxlens import plotting
from jaxlens.grid import Grid
from jaxlens.plotting._covariance import rounded, symbol
from jaxlens.plotting._labels import place_labels
from jaxlens.plotting._style import cycle, nice

GRID = Grid(shape=(40, 40), pixel=2.0)
_T = np.linspace(0.0, 2.0 * np.pi, 60)
RING = np.stack([np.cos(_T), np.sin(_T)], axis=1)


@pytest.fixture
def images() -> np.ndarray:
    rng = np.random.default_rng(4)
    angle = rng.uniform(0.0, 2.0 * np.pi, 12)
    return rng.uniform(10.0, 30.0, 12)[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)


def kappa() -> Any:
    return jnp.asarray(20.0 / (3.0 + GRID.radius))


def texts(fig: Figure) -> list[str]:
    """Every text of a figure that is not empty, legends included."""
    return [text.get_text() for text in fig.findobj(Text) if isinstance(text, Text) and text.get_text()]


def lines(ax: Axes, colour: str) -> list[np.ndarray]:
    return [np.asarray(line.get_xydata()) for line in ax.get_lines() if line.get_color() == colour]


def heights(ax: Axes) -> np.ndarray:
    """Ordinates of the first line."""
    return np.asarray(ax.get_lines()[0].get_ydata())


# --- saving --------------------------------------------------------------------------------------


def test_save_writes_both_files_and_nothing_else(tmp_path: Path):
    fig = plotting.starts([1.0, 2.0])
    paths = plotting.save(fig, tmp_path / "new" / "chi2_z1.5")
    assert [path.name for path in paths] == ["chi2_z1.5.pdf", "chi2_z1.5.png"]
    assert sorted((tmp_path / "new").iterdir()) == sorted(paths)
    assert paths[0].read_bytes().startswith(b"%PDF")
    with Image.open(paths[1]) as picture:
        assert picture.size[0] == round(200 * plotting.COLUMN)
    before = paths[0].read_bytes()
    plotting.save(plotting.starts([1.0, 2.0]), tmp_path / "new" / "chi2_z1.5")
    assert paths[0].read_bytes() == before  # no date inside


def test_a_failed_save_leaves_the_old_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    fig = plotting.starts([1.0, 2.0])
    paths = plotting.save(fig, tmp_path / "a")
    before = [path.read_bytes() for path in paths]

    def broken(*_: Any) -> None:
        raise OSError("disk full")

    monkeypatch.setattr("os.replace", broken)
    with pytest.raises(OSError, match="disk full"):
        plotting.save(plotting.starts([3.0, 4.0, 5.0]), tmp_path / "a")
    assert [path.read_bytes() for path in paths] == before
    assert len(list(tmp_path.iterdir())) == 2


def test_figures_touch_no_global_state():
    code = (
        "import sys, matplotlib; from jaxlens import plotting;"
        "settings = lambda: {key: matplotlib.rcParams[key] for key in plotting.STYLE};"
        "before = settings(); plotting.starts([1.0]); assert settings() == before;"
        "assert not {'matplotlib.pyplot', 'astropy'} & set(sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


# --- the map -------------------------------------------------------------------------------------


def test_kappa_map_shows_curves_images_and_directions(tmp_path: Path, images: np.ndarray):
    systems = np.repeat(["1", "2", "10"], 4)
    ids = [f"{name}.{k}" for name in ("1", "2", "10") for k in range(4)]
    fig = plotting.kappa_map(
        kappa(),
        GRID,
        tangential=[25.0 * RING, 2.0 * RING + 20.0],
        radial=[8.0 * RING],
        caustics=[5.0 * RING, 3.0 * RING],
        theta=jnp.asarray(images),
        systems=systems,
        image_ids=ids,
        z_s=2.0,
        kappa_label="kappa at z = 2",
        kpc_per_arcsec=5.0,
        title="a cluster",
    )
    ax = fig.axes[0]
    assert "arcsec" in ax.get_xlabel() and "West" in ax.get_xlabel()
    assert "arcsec" in ax.get_ylabel() and "North" in ax.get_ylabel()
    assert ax.get_xlim() == (-40.0, 40.0)  # West to the right: East is left, as on the sky
    shown = texts(fig)
    assert {"E", "N", "a cluster", "kappa at z = 2", "100 kpc", *ids} <= set(shown)
    assert any("tangential" in text and "z_s = 2" in text for text in shown)
    assert any("caustics (source plane)" in text for text in shown)
    assert [len(lines(ax, colour)) for colour in ("#D55E00", "#0072B2", "#009E73")] == [2, 1, 2]
    np.testing.assert_allclose(lines(ax, "#D55E00")[0], 25.0 * RING)
    drawn = [line for line in ax.get_lines() if line.get_gid() == "images"]
    assert [len(np.asarray(line.get_xydata())) for line in drawn] == [4, 4, 4]
    assert len({(line.get_marker(), line.get_markeredgecolor()) for line in drawn}) == 3
    np.testing.assert_allclose(np.concatenate([np.asarray(line.get_xydata()) for line in drawn]), images)
    picture = ax.get_images()[0]
    assert picture.origin == "lower" and tuple(picture.get_extent()) == GRID.extent
    plotting.save(fig, tmp_path / "kappa")
    assert len(list(tmp_path.iterdir())) == 2


def test_kappa_map_of_nothing_but_kappa():
    fig = plotting.kappa_map(kappa(), GRID)
    assert not [text for text in texts(fig) if "critical" in text or "images" in text]
    linear = plotting.kappa_map(np.asarray(kappa()) - 1.0, GRID)  # negative values: no logarithm
    linear.draw_without_rendering()
    plotting.kappa_map(np.ones(GRID.shape), GRID).draw_without_rendering()


def test_kappa_map_refuses_what_does_not_fit():
    with pytest.raises(ValueError, match=r"shape \(2, 2\) but `grid.shape` is \(40, 40\)"):
        plotting.kappa_map(np.ones((2, 2)), GRID)
    with pytest.raises(ValueError, match="no finite value"):
        plotting.kappa_map(np.full(GRID.shape, np.nan), GRID)
    with pytest.raises(ValueError, match="1 `systems` for 2 images"):
        plotting.kappa_map(kappa(), GRID, theta=np.zeros((2, 2)), systems=["a"])


def test_names_of_close_images_do_not_overlap():
    fig = Figure(figsize=(4.0, 4.0))
    FigureCanvasAgg(fig)
    ax = fig.add_subplot()
    ax.set_xlim(0.0, 10.0)
    ax.set_ylim(0.0, 10.0)
    points = np.array([[5.0, 5.0], [5.2, 5.0], [5.0, 5.2], [5.2, 5.2], [9.95, 9.95]])
    place_labels(fig, ax, points, ["1.1", "1.2", "1.3", "1.4", "2.1"], ["black"] * 5)
    boxes = [text.get_window_extent() for text in ax.texts if isinstance(text, Annotation)]
    assert len(boxes) == 5
    for index, one in enumerate(boxes):
        assert not any(one.shrunk(0.8, 0.6).overlaps(other.shrunk(0.8, 0.6)) for other in boxes[:index])
        inside = ax.get_window_extent()
        assert inside.x0 <= one.x0 and one.x1 <= inside.x1 + 1.0


def test_systems_are_told_apart():
    assert len({cycle(index) for index in range(84)}) == 84


# --- residuals -----------------------------------------------------------------------------------


def test_residual_vectors(tmp_path: Path, images: np.ndarray):
    shift = np.random.default_rng(5).normal(0.0, 0.4, images.shape)
    predicted = images + shift
    predicted[3] = np.nan
    ids = [f"s{k}" for k in range(12)]
    fig = plotting.residual_vectors(
        jnp.asarray(images),
        jnp.asarray(predicted),
        produced=np.arange(12) != 7,
        image_ids=ids,
        sigma_pos=0.5,
        tangential=[20.0 * RING],
        exaggeration=10.0,
        source_definition="tensor",
        n_labels=3,
    )
    ax, histogram = fig.axes[:2]
    keep = np.delete(np.arange(12), [3, 7])
    arrows: Any = next(item for item in ax.collections if isinstance(item, Quiver))
    np.testing.assert_allclose(arrows.get_offsets(), images[keep])
    np.testing.assert_allclose(np.stack([arrows.U, arrows.V], axis=1), 10.0 * shift[keep])
    shown = texts(fig)
    rms = np.sqrt(np.mean(np.sum(shift[keep] ** 2, axis=1)))
    assert f"rms {rms:.3f} arcsec" in shown
    assert {"residual × 10", "not produced", "10 of 12 images produced, source: tensor"} <= set(shown)
    assert any("sigma" in text and "0.5" in text for text in shown)
    worst = keep[np.argsort(np.hypot(*shift[keep].T))[-3:]]
    named = {text.get_text() for text in ax.texts if text.get_text() in ids}
    assert named == {ids[3], ids[7], *(ids[k] for k in worst)}
    assert "arcsec" in histogram.get_xlabel() and histogram.get_ylabel() == "images"
    assert sum(bar.get_height() for bar in histogram.patches if isinstance(bar, Rectangle)) == 10
    key: Any = next(item for item in ax.artists if isinstance(item, QuiverKey))
    length, unit = key.text.get_text().split()
    assert unit == "arcsec" and pytest.approx(10.0 * float(length)) == key.U
    plotting.save(fig, tmp_path / "residuals")


def test_residual_vectors_of_extremes(images: np.ndarray):
    perfect = plotting.residual_vectors(images, images)
    assert "residual × 1" in texts(perfect)
    none = plotting.residual_vectors(images, np.full(images.shape, np.nan), image_ids=["a"] * 12)
    assert "0 of 12 images produced" in texts(none)
    for fig in (perfect, none):
        fig.draw_without_rendering()
    with pytest.raises(ValueError, match=r"`observed` has shape \(12, 2\), `predicted` \(3, 2\)"):
        plotting.residual_vectors(images, images[:3])


# --- starts --------------------------------------------------------------------------------------


def test_starts_are_sorted_and_told_apart(tmp_path: Path):
    chi2 = [35.0, 31.7503, np.nan, 31.75, 44.0, 31.7505]
    fig = plotting.starts(chi2, converged=[True, True, False, True, False, True], title="t")
    ax = fig.axes[0]
    by_label = {str(line.get_label()): np.asarray(line.get_xydata()) for line in ax.get_lines()}
    np.testing.assert_allclose(by_label["agree within 0.001 (3)"], [[1, 31.75], [2, 31.7503], [3, 31.7505]])
    np.testing.assert_allclose(by_label["converged elsewhere (1)"], [[4, 35.0]])
    np.testing.assert_allclose(by_label["not converged (1)"], [[5, 44.0]])
    np.testing.assert_allclose(by_label["lowest 31.75 (start 3)"], [[1, 31.75]])
    assert by_label["failed (1)"][0, 0] == 6
    assert "sorted" in ax.get_xlabel() and "chi^2" in ax.get_ylabel()
    plotting.save(fig, tmp_path / "starts")


def test_starts_over_a_wide_range_are_logarithmic_and_equal_ones_are_not_magnified():
    assert plotting.starts([10.0, 5000.0]).axes[0].get_yscale() == "log"
    low, high = plotting.starts(31.75 + 1e-9 * np.arange(4)).axes[0].get_ylim()
    assert high - low > 1.0
    failed = plotting.starts([np.nan, np.inf])
    assert "failed (2)" in texts(failed)


@pytest.mark.parametrize("converged", [[True], [[True, True]]])
def test_starts_refuses_lengths_that_differ(converged: Any):
    with pytest.raises(ValueError, match=r"`chi2` has shape \(2,\), `converged`"):
        plotting.starts([1.0, 2.0], converged=converged)
    with pytest.raises(ValueError, match="one of each per start"):
        plotting.starts([])


# --- covariance ----------------------------------------------------------------------------------

NAMES = ["O1.ellipticity", "O1.pa_deg", "O1.sigma_lt_km_s", "z.12"]


def normal(n: int) -> np.ndarray:
    factor = np.random.default_rng(6).normal(size=(n, n + 3))
    return factor @ factor.T


def test_covariance_as_a_corner(tmp_path: Path):
    matrix = (
        np.diag([0.01, 0.5, 15.0, 0.1])
        @ np.array([[1.0, 0.3, 0.0, 0.0], [0.3, 1.0, -0.8, 0.0], [0.0, -0.8, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
        @ np.diag([0.01, 0.5, 15.0, 0.1])
    )
    fig = plotting.covariance(NAMES, [0.5, -36.0, 1223.7, 3.2], matrix, at_bound=["z.12"], title="best")
    axes = np.array(fig.axes).reshape(4, 4)
    shown = texts(fig)
    assert {"best", "+0.30", "−0.80"} <= set(shown)
    rows = [text for text in shown if "±" in text and "\n" in text]
    assert rows[0].endswith("0.500 ± 0.010") and "[deg]\n−36.00 ± 0.50" in rows[1]
    assert "[km/s]\n1224 ± 15" in rows[2] and rows[3].endswith("3.20 ± 0.10\nat its bound")
    outer, inner = [patch for patch in axes[2, 1].patches if isinstance(patch, Ellipse)]
    assert outer.width == pytest.approx(2.0 * inner.width)
    assert (inner.width, inner.height) == pytest.approx((2.0 * np.sqrt(0.2), 2.0 * np.sqrt(1.8)))
    # The tangent to the 1 sigma ellipse is 1 sigma from the centre, whatever the correlation.
    reach = axes[2, 1].transData.inverted().transform(inner.get_verts())
    np.testing.assert_allclose(np.abs(reach).max(axis=0), 1.0, atol=0.01)
    plotting.save(fig, tmp_path / "covariance")


@pytest.mark.parametrize("n", [1, 12])
def test_covariance_of_few_and_of_many(n: int):
    fig = plotting.covariance([f"h{k}.mass_vir_msun" for k in range(n)], 1e14 * np.ones(n), 1e26 * normal(n))
    assert len(fig.axes) == n * n
    assert any("M$_\\odot$" in text and "10^{14}" in text for text in texts(fig))
    fig.draw_without_rendering()


def test_covariance_of_too_many_is_a_matrix():
    n = 13
    fig = plotting.covariance(
        [f"h{k}.x_arcsec" for k in range(n)], np.ones(n), normal(n), at_bound=["h2.x_arcsec"]
    )
    ax = fig.axes[0]
    assert [tick.get_text() for tick in ax.get_yticklabels()] == [f"h{k} $x$" for k in range(n)]
    assert ax.get_yticklabels()[2].get_color() != ax.get_yticklabels()[3].get_color()
    assert texts(fig).count("100") == n
    assert "correlation coefficient" in texts(fig)
    assert ax.get_images()[0].get_array().shape == (n, n, 3)  # pyright: ignore[reportOptionalMemberAccess]


def test_covariance_with_units_of_its_own():
    fig = plotting.covariance(["a.mass", "b.c"], [1e14, 2.0], np.diag([1e26, 1.0]), units=["Msun", ""])
    assert any("a $M$ [M$_\\odot$]" in text for text in texts(fig))
    assert any(text.startswith("b c\n2.0 ± 1.0") for text in texts(fig))


def test_covariance_of_a_fixed_number():
    fig = plotting.covariance(["a.x_arcsec", "a.y_arcsec"], [1.0, -2.0], np.diag([0.0, 4.0]))
    assert any(text.endswith("\n1") for text in texts(fig))
    fig.draw_without_rendering()


def test_covariance_refuses_shapes_that_differ():
    with pytest.raises(
        ValueError, match=r"2 `names`, `values` of shape \(2,\) and `covariance` of shape \(3, 3\)"
    ):
        plotting.covariance(["a", "b"], [1.0, 2.0], np.eye(3))


@pytest.mark.parametrize(
    ("value", "error", "text"),
    [
        (1223.737, 14.75, "1224 ± 15"),
        (-0.517298, 0.0110379, "−0.517 ± 0.011"),
        (20.13, 0.94, "20.13 ± 0.94"),
        (1.2e14, 3.4e12, r"(1.200 ± 0.034)$\times 10^{14}$"),
        (3.0, 0.0, "3"),
        (-2.5, np.nan, "−2.5"),
        (0.0, 12.0, "0 ± 12"),
    ],
)
def test_rounded(value: float, error: float, text: str):
    assert rounded(value, error) == text


def test_symbols():
    assert symbol("O1.r_core_arcsec") == ("O1", r"$r_{\rm core}$", "arcsec")
    assert symbol("members.sigma_ref_km_s") == ("members", r"$\sigma_{\rm ref}$", "km/s")
    assert symbol("z.3.2") == ("system 3.2", "$z$", "")
    assert symbol("odd_number") == ("", "odd number", "")


@pytest.mark.parametrize(("value", "step"), [(0.99, 0.5), (1.0, 1.0), (37.0, 20.0), (5000.0, 5000.0)])
def test_nice(value: float, step: float):
    assert nice(value) == pytest.approx(step)


# --- profiles ------------------------------------------------------------------------------------


def test_mass_profile(tmp_path: Path):
    r = jnp.geomspace(1.0, 100.0, 30)
    mass = {"fit": 1.1e12 * r**1.2, "published": 1e12 * r**1.2}
    kappa_of = {"fit": 1.8 / r, "published": 2.0 / r}
    fig = plotting.mass_profile(
        r,
        mass,
        kappa_of,
        bands={"fit": (0.9 * mass["fit"], 1.1 * mass["fit"])},
        theta_e={"fit": 30.0, "published": 31.0},
        images=[20.0, 40.0],
        kpc_per_arcsec=5.0,
    )
    (top_m, top_k, low_m, low_k), _ = fig.axes[:4], fig.axes[4:]
    assert "M" in top_m.get_ylabel() and "odot" in top_m.get_ylabel() and "kappa" in top_k.get_ylabel()
    assert low_m.get_xlabel() == "$R$ [arcsec]" and low_m.get_ylabel() == "ratio to\npublished"
    np.testing.assert_allclose(heights(low_m), 1.1)
    np.testing.assert_allclose(heights(low_k), 0.9)
    np.testing.assert_allclose(heights(top_m), mass["fit"])
    assert top_m.get_xscale() == top_m.get_yscale() == "log"
    assert len(top_m.collections) == 1 and not top_k.collections
    assert {"fit", "published", "images"} <= set(texts(fig))
    kpc = top_m.child_axes[0]
    fig.draw_without_rendering()
    assert kpc.get_xlabel() == "$R$ [kpc]"
    np.testing.assert_allclose(kpc.get_xlim(), (5.0, 500.0))
    plotting.save(fig, tmp_path / "profile")


def test_mass_profile_refuses():
    r = np.ones(3)
    with pytest.raises(ValueError, match=r"`mass` has the models \['a'\], `kappa` \['b'\]"):
        plotting.mass_profile(r, {"a": r}, {"b": r})
    with pytest.raises(ValueError, match="profiles of 'a' do not have the length"):
        plotting.mass_profile(r, {"a": r[:2]}, {"a": r})
    with pytest.raises(ValueError, match=r"`reference` is 'c'; choose one of \['a'\]"):
        plotting.mass_profile(r, {"a": r}, {"a": r}, reference="c")
