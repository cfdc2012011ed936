"""chi^2 of 68 images behind 54 components, its gradient in 26 free numbers, and the full Jacobian.

    python benchmarks/chi2_gradient.py [--smoke] [--full] [--out FILE]

Beside lenstronomy (gradient by forward differences, as a minimiser takes them) and JAXtronomy (its ordinary
class and the one for many profiles), all in double precision. Errors: of chi^2 relative to lenstronomy's
(of lenstronomy's to ours), of gradients relative to fourth-order differences of our chi^2, of the Jacobian
to central ones. Forward differences have an error of their own, which stands beside the others. The members
are swept from 50 to 1000, the images from 68 to 1088; `--full` runs the larger sizes in JAXtronomy too,
whose ordinary class then compiles for minutes.
"""

import sys
from collections.abc import Callable
from typing import Any

import jax

jax.config.update("jax_enable_x64", True)

import _peers as peers  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
from _composite import Composite, load  # noqa: E402
from _harness import Report, Row, parser  # noqa: E402
from scipy.optimize import approx_fprime  # noqa: E402

from jaxlens import strong  # noqa: E402

WAYS = {"": jax.grad, " forward": jax.jacfwd}
"""Reverse mode, and forward mode in 26 directions; each program is judged by the faster."""

EXACT = 1e-6
"""Largest error of chi^2, of a gradient by automatic differentiation and of the Jacobian."""
BY_STEPS = 1e-4
"""Largest error of a gradient by forward differences, in units of its largest component."""

Size = dict[str, int]
Error = Callable[[Any], float]


def relative(found: Any, expected: Any) -> float:
    """Largest difference relative to the largest value."""
    return float(np.abs(np.asarray(found) - np.asarray(expected)).max() / np.abs(np.asarray(expected)).max())


def rows_of(composite: Composite) -> Callable[[Any], Any]:
    """Our whitened residuals `(2 i,)` as a function of p."""
    ratio = jnp.asarray(composite.dls_ds)

    def rows(p: Any) -> Any:
        prediction = strong.Prediction(composite.lens(p), ratio)
        return strong.source_plane_residuals(prediction, composite.images).ravel()

    return rows


def steps_of(p: np.ndarray) -> np.ndarray:
    """Steps of differences: 1e-5 of each number, of 1 for those near zero."""
    return 1e-5 * np.maximum(np.abs(p), 1.0)


def differences(function: Callable[[Any], Any], p: np.ndarray, order: int) -> np.ndarray:
    """Derivatives by central differences of order 2 or 4, `(..., 26)`."""
    weights = {2: {1: 0.5, -1: -0.5}, 4: {1: 2 / 3, -1: -2 / 3, 2: -1 / 12, -2: 1 / 12}}[order]
    columns = []
    for k, step in enumerate(steps_of(p)):
        unit = np.zeros(len(p))
        unit[k] = step
        columns.append(sum(w * np.asarray(function(p + n * unit)) for n, w in weights.items()) / step)
    return np.stack(columns, axis=-1)


def ours(report: Report, composite: Composite, size: Size, expected: float | None) -> dict[str, Row]:
    """chi^2, gradient and Jacobian by this package."""
    rows, p = rows_of(composite), jnp.asarray(composite.p)
    chi2 = lambda p: jnp.sum(rows(p) ** 2)
    error = None if expected is None else lambda value: relative(value, expected)
    found = {"chi2": report.measure("chi2", chi2, p, size=size, error=error)}
    for way, derivative in WAYS.items():
        found[f"gradient{way}"] = report.measure(
            f"gradient{way}", derivative(chi2), p, size=size, error=lambda g: gradient_error(composite, g)
        )
    central = lambda jacobian: relative(jacobian, differences(jax.jit(rows), composite.p, 2))
    found["Jacobian"] = report.measure("Jacobian", jax.jacfwd(rows), p, size=size, error=central)
    return found


def gradient_error(composite: Composite, gradient: Any) -> float:
    """Largest error of a gradient in units of its largest component, each times the size of its number."""
    rows = rows_of(composite)
    exact = differences(jax.jit(lambda p: jnp.sum(rows(p) ** 2)), composite.p, 4)
    scale = np.maximum(np.abs(composite.p), 1.0)
    return relative(np.asarray(gradient) * scale, exact * scale)


