"""chi^2 of 68 images behind 54 components, its gradient in 26 free numbers, and the full Jacobian.

    python benchmarks/chi2_gradient.py [--smoke] [--full] [--out FILE]

Beside lenstronomy (gradient by forward differences, as a minimiser takes them) and JAXtronomy (its ordinary
class and the one for many profiles), all in double precision. Errors: of chi^2 relative to lenstronomy's
(of lenstronomy's to ours), of gradients relative to fourth-order differences of our chi^2, of the Jacobian
to central ones. Forward differences have an error of their own, which stands beside the others. The members
are swept from 50 to 1000, the images are 68 and 1088; `--full` runs the larger sizes in JAXtronomy's
class for many profiles too.

JAXtronomy's ordinary class writes out every component, and compiling 54 of them may take many minutes and 15
GB: a process of its own tries it for `PATIENCE_S`, in forward mode, which compiles faster. If it does not
end, the ratio of compile times is a lower limit, and run times are compared on 14 components, which it
compiles in half a minute.
"""

import subprocess
import sys
from collections.abc import Callable, Collection, Sequence
from importlib import import_module
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

STEP = float(np.finfo(float).eps ** 0.5)
"""Step of forward differences relative to each number (to 1 for those below), as minimisers take it."""

PATIENCE_S = 30.0
"""How long JAXtronomy's ordinary class may trace and compile a gradient of 54 components."""
FEW = 10
"""Members of the smaller composite."""

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


def ours_of(report: Report, composite: Composite, size: Size, expected: float | None) -> dict[str, Row]:
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


_EXACT: dict[tuple[int, int], np.ndarray] = {}
"""Gradients by differences, by members and images of the composite."""


def exact_gradient(composite: Composite) -> np.ndarray:
    """Fourth-order differences of our chi^2, compiled once for each composite."""
    key = len(composite.x), composite.images.n_images
    if key not in _EXACT:
        rows = rows_of(composite)
        _EXACT[key] = differences(jax.jit(lambda p: jnp.sum(rows(p) ** 2)), composite.p, 4)
    return _EXACT[key]


def gradient_error(composite: Composite, gradient: Any) -> float:
    """Largest error of a gradient in units of its largest component, each times the size of its number."""
    scale = np.maximum(np.abs(composite.p), 1.0)
    return relative(np.asarray(gradient) * scale, exact_gradient(composite) * scale)


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
    gradient = lambda: approx_fprime(p, chi2, STEP * np.maximum(np.abs(p), 1.0))
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


def ordinary_chi2(models: Any, composite: Composite) -> Callable[[Any], Any]:
    """chi^2(p) by JAXtronomy's ordinary class, `models` its module."""
    theta = jnp.asarray(np.asarray(composite.images.theta))
    fields = peers.by_class(models.LensModel(peers.names(composite)), composite, theta, jnp)
    return peers.chi2_from(fields, composite, jnp)


def bulk_chi2(models: Any, composite: Composite) -> Callable[[Any], Any]:
    """chi^2(p) by JAXtronomy's class for many profiles, `models` its module."""
    model = models.LensModelBulk(peers.NAMES, multi_plane=False)
    fields = peers.by_bulk(model, composite, np.asarray(composite.images.theta))
    return peers.chi2_from(fields, composite, jnp)


def gradients(
    report: Report,
    name: str,
    chi2: Callable[[Any], Any],
    composite: Composite,
    size: Size,
    expected: float | None,
    ways: Collection[str] = tuple(WAYS),
) -> list[Row]:
    """Rows of a program's chi^2 and gradients; returns those of the gradients."""
    p = jnp.asarray(composite.p)
    error = None if expected is None else lambda value: relative(value, expected)
    report.measure(f"chi2, {name}", chi2, p, size=size, error=error)
    of_gradient = lambda g: gradient_error(composite, g)
    return [
        report.measure(f"gradient{way}, {name}", WAYS[way](chi2), p, size=size, error=of_gradient)
        for way in ways
    ]


def fastest(rows: Sequence[Row]) -> Row:
    """The row of the shortest run time."""
    return min(rows, key=lambda row: row.median_ms)


def compile_s(rows: Sequence[Row]) -> float:
    """The shortest compile time."""
    return min(row.compile_s for row in rows if row.compile_s is not None)


FASTER = " forward"
"""The way whose program JAXtronomy's ordinary class compiles faster."""


def compile_only() -> int:
    """For a process of its own: the gradient of 54 components by JAXtronomy's ordinary class."""
    composite = load()
    chi2 = ordinary_chi2(import_module("jaxtronomy.LensModel.lens_model"), composite)
    p = jnp.asarray(composite.p)
    print("ready", flush=True)
    jax.jit(WAYS[FASTER](chi2)).lower(p).compile()
    return 0


