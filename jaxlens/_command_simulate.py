"""What `jaxlens simulate` does, from the configuration to the last line on the screen."""

import os
from pathlib import Path

from rich.console import Console
from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

from jaxlens import io, results_simulate, simulate, workflow_simulate


def run(console: Console, out: Path, seed: int | None, config: Path | None) -> int:
    """Simulate, write, and say what came out; returns the exit code.

    Raises:
        ValueError, OSError: for mistakes in the configuration; nothing is written then.
    """
    said = workflow_simulate.load(config, seed)
    io.writable(out)
    console.print(f"[bold]{said.name}[/]: seed {said.seed}", highlight=False)
    columns = (SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn())
    with Progress(*columns, console=console, transient=True) as progress:
        task = progress.add_task("starting", total=None)
        say = lambda step: progress.update(task, description=step)
        mock = simulate.mock(said.seed, said.settings, on_step=say)
        say("drawing figures, writing files")
        content = results_simulate.write(mock, said, out)
    console.print(results_simulate.verdict(content), markup=False, highlight=False, soft_wrap=True)
    console.print(f"Results in {out}{os.sep}", markup=False, highlight=False, soft_wrap=True)
    return 0
