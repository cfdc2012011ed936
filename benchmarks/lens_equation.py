"""Completeness and cost of the lens equation, against a search eight times finer.

Sources behind two clusters: `composite_A` of the tests (two haloes, two BCGs, 20 members without a core,
external shear) and a cluster of 300 elliptical members with small cores. Half of the sources are uniform
in the square around the caustics, half lie within 0.1 arcsec of a caustic, at redshifts 1 to 10, one tiling
for all. The reference divides the base pixel by eight and starts a search at every component centre as well;
an image of |mu| > 1e-3 that it has and the default search has not is missed.

The composite of 54 components is solved by lenstronomy and JAXtronomy too (search on a grid of 1 arcsec in
the same window of 200 arcsec, residual below 1e-10 arcsec), a few sources each: their time is per source,
ours that of 1000 sources with the tiling, divided by 1000. The error column is the share of images missed.

    python benchmarks/lens_equation.py [--smoke] [--full] [--sources N] [--out FILE]
"""

import sys
import time
from pathlib import Path
from typing import Any

import jax

jax.config.update("jax_enable_x64", True)

import _composite  # noqa: E402
import _peers as peers  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
from _harness import ROOT, Report, Row, parser  # noqa: E402

sys.path.insert(0, str(Path(ROOT, "tests")))

import glafic_configs  # noqa: E402
from deflection import members_of  # noqa: E402

from jaxlens import critical, lens_equation  # noqa: E402
from jaxlens import lens as lensing  # noqa: E402
from jaxlens.cosmology import LensPlane  # noqa: E402
from jaxlens.grid import Grid  # noqa: E402
from jaxlens.lens import Component, Lens  # noqa: E402
from jaxlens.profiles import DPIE, Shear, hernquist, nfw  # noqa: E402

HALF_WIDTH = 100.0
FAINT = 1e-3
SAME = 1e-5  # two solutions closer than this, arcsec, are the same image
FINER = 8


def rich_cluster(plane: LensPlane, n: int = 300) -> Lens:
    """A merging halo, two BCGs and `n` elliptical members with cores of 0.05 arcsec."""
    m = members_of(n, seed=3)
    params = DPIE(0.6 * m["b"], m["r_core"], m["r_cut"], m["e"])
    return Lens(
        halo=Component(
            nfw.from_mass(jnp.array([9e14, 5e14]), jnp.array([5.0, 5.5]), plane, e=jnp.array([0.35, 0.2])),
            jnp.array([[-6.0, 1.0], [9.0, -3.0]]),
            jnp.array([0.3, 1.1]),
        ),
        bcg=Component(
            hernquist.from_mass(jnp.array([3e12, 2e12]), jnp.array([6.0, 5.0]), plane, e=0.2),
            jnp.array([[-6.0, 1.0], [9.0, -3.0]]),
            jnp.array([0.4, 1.0]),
        ),
        members=Component(params, np.stack([m["x"], m["y"]], axis=1), m["pa"]),
        shear=Component(Shear(gamma=0.03), pa=0.7),
    )


def ratios(plane: LensPlane, n: int) -> np.ndarray:
    """Distance ratios of n sources at redshifts 1 to 10."""
    return np.array(plane.dls_ds(jnp.asarray(np.random.default_rng(8).uniform(1.0, 10.0, n))))


