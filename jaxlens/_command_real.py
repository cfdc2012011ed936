"""What `jaxlens real` does, from the data set to the last line on the screen."""

import os
from pathlib import Path

from rich.console import Console

from jaxlens import analysis_real, io, results_real, workflow_real


def run(console: Console, source: str, out: Path, options: workflow_real.Options) -> int:
    """Analyse, write, and say what was found; returns the exit code.

    Raises:
        ValueError, OSError: for mistakes in the input; nothing is written then.
    """
    io.writable(out)
    cluster = workflow_real.load(source)
    console.print(f"[bold]{cluster.name}[/], z = {float(cluster.plane.z_l):g}", highlight=False)
    for one in cluster.samples:
        left = ", ".join(f"{name}: {count}" for name, count in one.field.counts.items())
        console.print(f"{one.title}: {left}", markup=False, highlight=False, soft_wrap=True)
    with console.status("compiling") as status:
        found = analysis_real.analyse(cluster, options, on_step=status.update)
        status.update("writing results")
        content = results_real.write(found, out)
    console.print(results_real.verdict(content), markup=False, highlight=False, soft_wrap=True)
    console.print(f"Results in {out}{os.sep}", markup=False, highlight=False, soft_wrap=True)
    return 130 if found.fit.interrupted else 0
