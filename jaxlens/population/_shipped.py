"""The population that ships with the package."""

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


def unpack(content: Mapping[str, Any], out: str | Path) -> None:
    """Write a population as `jaxlens population --out` does, so that the command goes on with more clusters.

    Args:
        content: from `shipped`.
        out: directory; files of the same clusters are replaced.

    Raises:
        ValueError: if the directory holds another population.
    """
    out, made_with = Path(out), content["made_with"]
    said = Population.model_validate({"population": made_with["laws"], "simulate": made_with["simulate"]})
    said_there = out / "made_with.json"
    if said_there.exists() and io.read_json(said_there) != made_with:
        raise ValueError(f"{said_there} says another population; give an empty directory.")
    (out / "clusters").mkdir(parents=True, exist_ok=True)
    io.write_json(out / "made_with.json", made_with)
    for row in content["clusters"]:
        stamp = reproduce.stamp(settings_of(row["seed"], said), made_with["realisations"])
        file = {"made_with": stamp | {"version": made_with["version"]}, "cluster": row}
        io.write_json(reproduce.cluster_file(out / "clusters", row["seed"]), file)
