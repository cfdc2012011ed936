"""The files of a simulated field: several bins, an earlier field in the same place, other processes."""

import hashlib
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from jaxlens import config_simulate, results_simulate, simulate, workflow_weak

SMALL: dict[str, Any] = {
    "seed": 3,
    "cluster": {"subhaloes": False, "clumps": [{"mass_msun_h": 6e14, "concentration": 4.0}]},
    "sources": {"box_arcsec": 6.0},
    "images": {"half_width_arcsec": 40.0},
    "shear": {
        "map_pixels": 256,
        "pixels": 24,
        "density_arcmin2": 40.0,
        "mode": "periodic",
        "bins": [{"z_s": 1.0, "share": 0.3}, {"z_s": 3.0, "share": 0.7}],
    },
}


@pytest.fixture(scope="module")
def mocks() -> dict[str, tuple[simulate.Mock, config_simulate.Simulate]]:
    """A field with two bins and systems, and the same with one bin and none."""
    two = config_simulate.parse(SMALL, "test")
    shear = {**SMALL["shear"], "bins": [{"z_s": 2.0, "share": 1.0}]}
    one = config_simulate.parse(
        {**SMALL, "shear": shear, "images": {**SMALL["images"], "m_tele": 5.0}}, "test"
    )
    made = {
        "two": (simulate.mock(two.seed, two.settings), two),
        "one": (simulate.mock(one.seed, one.settings), one),
    }
    assert made["two"][0].strong.catalogue.n_systems > 0
    assert made["one"][0].strong.catalogue.n_systems == 0
    return made


@pytest.fixture
def no_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(results_simulate, "figures", lambda *_: {})


@pytest.mark.usefixtures("no_figures")
def test_the_weak_command_reads_both_bins(mocks: Any, tmp_path: Path):
    mock, said = mocks["two"]
    results_simulate.write(mock, said, tmp_path)
    maps = [workflow_weak.field(str(tmp_path / name)) for name in ("shear.fits", "shear_2.fits")]
    for found, one in zip(maps, mock.bins, strict=True):
        used = np.asarray(one.shear.weight) > 0.0
        assert found.header["ZSOURCE"] == one.z_s
        assert np.array_equal(np.asarray(found.shear.g)[used], np.asarray(one.shear.g)[used])
        assert np.array_equal(np.asarray(found.shear.n_gal), np.asarray(one.shear.n_gal))
    # The catalogue has both, each galaxy at its own depth.
    setup = workflow_weak.load(str(tmp_path))
    total = sum(np.where(np.asarray(b.shear.weight) > 0, np.asarray(b.shear.n_gal), 0) for b in mock.bins)
    assert np.array_equal(np.asarray(setup.shear.n_gal), total)
    ratio = [float(mock.cluster.plane.dls_ds(z)) for z in (1.0, 3.0)]
    assert ratio[0] < float(setup.depth.mean) < ratio[1]


@pytest.mark.usefixtures("no_figures")
def test_files_of_an_earlier_field_do_not_stay_beside_the_new_ones(mocks: Any, tmp_path: Path):
    out = tmp_path / "out"
    first = results_simulate.write(mocks["two"][0], mocks["two"][1], out)
    assert first["removed"] == []
    (out / "notes.txt").write_text("mine", encoding="utf-8")
    optional = {"strong.toml", "shear_2.fits", "truth_2.fits"}
    assert optional <= {path.name for path in out.iterdir()}
    second = results_simulate.write(mocks["one"][0], mocks["one"][1], out)
    assert set(second["removed"]) == optional
    left = {path.name for path in out.iterdir()}
    assert not optional & left
    assert {"notes.txt", "shear.fits", "images.ecsv"} <= left
    assert "removed from an earlier result: shear_2.fits, strong.toml" in results_simulate.verdict(second)


@pytest.mark.usefixtures("no_figures")
def test_a_file_that_no_field_left_there_stays(mocks: Any, tmp_path: Path):
    (tmp_path / "strong.toml").write_text("mine", encoding="utf-8")
    assert results_simulate.write(mocks["one"][0], mocks["one"][1], tmp_path)["removed"] == []
    assert (tmp_path / "strong.toml").read_text(encoding="utf-8") == "mine"


def test_what_is_said_about_the_main_caustic(mocks: Any):
    mock, said = mocks["one"]
    content = results_simulate.summary(mock, said)
    states = {
        "leaves the box of the sources by 2.5 arcsec": (-2.5, False),
        "the window cuts the main critical curve": (float("nan"), True),
        "no critical curve closes in the window": (float("nan"), False),
    }
    for text, (margin, cut) in states.items():
        lines = results_simulate.verdict(
            {**content, "caustic_margin_arcsec": margin, "caustic_cut_by_window": cut}
        )
        assert [other for other in states if other in lines] == [text]
    inside = results_simulate.verdict(
        {**content, "caustic_margin_arcsec": 1.0, "caustic_cut_by_window": False}
    )
    assert not any(text in inside for text in states)


PROGRAM = """
import hashlib
from functools import partial
import jax
jax.config.update("jax_enable_x64", True)
import numpy as np
from jaxlens import simulate
clumps = (simulate.Clump(6e14, concentration=4.0),)
cluster = simulate.draw_cluster(jax.random.key(0), simulate.ClusterSettings(clumps=clumps, subhaloes=False))
settings = simulate.ShearSettings(map_pixels=256, pixels=24)
found = simulate.true_field(cluster.lens, partial(simulate.render, cluster), settings)
print(hashlib.sha256(b"".join(np.asarray(x).tobytes() for x in (found.kappa, found.gamma))).hexdigest())
"""


def test_extended_shear_has_the_same_bytes_in_every_process():
    # Another number of threads, so that work is shared out differently.
    said = []
    for threads in ("1", "2"):
        done = subprocess.run(
            [sys.executable, "-c", PROGRAM],
            env={**os.environ, "OMP_NUM_THREADS": threads},
            capture_output=True,
            text=True,
            check=True,
            timeout=300,
        )
        said.append(done.stdout.strip())
    assert len(said[0]) == hashlib.sha256().digest_size * 2
    assert said[0] == said[1]