def attempt() -> str:
    """How a process of its own that compiles that gradient ended: `"compiled"`, or why it did not."""
    line = [sys.executable, __file__, "--compile-only"]
    with subprocess.Popen(line, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as process:
        assert process.stdout is not None
        process.stdout.readline()
        try:
            code = process.wait(PATIENCE_S)
        except subprocess.TimeoutExpired:
            process.kill()
            return LATE
    return "compiled" if code == 0 else f"its compiler ended with exit code {code}"


IMAGES = 68
LATE = f"not compiled within {PATIENCE_S:.0f} s"
GRADIENT = "gradient of the 26-parameter chi2"


def ours_in(rows: dict[str, Row]) -> list[Row]:
    """Our gradients."""
    return [rows[f"gradient{way}"] for way in WAYS]


def judge(report: Report, own: dict[str, Row], plain: dict[str, Row]) -> None:
    """The targets beside lenstronomy and of the Jacobian, for 54 components and 68 images."""
    if plain:
        report.faster(
            f"{GRADIENT} by forward differences",
            fastest(ours_in(own)),
            plain["gradient"],
            75.0,
            error=BY_STEPS,
        )
        report.faster(f"chi2 of {IMAGES} images", own["chi2"], plain["chi2"], None, error=EXACT)
    else:
        claim = f"{GRADIENT} by forward differences, times faster than lenstronomy"
        report.unmeasured(claim, "lenstronomy missing", least=75.0)
    claim = "full Jacobian (136 x 26), time in chi2 evaluations"
    report.ratio(claim, own["Jacobian"], own["chi2"], most=8.0)


def compare(
    report: Report, what: str, own: dict[str, Row], theirs: Sequence[Row], least: float | None = None
) -> None:
    """Run and compile times beside JAXtronomy's; `least` of the latter, None for information."""
    ours, other = fastest(ours_in(own)), fastest(theirs)
    report.faster(what, ours, other, 1.5, error=EXACT)
    ratio = compile_s(theirs) / compile_s([ours])
    report.target(f"{what}, compiled times faster than {other.program}", ratio, least=least)


def beside_jaxtronomy(
    report: Report, base: Composite, size: Size, own: dict[str, Row], expected: float | None
) -> None:
    """The targets beside JAXtronomy: both classes, the ordinary one as far as it compiles."""
    running = f"{GRADIENT}, times faster than JAXtronomy"
    compiling = f"{GRADIENT}, compiled times faster than JAXtronomy"
    many = peers.find(report, "jaxtronomy", "LensModel.lens_model_bulk")
    models = peers.find(report, "jaxtronomy", "LensModel.lens_model")
    if many is None or models is None:
        report.unmeasured(running, "JAXtronomy missing", least=1.5)
        report.unmeasured(compiling, "JAXtronomy missing", least=5.0)
        return
    bulk = gradients(report, "JAXtronomy (bulk)", bulk_chi2(many, base), base, size, expected)
    compare(report, GRADIENT, own, bulk)
    reason = "compiled" if report.smoke else attempt()
    if reason == "compiled":
        chi2 = ordinary_chi2(models, base)
        theirs = gradients(report, "JAXtronomy", chi2, base, size, expected)
        compare(report, GRADIENT, own, theirs, least=5.0)
        return
    report.unmeasured(running, reason, least=1.5)
    bound = PATIENCE_S / compile_s([fastest(ours_in(own))])
    if bound >= 5.0 and reason == LATE:
        report.target(f"{compiling} ({LATE}: a lower limit)", bound, least=5.0)
    else:
        report.unmeasured(compiling, reason, least=5.0)
    few = base.resized(FEW, 1)
    size = {"components": FEW + 4, "images": few.images.n_images}
    value, _ = by_lenstronomy(report, few, size)
    mine = ours_of(report, few, size, value)
    theirs = gradients(report, "JAXtronomy", ordinary_chi2(models, few), few, size, value)
    compare(report, f"{GRADIENT} of {FEW + 4} components", mine, theirs)


def judge_errors(report: Report) -> None:
    """The largest error of every kind of row, by every program."""
    for name in dict.fromkeys(row.name for row in report.rows):
        errors = [row.error for row in report.rows if row.name == name and row.error is not None]
        limit = BY_STEPS if name == "gradient, lenstronomy" else EXACT
        if errors:
            report.check(f"{name}: error {max(errors):.0e} (limit {limit:.0e})", max(errors) <= limit)


def main(arguments: list[str] | None = None) -> int:
    """Run everything."""
    options = parser(__doc__ or "")
    options.add_argument("--compile-only", action="store_true", help="for the process that tries to compile")
    given = options.parse_args(arguments)
    if given.compile_only:
        return compile_only()
    base = load()
    report = Report("chi2_gradient", given)
    sweep = [(10, 1)] if report.smoke else [(50, 1), (200, 1), (1000, 1), (50, 16)]
    for members, copies in sweep:
        composite = base if (members, copies) == (50, 1) else base.resized(members, copies)
        size = {"components": members + 4, "images": composite.images.n_images}
        expected, plain = by_lenstronomy(report, composite, size)
        own = ours_of(report, composite, size, expected)
        if copies == sweep[-1][1] > 1 and plain:
            what = f"{GRADIENT} of {composite.images.n_images} images"
            report.faster(what, fastest(ours_in(own)), plain["gradient"], None, error=BY_STEPS)
        if (members, copies) == sweep[0]:
            judge(report, own, plain)
            beside_jaxtronomy(report, composite, size, own, expected)
        elif report.full:
            many = peers.find(report, "jaxtronomy", "LensModel.lens_model_bulk")
            if many is not None:
                chi2 = bulk_chi2(many, composite)
                gradients(report, "JAXtronomy (bulk)", chi2, composite, size, expected)
    judge_errors(report)
    return report.finish()


if __name__ == "__main__":
    sys.exit(main())
