"""`jaxlens reproduce` from process start to the last file: compiling, then with compiled programs at hand.

    python benchmarks/reproduce.py [--smoke] [--full] [--out FILE]

`--quick` (a coarser truth, 64 realisations, no checks of mask, counts and shear); with `--full` also the
whole experiment of `make run`. Beside the time, the error of lambda_P at 100-300 kpc/h against the truth, per
cent. None of the packages that are compared with does the same.
"""

import json
import sys
import tempfile
from pathlib import Path

from _harness import Report, parser
from _process import command

REALISATIONS = {"--quick": 64, "": 256}


def once(report: Report, option: str, folder: Path, state: str) -> float:
    """One run; a row for the whole and one for each stage. Returns the error of lambda_P, per cent."""
    out = folder / f"out{option}-{state}"
    line = ["reproduce", *([option] if option else []), "--out", str(out)]
    done = command(line, folder / "cache")
    size = {"realisations": REALISATIONS[option]}
    content = json.loads((out / "summary.json").read_text(encoding="utf-8"))
    error = content["statements"]["lambda_within_1_percent"]["value"]
    title = " ".join(["reproduce", *([option] if option else [])])
    note = f"lambda_P at 100-300 kpc/h off by {error:.2f} %"
    row = report.record(
        f"{title}, {state}", [done.seconds], size, peak_mb=done.peak_mb, cpu_s=done.cpu_s, error=abs(error)
    )
    for stage, time in content["seconds"].items():
        report.record(f"    {stage}", [time], size)
    report.check(f"{row.name}: {note} (limit 1 %)", abs(error) < 1.0)
    return done.seconds


def main(arguments: list[str] | None = None) -> int:
    """Cold, then warm."""
    report = Report("reproduce", parser(__doc__ or "").parse_args(arguments))
    with tempfile.TemporaryDirectory() as name:
        for option in ("--quick", "") if report.full else ("--quick",):
            cold = once(report, option, Path(name), "cold")
            warm = cold if report.smoke else once(report, option, Path(name), "warm")
            title = f"jaxlens reproduce {option}".strip()
            report.target(f"`{title}`, cold, seconds", cold, most=360.0 if option else 600.0)
            report.target(f"`{title}`, compiled before, seconds", warm, most=cold)
    return report.finish()


if __name__ == "__main__":
    sys.exit(main())
