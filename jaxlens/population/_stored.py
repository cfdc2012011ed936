"""Populations that are finished: those of a directory, and the one that ships with the package."""

import gzip
import json
from collections.abc import Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Any

from jaxlens import io, reproduce
from jaxlens.config_population import Population
from jaxlens.population._draw import settings_of

SHIPPED = "clusters.json.gz"

MADE_WITH = "made_with.json"
"""Version, realisations, laws and settings, written before the first cluster, one for a directory."""


def pack(rows: Sequence[Mapping[str, Any]], made_with: Mapping[str, Any], command: str, path: Path) -> None:
    """Write a population as one small file, the same bytes for the same rows.

    Args:
        rows: from `run`.
        made_with: version, realisations, laws and settings.
        command: what made them.
        path: ends in `.json.gz`.
    """
    content = {"command": command, "made_with": made_with, "clusters": rows}
    text = json.dumps(content, allow_nan=False, separators=(",", ":"))
    path.write_bytes(gzip.compress(text.encode(), mtime=0))


def shipped() -> dict[str, Any] | None:
    """The clusters that ship with the package; None if there are none.

    Returns:
        `command`, `made_with` (version, realisations, laws, settings) and `clusters`, rows as from `run`:
        see `columns`, `profiles` and `figures`.
    """
    file = resources.files("jaxlens.population").joinpath(SHIPPED)
    return json.loads(gzip.decompress(file.read_bytes())) if file.is_file() else None


def _law(made_with: Mapping[str, Any]) -> Population:
    return Population.model_validate({"population": made_with["laws"], "simulate": made_with["simulate"]})


def read(out: str | Path) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """What a result directory of `jaxlens population` was made with, and its rows by seed.

    Raises:
        ValueError: if it holds no finished cluster, or one that was made with something else.
    """
    out = Path(out)
    paths = sorted((out / "clusters").glob("cluster_*.json"), key=lambda path: int(path.stem.split("_")[1]))
    if not paths or not (out / MADE_WITH).exists():
        raise ValueError(
            f"{out} holds no finished cluster; run `jaxlens population --n N --out {out}` first."
        )
    made_with = io.read_json(out / MADE_WITH)
    said, rows = _law(made_with), []
    for path in paths:
        settings = settings_of(int(path.stem.split("_")[1]), said)
        stamp = reproduce.stamp(settings, made_with["realisations"]) | {"version": made_with["version"]}
        row = reproduce.finished(path, stamp)
        assert row is not None
        rows.append(row)
    return made_with, rows


def unpack(content: Mapping[str, Any], out: str | Path) -> None:
    """Write a population as `jaxlens population --out` does, so that the command goes on with more clusters.

    Args:
        content: from `shipped`.
        out: directory; files of the same clusters are replaced.

    Raises:
        ValueError: if the directory holds another population.
    """
    out, made_with = Path(out), content["made_with"]
    said, said_there = _law(made_with), out / MADE_WITH
    if said_there.exists() and io.read_json(said_there) != made_with:
        raise ValueError(f"{said_there} says another population; give an empty directory.")
    (out / "clusters").mkdir(parents=True, exist_ok=True)
    io.write_json(said_there, made_with)
    for row in content["clusters"]:
        stamp = reproduce.stamp(settings_of(row["seed"], said), made_with["realisations"])
        file = {"made_with": stamp | {"version": made_with["version"]}, "cluster": row}
        io.write_json(reproduce.cluster_file(out / "clusters", row["seed"]), file)
