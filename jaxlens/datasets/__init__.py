"""Small real data sets that ship with the package; `README.md` beside them has the origin of every file."""

import csv
from dataclasses import dataclass
from importlib import resources
from pathlib import Path

from jaxlens._config import ConfigError
from jaxlens.lens import Lens


@dataclass(frozen=True)
class _Record:
    title: str
    papers: tuple[str, ...]
    licence: str


_RRG = (
    "Harvey et al., pyRRG, github.com/davidharvey1986/pyRRG (with which the shapes were measured)",
    "Rhodes, Refregier & Groth 2000, ApJ 536, 79 (the method RRG)",
    "Pagul et al. 2021, ApJS 256, 27, arXiv:2103.01952 (photometric redshifts)",
)
_SHAPES = (
    " Shapes: from github.com/davidharvey1986/pyRRG, MIT, copyright 2017 David Harvey. Photometric "
    "redshifts: Zenodo 5338978, CC-BY-4.0."
)
_FRONTIER = "Lotz et al. 2017, ApJ 837, 97 (the Frontier Fields)"

_LENSTOOL_HPC = (
    "Published facts (positions, magnitudes, shapes, redshifts, parameter values of the published "
    "model), taken from the configuration files in github.com/cerschae/Lenstool-HPC, whose code is "
    "under GPL-3 and not included. Their arrangement in these tables: BSD-3-Clause."
)

KINDS = ("strong", "weak")
"""What a data set may hold: for each kind a file `<kind>.toml` that names its tables."""

_RECORDS = {
    "abell2744": _Record(
        title="Abell 2744, z = 0.308",
        papers=(
            "Mahler et al. 2018, MNRAS 473, 663 (images, redshifts, members, published model)",
            "Jullo et al. 2007, New Journal of Physics 9, 447 (Lenstool, with which the published model "
            "was made)",
            *_RRG,
            _FRONTIER,
        ),
        licence=_LENSTOOL_HPC + _SHAPES,
    ),
    "as1063": _Record(
        title="Abell S1063 (RXC J2248.7-4431), z = 0.3475",
        papers=(
            "Richard et al. 2014, MNRAS 444, 268 (model series of the CATS team; images, members, "
            "published model)",
            "Caminha et al. 2016, A&A 587, A80 (redshifts)",
            "Karman et al. 2017, A&A 599, A28 (redshifts)",
            "Jullo et al. 2007, New Journal of Physics 9, 447 (Lenstool, with which the published model "
            "was made)",
            *_RRG,
            _FRONTIER,
        ),
        licence=_LENSTOOL_HPC + _SHAPES,
    ),
    "cosmos": _Record(
        title="COSMOS, 15 arcmin about an X-ray group, z = 0.22",
        papers=(
            "Schrabback et al. 2010, A&A 516, A63 (shapes)",
            "Remy et al. 2023, A&A 672, A51 (the catalogue in this form)",
            "Finoguenov et al. 2007, ApJS 172, 182 (X-ray groups)",
        ),
        licence=(
            "From github.com/CosmoStat/jax-lensing, MIT, copyright 2020 CosmoStat Laboratory. The "
            "arrangement in these tables: BSD-3-Clause."
        ),
    ),
    "macs1149": _Record(
        title="MACS J1149.5+2223, z = 0.544",
        papers=(
            "Jauzac et al. 2016, MNRAS 457, 2029 (model series of the CATS team; images, members, "
            "published model)",
            "Jullo et al. 2007, New Journal of Physics 9, 447 (Lenstool, with which the published model "
            "was made)",
            _FRONTIER,
        ),
        licence=_LENSTOOL_HPC,
    ),
    "smacs0723": _Record(
        title="SMACS J0723.3-7327, z = 0.39",
        papers=(
            "Mahler et al. 2023, ApJ 945, 49 (images, redshifts, members, published model)",
            "Jullo et al. 2007, New Journal of Physics 9, 447 (Lenstool, with which the published model "
            "was made)",
        ),
        licence=(
            "Published facts and model, taken from github.com/guillaumemahler/SMACS0723-mahler2022 (folder "
            "ICLv2), which is under CC0-1.0. Their arrangement in these tables: BSD-3-Clause."
        ),
    ),
}


def _record(name: str) -> _Record:
    if name not in _RECORDS:
        raise ValueError(f"There is no data set {name!r}; the package ships {', '.join(names())}.")
    return _RECORDS[name]


def names(kind: str | None = None) -> list[str]:
    """Names of the data sets, sorted; with a kind, of those that hold it.

    >>> names()
    ['abell2744', 'as1063', 'cosmos', 'macs1149', 'smacs0723']

    Raises:
        ValueError: if `kind` is none of `KINDS`.
    """
    if kind is not None and kind not in KINDS:
        raise ValueError(f"`kind` is {kind!r}; choose one of {', '.join(KINDS)}.")
    return [name for name in sorted(_RECORDS) if kind is None or kind in holds(name)]


