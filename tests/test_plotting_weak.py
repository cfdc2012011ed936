"""Figures of weak lensing: what they show and say, and what they refuse."""

from collections.abc import Iterator
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.container import ErrorbarContainer
from matplotlib.contour import ContourSet
from matplotlib.figure import Figure
from matplotlib.quiver import Quiver, QuiverKey
from matplotlib.text import Text

from jaxlens import plotting
from jaxlens.grid import Grid

GRID = Grid(shape=(8, 10), pixel=15.0, centre=(5.0, 0.0))
RNG = np.random.default_rng(0)
KAPPA = np.asarray(0.4 * jnp.exp(-((GRID.radius / 40.0) ** 2))) - 0.05


def texts(fig: Figure) -> list[str]:
    return [text.get_text() for text in fig.findobj(Text) if isinstance(text, Text) and text.get_text()]


def found(axes: Axes, kind: type) -> Iterator[Any]:
    return (child for child in axes.get_children() if isinstance(child, kind))


# --- maps ----------------------------------------------------------------------------------------


def test_both_modes_share_one_scale_and_the_peak_is_marked():
    fig = plotting.shear_maps(
        jnp.asarray(KAPPA),
        0.2 * KAPPA,
        GRID,
        snr=20.0 * KAPPA,
        weight=np.where(GRID.x > -50.0, 1.0, 0.0) * np.ones((8, 1)),
        peak=jnp.array([5.0, 1.0]),
        density=np.maximum(KAPPA, 0.0),
        density_label="members",
        kpc_per_arcsec=5.0,
        title="name",
    )
    panels = fig.axes[:3]
    images = [ax.get_images()[0] for ax in panels]
    limits = [image.get_clim() for image in images]
    largest = np.abs(KAPPA).max()
    np.testing.assert_allclose(limits[0], (-largest, largest))
    assert limits[1] == limits[0] != limits[2]
    shown = images[0].get_array()
    assert shown is not None and np.ma.getmaskarray(np.ma.masked_invalid(shown))[:, :1].all()
    for ax in panels:
        (mark,) = [line for line in ax.get_lines() if line.get_gid() == "peak"]
        np.testing.assert_array_equal(mark.get_xydata(), [[5.0, 1.0]])
    said = texts(fig)
    assert {"name", "members", "S/N", r"$\kappa_{\rm E}$", r"$\kappa_{\rm B}$"} <= set(said)
    assert "100 kpc" in said
    assert any(text.startswith("contours on the first map: S/N = 2, 3, ..., ") for text in said)
    # S/N from 2 in steps of 1 on the first panel; the density on the last.
    assert [len(list(found(ax, ContourSet))) for ax in panels] == [1, 0, 1]
    (contours,) = found(panels[0], ContourSet)
    np.testing.assert_array_equal(contours.levels, np.arange(2.0, 20.0 * KAPPA.max()))


def test_strong_signals_have_no_more_contours_than_weak_ones():
    fig = plotting.shear_maps(KAPPA, 0.2 * KAPPA, GRID, snr=70.0 * KAPPA)
    (contours,) = found(fig.axes[0], ContourSet)
    np.testing.assert_array_equal(contours.levels, [5.0, 10.0, 15.0, 20.0])
    assert "contours on the first map: S/N = 5, 10, ..., 20" in texts(fig)


def test_two_panels_without_signal_to_noise_and_a_map_of_nothing():
    fig = plotting.shear_maps(0.0 * KAPPA, 0.0 * KAPPA, GRID)
    assert len([ax for ax in fig.axes if ax.get_images()]) == 2
    with pytest.raises(ValueError, match=r"`kappa_b` has shape \(10, 8\) but `grid.shape` is \(8, 10\)"):
        plotting.shear_maps(KAPPA, KAPPA.T, GRID)


# --- sticks --------------------------------------------------------------------------------------


