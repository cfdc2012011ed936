"""What configuration files share: strict tables, reading TOML, and mistakes explained line by line."""

import json
import tomllib
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from jaxlens._text import read_text


class ConfigError(ValueError):
    """A configuration file that cannot be read; the message names file, key, value and remedy."""


class Strict(BaseModel):
    """A table that refuses keys it does not know."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Cosmology(Strict):
    """A flat universe."""

    h: Annotated[float, Field(gt=0)] = 0.7
    omega_m: Annotated[float, Field(gt=0, le=1)] = 0.3


def load(path: Path) -> dict[str, Any]:
    """The table of a TOML file, unchecked; `ConfigError` if it is missing or not TOML."""
    try:
        return tomllib.loads(read_text(path))
    except FileNotFoundError as error:
        raise ConfigError(f"{path} does not exist; check the name and the directory.") from error
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{path} is not valid TOML: {error}. Correct it there.") from error
    except ValueError as error:  # too large, or not UTF-8: the message says so
        raise ConfigError(str(error)) from error


def _place(item: Mapping[str, Any]) -> tuple[str, ...]:
    """Keys down to the mistake, without the names that pydantic gives to the branches of a union."""
    parts: list[str] = []
    for part in item["loc"]:
        if isinstance(part, int):
            parts[-1:] = [f"{parts[-1]} {part + 1}"]
        elif part != "float" and not part.startswith(("literal[", "function-after[")):
            parts.append(part)
    return tuple(parts)


def _other_branch(item: Mapping[str, Any]) -> bool:
    """Whether this is about the branch of `Number` that was not meant."""
    in_union = any(isinstance(part, str) and part.startswith("function-after[") for part in item["loc"])
    return (item["type"] == "float_type" and isinstance(item["input"], dict)) or (
        item["type"] == "model_type" and in_union
    )


def _mistake(
    item: Mapping[str, Any],
    place: tuple[str, ...],
    top: type[BaseModel],
    tables: Mapping[str, type[Any]],
) -> str:
    if item["type"] == "missing":
        return "is missing; add it"
    if item["type"] in ("extra_forbidden", "unexpected_keyword_argument"):
        table = top if len(place) == 1 else tables.get(place[-2].partition(" ")[0], tables.get("", top))
        return f"is not known; remove it, or use one of {', '.join(_names(table))}"
    said = item["msg"].removeprefix("Value error, ")
    said = said if item["type"] == "value_error" else said[:1].lower() + said[1:]
    return said if isinstance(item["input"], dict | list) else f"{said} (given: {item['input']!r})"


def _names(table: type[Any]) -> list[str]:
    return [one.name for one in fields(table)] if is_dataclass(table) else list(table.model_fields)


def explain(
    error: ValidationError,
    source: str,
    top: type[BaseModel],
    tables: Mapping[str, type[Any]],
) -> str:
    """One line per mistake: file, key, what is wrong with the value that was given, what to do.

    `top` is the model of the whole, `tables` those of its tables by key, models or dataclasses; `""` stands
    for any other.
    """
    found: dict[tuple[str, ...], list[str]] = {}
    for item in error.errors():
        if not _other_branch(item):
            place = _place(item)
            found.setdefault(place, []).append(_mistake(item, place, top, tables))
    lines = []
    for place, said in found.items():
        where = f"{source}: {'.'.join(place)}" if place else source
        lines.append(f"{where}: {', or '.join(said).removesuffix('.')}.")
    return "\n".join(lines)


def dumps(table: Mapping[str, Any]) -> str:
    """A table as TOML; `None` is left out, numbers read back bit for bit.

    Tables become `[sections]`, lists of tables `[[sections]]`; tables inside those, and boxes `{ min, max }`,
    stand on one line.
    """
    return "\n".join(_section("", table)).strip() + "\n"


def _section(path: str, table: Mapping[str, Any]) -> list[str]:
    lines, after = [], []
    for key, value in table.items():
        full = f"{path}.{key}" if path else key
        if value is None:
            continue
        if isinstance(value, Mapping) and not {"min", "max"} & set(value):
            after += ["", f"[{full}]", *_section(full, value)]
        elif isinstance(value, list | tuple) and value and all(isinstance(one, Mapping) for one in value):
            for one in value:
                rows = [f"{name} = {_value(each)}" for name, each in one.items() if each is not None]
                after += ["", f"[[{full}]]", *rows]
        else:
            lines.append(f"{key} = {_value(value)}")
    return lines + after


def _value(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False)
    if isinstance(value, int):
        return str(value)
    if isinstance(value, float):
        return repr(value)
    if isinstance(value, Mapping):
        inside = [f"{key} = {_value(one)}" for key, one in value.items() if one is not None]
        return "{ " + ", ".join(inside) + " }"
    return "[" + ", ".join(_value(one) for one in value) + "]"
