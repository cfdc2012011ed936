"""The population that ships with the package."""

import gzip
import json
from collections.abc import Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Any

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


def shipped() -> dict[str, Any]:
    """The clusters that ship with the package.

    Returns:
        `command`, `made_with` (version, realisations, laws, settings) and `clusters`, rows as from `run`:
        see `columns`, `profiles` and `figures`.
    """
    file = resources.files("jaxlens.population").joinpath(SHIPPED)
    return json.loads(gzip.decompress(file.read_bytes()))
