"""A lens as a TOML file that reads back to the same numbers, bit for bit."""

import json
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxlens._text import read_text
from jaxlens.cosmology import FlatLCDM, LensPlane
from jaxlens.io._files import atomic
from jaxlens.io._sky import Reference
from jaxlens.lens import Component, Lens
from jaxlens.profiles import PROFILES, profile_of

_FORMAT = "jaxlens lens 1"
_SKY = ("ra_deg", "dec_deg")


def _array(values: Any) -> str:
    # repr of a float is the shortest text that reads back to the same double.
    return "[" + ", ".join(repr(float(value)) for value in np.asarray(values)) + "]"


def write_lens(
    path: str | Path,
    lens: Lens,
    plane: LensPlane,
    *,
    comment: str = "",
    reference: Reference | None = None,
    labels: Mapping[str, Sequence[str]] | None = None,
) -> None:
    """Write a lens with its plane.

    Fields are those of the profiles (strengths for D_LS/D_S = 1, lengths in arcsec); position angles in rad
    from +theta_1 (West) towards +theta_2 (North).

    Args:
        path: the file; replaced in one step.
        lens: the lens.
        plane: its plane.
        comment: text for the head of the file.
        reference: (RA, Dec) of the origin, degrees.
        labels: names of the profiles of a component, in their order; for those that have any.

    Raises:
        ValueError: if the labels of a component are not as many as its profiles.
    """
    for name, said in (labels or {}).items():
        if name not in lens.components or len(said) != len(lens.components[name]):
            raise ValueError(
                f"`labels` has {len(said)} for {name!r}, which is no component of so many profiles; give one "
                "for each profile."
            )
    lines = [f"# {line}" for line in comment.splitlines()]
    lines += [
        f'format = "{_FORMAT}"',
        f"z_l = {float(plane.z_l)!r}",
        *(f"{key} = {float(at)!r}" for key, at in zip(_SKY, reference or (), strict=False)),
        "",
        "[cosmology]",
        f"h = {float(plane.cosmology.h)!r}",
        f"omega_m = {float(plane.cosmology.omega_m)!r}",
    ]
    for name, component in lens.components.items():
        params = component.params
        lines += ["", "[[component]]", f'name = "{name}"', f'profile = "{profile_of(params).name}"']
        if labels and name in labels:
            lines.append(f"labels = {json.dumps(list(labels[name]), ensure_ascii=False)}")
        lines += [f"{field} = {_array(getattr(params, field))}" for field in params.__dataclass_fields__]
        lines += [
            f"x_arcsec = {_array(np.asarray(component.centre)[:, 0])}",
            f"y_arcsec = {_array(np.asarray(component.centre)[:, 1])}",
            f"pa_rad = {_array(component.pa)}",
        ]
    with atomic(path) as temporary:
        temporary.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _table(path: Path) -> dict[str, Any]:
    try:
        table = tomllib.loads(read_text(path))
    except tomllib.TOMLDecodeError as error:
        raise ValueError(f"{path} is not valid TOML: {error}.") from error
    if table.get("format") != _FORMAT:
        raise ValueError(
            f'{path} is not a lens file: its key `format` is {table.get("format")!r}, not "{_FORMAT}".'
        )
    for key in ("z_l", "cosmology"):
        if key not in table:
            raise ValueError(f"{path}: {key} is missing; write the lens again with `io.write_lens`.")
    return table


def read_lens_reference(path: str | Path) -> Reference | None:
    """(RA, Dec) of the origin of a lens file in degrees, or None if it has none; errors as `read_lens`."""
    table = _table(Path(path))
    if not all(key in table for key in _SKY):
        return None
    return float(table[_SKY[0]]), float(table[_SKY[1]])


def read_lens_labels(path: str | Path) -> dict[str, tuple[str, ...]]:
    """Names of the profiles of the components of a lens file that have any; errors as `read_lens`."""
    entries = _table(Path(path)).get("component", [])
    return {entry["name"]: tuple(map(str, entry["labels"])) for entry in entries if "labels" in entry}


def read_lens(path: str | Path) -> tuple[Lens, LensPlane]:
    """Read what `write_lens` wrote.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is not such a file, or a field is missing or unknown.
    """
    table = _table(Path(path))
    by_name = {record.name: record for record in PROFILES.values()}
    components = {}
    for index, entry in enumerate(table.get("component", []), start=1):
        where = f"{path}, component {index}"
        record = by_name.get(entry.get("profile"))
        if record is None:
            raise ValueError(
                f"{where}: profile is {entry.get('profile')!r}; known are {', '.join(sorted(by_name))}."
            )
        fields = list(record.params.__dataclass_fields__)
        needed = {"name", "profile", *fields, "x_arcsec", "y_arcsec", "pa_rad"}
        if needed != set(entry) - {"labels"}:
            raise ValueError(
                f"{where}: a {record.name} has the keys {', '.join(sorted(needed))}; "
                f"missing {sorted(needed - set(entry))}, unknown {sorted(set(entry) - needed - {'labels'})}."
            )
        params = record.params(**{field: jnp.asarray(entry[field], float) for field in fields})
        centre = jnp.stack([jnp.asarray(entry[key], float) for key in ("x_arcsec", "y_arcsec")], axis=1)
        components[entry["name"]] = Component(params, centre, jnp.asarray(entry["pa_rad"], float))
    cosmology = FlatLCDM(h=table["cosmology"]["h"], omega_m=table["cosmology"]["omega_m"])
    if not jax.config.read("jax_enable_x64"):
        raise ValueError(
            f"{path} holds double-precision numbers, and JAX is in single precision. "
            'Add `jax.config.update("jax_enable_x64", True)` before the first array is made.'
        )
    return Lens(components), LensPlane.at(table["z_l"], cosmology)
