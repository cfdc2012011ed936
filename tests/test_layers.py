"""The order of imports: a module sees only lower levels, and a sibling only where the table says so."""

import ast
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parent.parent / "jaxlens"

# A name stands for the module, or for the package and all its modules.
LEVELS: dict[str, int] = {
    "_types": 0, "units": 0, "_text": 0,
    "cosmology": 1, "grid": 1,
    "profiles": 2,
    "lens": 3, "_component": 3,
    "scaling": 4, "_tiling": 4, "_starts": 4, "_newton": 4, "lens_equation": 4, "critical": 4, "radial": 4,
    "mass_sheet": 4,
    "simulate": 5, "strong": 5, "weak": 5,
    "transition": 6, "monte_carlo": 6,
    "_config": 7, "config": 7, "config_weak": 7, "io": 7, "datasets": 7, "plotting": 7, "report": 7,
    "glafic": 7, "lenstool": 7, "lenstronomy": 7, "config_simulate": 7,
    "workflow": 8, "workflow_weak": 8, "prediction": 8, "posterior": 8, "_screen": 8, "results": 8,
    "analysis_weak": 8, "results_weak": 8, "_command_weak": 8, "analysis_strong": 8,
    "_command_strong": 8, "reproduce": 8, "_command_reproduce": 8, "cli": 8, "workflow_simulate": 8,
    "results_simulate": 8, "_command_simulate": 8, "workflow_lambda": 8, "analysis_lambda": 8,
    "results_lambda": 8, "_command_lambda": 8, "_nulls_weak": 8, "_verdict_weak": 8, "redshift_weak": 8,
    "model_weak": 8, "_draws": 8, "config_population": 8, "population": 8, "_command_population": 8,
    "_free": 7, "_reader": 8, "_outcome": 8, "_tables_strong": 8, "_summary_strong": 8, "_fitted": 8,
    "workflow_real": 8, "analysis_real": 8, "results_real": 8, "_command_real": 8, "maps_real": 8,
    "budget_real": 8, "twin_real": 8, "joint_real": 8, "density_real": 8,
    "_verdict_real": 8, "calibration_real": 8,
}  # fmt: skip

SIBLINGS = {
    "lens": {"_component"},
    "lens_equation": {"_newton", "_starts", "_tiling"},
    "_starts": {"_tiling"},
    "config": {"_config", "_free"},
    "_free": {"_config"},
    "workflow": {"_reader"},
    "config_weak": {"_config"},
    "datasets": {"_config", "io"},
    "glafic": {"io"},
    "lenstool": {"io"},
    "analysis_strong": {"posterior", "workflow"},
    "_outcome": {"analysis_strong", "posterior", "workflow"},
    "_tables_strong": {"_outcome", "analysis_strong"},
    "_summary_strong": {"_outcome", "analysis_strong"},
    "results": {"_outcome", "_summary_strong", "_tables_strong", "analysis_strong", "posterior", "workflow"},
    "_command_strong": {"_screen", "analysis_strong", "results", "workflow"},
    "prediction": {"_fitted", "posterior"},
    "_fitted": {"posterior"},
    "_screen": {"prediction", "results"},
    "analysis_weak": {"_nulls_weak", "redshift_weak", "workflow_weak"},
    "results_weak": {"_verdict_weak", "analysis_weak", "redshift_weak"},
    "_command_weak": {"analysis_weak", "model_weak", "results_weak", "workflow_weak"},
    "reproduce": {"workflow", "workflow_simulate"},
    "_command_reproduce": {"population", "reproduce", "workflow_simulate"},
    "population": {"config_population", "io", "reproduce"},
    "_command_population": {"config_population", "population", "reproduce"},
    "cli": {
        "_command_lambda",
        "_command_population",
        "_command_real",
        "_command_reproduce",
        "_command_simulate",
        "_command_strong",
        "_command_weak",
        "_screen",
        "analysis_strong",
        "analysis_weak",
        "prediction",
        "reproduce",
        "results",
        "workflow",
        "workflow_lambda",
        "workflow_real",
    },
    "workflow_real": {"datasets", "workflow", "workflow_weak"},
    "maps_real": {"workflow_real"},
    "budget_real": {"maps_real"},
    "analysis_real": {
        "_nulls_weak",
        "analysis_lambda",
        "budget_real",
        "calibration_real",
        "density_real",
        "joint_real",
        "maps_real",
        "posterior",
        "workflow_lambda",
        "workflow_real",
    },
    "calibration_real": {"maps_real", "workflow_real"},
    "joint_real": {"maps_real", "workflow_real"},
    "density_real": {"budget_real", "maps_real"},
    "twin_real": {"_nulls_weak", "analysis_real", "density_real", "maps_real", "workflow_real"},
    "results_real": {"_verdict_real", "analysis_real", "budget_real", "report"},
    "_command_real": {"analysis_real", "results_real", "workflow_real"},
    "simulate": {"weak"},
    "config_simulate": {"_config"},
    "results_simulate": {"workflow_simulate"},
    "_command_simulate": {"results_simulate", "workflow_simulate"},
    "mass_sheet": {"radial"},
    "monte_carlo": {"transition"},
    "analysis_lambda": {"workflow_lambda"},
    "results_lambda": {"analysis_lambda"},
    "_command_lambda": {"analysis_lambda", "results_lambda", "workflow_lambda"},
    "report": {"plotting"},
    "redshift_weak": {"workflow_weak"},
    "model_weak": {"prediction", "workflow_weak"},
    "posterior": {"_draws"},
}
"""Modules of its own level that a module may import."""

