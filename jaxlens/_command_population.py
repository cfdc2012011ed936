"""What `jaxlens population` does, from the configuration to the last line on the screen."""

import json
import os
from collections.abc import Mapping, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

import jax
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from jaxlens import config_population, io, plotting, population, reproduce, transition
from jaxlens.config_population import Population


def _made_with(said: Population, realisations: int) -> dict[str, Any]:
    stamp = {
        "version": metadata.version("jaxlens-cluster"),
        "realisations": realisations,
        "transition": transition.RULE,
        "laws": said.population.model_dump(mode="json", exclude_none=True),
        "simulate": said.simulate.model_dump(mode="json", exclude={"seed"}),
    }
    return json.loads(json.dumps(stamp))


def run(
    console: Console,
    out: Path,
    config: Path | None,
    *,
    n: int,
    first: int,
    realisations: int,
    scheduler: str | None,
    workers: int | None,
) -> int:
    """Compute what is missing, then write the table and the report; returns the exit code.

    Raises:
        ValueError, OSError: for mistakes in the configuration, a lost scheduler, a full disk.
        ModuleNotFoundError: without the extra `cluster`.
    """
    import pyarrow.parquet  # noqa: F401 - not after hours of work

    said = config_population.read(config)
    io.writable(out)
    seeds = list(range(first, first + n))
    clusters = {seed: population.settings_of(seed, said) for seed in seeds}
    # With the first cluster, so that `report` knows the laws of a run that never ended.
    path, made_with = out / population.MADE_WITH, _made_with(said, realisations)
    if path.exists() and io.read_json(path) != made_with:
        raise ValueError(
            f"{path} says other laws, settings, realisations or version; give an empty directory."
        )
    io.write_json(path, made_with)
    # Workers elsewhere have directories of their own.
    cache = getattr(jax.config, "jax_compilation_cache_dir", None) if scheduler is None else None
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, console=console, transient=True) as progress:
        bar = progress.add_task("starting workers", total=n)

        def on_done(done: int, total: int, row: Mapping[str, Any]) -> None:
            progress.update(bar, completed=done, total=total, description=f"cluster {row['seed']} finished")

        count = population.cores() if workers is None else workers
        client = population.local(min(count, n)) if scheduler is None else population.remote(scheduler)
        with client as opened:
            progress.update(bar, description="simulating clusters")
            rows = population.run(
                opened, clusters, realisations, out / "clusters", cache=cache, on_done=on_done
            )
    write(rows, made_with, out)
    _say(console, rows, out)
    missing = [str(row["seed"]) for row in rows if row.get("try_again")]
    if missing:
        console.print(
            f"Not finished, perhaps through no fault of theirs: {', '.join(missing)}; the same command "
            "tries them again.", markup=False, highlight=False, soft_wrap=True,
        )  # fmt: skip
    return 1 if missing else 0


def report(console: Console, out: Path) -> int:
    """Write the table and the report again from the finished clusters of a directory.

    Raises:
        ValueError: if there are none, or one that was made with something else.
    """
    made_with, rows = population.read(out)
    write(rows, made_with, out)
    _say(console, rows, out)
    return 0


def write(rows: Sequence[Mapping[str, Any]], made_with: Mapping[str, Any], out: Path) -> None:
    """`population.parquet`, `profiles.fits`, `population.json`, figures and `report.html`."""
    columns = population.columns(rows)
    statements = reproduce.tally(population.applicable(rows))
    drawn = population.figures(rows)
    with io.staging(out) as stage:
        io.write_parquet(stage / "population.parquet", columns)
        io.write_array_table(stage / "profiles.fits", population.profiles(rows))
        io.write_json(
            stage / "population.json",
            {**made_with, "facts": population.facts(columns), "statements": statements},
        )
        pictures = {name: plotting.save(one, stage / "figures" / name)[1] for name, one in drawn.items()}
        text = population.page(rows, columns, made_with, pictures)
        (stage / "report.html").write_text(text, encoding="utf-8")


def _say(console: Console, rows: Sequence[Mapping[str, Any]], out: Path) -> None:
    for name, value in population.facts(population.columns(rows)).items():
        console.print(f"{name}: {value}", markup=False, highlight=False, soft_wrap=True)
    failed = [str(row["seed"]) for row in rows if "failed" in row]
    if failed:
        console.print(
            f"Seeds that failed: {', '.join(failed)}.", markup=False, highlight=False, soft_wrap=True
        )
    console.print(f"Results in {out}{os.sep}", markup=False, highlight=False, soft_wrap=True)