def test_sticks_lie_along_the_stretch_and_skip_empty_pixels():
    g = np.full(GRID.shape, 0.2 * np.exp(2j * 0.6))
    weight = np.ones(GRID.shape)
    weight[2, 3], g[4, 4] = 0.0, np.nan
    fig = plotting.shear_sticks(g, weight, GRID, kappa=KAPPA, centre=(0.0, 0.0))
    (sticks,) = found(fig.axes[0], Quiver)
    assert sticks.N == 78
    np.testing.assert_allclose(np.arctan2(sticks.V, sticks.U), 0.6)
    np.testing.assert_allclose(np.hypot(sticks.U, sticks.V), 1.5 * GRID.pixel)
    at = {(round(float(x), 6), round(float(y), 6)) for x, y in sticks.XY}
    assert (float(GRID.x[3]), float(GRID.y[2])) not in at and (float(GRID.x[3]), float(GRID.y[3])) in at
    (key,) = found(fig.axes[0], QuiverKey)
    assert key.text.get_text() == "$|g| = 0.2$"
    fig.draw_without_rendering()
    box = key.text.get_window_extent()
    assert box.y0 > 0.0 and box.x0 > 0.0  # on the page
    fig = plotting.shear_sticks(g, weight, GRID, kappa=KAPPA, smoothing=15.0)
    (key,) = found(fig.axes[0], QuiverKey)
    assert key.text.get_text() == r"$|g| = 0.2$, shear smoothed with $\sigma = 15$ arcsec"
    fig.draw_without_rendering()
    below, axis = key.text.get_window_extent(), fig.axes[0].xaxis.label.get_window_extent()
    assert below.y0 > 0.0 and below.y1 < axis.y0 and below.x1 < fig.bbox.x1


def test_a_stick_every_other_pixel():
    fig = plotting.shear_sticks(np.full(GRID.shape, 0.1 + 0j), np.ones(GRID.shape), GRID, step=2)
    (sticks,) = found(fig.axes[0], Quiver)
    assert sticks.N == 20
    with pytest.raises(ValueError, match="No pixel has positive weight"):
        plotting.shear_sticks(np.zeros(GRID.shape), np.zeros(GRID.shape), GRID)


# --- numbers -------------------------------------------------------------------------------------

PROFILE: dict[str, Any] = {
    "r": [40.0, 60.0, 90.0],
    "g_t": [0.2, 0.1, 0.05],
    "g_x": [0.01, -0.02, 0.0],
    "sigma_t": [0.03, 0.02, np.inf],
    "sigma_x": [0.03, 0.02, np.inf],
}


def test_the_profile_shows_bins_with_an_error_alone_and_the_model():
    fig = plotting.tangential_profile(
        **PROFILE,
        edges=[30.0, 50.0, 70.0, 110.0],
        model_r=[30.0, 110.0],
        model=[0.25, 0.04],
        model_band=([0.2, 0.03], [0.3, 0.05]),
        model_label="a halo",
        kpc_per_arcsec=5.0,
        title="name",
    )
    top, bottom = fig.axes[:2]
    for ax, heights in ((top, [0.2, 0.1]), (bottom, [0.01, -0.02])):
        (bars,) = (one for one in ax.containers if isinstance(one, ErrorbarContainer))
        np.testing.assert_array_equal(
            bars.lines[0].get_xydata(), list(zip([40.0, 60.0], heights, strict=True))
        )
        assert len(list(found(ax, LineCollection))) == 2  # errors, and widths of the bins
    assert {"a halo", r"$g_{\rm t}$", r"$g_\times$", r"$r$ [arcsec]", r"$r$ [kpc]", "name"} <= set(texts(fig))
    low, high = bottom.get_ylim()
    assert low == -high


def test_profiles_of_different_length_are_refused():
    with pytest.raises(ValueError, match=r"`g_x` has shape \(2,\) but `r` has \(3,\); one per bin"):
        plotting.tangential_profile(**{**PROFILE, "g_x": [0.0, 0.0]})
    with pytest.raises(ValueError, match=r"`edges` has shape \(3,\) for 3 bins; give one more than bins"):
        plotting.tangential_profile(**PROFILE, edges=[1.0, 2.0, 3.0])


def test_the_history_has_the_line_of_the_spectral_radius():
    change = [0.2, 0.02, 4e-3, 1e-3]
    fig = plotting.iteration_history(change, spectral_radius=0.25, used=3, title="A2")
    (ax,) = fig.axes
    data, line, used = ax.get_lines()
    np.testing.assert_array_equal(data.get_xydata(), list(enumerate(change, 1)))
    np.testing.assert_allclose(np.asarray(line.get_ydata()), [0.064, 0.016, 4e-3, 1e-3])
    np.testing.assert_array_equal(used.get_xdata(), 3)
    assert ax.get_yscale() == "log"
    assert any(r"\rho = 0.25" in text and "diverges" not in text for text in texts(fig))
    loud = plotting.iteration_history([1.0, 2.0, 4.0], spectral_radius=2.0)
    assert any("diverges" in text for text in texts(loud))


def test_a_history_needs_an_iteration_and_may_hold_a_zero():
    with pytest.raises(ValueError, match=r"`change` has shape \(0,\); give one number for each iteration"):
        plotting.iteration_history([])
    plotting.iteration_history([1.0, 0.0, np.inf], spectral_radius=0.0)
