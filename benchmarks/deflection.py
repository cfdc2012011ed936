"""Deflection and Hessian of a cluster, and their gradient, against the number of members.

    python benchmarks/deflection.py [--smoke] [--out FILE]

68 positions (images), one elliptical NFW, n elliptical dPIE members. The reference is a plain NumPy
sum of the closed forms, for the gradient its fourth-order differences along one direction; circular members
are run in lenstronomy too. Then one elliptical NFW halo on square maps: ours, lenstronomy, JAXtronomy, and a
kernel that does only the square roots and divisions of its 44 terms; errors are relative to lenstronomy.
"""

import sys
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from _harness import Report, parser
from _peers import find
from jax.flatten_util import ravel_pytree

from jaxlens import lenstronomy
from jaxlens.grid import Grid
from jaxlens.lens import TILE, Component, Lens, alpha_and_hessian
from jaxlens.profiles import DPIE, NFW
from jaxlens.profiles import _cse as cse

POSITIONS = 68
Member = dict[str, np.ndarray]


def members_of(n: int, seed: int = 0) -> Member:
    """Numbers of `n` member galaxies: b, r_core, r_cut, e, x, y, pa."""
    rng = np.random.default_rng(seed)
    luminosity = 10.0 ** rng.uniform(-1.6, 0.0, n)
    return {
        "b": 1.2 * luminosity**0.5,
        "r_core": np.full(n, 0.05),
        "r_cut": 12.0 * luminosity**0.5,
        "e": rng.uniform(0.05, 0.5, n),
        "x": rng.uniform(-60.0, 60.0, n),
        "y": rng.uniform(-60.0, 60.0, n),
        "pa": rng.uniform(-np.pi, np.pi, n),
    }


def lens_of(m: Member) -> Lens:
    """A halo and the members."""
    return Lens(
        halo=Component(NFW(kappa_s=0.3, r_s=50.0, e=0.3), jnp.array([1.0, -2.0]), 0.5),
        members=members_only(m),
    )


def members_only(m: Member) -> Component:
    """The members as one component."""
    params = DPIE(m["b"], m["r_core"], m["r_cut"], m["e"])
    return Component(params, np.stack([m["x"], m["y"]], axis=1), m["pa"])


def positions() -> np.ndarray:
    """Image positions within 40 arcsec, `(68, 2)`."""
    rng = np.random.default_rng(1)
    r, phi = 40.0 * np.sqrt(rng.uniform(0.01, 1.0, POSITIONS)), rng.uniform(-np.pi, np.pi, POSITIONS)
    return np.stack([r * np.cos(phi), r * np.sin(phi)], axis=1)


def plain_deflection(m: Member, theta: np.ndarray) -> np.ndarray:
    """Sum of the closed forms (Keeton 2001) over members, in a NumPy loop, `(i, 2)`."""
    total = np.zeros_like(theta)
    for b, core, cut, e, x0, y0, pa in zip(*m.values(), strict=True):
        c, s, q = np.cos(pa), np.sin(pa), 1.0 - e
        d = theta - [x0, y0]
        x, y = c * d[:, 0] + s * d[:, 1], c * d[:, 1] - s * d[:, 0]
        f, strength = np.sqrt(1.0 - q**2), b * np.sqrt(q)
        a_x, a_y = np.zeros_like(x), np.zeros_like(x)
        for radius, sign in ((core, 1.0), (cut, -1.0)):
            t = radius / np.sqrt(q)
            p = np.sqrt(q**2 * (t**2 + x**2) + y**2)
            a_x += sign * strength / f * np.arctan(f * x / (p + t))
            a_y += sign * strength / f * np.arctanh(f * y / (p + q**2 * t))
        total += np.stack([c * a_x - s * a_y, s * a_x + c * a_y], axis=1)
    return total


def relative(found: Any, expected: Any) -> float:
    """Largest difference relative to the largest value."""
    return float(np.abs(np.asarray(found) - expected).max() / np.abs(expected).max())


