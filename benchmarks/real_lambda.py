"""Simulated twins of Abell S1063 and Abell 2744: how often the truth lies inside the reported intervals.

Each twin has the images, galaxies, mask and noise of the real field, the published model as its lens, a
calibration and redshifts drawn from their priors; every second one has subhaloes that no model knows.

    python benchmarks/real_lambda.py [--smoke] [--clusters as1063,abell2744] [--twins N]
"""

import sys
import time

import jax

jax.config.update("jax_enable_x64", True)

import numpy as np  # noqa: E402
from _harness import Report, parser  # noqa: E402

from jaxlens import analysis_real, twin_real, workflow_real  # noqa: E402


def binomial(inside: int, n: int) -> str:
    """A share and its standard error."""
    share = inside / max(n, 1)
    return f"{inside} of {n} ({100 * share:.0f} +- {100 * (share * (1 - share) / max(n, 1)) ** 0.5:.0f} %)"


def cluster(report: Report, name: str, twins: int, draws: int) -> None:
    """The real cluster, then its twins."""
    known = workflow_real.load(name)
    start = time.perf_counter()
    real = analysis_real.analyse(known, workflow_real.Options(starts=1 if report.smoke else 4, draws=draws))
    seconds = time.perf_counter() - start
    report.check(
        f"{name}: the real cluster in {seconds:.0f} s, compilation included (limit 300 s)", seconds < 300
    )
    assert known.published is not None
    found: dict[str, list[tuple[bool, twin_real.Judgement]]] = {one.key: [] for one in known.samples}
    for number in range(twins):
        rich = number % 2 == 0
        made, truth = twin_real.twin(
            known, real.fit.u, known.published, jax.random.key(number), substructure=rich
        )
        result = analysis_real.analyse(made, workflow_real.Options(starts=1, draws=draws, seed=number))
        for one in result.outcomes:
            found[one.sample.key].append((rich, twin_real.judge(one, truth)))
    for key, judged in found.items():
        every = [one for _, one in judged]
        inside = sum(one.lam_inside for one in every)
        off = np.array([one.lam - one.lam_true for one in every])
        print(f"{name}, {key}: lambda - truth {off.mean():+.3f}, scatter {off.std():.3f}")
        text = f"{name}, {key}: true lambda inside the 68 % interval in {binomial(inside, twins)}"
        # A share of 0.68 leaves 0.50-0.85 in 0.7 % of sets of 50.
        report.check(f"{text} (50 to 85 %)", report.smoke or 0.5 <= inside / twins <= 0.85)
        with_one = [one for one in every if one.radius_inside is not None]
        hits = sum(bool(one.radius_inside) for one in with_one)
        print(f"{name}, {key}: the truth has a transition in {len(with_one)}; inside in {hits}")
        without = [one for one in every if one.radius_inside is None]
        quiet = sum(bool(np.isnan(one.radius)) for one in without)
        print(f"{name}, {key}: without one, 'not found' in {binomial(quiet, len(without))}")
        for rich, label in ((True, "subhaloes"), (False, "no subhaloes")):
            shares = [one.share for had, one in judged if had is rich]
            if shares:
                print(f"  {label}: a transition in {100 * np.mean(shares):.0f} % of the draws on average")


def main() -> int:
    """Run everything."""
    options = parser(__doc__ or "")
    options.add_argument("--clusters", default="as1063,abell2744")
    options.add_argument("--twins", type=int, default=50)
    said = options.parse_args()
    report = Report("real_lambda", said)
    names = ["as1063"] if report.smoke else said.clusters.split(",")
    for name in names:
        cluster(report, name, 1 if report.smoke else said.twins, 8 if report.smoke else 50)
    return report.finish()


if __name__ == "__main__":
    sys.exit(main())