def by_lenstronomy(report: Report, composite: Composite, size: Size) -> tuple[float | None, dict[str, Row]]:
    """chi^2 (its value is the reference of the others) and the gradient by forward differences."""
    module = peers.find(report, "lenstronomy", "LensModel.lens_model")
    if module is None:
        return None, {}
    model = module.LensModel(peers.names(composite))
    # Contiguous columns, with which NumPy is fastest.
    theta = np.asfortranarray(np.asarray(composite.images.theta))
    chi2 = peers.chi2_from(peers.by_class(model, composite, theta, np), composite, np)
    p = composite.p
    gradient = lambda: approx_fprime(p, chi2, 1e-7 * np.maximum(np.abs(p), 1.0))
    own = rows_of(composite)
    expected = float(jnp.sum(own(jnp.asarray(p)) ** 2))
    same = {"size": size, "compiled": False, "traced": True}
    return float(chi2(p)), {
        "chi2": report.measure(
            "chi2, lenstronomy", lambda: chi2(p), error=lambda value: relative(value, expected), **same
        ),
        "gradient": report.measure(
            "gradient, lenstronomy", gradient, error=lambda g: gradient_error(composite, g), **same
        ),
    }


def by_jaxtronomy(
    report: Report, composite: Composite, size: Size, expected: float | None, ordinary: bool
) -> dict[str, Row]:
    """chi^2 and its gradient by both classes of JAXtronomy."""
    found = {}
    theta, p = np.asarray(composite.images.theta), jnp.asarray(composite.p)
    fields = {}
    if ordinary and (module := peers.find(report, "jaxtronomy", "LensModel.lens_model")) is not None:
        model = module.LensModel(peers.names(composite))
        fields["JAXtronomy"] = peers.by_class(model, composite, jnp.asarray(theta), jnp)
    if (module := peers.find(report, "jaxtronomy", "LensModel.lens_model_bulk")) is not None:
        model = module.LensModelBulk(peers.NAMES, multi_plane=False)
        fields["JAXtronomy (bulk)"] = peers.by_bulk(model, composite, theta)
    error = None if expected is None else lambda value: relative(value, expected)
    for name, each in fields.items():
        chi2 = peers.chi2_from(each, composite, jnp)
        report.measure(f"chi2, {name}", chi2, p, size=size, error=error)
        for way, derivative in WAYS.items():
            found[f"{name}{way}"] = report.measure(
                f"gradient{way}, {name}",
                derivative(chi2),
                p,
                size=size,
                error=lambda g: gradient_error(composite, g),
            )
    return found


def judge(report: Report, own: dict[str, Row], plain: dict[str, Row], jaxed: dict[str, Row]) -> None:
    """The targets, for 54 components and 68 images."""
    what = "gradient of the 26-parameter chi2"
    best = lambda rows, name: min((rows[f"{name}{way}"] for way in WAYS), key=lambda row: row.median_ms)
    ours = best(own, "gradient")
    if plain:
        report.faster(f"{what} by forward differences", ours, plain["gradient"], 75.0, error=BY_STEPS)
    else:
        claim = f"{what} by forward differences, times faster than lenstronomy"
        report.unmeasured(claim, "lenstronomy missing", least=75.0)
    compiling = f"{what}, compiled times faster than JAXtronomy"
    if "JAXtronomy" in jaxed:
        other = best(jaxed, "JAXtronomy")
        report.faster(what, ours, other, 1.5, error=EXACT)
        # Each was compiled once, without a cache.
        report.target(compiling, other.compile_s / ours.compile_s, least=5.0)
    else:
        report.unmeasured(f"{what}, times faster than JAXtronomy", "JAXtronomy missing", least=1.5)
        report.unmeasured(compiling, "JAXtronomy missing", least=5.0)
    claim = "full Jacobian (136 x 26), time in chi2 evaluations"
    report.ratio(claim, own["Jacobian"], own["chi2"], most=8.0)


def judge_errors(report: Report) -> None:
    """The largest error of every kind of row, by every program."""
    for name in dict.fromkeys(row.name for row in report.rows):
        errors = [row.error for row in report.rows if row.name == name and row.error is not None]
        limit = BY_STEPS if name == "gradient, lenstronomy" else EXACT
        if errors:
            report.check(f"{name}: error {max(errors):.0e} (limit {limit:.0e})", max(errors) <= limit)


def main(arguments: list[str] | None = None) -> int:
    """Run everything."""
    report = Report("chi2_gradient", parser(__doc__ or "").parse_args(arguments))
    base = load()
    sweep = [(10, 1)] if report.smoke else [(50, 1), (200, 1), (1000, 1), (50, 4), (50, 16)]
    for members, copies in sweep:
        composite = base if (members, copies) == (50, 1) else base.resized(members, copies)
        size = {"components": members + 4, "images": composite.images.n_images}
        standard = (members, copies) == sweep[0]
        expected, plain = by_lenstronomy(report, composite, size)
        own = ours(report, composite, size, expected)
        jaxed = {}
        if standard or report.full:
            jaxed = by_jaxtronomy(report, composite, size, expected, ordinary=standard or members <= 200)
        if standard:
            judge(report, own, plain, jaxed)
    judge_errors(report)
    return report.finish()


if __name__ == "__main__":
    sys.exit(main())