def value(lens: Lens, theta: jax.Array) -> tuple[jax.Array, jax.Array]:
    """What is timed: deflection and Hessian."""
    return alpha_and_hessian(lens, theta)


def merit(lens: Lens, theta: jax.Array) -> jax.Array:
    """A scalar of both."""
    deflection, hessian = alpha_and_hessian(lens, theta)
    return jnp.sum(deflection**2) / 100.0 + jnp.sum(hessian**2)


def gradient_error(lens: Lens, theta: jax.Array, gradient: Lens) -> float:
    """Of the derivative along one direction, against fourth-order differences of the value."""
    flat, unravel = ravel_pytree(lens)
    direction = np.random.default_rng(2).normal(size=flat.shape) * np.maximum(np.abs(flat), 0.1)
    along = jax.jit(lambda t: merit(unravel(flat + t * direction), theta))
    h = 1e-5
    expected = (8.0 * (along(h) - along(-h)) - (along(2 * h) - along(-2 * h))) / (12.0 * h)
    found = ravel_pytree(gradient)[0] @ direction
    return float(abs(found / expected - 1.0))


def compare_with_lenstronomy(report: Report, m: Member, theta: np.ndarray, size: dict[str, int]) -> None:
    """The circular members in both programs."""
    module = find(report, "lenstronomy", "LensModel.lens_model")
    if module is None:
        return
    m = {**m, "e": np.zeros_like(m["e"])}
    lens = Lens(members=members_only(m))
    expected = value(lens, jnp.asarray(theta))
    report.measure("circular members", value, lens, jnp.asarray(theta), size=size)
    names, numbers = lenstronomy.export(lens, 1.0)
    model = module.LensModel(names)

    def run() -> tuple[np.ndarray, np.ndarray]:
        deflection = np.stack(model.alpha(theta[:, 0], theta[:, 1], numbers), axis=1)
        return deflection, np.stack(model.hessian(theta[:, 0], theta[:, 1], numbers), axis=1)

    error = lambda result: relative(result[0], np.asarray(expected[0]))
    report.measure("circular members, lenstronomy", run, size=size, compiled=False, error=error, seconds=0.5)


