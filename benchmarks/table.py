"""The Markdown table of ratios, from the results that the scripts saved.

    python benchmarks/table.py [DIRECTORY]     # default: benchmarks/results

One row for each target of each script, those that are missed among them.
"""

import json
import sys
from pathlib import Path

from _harness import ROOT


def line(script: str, target: dict) -> str:
    """One row: what, ratio, limit, script."""
    limits = [f"{sign} {target[key]:g}" for sign, key in ((">=", "least"), ("<=", "most")) if target[key]]
    limit = ", ".join(limits) + ("" if target["held"] else " (missed)")
    return f"| {target['claim']} | {target['ratio']:.3g} | {limit} | `{script}.py` |"


def main() -> int:
    """Print the table and what it was measured on."""
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else ROOT / "benchmarks" / "results"
    results = [json.loads(path.read_text(encoding="utf-8")) for path in sorted(folder.glob("*.json"))]
    results = [one for one in results if one.get("targets") and not one["smoke"]]
    if not results:
        print(f"no results in {folder}; run `make bench`")
        return 1
    print("| what | measured | target | script |\n|---|---|---|---|")
    for one in results:
        for target in one["targets"]:
            print(line(one["benchmark"], target))
    versions: dict[str, str] = {}
    for one in results:
        versions |= one["machine"]["versions"]
    machine = results[0]["machine"]
    loads = ", ".join(f"{one['benchmark']} {one['machine']['load']:.1f}" for one in results)
    print(f"\n{machine['cpu']}, {machine['cores']} cores; load at the end: {loads};")
    print(", ".join(f"{name} {version}" for name, version in versions.items()))
    return 0


if __name__ == "__main__":
    sys.exit(main())
