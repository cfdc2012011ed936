"""Many clusters drawn from a population, on one machine or many, and what they say together."""

from jaxlens.population._draw import numbers_of, settings_of, turned
from jaxlens.population._figures import figures
from jaxlens.population._report import facts, page, pooled, reasons, success_rates
from jaxlens.population._run import THREADS, Task, cores, local, remote, run, task, versions
from jaxlens.population._stored import MADE_WITH, pack, read, shipped, unpack
from jaxlens.population._table import applicable, columns, profiles

__all__ = [
    "MADE_WITH",
    "THREADS",
    "Task",
    "applicable",
    "columns",
    "cores",
    "facts",
    "figures",
    "local",
    "numbers_of",
    "pack",
    "page",
    "pooled",
    "profiles",
    "read",
    "reasons",
    "remote",
    "run",
    "settings_of",
    "shipped",
    "success_rates",
    "task",
    "turned",
    "unpack",
    "versions",
]