def holds(name: str) -> tuple[str, ...]:
    """What a data set holds, of `KINDS`: `strong` (multiple images), `weak` (galaxy shapes).

    Raises:
        ValueError: if there is no such data set.
    """
    folder = path(name)
    return tuple(kind for kind in KINDS if (folder / f"{kind}.toml").is_file())


def path(name: str) -> Path:
    """The directory of a data set: `strong.toml`, `weak.toml` and the tables they name.

    Raises:
        ValueError: if there is no such data set; the message lists those there are.
        FileNotFoundError: if the installation has lost the data.
    """
    _record(name)
    folder = Path(str(resources.files(__name__) / name))
    if not folder.is_dir():
        raise FileNotFoundError(f"{folder} is missing; install the package again from its wheel, unpacked.")
    return folder


def models(name: str, kind: str = "strong") -> list[str]:
    """The models of a data set, the plain kind first; `jaxlens strong name/model` fits one.

    Raises:
        ValueError: if there is no such data set.
    """
    return sorted(file.stem for file in path(name).glob(f"{kind}*.toml"))


def configuration(source: str, kind: str) -> Path:
    """The file `<kind>.toml` that `source` names: a data set, a directory holding one, or such a file.

    A further model of a data set is `<data set>/<model>`, such as `as1063/strong_nfw`. A directory in the
    current one wins over a data set of the same name.

    Raises:
        ConfigError: if it is none of these, or the data set does not hold the kind; the message lists those
            that do.
    """
    found = Path(source)
    if found.is_dir():
        found = found / f"{kind}.toml"
    elif not found.exists() and source in _RECORDS:
        if kind not in holds(source):
            raise ConfigError(
                f"The data set {source} ({title(source)}) has no {kind}.toml; it holds "
                f"{', '.join(f'{one}.toml' for one in holds(source))}. Data sets with {kind}.toml: "
                f"{', '.join(names(kind))}."
            )
        found = path(source) / f"{kind}.toml"
    elif not found.exists() and found.parent.name == str(found.parent) in _RECORDS:
        known = models(found.parent.name, kind)
        if found.stem not in known:
            raise ConfigError(
                f"{source}: the data set {found.parent.name} has no model {found.stem!r}; "
                f"it has {', '.join(known) or 'none of this kind'}."
            )
        found = path(found.parent.name) / f"{found.stem}.toml"
    if not found.is_file():
        raise ConfigError(
            f"{source} is neither a file, nor a directory holding {kind}.toml, nor one of the data sets "
            f"that ship with the package ({', '.join(names(kind))})."
        )
    return found


def title(name: str) -> str:
    """The object and its redshift, one line; `ValueError` if there is no such data set."""
    return _record(name).title


def citation(name: str) -> str:
    """What to cite when the data set is used, one paper per line.

    Raises:
        ValueError: if there is no such data set.
    """
    record = _record(name)
    return "\n".join([f"{record.title}. Cite:", *(f"- {paper}" for paper in record.papers)])


def licence(name: str) -> str:
    """Under which terms the data set may be passed on; the README beside the data has each file.

    Raises:
        ValueError: if there is no such data set.
    """
    return _record(name).licence


def reference_numbers(name: str) -> dict[str, float]:
    """Single numbers of the published model, by name: masses in Msun, lengths in arcsec, velocities in km/s.

    The table `reference_numbers.csv` also says of each whether it was published, or computed from the
    published model.

    Raises:
        ValueError: if there is no such data set.
    """
    with (path(name) / "reference_numbers.csv").open(newline="", encoding="utf-8") as file:
        return {row["quantity"]: float(row["value"]) for row in csv.DictReader(file)}


def reference_redshifts(name: str) -> dict[str, float]:
    """Redshift of every system of images in the published model: measured, or else its best-fit value.

    Raises:
        ValueError: if there is no such data set.
    """
    with (path(name) / "images.csv").open(newline="", encoding="utf-8") as file:
        return {row["system"]: float(row["z_spec"] or row["z_model"]) for row in csv.DictReader(file)}


def reference_lens(name: str) -> Lens:
    """The published model of a data set.

    Components: `halo` (cluster haloes, brightest galaxies and clumps with numbers of their own),
    `shear`, and `members` (all galaxies on scaling relations), each one stack of profiles.

    Raises:
        ValueError: if there is no such data set.
    """
    from jaxlens import io  # imports astropy, which names() and path() do without

    return io.read_lenstool_halos(path(name) / "reference_halos.csv")
