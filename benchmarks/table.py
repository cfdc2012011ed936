"""The Markdown table of ratios, from the results that the scripts saved.

    python benchmarks/table.py [DIRECTORY] [--smoke]     # default: benchmarks/results

One row for each target of each script, those that are missed or could not be measured among them; then
where and when each script ran. Fails if the results do not belong together, or took longer than half an
hour.
"""

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from _machine import ROOT
from _results import Target

LIMIT_S = 1800.0
"""All hot paths together, s."""


def line(script: str, target: Target) -> str:
    """One row: what, number, limit, cores and errors of ours and of the other, script."""
    limit = target.limits + (" (missed)" if target.held is False else "")
    cores, errors = (pair(values, form) for values, form in ((target.cores, ".1f"), (target.errors, ".0e")))
    return f"| {target.claim} | {target.measured} | {limit} | {cores} | {errors} | `{script}.py` |"


def pair(values: Sequence[float | None] | None, form: str) -> str:
    """Ours and the other's, e.g. `1.9, 1.0`; empty where there is no such pair."""
    return ", ".join("?" if value is None else format(value, form) for value in values or ())


def mixed(results: list[dict[str, Any]]) -> list[str]:
    """What is not the same for all results: commit, cpu, cores, threads or versions."""
    keys = ("commit", "cpu", "cores", "threads", "versions")
    return [key for key in keys if any(one["machine"][key] != results[0]["machine"][key] for one in results)]


def print_origin(results: list[dict[str, Any]]) -> None:
    """Where and when every script ran."""
    for one in results:
        where = one["machine"]
        print(
            f"{one['benchmark']}: commit {where['commit']}, {where['date']}, load at the end "
            f"{where['load']:.1f}, {one['elapsed_s']:.0f} s"
        )
    where = results[0]["machine"]
    print(f"{where['cpu']}, {where['cores']} cores")
    threads = ", ".join(f"{name}={value}" for name, value in where["threads"].items() if value is not None)
    print(f"threads: {threads or 'as the libraries choose'}")
    print(", ".join(f"{name} {version}" for name, version in where["versions"].items()))


def main() -> int:
    """Print the table and what it was measured on."""
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("directory", nargs="?", type=Path, default=ROOT / "benchmarks" / "results")
    options.add_argument("--smoke", action="store_true", help="the results of smoke runs")
    said = options.parse_args()
    results = [json.loads(path.read_text(encoding="utf-8")) for path in sorted(said.directory.glob("*.json"))]
    results = [one for one in results if one.get("targets") and one["smoke"] is said.smoke]
    if not results:
        print(f"no results in {said.directory}; run `make bench`")
        return 1
    print("| what | measured | target | cores | errors | script |\n|---|---|---|---|---|---|")
    for one in results:
        for target in one["targets"]:
            print(line(one["benchmark"], Target.read(target)))
    print()
    print_origin(results)
    seconds = sum(one["elapsed_s"] for one in results)
    # `--full` adds studies that take longer.
    late = seconds > LIMIT_S and not any(one["full"] for one in results)
    print(f"{seconds:.0f} s in all (limit {LIMIT_S:.0f} s{', missed' if late else ''})")
    differ = mixed(results)
    if differ:
        print(f"the results do not belong together: {', '.join(differ)} differ; run `make bench` again")
    return 1 if differ or late else 0


if __name__ == "__main__":
    sys.exit(main())
