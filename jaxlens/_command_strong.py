"""What `jaxlens strong` does, from the problem to the last line on the screen."""

import os
from pathlib import Path

import jax
from rich.console import Console
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

from jaxlens import _screen, analysis_strong, results, strong
from jaxlens.config import Fit
from jaxlens.workflow import Setup


def run(
    console: Console,
    setup: Setup,
    out: Path,
    options: analysis_strong.Options,
    *,
    starts: int | None,
    seed: int,
    plane: str | None,
    definition: str | None,
) -> int:
    """Fit, answer what else was asked, write, and say what was found; returns the exit code."""
    said = setup.config.fit if setup.config else Fit(weak_prior=0.0)
    count = starts or said.starts
    where = plane or said.plane
    how = definition or said.definition
    images = setup.problem.images
    n_free = strong.total_size(setup.problem.bounds)
    console.print(
        f"[bold]{setup.name}[/]: {images.n_images} images of {images.n_systems} systems, "
        f"{n_free} free numbers, {count} starts",
        highlight=False,
    )
    for note in setup.notes:
        console.print(f"note: {note}", markup=False, highlight=False, soft_wrap=True)
    columns = (SpinnerColumn(), TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn())
    with Progress(*columns, console=console, transient=True) as progress:
        task = progress.add_task("compiling", total=count)

        def on_step(number: int, floor: float, steps: int) -> None:
            progress.update(
                task, description=f"start {number}/{count}, floor {floor:g} arcsec, {steps} steps"
            )

        def on_start(start: strong.Start) -> None:
            progress.advance(task)
            bound = f"  at bound: {', '.join(start.at_bound)}" if start.at_bound else ""
            state = "converged" if start.converged else "not converged"
            progress.console.print(
                f"  start {start.number:>2}: chi2 = {start.chi2:10.3f}  {state}, {start.steps} steps, "
                f"{start.seconds:.1f} s{bound}",
                highlight=False,
            )
            if start.number == count:
                progress.update(task, description="image-plane stage" if where == "both" else "finishing")

        fit = strong.fit(
            setup.problem,
            key=jax.random.key(seed),
            n_starts=count,
            start=setup.start,
            plane=where,
            definition=how,
            on_start=on_start,
            on_step=on_step,
        )
        say = lambda step: progress.update(task, description=step)
        try:
            fit, analysis = analysis_strong.answer(setup, fit, options, on_step=say)
            say("solving the lens equation, writing results")
            outcome = results.derive(setup, fit, seed=seed, plane=where, definition=how, analysis=analysis)
            content = results.write(outcome, out)
        except KeyboardInterrupt:
            console.print(
                f"Interrupted after the fit (chi2 = {float(fit.chi2):.3f}); no results were written."
            )
            return 130
    console.print(_screen.numbers(outcome))
    console.print(results.verdict(content), markup=False, highlight=False)
    console.print(f"Results in {out}{os.sep}", markup=False, highlight=False)
    return 130 if fit.interrupted else 0
