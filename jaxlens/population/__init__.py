"""Many clusters drawn from a population, on one machine or many, and what they say together."""

from jaxlens.population._draw import numbers_of, settings_of, turned
from jaxlens.population._report import facts, page
from jaxlens.population._run import THREADS, Task, local, remote, run, task
from jaxlens.population._table import columns, profiles

__all__ = [
    "THREADS",
    "Task",
    "columns",
    "facts",
    "local",
    "numbers_of",
    "page",
    "profiles",
    "remote",
    "run",
    "settings_of",
    "task",
    "turned",
]