def roots_and_divisions(theta: jax.Array) -> jax.Array:
    """One square root and two divisions for each position and term, in our tiles and loop, and little else.

    The 44 terms of an NFW halo need P = sqrt(q^2 (S^2 + x^2) + y^2), 1/P and 1/D.
    """
    columns = tuple(jnp.asarray(column) for column in cse.table("nfw"))

    def tile(points: jax.Array) -> jax.Array:
        def add(total: jax.Array, term: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, None]:
            radius, amplitude = term
            p = jnp.sqrt(radius + points[:, 0])
            return total + amplitude * (1.0 / p + 1.0 / (p + points[:, 1])), None

        return jax.lax.scan(add, jnp.zeros(len(points)), columns, unroll=4)[0]

    return jax.lax.map(tile, jnp.abs(theta).reshape(-1, min(TILE, theta.size // 2), 2)).ravel()


def maps(report: Report) -> None:
    """Deflection and Hessian of an elliptical NFW halo on square maps: three programs, and the limit."""
    halo = Component(NFW(kappa_s=0.3, r_s=50.0, e=0.3), jnp.array([1.0, -2.0]), 0.5)
    lens = Lens(halo=halo)
    names, numbers = lenstronomy.export(lens, 1.0)
    sides = (64,) if report.smoke else (128, 512, 1024)
    theirs = find(report, "lenstronomy", "LensModel.lens_model")
    jaxed = find(report, "jaxtronomy", "LensModel.lens_model")
    for side in sides:
        theta = Grid((side, side), 200.0 / side).theta
        flat, size = theta.reshape(-1, 2), {"side": side}
        x, y = np.asarray(flat).T
        found = {}
        expected = None
        if theirs is not None:
            model = theirs.LensModel(names)
            alpha, hessian = model.alpha(x, y, numbers), model.hessian(x, y, numbers)
            expected = np.stack([*alpha, hessian[0], hessian[1], hessian[3]])
        error = lambda result, expected=expected: relative(columns(result), expected)
        known = {} if expected is None else {"error": error}
        ours = report.measure("map of an NFW halo", value, lens, theta, size=size, **known)
        floor = report.measure("roots and divisions alone", roots_and_divisions, flat, size=size)
        if theirs is not None:
            found["lenstronomy"] = report.measure(
                "map of an NFW halo, lenstronomy",
                lambda model=model, x=x, y=y: (model.alpha(x, y, numbers), model.hessian(x, y, numbers)),
                size=size,
                compiled=False,
                traced=True,
                error=lambda r, e=expected: relative(np.stack([*r[0], r[1][0], r[1][1], r[1][3]]), e),
            )
        if jaxed is not None:
            other = jaxed.LensModel(names)
            both = lambda x, y, numbers, m=other: (m.alpha(x, y, numbers), m.hessian(x, y, numbers))
            found["JAXtronomy"] = report.measure(
                "map of an NFW halo, JAXtronomy",
                both,
                jnp.asarray(x),
                jnp.asarray(y),
                numbers,
                size=size,
                error=lambda r, e=expected: relative(np.stack([*r[0], r[1][0], r[1][1], r[1][3]]), e),
            )
        if side == sides[-1]:
            what = f"deflection and Hessian of an NFW halo, {side} x {side}"
            for name, least in (("lenstronomy", 10.0), ("JAXtronomy", 1.5)):
                if name in found:
                    report.faster(what, ours, found[name], least)
            ratio = ours.best_ms / floor.best_ms
            report.target(f"{what}, time over that of its roots and divisions alone", ratio, most=2.0)


def columns(result: tuple[jax.Array, jax.Array]) -> np.ndarray:
    """Deflection and Hessian as rows (x, y, xx, xy, yy)."""
    alpha, hessian = (np.asarray(part) for part in result)
    parts = (alpha[..., 0], alpha[..., 1], hessian[..., 0, 0], hessian[..., 0, 1], hessian[..., 1, 1])
    return np.stack([part.ravel() for part in parts])


def main(arguments: list[str] | None = None) -> int:
    """Run the sweep."""
    report = Report("deflection", parser(__doc__ or "").parse_args(arguments))
    theta = positions()
    sweep = (5,) if report.smoke else (3, 10, 30, 100, 300, 1000)
    compile_s = {}
    for n in sweep:
        m, size = members_of(n), {"members": n}
        lens, at = lens_of(m), jnp.asarray(theta)
        expected = plain_deflection(m, theta)
        # The halo's tabulated sum has its own reference in the tests; here the members' deflection.
        report.measure(
            "members",
            value,
            Lens(members=lens.components["members"]),
            at,
            size=size,
            error=lambda result, expected=expected: relative(result[0], expected),
        )
        report.measure("halo and members", value, lens, at, size=size)
        row = report.measure(
            "gradient",
            jax.grad(merit),
            lens,
            at,
            size=size,
            error=lambda result, lens=lens, at=at: gradient_error(lens, at, result),
        )
        compile_s[n] = row.compile_s
        compare_with_lenstronomy(report, m, theta, size)
    maps(report)
    growth = compile_s[sweep[-1]] / compile_s[sweep[0]]
    report.check(
        f"compiling the gradient takes {growth:.2f} times as long for {sweep[-1]} members as for {sweep[0]} "
        "(limit 1.5)",
        growth < 1.5,
    )
    worst = max(row.error for row in report.rows if row.name == "members" and row.error is not None)
    report.check(f"the deflection equals the plain sum to {worst:.0e} (limit 1e-12)", worst < 1e-12)
    return report.finish()


if __name__ == "__main__":
    sys.exit(main())