def draw(model: Lens, ratio: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Source positions `(n, 2)`, and their distance ratios `(n,)`."""
    rng, n, ratio = np.random.default_rng(7), len(ratio), ratio.copy()
    grid = Grid.square(2.0 * HALF_WIDTH, 0.4)
    # The sources near caustics share one redshift; the others one square.
    ratio[n // 2 :] = np.median(ratio)
    loops = np.concatenate([one.beta for one in critical.curves(model, grid, float(ratio[-1])).items])
    low, high = loops.min(axis=0), loops.max(axis=0)
    beta = rng.uniform(low, high, (n, 2))
    near = loops[rng.integers(len(loops), size=n - n // 2)]
    beta[n // 2 :] = near + rng.normal(scale=0.1, size=near.shape)
    return beta, ratio


def solve(model: Lens, beta: np.ndarray, ratio: np.ndarray, tiling: Any, **options: int) -> Any:
    """All images, as NumPy arrays."""
    found = lens_equation.solve(model, jnp.asarray(beta), jnp.asarray(ratio), tiling=tiling, **options)
    return jax.tree.map(np.asarray, found)


def from_centres(
    model: Lens, beta: np.ndarray, ratio: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What Newton's method reaches from every component centre: theta `(s, n, 2)`, mu and found `(s, n)`."""
    centres = lensing.centres(model) + 1e-3

    @jax.jit
    def one(b: jax.Array, w: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        theta, found = lens_equation.images_from(model, centres, b, w)
        return theta, lensing.mu(model, theta, w), found

    parts = [one(jnp.asarray(b), jnp.asarray(w)) for b, w in zip(beta, ratio, strict=True)]
    theta, mu, found = (np.stack([np.asarray(part[k]) for part in parts]) for k in range(3))
    return theta, mu, found & (np.abs(theta) < HALF_WIDTH).all(axis=-1)


def missing(have: np.ndarray, want: np.ndarray, mu: np.ndarray) -> list[tuple[np.ndarray, float]]:
    """Images of `want` brighter than `FAINT` that are not in `have`."""
    lost: list[tuple[np.ndarray, float]] = []
    for theta, m in zip(want, mu, strict=True):
        known = np.concatenate([have, [one for one, _ in lost]]) if lost else have
        if abs(m) > FAINT and not (np.linalg.norm(known - theta, axis=1) < SAME).any():
            lost.append((theta, float(m)))
    return lost


def completeness(
    report: Report, name: str, model: Lens, beta: np.ndarray, ratio: np.ndarray
) -> tuple[Any, float]:
    """Search twice and compare; returns the images of the finer search and the share that was missed."""
    n = len(beta)
    tiling = lens_equation.tile(model, half_width=HALF_WIDTH)
    solve(model, beta[:256], ratio[:256], tiling)  # compiles
    began = time.perf_counter()
    found = solve(model, beta, ratio, tiling)
    seconds = time.perf_counter() - began
    first = min(n, 256)
    report.measure(
        f"{name}: {first} sources",
        lambda b, w: lens_equation.solve(model, b, w, tiling=tiling),
        jnp.asarray(beta[:first]),
        jnp.asarray(ratio[:first]),
        size={"profiles": len(lensing.centres(model)), "sources": first},
    )
    fine = lens_equation.tile(model, half_width=HALF_WIDTH, pixel=1.0 / (2 if report.smoke else FINER))
    began = time.perf_counter()
    reference = solve(model, beta, ratio, fine, k=32, n_starts=256)
    print(
        f"{name}: {n} sources in {seconds:.1f} s ({1e3 * seconds / n:.2f} ms each), "
        f"reference {time.perf_counter() - began:.0f} s"
    )
    centres = from_centres(model, beta, ratio)

    images, lost, wrong, extra = 0, [], 0, 0
    for s in range(n):
        have = found.theta[s][found.valid[s]]
        want = np.concatenate([reference.theta[s][reference.valid[s]], centres[0][s][centres[2][s]]])
        mu = np.concatenate([reference.mu[s][reference.valid[s]], centres[1][s][centres[2][s]]])
        gone = missing(have, want, mu)
        images += len(have)
        lost += [(s, *one) for one in gone]
        wrong += bool(gone) and bool(found.parity_ok[s])
        extra += len(missing(want, have, found.mu[s][found.valid[s]]))
    odd = (found.valid.sum(axis=1) + found.hidden) % 2 == 1
    print(
        f"{name}: {images} images, {len(lost)} missed with |mu| > {FAINT:g}, {wrong} of their sources with "
        f"parity_ok; {extra} that the reference lacks; {int((~odd).sum())} even counts; "
        f"{int((~found.parity_ok).sum())} with parity_ok False; {int(found.overflow.sum())} overflows"
    )
    for s, theta, m in lost[:20]:
        print(
            f"    missed: source {beta[s].round(6)}, D_LS/D_S {ratio[s]:.4f}, "
            f"image {theta.round(5)}, mu {m:.3g}"
        )
    report.check(f"{name}: no image missed among {n} sources", not lost)
    report.check(f"{name}: all counts odd after counting singular centres", bool(odd.all()))
    report.check(f"{name}: no overflow", not found.overflow.any())
    return reference, len(lost) / images


def beside_peers(report: Report, n: int) -> None:
    """The composite of 54 components: n sources of ours, a few of the others."""
    composite = _composite.load()
    model, size = composite.lens(composite.p), {"profiles": len(composite.x) + 4}
    beta, ratio = draw(model, np.ones(n))
    reference, missed = completeness(report, "composite of 54", model, beta, ratio)

    def everything(model: Lens, beta: jax.Array) -> Any:
        tiling = lens_equation.tile(model, half_width=HALF_WIDTH)
        return lens_equation.solve(model, beta, 1.0, tiling=tiling)

    ours = report.measure(
        "composite of 54",
        everything,
        model,
        jnp.asarray(beta),
        size={**size, "sources": n},
        error=lambda _: missed,
    )
    few = 2 if report.smoke else 8
    names, numbers = peers.names(composite), peers.keywords(composite.p, composite)
    for package, least in (("lenstronomy", 100.0), ("jaxtronomy", None)):
        row = by_package(report, package, names, numbers, beta[:few], reference)
        if row is None:
            continue
        ratio_of = (row.best_ms / few) / (ours.best_ms / n)
        report.target(f"images of a source, times faster than {row.name}", ratio_of, least=least)


def by_package(
    report: Report, package: str, names: list[str], numbers: Any, beta: np.ndarray, reference: Any
) -> Row | None:
    """lenstronomy's search, or JAXtronomy's: all sources one after the other."""
    models = peers.find(report, package, "LensModel.lens_model")
    solvers = peers.find(report, package, "LensModel.Solver.lens_equation_solver")
    if models is None or solvers is None:
        return None
    solver = solvers.LensEquationSolver(models.LensModel(names))
    common = {"min_distance": 1.0, "search_window": 2.0 * HALF_WIDTH, "precision_limit": 1e-10}

    def search() -> list[np.ndarray]:
        found = [solver.image_position_from_source(*b, numbers, **common) for b in beta]
        return [np.stack(one, axis=1) for one in found]

    def error(found: list[np.ndarray]) -> float:
        lost = total = 0
        for s, have in enumerate(found):
            known = reference.valid[s]
            total += int(known.sum())
            # Theirs are as good as the residual allows, ours better: |mu| magnifies it.
            lost += len(missing(have, reference.theta[s][known], reference.mu[s][known]))
        return lost / total

    title = {"lenstronomy": "lenstronomy", "jaxtronomy": "JAXtronomy"}[package]
    size = {"profiles": len(names), "sources": len(beta)}
    return report.measure(
        f"composite of 54, {title}", search, size=size, compiled=False, error=error, seconds=0.0, least=1
    )


def main(arguments: list[str] | None = None) -> int:
    """Run everything."""
    options = parser(__doc__ or "")
    options.add_argument(
        "--sources", type=int, help="sources behind each cluster (default 1000; 10000 with --full)"
    )
    report = Report("lens_equation", options.parse_args(arguments))
    n = report.options.sources or (64 if report.smoke else 10000 if report.full else 1000)
    plane = glafic_configs.plane()
    beside_peers(report, n)
    lenses = {
        "composite_A": glafic_configs.lens("composite_A"),
        "300 members": rich_cluster(plane, 30 if report.smoke else 300),
    }
    for name, model in lenses.items():
        completeness(report, name, model, *draw(model, ratios(plane, n)))
    return report.finish()


if __name__ == "__main__":
    sys.exit(main())
