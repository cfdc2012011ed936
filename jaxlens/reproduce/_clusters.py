"""Many clusters, each from its own seed with its own noise: how often a statement holds."""

import json
import math
import os
import re
from collections.abc import Mapping, Sequence
from importlib import metadata, resources
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import numpy as np

from jaxlens import io, transition
from jaxlens.config_simulate import Simulate
from jaxlens.report import Figure, Page, Section, Table, html
from jaxlens.reproduce._one import SCRATCH, one_cluster
from jaxlens.reproduce._statements import CLAIMS, OURS, Measured

SHIPPED = "clusters.json"

NOT_APPLICABLE = "not applicable"
"""Of a cluster without what a statement speaks of; `judge` never says so, see `population.applicable`."""


def stamp(settings: Simulate, n: int) -> dict[str, Any]:
    """What the file of a cluster was made with, apart from its seed; as it reads back from JSON."""
    said = {
        "version": metadata.version("jaxlens-cluster"),
        "realisations": n,
        "transition": transition.RULE,
        "settings": settings.model_dump(mode="json", exclude={"seed"}),
    }
    return json.loads(json.dumps(said))


def cluster_file(folder: Path, seed: int) -> Path:
    """File of a cluster in the folder of many."""
    return folder / f"cluster_{seed}.json"


def finished(path: Path, made_with: Mapping[str, Any]) -> dict[str, Any] | None:
    """The row of a finished cluster, or None if there is none.

    Raises:
        ValueError: if the file belongs to other settings.
    """
    if not path.exists():
        return None
    said = io.read_json(path)
    if said["made_with"] != made_with:
        raise ValueError(
            f"{path} was made with other settings, realisations or version; give an empty directory."
        )
    return said["cluster"]


_SHARE = 0.6
# Of the memory of a core, and of the mappings that Linux allows a process (65530 as a rule; the compiler
# crashes without). One that holds more drops its compiled programs before the next cluster: those of one take
# 0.5 GB and ten thousand mappings at first, less later, since most are shared with the next.


def _crowded() -> bool:
    """Whether this process holds more than its share; False where the system does not say."""
    own = Path("/proc/self")
    try:
        pages = int((own / "statm").read_text(encoding="ascii").split()[1])
        with (own / "maps").open("rb") as lines:
            maps = sum(1 for _ in lines)
        most = int(Path("/proc/sys/vm/max_map_count").read_text(encoding="ascii"))
        memory = os.sysconf("SC_PHYS_PAGES") / (os.cpu_count() or 1)
    except (OSError, ValueError):
        return False
    return pages > _SHARE * memory or maps > _SHARE * most


def cluster_row(seed: int, settings: Simulate, n: int) -> dict[str, Any]:
    """`one_cluster`; one that fails is a row with its reason.

    Where the reason lies in the seed and the settings (nothing is multiply imaged, a solver that gives up)
    the row says the same each time. Anything else (memory, disk, a package that this machine lacks) is
    marked `try_again`: another run, or another machine, may do better.
    """
    if _crowded():
        jax.clear_caches()
    try:
        return one_cluster(seed, settings, n)
    except Exception as error:
        failed = {"seed": seed, "failed": f"{type(error).__name__}: {_message(error)}"}
        return failed if _is_of_the_cluster(error) else failed | {"try_again": True}


def _is_of_the_cluster(error: Exception) -> bool:
    """Whether it would come again with the same seed and settings, everywhere."""
    if isinstance(error, eqx.EquinoxRuntimeError):
        return True
    # Subclasses are those of XLA, out of memory among them, and a thread that cannot start is one of these.
    if type(error) is RuntimeError:
        return str(error).endswith("take another seed.")
    return isinstance(error, ValueError) and not isinstance(error, UnicodeError)


def _message(error: Exception) -> str:
    """What it says, without advice on debugging and without the name of the temporary directory."""
    text = str(error).split("\n--------")[0].strip() or "no message"
    return re.sub(rf"[^\s'\"`]*{SCRATCH}\w+/?", "", text)


def clusters_content(rows: Sequence[Mapping[str, Any]], settings: Simulate, n: int) -> dict[str, Any]:
    """The content of `clusters.json`.

    Args:
        rows: from `cluster_row`; one that failed holds its reason.
        settings: the configuration that all share but for the seed.
        n: noise realisations of each.
    """
    return {"made_with": stamp(settings, n), "clusters": rows, "statements": tally(rows)}


