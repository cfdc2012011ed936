"""Figures of simulated fields show what they were given."""

import numpy as np
import pytest
from matplotlib.figure import Figure

from jaxlens import plotting
from jaxlens.cosmology import FlatLCDM
from jaxlens.grid import Grid
from jaxlens.simulate import luminosity_function

GRID = Grid((24, 24), 10.0)


def texts(fig: Figure) -> str:
    fig.canvas.draw()
    parts = [ax.get_xlabel() + ax.get_ylabel() + ax.get_title() for ax in fig.axes]
    legends = [*fig.legends, *(ax.get_legend() for ax in fig.axes)]
    return " ".join(parts + [t.get_text() for one in legends if one is not None for t in one.get_texts()])


def test_a_cluster_with_members_and_images():
    rng = np.random.default_rng(0)
    kappa = np.exp(-np.hypot(*np.moveaxis(np.asarray(GRID.theta), -1, 0)) / 50.0) + 0.02
    fig = plotting.simulated_cluster(
        kappa,
        GRID,
        members=rng.uniform(-100.0, 100.0, (30, 2)),
        luminosity=rng.uniform(0.0, 1.0, 30),
        bcg=np.arange(30) < 2,
        tangential=[np.array([[0.0, 10.0], [10.0, 0.0], [-10.0, -10.0], [0.0, 10.0]])],
        theta=np.array([[12.0, 3.0], [-9.0, 4.0], [1.0, 15.0]]),
        systems=["a", "a", "b"],
        z_s=2.0,
        kpc_per_arcsec=4.45,
    )
    said = texts(fig)
    assert "tangential critical curve" in said
    assert "radial" not in said
    drawn = [line for line in fig.axes[1].lines if line.get_gid() == "images"]
    assert [len(np.asarray(line.get_xdata())) for line in drawn] == [2, 1]
    with pytest.raises(ValueError, match="give the map's own grid"):
        plotting.simulated_cluster(
            kappa[1:], GRID, members=np.zeros((0, 2)), luminosity=[], bcg=[], theta=[], systems=[], z_s=2.0
        )


def test_sources_without_a_system():
    expected = luminosity_function.counts(0.3, FlatLCDM(h=0.7, omega_m=0.3), luminosity_function.Depth())
    fig = plotting.source_population(
        np.array([1.0, 2.0, 5.0]),
        np.array([27.0, 30.0, 31.5]),
        expected=expected,
        area=900.0,
        systems=np.zeros(0, int),
        image_radius=np.array([10.0, 200.0]),
        image_mag=np.array([26.0, 31.0]),
        detected=np.array([True, False]),
        limit=(29.5, 1.5, 100.0),
    )
    assert "source redshift" in texts(fig)
    assert "brighter than the limit" in texts(fig)


def test_weak_data_has_its_four_panels():
    rng = np.random.default_rng(0)
    g = 0.3 * (rng.normal(size=GRID.shape) + 1j * rng.normal(size=GRID.shape))
    fig = plotting.weak_data(np.full(GRID.shape, 12), np.abs(g) < 0.5, g, GRID, kpc_per_arcsec=4.45)
    shown = [ax.images[0].get_array() for ax in fig.axes[:4]]
    assert np.array_equal(np.asarray(shown[2]), np.real(g))
    assert np.array_equal(np.asarray(shown[3]), np.imag(g))
    assert np.array_equal(np.asarray(shown[1]), (np.abs(g) < 0.5).astype(float))
    with pytest.raises(ValueError, match="own grid"):
        plotting.weak_data(np.ones((3, 3)), np.ones((3, 3)), np.ones((3, 3), complex), GRID)