OUTSIDE = {
    "astropy": {"io", "units"},
    "matplotlib": {"plotting"},
    "contourpy": {"critical"},
    "pydantic": {"_config", "_free", "config", "config_population", "config_simulate", "config_weak"},
    "dask": {"population"},
    "distributed": {"population"},
    "jinja2": {"report"},
    "typer": {"cli"},
    "rich": {
        "_command_lambda",
        "_command_population",
        "_command_real",
        "_command_reproduce",
        "_command_simulate",
        "_command_strong",
        "_command_weak",
        "_screen",
        "analysis_strong",
        "analysis_weak",
        "cli",
    },
}
"""Packages that belong to the edge, and the only modules that may import them."""

SOURCES = sorted(PACKAGE.rglob("*.py"))


def dotted(path: Path) -> str:
    """`strong._fit` for strong/_fit.py, `strong` for strong/__init__.py, `` for the package itself."""
    parts = path.relative_to(PACKAGE).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


MODULES = {dotted(path) for path in SOURCES}


def imported(tree: ast.AST, module: str, *, is_package: bool) -> Iterator[str]:
    """Full dotted names of everything a module imports, also inside functions; relative names resolved."""
    here = ["jaxlens", *module.split(".")] if module else ["jaxlens"]
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            package = here[: len(here) - node.level + is_package] if node.level else []
            base = ".".join(package + ([node.module] if node.module else []))
            yield from (f"{base}.{alias.name}" for alias in node.names)


def own_module(name: str) -> str | None:
    """The module of jaxlens that a dotted name lives in; `` is the package itself, None another package."""
    first, *rest = name.split(".")
    if first != "jaxlens":
        return None
    while rest and ".".join(rest) not in MODULES:
        rest.pop()
    return ".".join(rest)


def breaches(module: str, names: set[str]) -> Iterator[str]:
    top = module.split(".")[0]
    for name in sorted(names):
        other = own_module(name)
        if other is None:
            home = OUTSIDE.get(name.split(".")[0])
            if home is not None and top not in home:
                yield f"imports {name}, which only {sorted(home)} may"
        elif other == "":
            if not (name == "jaxlens.__version__" and LEVELS[top] >= 7):
                yield f"imports {name} from the package itself, which imports this module"
        elif (target := other.split(".")[0]) != top:
            if LEVELS[target] > LEVELS[top]:
                yield f"(level {LEVELS[top]}) imports {target} (level {LEVELS[target]})"
            elif LEVELS[target] == LEVELS[top] and target not in SIBLINGS.get(top, set()):
                yield f"imports {target}, a sibling of level {LEVELS[top]}"


def names_of(path: Path) -> set[str]:
    tree = ast.parse(path.read_text(encoding="utf-8"))
    return set(imported(tree, dotted(path), is_package=path.name == "__init__.py"))


def test_every_module_has_a_level():
    unknown = {module.split(".")[0] for module in MODULES} - {""} - set(LEVELS)
    assert not unknown, f"{sorted(unknown)} are not in LEVELS: decide what they may import"


@pytest.mark.parametrize("path", [p for p in SOURCES if dotted(p)], ids=lambda p: dotted(p))
def test_imports_go_downwards(path: Path):
    found = list(breaches(dotted(path), names_of(path)))
    assert not found, "\n".join(f"{dotted(path)} {breach}" for breach in found)


def test_modules_of_one_package_do_not_import_in_circles():
    graph = {
        dotted(path): {
            other for name in names_of(path) if (other := own_module(name)) and other != dotted(path)
        }
        for path in SOURCES
        if dotted(path)
    }

    def visit(module: str, trail: tuple[str, ...]) -> None:
        assert module not in trail, " -> ".join((*trail, module))
        if module in done:
            return
        for other in sorted(graph[module]):
            visit(other, (*trail, module))
        done.add(module)

    done: set[str] = set()
    for module in sorted(graph):
        visit(module, ())


@pytest.mark.parametrize(
    ("module", "source", "breach"),
    [
        ("lens", "from jaxlens.profiles import nfw", ""),
        ("lens", "from jaxlens import strong", "level 5"),
        ("grid", "import jaxlens.cosmology", "sibling of level 1"),
        ("strong._chi2", "from . import _bounds\nfrom ._model import f\nfrom .. import lens", ""),
        ("datasets", "def f():\n    from jaxlens.io import read", ""),
        ("io", "from jaxlens.datasets import load", "sibling of level 7"),
        ("lens", "from astropy import units", "only ['io', 'units'] may"),
        ("cli", "from jaxlens import __version__", ""),
        ("lens", "from jaxlens import psi", "from the package itself"),
    ],
)
def test_the_parser_sees_a_breach(module: str, source: str, breach: str, monkeypatch: pytest.MonkeyPatch):
    # Names that may not exist yet, so that this test does not depend on the state of the package.
    known = {"lens", "strong", "strong._bounds", "strong._model", "io", "datasets", "cosmology", "profiles"}
    monkeypatch.setattr(sys.modules[__name__], "MODULES", MODULES | known)
    found = list(breaches(module, set(imported(ast.parse(source), module, is_package=False))))
    assert bool(found) == bool(breach), found
    assert not breach or breach in found[0]
