"""What several test files share: reference tables, error measures, hypothesis strategies."""

import csv
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from jaxlens import lens as lens_module
from jaxlens.lens import Component, Lens

REFERENCE = Path(__file__).parent / "reference"


def table(name: str, **only: str) -> dict[str, np.ndarray]:
    """Columns of `reference/<name>` in the rows where column == value; floats where all cells are.

    An empty cell is NaN.
    """
    with open(REFERENCE / name, newline="", encoding="utf-8") as file:
        rows = [row for row in csv.DictReader(file) if all(row[k] == v for k, v in only.items())]
    assert rows, f"no row of {name} has {only}"

    def column(cells: list[str]) -> np.ndarray:
        try:
            return np.array([float(cell) if cell else np.nan for cell in cells])
        except ValueError:
            return np.array(cells)

    return {key: column([row[key] for row in rows]) for key in rows[0]}


def relative_error(value: Any, reference: Any) -> float:
    """Largest |difference| / max(|reference|, 1e-3 of the largest |reference|).

    gamma and kappa cross zero, where a plain relative error has no meaning.
    """
    value, reference = np.asarray(value), np.asarray(reference)
    largest = np.abs(reference).max()
    scale = np.maximum(np.abs(reference), 1e-3 * largest) if largest > 0 else 1.0
    return float(np.max(np.abs(value - reference) / scale))


def rotation(phi: float) -> np.ndarray:
    """The matrix that turns a vector by `phi` from +x towards +y."""
    return np.array([[np.cos(phi), -np.sin(phi)], [np.sin(phi), np.cos(phi)]])


def angles() -> st.SearchStrategy[float]:
    """An angle in (-pi, pi), rad."""
    return st.floats(-np.pi, np.pi)


def points(
    n: int = 6, *, min_radius: float = 1e-3, max_radius: float = 200.0
) -> st.SearchStrategy[np.ndarray]:
    """`n` positions with log-uniform distance from the origin and any direction, `(n, 2)`, arcsec."""
    log_r = hnp.arrays(float, n, elements=st.floats(np.log(min_radius), np.log(max_radius)))
    phi = hnp.arrays(float, n, elements=st.floats(-np.pi, np.pi))
    return st.builds(lambda s, t: np.exp(s)[:, None] * np.stack([np.cos(t), np.sin(t)], axis=1), log_r, phi)


def strewn(n: int, seed: int, *, min_radius: float = 0.05, max_radius: float = 150.0) -> np.ndarray:
    """`n` fixed positions with log-uniform distance from the origin, `(n, 2)`, arcsec."""
    rng = np.random.default_rng(seed)
    r = np.exp(rng.uniform(np.log(min_radius), np.log(max_radius), n))
    phi = rng.uniform(-np.pi, np.pi, n)
    return np.stack([r * np.cos(phi), r * np.sin(phi)], axis=1)


@jax.jit
def fields(lens: Lens, theta: Any) -> dict[str, jax.Array]:
    """psi, alpha, Hessian, kappa and gamma of a lens at positions, all for D_LS/D_S = 1."""
    deflection, hessian = lens_module.alpha_and_hessian(lens, theta)
    convergence, shear = lens_module.kappa_and_gamma(lens, theta)
    return {
        "psi": lens_module.psi(lens, theta),
        "alpha": deflection,
        "hessian": hessian,
        "kappa": convergence,
        "gamma": shear,
    }


def arrays(found: dict[str, jax.Array]) -> dict[str, np.ndarray]:
    """The same on the host."""
    return {name: np.asarray(value) for name, value in found.items()}


def one(params: Any, centre: Any = (0.0, 0.0), pa: Any = 0.0) -> Lens:
    """The lens of one component."""
    return Lens(one=strict(params, centre, pa))


def strict(params: Any, centre: Any = (0.0, 0.0), pa: Any = 0.0) -> Component:
    """A component of plain float64 arrays: a Python number among them would compile everything twice."""
    params = jax.tree.map(lambda v: np.asarray(v, float), params)
    return Component(params, np.asarray(centre, float), np.asarray(pa, float))


def differences(f: Callable[[Any], Any], x: Any, step: Any) -> np.ndarray:
    """Central differences of `f` along every coordinate of the vector `x`, fourth order, `(len(x), ...)`.

    Four evaluations a coordinate, Richardson-extrapolated; `step` is one number or one per coordinate.
    `f` should be compiled.
    """
    x = np.asarray(x)
    steps = np.broadcast_to(np.asarray(step, float), x.shape)

    def slope(k: int, h: float) -> np.ndarray:
        shift = h * np.eye(len(x))[k]
        return (np.asarray(f(x + shift)) - np.asarray(f(x - shift))) / (2.0 * h)

    return np.stack([(4.0 * slope(k, h) - slope(k, 2.0 * h)) / 3.0 for k, h in enumerate(steps)])
