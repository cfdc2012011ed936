"""What `jaxlens lambda` does, from the maps to the last line on the screen."""

import os
from pathlib import Path
from typing import Any

from rich.console import Console

from jaxlens import analysis_lambda, io, results_lambda, workflow_lambda


def run(
    console: Console, wl: Path, sl: Path, out: Path, options: workflow_lambda.Options, **files: Any
) -> int:
    """Compare, write, and say what was found; returns the exit code.

    Args:
        console: to write on.
        wl, sl: maps.
        out: directory of the results.
        options: how.
        files: `truth`, `mask`, `sigma`, `snr` of `workflow_lambda.load`.

    Raises:
        ValueError, OSError: for mistakes in the input; nothing is written then.
    """
    io.writable(out)
    pair = workflow_lambda.load(wl, sl, options, **files)
    console.print(
        f"[bold]{pair.name}[/]: {int((pair.weight > 0.0).sum())} pixels of {pair.grid.pixel:g} arcsec known "
        f"in both maps, smoothing {pair.smoothing:g} arcsec, D_LS/D_S {pair.dls_ds:.4f} (strong lensing "
        f"scaled by {pair.scale_sl:.4f})",
        highlight=False,
        soft_wrap=True,
    )
    outcome = analysis_lambda.derive(pair, options)
    content = results_lambda.write(outcome, out)
    console.print(results_lambda.verdict(content), markup=False, highlight=False, soft_wrap=True)
    console.print(f"Results in {out}{os.sep}", markup=False, highlight=False, soft_wrap=True)
    return 0
