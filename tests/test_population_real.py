"""Small clusters of a population, computed."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from population_support import files_of

from jaxlens import population
from jaxlens.config_population import Population


@pytest.mark.long
def test_real_clusters_have_the_same_bytes_in_any_way(tmp_path: Path):
    """Small maps; two workers, then one that ends after the last cluster and goes on with the others."""
    base = Population()
    simulation = base.simulate.model_copy(
        update={
            "shear": replace(base.simulate.shear, map_pixels=512),
            "cluster": replace(base.simulate.cluster, m_min_msun_h=1e12),
        }
    )
    said = base.model_copy(update={"simulate": simulation})
    clusters = {seed: population.settings_of(seed, said) for seed in (1000, 1001)}
    two, one = tmp_path / "two", tmp_path / "one"
    two.mkdir()
    one.mkdir()
    cache = str(tmp_path / "programs")
    with population.local(2) as client:
        rows = population.run(client, clusters, 64, two, cache=cache)
    with population.local(1) as client:
        population.run(client, {1001: clusters[1001]}, 64, one, cache=cache)
        population.run(client, clusters, 64, one, cache=cache)
    assert len(files_of(two)) == 2 and files_of(one) == files_of(two)
    assert {path.name for path in Path(cache).iterdir()} == {"worker_0", "worker_1"}
    good = [row for row in rows if "failed" not in row]
    assert good, rows
    table = population.columns(rows)
    drawn = [population.numbers_of(row["seed"], said.population) for row in rows]
    for column, name in (("z_l", "z_l"), ("n0_arcmin2", "n0"), ("m_tele", "m_tele")):
        assert_allclose(table[column], np.where(table["failed"] == "", [one[name] for one in drawn], np.nan))
    for name in ("mass_ratio", "pa_difference_deg", "separation_kpc_h"):
        expected = np.where(table["failed"] == "", [one[name] for one in drawn], np.nan)
        assert_allclose(table[name], expected, rtol=1e-12)
    for row in good:
        assert {"excess_ratio_of_means", "lambda_true_inner", "lambda_rec_noiseless"} <= set(row)
        # Pixel by pixel lambda_rec is lambda_map over the strong-lensing map's own factor; medians of a
        # ratio differ from the ratio of medians by the scatter of both, a few per cent.
        expected = row["lambda_true_inner"] / row["lambda_sl"]
        assert_allclose(row["lambda_rec_noiseless"], expected, rtol=0.05)
        none = row["transition_kpc_h"] is None
        assert none or row["transition_lo_kpc_h"] != 0.0
        assert not none or row["transition_lo_kpc_h"] is row["transition_hi_kpc_h"] is None
