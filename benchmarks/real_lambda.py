"""Simulated twins of Abell S1063 and Abell 2744: how often the truth lies inside the reported intervals.

Each twin has the images, galaxies, mask and noise of the real field, the published model as its lens, a
calibration and redshifts drawn from their priors; every second one has subhaloes that no model knows. Every
twin is a line of a file (`--lines`), written as soon as it is judged; the same command goes on behind the
last line.

    python benchmarks/real_lambda.py [--smoke] [--clusters as1063,abell2744] [--twins N] [--lines FILE]
        [--joint N] [--only-print]
"""

import json
import sys
import time
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import jax

jax.config.update("jax_enable_x64", True)

import numpy as np  # noqa: E402
from _harness import ROOT, Report, parser  # noqa: E402

from jaxlens import analysis_real, maps_real, twin_real, workflow_real  # noqa: E402

SEED = 1_000_000
"""First seed of the twins: far from those of their analysis, which would else share random keys."""


def binomial(inside: int, n: int) -> str:
    """A share and its standard error."""
    share = inside / max(n, 1)
    return f"{inside} of {n} ({100 * share:.0f} +- {100 * (share * (1 - share) / max(n, 1)) ** 0.5:.0f} %)"


def masked(known: workflow_real.Cluster, fit: Any) -> workflow_real.Cluster:
    """The cluster with the mask of the real field: where the fit of its images has |g| > 0.5."""
    lens = known.strong.problem.predict(fit.u).lens
    samples = []
    for one in known.samples:
        g = maps_real.reduced(maps_real.maps_of(lens, one.field.grid, one.field.smoothing), one.dls_ds)
        samples.append(one.within(abs(g) <= workflow_real.Options().max_g))
    return replace(known, samples=tuple(samples))


def judged(
    known: workflow_real.Cluster, fit: Any, number: int, draws: int, joint: bool
) -> list[dict[str, Any]]:
    """One twin: a line for each sample of galaxies."""
    assert known.published is not None
    known = masked(known, fit)
    rich = number % 2 == 0
    key = jax.random.key(SEED + number)
    made, truth = twin_real.twin(known, fit.u, known.published, key, substructure=rich)
    start = time.perf_counter()
    options = workflow_real.Options(starts=1, draws=draws, seed=number, max_g=1.0, joint=joint, fields=0)
    result = analysis_real.analyse(made, options)
    lines = []
    for one in result.outcomes:
        found = twin_real.judge(one, truth)
        line = {"twin": number, "sample": one.sample.key, "subhaloes": rich, **asdict(found)}
        line |= {"lam_inside": found.lam_inside, "radius_inside": found.radius_inside}
        line |= {"m_true": truth.calibration[one.sample.key], "images_kept": truth.images_kept}
        line |= {"dls_ds_true": truth.dls_ds[one.sample.key], "dls_ds": one.sample.dls_ds}
        line |= {"chi2": float(result.fit.chi2), "expected": one.expected_inner}
        line |= {"sources": {key: list(one.budget.inner_interval(key)) for key in one.budget.inner}}
        if one.joint is not None:
            names = ("lam", "m", "lam_error", "m_error", "correlation", "chi2_images", "chi2_map", "n_map")
            line |= {f"joint_{name}": getattr(one.joint, name) for name in names}
            line["joint_converged"] = one.joint.converged
        lines.append(line | {"seconds": time.perf_counter() - start})
    return lines


def read(path: Path) -> list[dict[str, Any]]:
    """The lines of a file; a last one that was cut off is left out."""
    if not path.exists():
        return []
    lines = []
    for text in path.read_text(encoding="utf-8").splitlines():
        try:
            lines.append(json.loads(text))
        except json.JSONDecodeError:
            break
    return lines


