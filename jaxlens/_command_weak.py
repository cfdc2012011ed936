"""What `jaxlens weak` does, from the input to the last line on the screen."""

import os
from dataclasses import replace
from pathlib import Path

from rich.console import Console
from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

from jaxlens import analysis_weak, io, model_weak, results_weak, workflow_weak


def run(console: Console, source: str, out: Path, options: analysis_weak.Options) -> int:
    """Reconstruct, write, and say what was found; returns the exit code, 1 when there is no map.

    Raises:
        ValueError, OSError: for mistakes in the input; nothing is written then.
    """
    io.writable(out)
    field = workflow_weak.field(source, options.axis)
    if options.smoothing is not None:
        field = replace(field, smoothing=options.smoothing)
    kappa0 = None if options.model is None else model_weak.first_guess(field, options.model)
    pixels = int((field.shear.weight > 0.0).sum())
    galaxies = list(field.counts.values())
    chosen = f"{galaxies[-1]} of {galaxies[0]} galaxies" if len(galaxies) > 1 else f"{galaxies[0]} galaxies"
    console.print(
        f"[bold]{field.name}[/]: {chosen}, {pixels} unmasked pixels of {field.grid.pixel:g} arcsec, "
        f"scheme {options.scheme}",
        highlight=False,
    )
    columns = (SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn())
    with Progress(*columns, console=console, transient=True) as progress:
        task = progress.add_task("compiling", total=None)
        say = lambda step: progress.update(task, description=step)
        try:
            outcome = analysis_weak.derive(field, options, kappa0=kappa0, on_step=say)
        except analysis_weak.Diverged as error:
            console.print(f"{error} Nothing was written.", markup=False, highlight=False, soft_wrap=True)
            return 1
        say("writing results")
        content = results_weak.write(outcome, out)
    console.print(results_weak.verdict(content), markup=False, highlight=False, soft_wrap=True)
    console.print(f"Results in {out}{os.sep}", markup=False, highlight=False, soft_wrap=True)
    return 0