def tally(rows: Sequence[Mapping[str, Any]]) -> dict[str, dict[str, Any]]:
    """How often each statement held, with the binomial error of its share among the clusters.

    The error is that of (k + 1)/(n + 2), so that it stays above 0 when all clusters agree. A cluster in which
    a statement is "not applicable" is counted, and left out of the share.
    """
    known = [row for row in rows if "failed" not in row]
    result: dict[str, dict[str, Any]] = {}
    for claim in (*CLAIMS, *OURS):
        verdicts = [row["statements"][claim.key]["verdict"] for row in known]
        count = {name: verdicts.count(name) for name in sorted(set(verdicts))}
        n = len(verdicts) - count.get(NOT_APPLICABLE, 0)
        held = verdicts.count("holds here")
        p = (held + 1.0) / (n + 2.0)
        result[claim.key] = {
            "statement": claim.text,
            "clusters": n,
            "verdicts": count,
            "share": held / n if n else None,
            "error": math.sqrt(p * (1.0 - p) / n) if n else None,
        }
    return result


def measured(rows: Sequence[Mapping[str, Any]], key: str) -> list[Measured]:
    """The number of one statement in every cluster that did not fail; NaN where it was not measured."""
    as_number = lambda value: math.nan if value is None else float(value)
    found = [row["statements"][key] for row in rows if "failed" not in row]
    return [Measured(as_number(one["value"]), as_number(one["error"])) for one in found]


def shipped() -> dict[str, Any] | None:
    """The clusters that ship with the package, with version and settings; None if there are none."""
    file = resources.files("jaxlens.reproduce").joinpath(SHIPPED)
    return json.loads(file.read_text(encoding="utf-8")) if file.is_file() else None


def section(content: Mapping[str, Any], origin: str) -> Section:
    """The section of a report on many clusters.

    Args:
        content: from `clusters_content` or `shipped`.
        origin: where they come from, a sentence.
    """
    verdicts = {"held in": "holds here", "undecided": "undecided", "did not hold": "does not hold here"}
    if any(NOT_APPLICABLE in one["verdicts"] for one in content["statements"].values()):
        verdicts[NOT_APPLICABLE] = NOT_APPLICABLE
    table = Table(
        ("statement", *verdicts, "share", "error"),
        [
            (
                one["statement"],
                *(str(one["verdicts"].get(name, 0)) for name in verdicts.values()),
                "" if one["share"] is None else f"{one['share']:.2f}",
                "" if one["error"] is None else f"{one['error']:.2f}",
            )
            for one in content["statements"].values()
        ],
        numeric=frozenset(range(1, len(verdicts) + 3)),
    )
    seeds = [row["seed"] for row in content["clusters"]]
    text = (
        f"{origin} {len(seeds)} clusters with seeds {min(seeds)} to {max(seeds)}, each with its own noise, "
        f"{content['made_with']['realisations']} realisations, jaxlens {content['made_with']['version']}. "
        "Errors are binomial."
    )
    failed = [str(row["seed"]) for row in content["clusters"] if "failed" in row]
    parts: list[Any] = [text, table]
    if failed:
        parts.append(f"Seeds that failed: {', '.join(failed)}.")
    return Section("clusters", "How often the statements hold", parts)


def shares(content: Mapping[str, Any]) -> tuple[list[str], np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Keys, and counts of the three verdicts and binomial errors of the share, for the figure."""
    said = content["statements"]
    count = lambda name: np.array([one["verdicts"].get(name, 0) for one in said.values()])
    error = np.array([one["error"] or 0.0 for one in said.values()])
    return list(said), count("holds here"), count("undecided"), count("does not hold here"), error


def clusters_page(content: Mapping[str, Any], pictures: Mapping[str, Path]) -> str:
    """The report on many clusters as HTML.

    Args:
        content: from `clusters_content`.
        pictures: PNG files by key of the statement, `shares` first.
    """
    claims = {claim.key: claim for claim in (*CLAIMS, *OURS)}
    caption = lambda key: (
        f"{claims[key].text} Measured: {claims[key].quantity}; claimed: {claims[key].range}."
        if key in claims
        else "Share of the clusters in which each statement holds, with its binomial error."
    )
    images = [Figure(key, path.read_bytes(), caption(key)) for key, path in pictures.items()]
    return html(
        Page(
            title="How often the statements hold",
            lead="Simulated clusters, each drawn, fitted and reconstructed from a seed of its own.",
            facts={"jaxlens": content["made_with"]["version"]},
            sections=(section(content, "This run:"), Section("figures", "Numbers by cluster", images)),
        )
    )
