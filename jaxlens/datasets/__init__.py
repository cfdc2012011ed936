"""Small real data sets that ship with the package; `README.md` beside them has the origin of every file."""

import csv
from dataclasses import dataclass
from importlib import resources
from pathlib import Path

from jaxlens.lens import Lens


@dataclass(frozen=True)
class _Record:
    title: str
    papers: tuple[str, ...]
    licence: str


_LENSTOOL_HPC = (
    "Published facts (positions, magnitudes, shapes, redshifts, parameter values of the published "
    "model), taken from the configuration files in github.com/cerschae/Lenstool-HPC, whose code is "
    "under GPL-3 and not included. Their arrangement in these tables: BSD-3-Clause."
)

_RECORDS = {
    "as1063": _Record(
        title="Abell S1063 (RXC J2248.7-4431), z = 0.3475",
        papers=(
            "Richard et al. 2014, MNRAS 444, 268 (model series of the CATS team; images, members, "
            "published model)",
            "Caminha et al. 2016, A&A 587, A80 (redshifts)",
            "Karman et al. 2017, A&A 599, A28 (redshifts)",
            "Jullo et al. 2007, New Journal of Physics 9, 447 (Lenstool, with which the published model "
            "was made)",
            "Lotz et al. 2017, ApJ 837, 97 (the Frontier Fields)",
        ),
        licence=_LENSTOOL_HPC,
    ),
    "abell2744": _Record(
        title="Abell 2744, z = 0.308",
        papers=(
            "Mahler et al. 2018, MNRAS 473, 663 (images, redshifts, members, published model)",
            "Jullo et al. 2007, New Journal of Physics 9, 447 (Lenstool, with which the published model "
            "was made)",
            "Lotz et al. 2017, ApJ 837, 97 (the Frontier Fields)",
        ),
        licence=_LENSTOOL_HPC,
    ),
    "macs1149": _Record(
        title="MACS J1149.5+2223, z = 0.544",
        papers=(
            "Jauzac et al. 2016, MNRAS 457, 2029 (model series of the CATS team; images, members, "
            "published model)",
            "Jullo et al. 2007, New Journal of Physics 9, 447 (Lenstool, with which the published model "
            "was made)",
            "Lotz et al. 2017, ApJ 837, 97 (the Frontier Fields)",
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


def names() -> list[str]:
    """Names of the data sets, sorted.

    >>> names()
    ['abell2744', 'as1063', 'macs1149', 'smacs0723']
    """
    return sorted(_RECORDS)


def path(name: str) -> Path:
    """The directory of a data set: `strong.toml` and the tables it names.

    Raises:
        ValueError: if there is no such data set; the message lists those there are.
        FileNotFoundError: if the installation has lost the data.
    """
    _record(name)
    folder = Path(str(resources.files(__name__) / name))
    if not folder.is_dir():
        raise FileNotFoundError(f"{folder} is missing; install the package again from its wheel, unpacked.")
    return folder


def models(name: str) -> list[str]:
    """The models of a data set, `strong` (the published freedom) first; `jaxlens strong name/model` fits one.

    Raises:
        ValueError: if there is no such data set.
    """
    return sorted(file.stem for file in path(name).glob("strong*.toml"))


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
