"""Figures of the mass-sheet factor: what they show and say, and what they refuse."""

from typing import Any

import numpy as np
import pytest
from matplotlib.container import ErrorbarContainer
from matplotlib.figure import Figure
from matplotlib.text import Text

from jaxlens import plotting
from jaxlens.grid import Grid
from jaxlens.plotting import Band, Curve

X = np.linspace(1.0, 1.3, 301)
EDGES = np.arange(50.0, 401.0, 50.0)
R = 0.5 * (EDGES[:-1] + EDGES[1:])
FLAT = Band(np.full(7, 1.15), np.full(7, 1.12), np.full(7, 1.20))


def texts(fig: Figure) -> str:
    return "\n".join(text.get_text() for text in fig.findobj(Text) if isinstance(text, Text))


def gauss(at: float, width: float) -> np.ndarray:
    return np.exp(-0.5 * ((X - at) / width) ** 2) / width / np.sqrt(2.0 * np.pi)


def lines(fig: Figure, gid: str) -> list[float]:
    return [
        float(np.asarray(line.get_xdata())[0])
        for ax in fig.axes
        for line in ax.get_lines()
        if line.get_gid() == gid
    ]


def test_distributions_with_their_peaks():
    fig = plotting.lambda_pdf(
        {
            "A2": Curve(X, gauss(1.146, 0.01), 1.146, 0.1 * gauss(1.146, 0.01)),
            "K2": Curve(X, gauss(1.17, 0.02), 1.17),
        },
        reference=1.15,
        title="name",
    )
    (ax,) = fig.axes
    assert lines(fig, "peak") == [1.146, 1.17] and lines(fig, "reference") == [1.15]
    said = texts(fig)
    assert r"A2, $\lambda_P = 1.146$" in said and "noiseless" in said and "probability density" in said
    low, high = ax.get_xlim()
    assert 1.08 < low < 1.12 and 1.22 < high < 1.26  # 3.3 standard deviations of the broader one
    assert ax.get_ylim()[1] > 1.1 * 1.3 * gauss(1.146, 0.01).max()  # the legend stands above the peak


def test_curves_must_have_equal_lengths():
    with pytest.raises(ValueError, match=r"A2 has x \(301,\) and density \(3,\)"):
        plotting.lambda_pdf({"A2": Curve(X, np.ones(3))})
    with pytest.raises(ValueError, match="`curves` is empty"):
        plotting.lambda_pdf({})


def test_the_input_leaves_masked_pixels_out():
    grid, rng = Grid((10, 12), 10.0), np.random.default_rng(0)
    g = 0.1 * (rng.normal(size=grid.shape) + 1j * rng.normal(size=grid.shape))
    weight = np.ones(grid.shape)
    weight[4:6, 5:7] = 0.0
    fig = plotting.shear_input(np.full(grid.shape, 12), weight, g, 0.5 * g, grid, title="name")
    panels = {ax.get_title(): ax.get_images()[0] for ax in fig.axes if ax.get_images() and ax.get_title()}
    assert set(panels) == {
        r"$N_{\rm pix}$", r"$g_1$", r"$g_2$", "mask (white: used)", r"$g_1^{\rm sm}$", r"$g_2^{\rm sm}$"
    }  # fmt: skip
    shown = np.ma.filled(np.ma.masked_invalid(np.ma.asarray(panels[r"$g_2$"].get_array())), np.nan)
    assert np.isnan(shown[4:6, 5:7]).all()
    np.testing.assert_array_equal(shown[0], g[0].imag)
    low, high = panels[r"$g_1$"].get_clim()
    assert low == -high
    with pytest.raises(ValueError, match=r"`g` has shape \(12, 10\)"):
        plotting.shear_input(np.ones(grid.shape), weight, g.T, g, grid)


def test_the_profile_shows_transition_region_and_errors():
    region = np.array([0, 0, 1, 1, 0, 0, 0], bool)
    fig = plotting.lambda_profile(
        EDGES,
        FLAT,
        lam_true=1.146,
        lam_inner=1.141,
        rmse_sl=np.linspace(0.0, 0.03, 7),
        rmse_wl=np.full(7, 0.015),
        region=region,
        transition=210.0,
        transition_range=(190.0, 240.0),
        title="name",
    )
    top, bottom = fig.axes
    (bars,) = (one for one in top.containers if isinstance(one, ErrorbarContainer))
    np.testing.assert_array_equal(bars.lines[0].get_xdata(), R)
    assert lines(fig, "transition") == [210.0, 210.0]
    said = texts(fig)
    for word in (r"\lambda_P = 1.141", "noiseless", "strong lensing", "transition region", "RMSE", "= 210"):
        assert word in said
    assert len(bottom.patches) == 3 and bottom.get_yscale() == "log"  # two annuli and the range
    drawn = np.asarray(bottom.get_lines()[1].get_ydata(), float)
    assert np.isnan(drawn[0]) or np.isnan(np.asarray(bottom.get_lines()[0].get_ydata(), float)[0])


def test_one_panel_without_errors_and_no_transition():
    fig = plotting.lambda_profile(EDGES, FLAT)
    assert len(fig.axes) == 1 and not lines(fig, "transition")
    with pytest.raises(ValueError, match="`rmse_sl` has 3 entries for 7 annuli"):
        plotting.lambda_profile(EDGES, FLAT, rmse_sl=np.ones(3))


def test_kappa_of_both_probes_and_the_truth():
    kappa = 20.0 / R
    band = Band(kappa, 0.9 * kappa, 1.1 * kappa)
    profiles: dict[str, Any] = {"weak": band, "strong": Band(1.02 * kappa, kappa, 1.1 * kappa)}
    fig = plotting.kappa_profiles(EDGES, profiles, truth=band)
    (ax,) = fig.axes
    (inset,) = ax.child_axes
    assert inset.get_xlim() == (100.0, 330.0)
    for panel in (ax, inset):
        made = [one for one in panel.containers if isinstance(one, ErrorbarContainer)]
        assert len(made) == 2
        left, right = (np.asarray(one.lines[0].get_xdata(), float) for one in made)
        assert (left < R).all() and (right > R).all()
    assert not plotting.kappa_profiles(EDGES, profiles, inset=None).axes[0].child_axes
    with pytest.raises(ValueError, match="`weak` has 2 entries for 7 annuli"):
        plotting.kappa_profiles(EDGES, {"weak": Band([1, 2], [1, 2], [1, 2])})


def test_maps_of_lambda_share_a_scale():
    grid, rng = Grid((8, 8), 10.0), np.random.default_rng(0)
    weight = np.ones(grid.shape)
    weight[3, 3] = 0.0
    maps = {name: 1.15 + width * rng.normal(size=grid.shape) for name, width in (("A2", 0.01), ("K2", 0.05))}
    fig = plotting.lambda_maps(maps, weight, grid, title="name")
    images = [ax.get_images()[0] for ax in fig.axes if ax.get_images()][:2]
    assert images[0].get_clim() == images[1].get_clim()
    assert np.ma.getmaskarray(np.ma.masked_invalid(np.ma.asarray(images[0].get_array())))[3, 3]