def coverage(report: Report, name: str, lines: list[dict[str, Any]]) -> None:
    """How often the truth lies inside, by sample of galaxies."""
    for key in dict.fromkeys(line["sample"] for line in lines):
        every = [line for line in lines if line["sample"] == key]
        n = len(every)
        inside = sum(line["lam_inside"] for line in every)
        off = np.array([line["lam"] - line["lam_true"] for line in every])
        half = np.array([0.5 * (line["interval"][1] - line["interval"][0]) for line in every])
        print(
            f"{name}, {key}: lambda - truth {off.mean():+.3f} +- {off.std() / n**0.5:.3f}, scatter "
            f"{off.std():.3f}, half an interval {np.median(half):.3f}"
        )
        text = f"{name}, {key}: true lambda inside the 68 % interval in {binomial(inside, n)}"
        # A share of 0.68 leaves 0.50-0.85 in 0.7 % of sets of 50.
        report.check(f"{text} (50 to 85 %)", 0.5 <= inside / n <= 0.85, smoke=False)
        for rich, label in ((True, "with subhaloes"), (False, "without")):
            some = [line for line in every if line["subhaloes"] is rich]
            if some:
                hits = sum(line["lam_inside"] for line in some)
                shares = 100 * np.mean([line["share"] for line in some])
                away = np.mean([line["lam"] - line["lam_true"] for line in some])
                print(
                    f"  {label}: inside in {binomial(hits, len(some))}, lambda - truth {away:+.3f}, a "
                    f"transition in {shares:.0f} % of the draws"
                )
        with_one = [line for line in every if line["radius_inside"] is not None]
        if with_one:
            hits = sum(line["radius_inside"] for line in with_one)
            print(
                f"  the truth has a transition in {len(with_one)}: inside in {binomial(hits, len(with_one))}"
            )
            seen = [line for line in with_one if np.isfinite(line["radius"])]
            print(f"  found at all in {binomial(len(seen), len(with_one))}")
        without = [line for line in every if line["radius_inside"] is None]
        quiet = sum(not np.isfinite(line["radius"]) for line in without)
        print(f"  without one, 'not found' in {binomial(quiet, len(without))}")
        joint = [line for line in every if "joint_lam" in line]
        if joint:
            pull = np.array([(one["joint_lam"] - one["lam_true"]) / one["joint_lam_error"] for one in joint])
            m = np.array([(one["joint_m"] - one["m_true"]) / one["joint_m_error"] for one in joint])
            error = np.median([one["joint_lam_error"] for one in joint])
            within, right = (binomial(int((abs(one) < 1.0).sum()), len(joint)) for one in (pull, m))
            print(
                f"  joint fit: true lambda within its error ({error:.3f}) in {within}, calibration in {right}"
            )


def cluster(
    report: Report, name: str, twins: int, draws: int, joint: int, path: Path
) -> list[dict[str, Any]]:
    """The real cluster, then the twins that the file lacks."""
    known = workflow_real.load(name)
    lines = read(path)
    done = {line["twin"] for line in lines if line["last"]}
    lines = [line for line in lines if line["twin"] in done]
    if twins <= len(done):
        return lines
    start = time.perf_counter()
    if lines:
        fit, _ = analysis_real.fit_images(known, workflow_real.Options(starts=1, draws=8))
    else:
        fit = analysis_real.analyse(known, workflow_real.Options(starts=4, draws=draws)).fit
        seconds = time.perf_counter() - start
        report.check(
            f"{name}: the real cluster in {seconds:.0f} s, compilation included (limit 300 s)",
            seconds < 300,
            smoke=False,
        )
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("".join(json.dumps(line) + "\n" for line in lines), encoding="utf-8")
    for number in range(twins):
        if number in done:
            continue
        made = judged(known, fit, number, draws, number < joint)
        for place, line in enumerate(made):
            line["last"] = place == len(made) - 1
        lines += made
        with path.open("a", encoding="utf-8") as file:
            file.write("".join(json.dumps(line) + "\n" for line in made))
        print(f"{name}: twin {number} in {made[-1]['seconds']:.0f} s", flush=True)
    return lines


def main() -> int:
    """Run everything."""
    options = parser(__doc__ or "")
    options.add_argument("--clusters", default="as1063,abell2744")
    options.add_argument("--twins", type=int, default=50)
    options.add_argument("--draws", type=int, default=50)
    options.add_argument("--joint", type=int, default=0, help="twins that get a joint fit, too")
    options.add_argument(
        "--lines", type=Path, help="lines of all twins (default: results/real_lambda.CLUSTER)"
    )
    options.add_argument("--only-print", action="store_true", help="no new twins")
    said = options.parse_args()
    report = Report("real_lambda", said)
    names = ["as1063"] if report.smoke else said.clusters.split(",")
    for name in names:
        stem = (
            said.lines or ROOT / "benchmarks" / "results" / f"real_lambda{'_smoke' if report.smoke else ''}"
        )
        path = Path(f"{stem}.{name}.jsonl")
        twins, draws = (1, 8) if report.smoke else (said.twins, said.draws)
        joint = 1 if report.smoke else said.joint
        lines = read(path) if said.only_print else cluster(report, name, twins, draws, joint, path)
        coverage(report, name, lines)
    return report.finish()


if __name__ == "__main__":
    sys.exit(main())
