"""What `jaxlens reproduce` does, from the configuration to the last line on the screen."""

import os
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import jax
from rich.console import Console
from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

from jaxlens import io, plotting, population, reproduce, workflow_simulate
from jaxlens.config_simulate import Simulate

QUICK_PIXELS, QUICK_REALISATIONS = 1024, 64
QUICK_VARIANTS = ("rectangle", "perfect")


@dataclass(frozen=True)
class Options:
    """What is run.

    Attributes:
        realisations: of the noise.
        quick: a coarser map of the truth, fewer realisations, no checks of mask, counts and shear.
        clusters: instead of one cluster, this many with seeds of their own, one process per core (Dask).
        sweep: instead, numbers of the simulation to vary, see `reproduce.VALUES`.
    """

    realisations: int = 256
    quick: bool = False
    clusters: int | None = None
    sweep: tuple[str, ...] = ()


def run(console: Console, out: Path, seed: int | None, config: Path | None, options: Options) -> int:
    """Run, write, and say what came out; returns the exit code.

    Raises:
        ValueError, OSError: for mistakes in the configuration; nothing is written then.
        ModuleNotFoundError: for several clusters without the extra `cluster`.
    """
    said = workflow_simulate.load(config, seed)
    io.writable(out)
    n = options.realisations
    if options.quick:
        said = said.model_copy(
            update={"shear": replace(said.shear, map_pixels=min(QUICK_PIXELS, said.shear.map_pixels))}
        )
        n = min(n, QUICK_REALISATIONS)
    columns = (SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn())
    with Progress(*columns, console=console, transient=True) as progress:
        task = progress.add_task("starting", total=None)
        say = lambda step: progress.update(task, description=step)
        if options.sweep:
            lines = _sweeps(said, n, options.sweep, out, say)
        elif options.clusters is not None:
            lines = _many(said, n, options.clusters, out, say)
        else:
            lines = _one(said, n, options, out, say)
    console.print(lines, markup=False, highlight=False, soft_wrap=True)
    console.print(f"Results in {out}{os.sep}", markup=False, highlight=False, soft_wrap=True)
    return 0


def _one(said: Simulate, n: int, options: Options, out: Path, say: Callable[[str], object]) -> str:
    seconds, began = {}, time.perf_counter()
    found = reproduce.run(
        said.seed,
        said,
        out / "strong",
        n=n,
        variants=QUICK_VARIANTS if options.quick else reproduce.VARIANTS,
        blocks=out / "blocks",
        on_step=say,
    )
    seconds["simulation, fits, realisations"] = time.perf_counter() - began
    say("measuring")
    made = reproduce.analyse(found)
    seconds["measuring"] = time.perf_counter() - began - sum(seconds.values())
    say("drawing figures, writing files")
    many = reproduce.shipped()
    more = () if many is None else (reproduce.section(many, "Shipped with the package:"),)
    return reproduce.verdict(reproduce.write(found, made, out, seconds=seconds, more=more))


def _many(said: Simulate, n: int, count: int, out: Path, say: Callable[[str], object]) -> str:
    cache = getattr(jax.config, "jax_compilation_cache_dir", None)
    clusters = {seed: said.model_copy(update={"seed": seed}) for seed in range(said.seed, said.seed + count)}
    say("starting workers")
    with population.local(min(population.cores(), count)) as client:
        say(f"cluster 1 of {count}")
        rows = population.run(
            client,
            clusters,
            n,
            out / "clusters",
            cache=cache,
            on_done=lambda done, total, _: say(f"{done} of {total} clusters finished"),
        )
    content = reproduce.clusters_content(rows, said, n)
    say("drawing figures, writing files")
    write_many(content, out)
    held = [f"{one['statement']} {_held(one)}" for one in content["statements"].values()]
    return "\n".join(held)


def _sweeps(said: Simulate, n: int, names: tuple[str, ...], out: Path, say: Callable[[str], object]) -> str:
    unknown = [name for name in names if name not in reproduce.VALUES]
    if unknown:
        raise ValueError(
            f"--sweep: {unknown[0]!r} is not known; give one or more of {', '.join(reproduce.VALUES)}."
        )
    paper = {"n0": said.shear.density_arcmin2, "m_tele": said.images.m_tele}
    rows = {
        name: reproduce.sweep(name, said.seed, said, out / "sweep_points", n=n, on_step=say) for name in names
    }
    lines = []
    with io.staging(out) as stage:
        for name, each in rows.items():
            io.write_json(stage / f"sweep_{name}.json", each)
            figure = plotting.sweep(each, x_label=reproduce.LABELS[name], at=paper[name])
            plotting.save(figure, stage / f"sweep_{name}")
    for name, each in rows.items():
        for row in each:
            where = row.get("failed") or (
                "no transition" if row["transition_kpc_h"] is None else f"{row['transition_kpc_h']:.0f} kpc/h"
            )
            lines.append(f"{name} = {row['value']:g}: {where}")
    return "\n".join(lines)


def _held(one: dict[str, Any]) -> str:
    if not one["clusters"]:
        return "[no cluster]"
    return f"[{one['verdicts'].get('holds here', 0)} of {one['clusters']}]"


def write_many(content: dict[str, Any], out: Path) -> None:
    """`clusters.json`, the figures, and `clusters.html`."""
    rows = content["clusters"]
    names = [str(row["seed"]) for row in rows if "failed" not in row]
    drawn = {"shares": plotting.statement_shares(*reproduce.shares(content))}
    for claim in (*reproduce.CLAIMS, *reproduce.OURS):
        each = reproduce.measured(rows, claim.key)
        drawn[claim.key] = plotting.statement_values(
            [one.value for one in each],
            [one.error for one in each],
            names,
            claimed=(claim.low, claim.high),
            x_label=claim.key.replace("_", " ") + (f" [{claim.unit}]" if claim.unit else ""),
        )
    with io.staging(out) as stage:
        io.write_json(stage / "clusters.json", content)
        pictures = {
            name: plotting.save(one, stage / "cluster_figures" / name)[1] for name, one in drawn.items()
        }
        text = reproduce.clusters_page(content, pictures)
        (stage / "clusters.html").write_text(text, encoding="utf-8")
