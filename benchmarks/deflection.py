"""Deflection and Hessian of a cluster, and their gradient, against the number of members.

    python benchmarks/deflection.py [--smoke] [--out FILE]

68 positions (images), one elliptical NFW, n elliptical dPIE members. The reference is a plain NumPy
sum of the closed forms, for the gradient its fourth-order differences along one direction; circular members
are run in lenstronomy too. Then one elliptical NFW halo on square maps: ours, lenstronomy, JAXtronomy, and a
kernel that does only the square roots and divisions of its 44 terms (two divisions a term as the closed form
is written, one at least); errors are relative to the plain sum of the terms at 500 pixels.
"""

import sys
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from _harness import Report, Row, parser
from _peers import find
from _plain_fields import Member, columns, columns_of, error_of, members_of, of_halo, of_members
from jax.flatten_util import ravel_pytree

from jaxlens import lenstronomy
from jaxlens.grid import Grid
from jaxlens.lens import TILE, WIDE, Component, Lens, alpha_and_hessian
from jaxlens.profiles import DPIE, NFW
from jaxlens.profiles import _cse as cse

POSITIONS = 68
HALO: dict[str, Any] = {"kappa_s": 0.3, "r_s": 50.0, "e": 0.3, "centre": (1.0, -2.0), "pa": 0.5}
ROUNDING = 1e-12
"""Largest error of all programs beside plain sums."""


def halo() -> Component:
    """The halo of all runs."""
    params = NFW(kappa_s=HALO["kappa_s"], r_s=HALO["r_s"], e=HALO["e"])
    return Component(params, jnp.array(HALO["centre"]), HALO["pa"])


def lens_of(m: Member) -> Lens:
    """The halo and the members."""
    return Lens(halo=halo(), members=members_only(m))


def members_only(m: Member) -> Component:
    """The members as one component."""
    params = DPIE(m["b"], m["r_core"], m["r_cut"], m["e"])
    return Component(params, np.stack([m["x"], m["y"]], axis=1), m["pa"])


def positions() -> np.ndarray:
    """Image positions within 40 arcsec, `(68, 2)`."""
    rng = np.random.default_rng(1)
    r, phi = 40.0 * np.sqrt(rng.uniform(0.01, 1.0, POSITIONS)), rng.uniform(-np.pi, np.pi, POSITIONS)
    return np.stack([r * np.cos(phi), r * np.sin(phi)], axis=1)


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


def by_class(model: Any, x: Any, y: Any, numbers: Any) -> tuple[Any, ...]:
    """Deflection and Hessian (x, y, xx, xy, yy) by a `LensModel` of lenstronomy or of JAXtronomy."""
    xx, xy, _, yy = model.hessian(x, y, numbers)
    return (*model.alpha(x, y, numbers), xx, xy, yy)


def circular_members(report: Report, m: Member, theta: np.ndarray, size: dict[str, int]) -> None:
    """The members without ellipticity, by us and by lenstronomy."""
    m = {**m, "e": np.zeros_like(m["e"])}
    lens = Lens(members=members_only(m))
    expected = columns_of(lambda at: of_members(m, at), theta)
    error = lambda found: error_of(columns(*found), expected)
    ours = report.measure("circular members", value, lens, jnp.asarray(theta), size=size, error=error)
    module = find(report, "lenstronomy", "LensModel.lens_model")
    if module is None:
        return
    names, numbers = lenstronomy.export(lens, 1.0)
    model = module.LensModel(names)
    x, y = np.ascontiguousarray(theta.T)
    theirs = report.measure(
        "circular members, lenstronomy",
        lambda: by_class(model, x, y, numbers),
        size=size,
        compiled=False,
        traced=True,
        error=lambda found: error_of(np.stack(found), expected),
        seconds=0.5,
    )
    report.as_exact(f"deflection and Hessian of {size['members']} circular members", ours, theirs, ROUNDING)


def roots_and_divisions(x: jax.Array, y: jax.Array, divisions: int) -> jax.Array:
    """A square root and so many divisions for each position and term in our tiles and loop, and little else.

    The 44 terms of an NFW halo are written with P = sqrt(q^2 (S^2 + x^2) + y^2), 1/P and 1/D: a root and two
    divisions; both quotients can be had from one.
    """
    terms = tuple(jnp.asarray(column) for column in cse.table("nfw"))

    def tile(points: tuple[jax.Array, jax.Array]) -> jax.Array:
        def add(total: jax.Array, term: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, None]:
            radius, amplitude = term
            p = jnp.sqrt(radius + points[0])
            quotients = [1.0 / p, 1.0 / (p + points[1])]
            return total + amplitude * sum(quotients[-divisions:]), None

        return jax.lax.scan(add, jnp.zeros_like(points[0]), terms, unroll=cse._UNROLL)[0]

    size = WIDE if x.size > WIDE // 2 else min(TILE, x.size)
    tiles = tuple(jnp.abs(one).reshape(-1, size) for one in (x, y))
    return jax.lax.map(tile, tiles).ravel()


def peers_on_map(
    report: Report, x: np.ndarray, y: np.ndarray, size: dict[str, int], error: Callable[[Any], float]
) -> dict[str, Row]:
    """The halo by lenstronomy and by JAXtronomy."""
    names, numbers = lenstronomy.export(Lens(halo=halo()), 1.0)
    found = {}
    if (module := find(report, "lenstronomy", "LensModel.lens_model")) is not None:
        model = module.LensModel(names)
        found["lenstronomy"] = report.measure(
            "map of an NFW halo, lenstronomy",
            lambda: by_class(model, x, y, numbers),
            size=size,
            compiled=False,
            traced=True,
            error=error,
        )
    if (module := find(report, "jaxtronomy", "LensModel.lens_model")) is not None:
        other = module.LensModel(names)
        found["JAXtronomy"] = report.measure(
            "map of an NFW halo, JAXtronomy",
            lambda x, y, numbers: by_class(other, x, y, numbers),
            jnp.asarray(x),
            jnp.asarray(y),
            numbers,
            size=size,
            error=error,
        )
    return found


def maps(report: Report) -> None:
    """Deflection and Hessian of an elliptical NFW halo on square maps: three programs, and the limit."""
    sides = (64,) if report.smoke else (128, 512, 1024)
    for side in sides:
        theta, size = Grid((side, side), 200.0 / side).theta, {"side": side}
        flat = np.asarray(theta).reshape(-1, 2)
        x, y = np.ascontiguousarray(flat.T)
        some = np.random.default_rng(3).integers(0, len(flat), 500)
        expected = columns_of(lambda at: of_halo(**HALO, theta=at), flat[some])
        of_rows = lambda rows, some=some, expected=expected: error_of(
            np.stack([np.asarray(row).ravel()[some] for row in rows]), expected
        )
        ours = report.measure(
            "map of an NFW halo",
            value,
            Lens(halo=halo()),
            theta,
            size=size,
            error=lambda found, of_rows=of_rows: of_rows(columns(*found)),
        )
        floors = [
            report.measure(
                f"roots and {name} alone",
                partial(roots_and_divisions, divisions=n),
                jnp.asarray(x),
                jnp.asarray(y),
                size=size,
            )
            for n, name in ((2, "two divisions"), (1, "one division"))
        ]
        found = peers_on_map(report, x, y, size, of_rows)
        if side == sides[-1]:
            what = f"deflection and Hessian of an NFW halo, {side} x {side}"
            for name, least in (("lenstronomy", 10.0), ("JAXtronomy", 1.5)):
                if name in found:
                    report.faster(what, ours, found[name], least, error=1e-10)
                else:
                    report.unmeasured(f"{what}, times faster than {name}", f"{name} missing", least=least)
            for floor in floors:
                report.ratio(f"{what}, time over that of {floor.name}", ours, floor, most=2.0)


def main(arguments: list[str] | None = None) -> int:
    """Run the sweep."""
    report = Report("deflection", parser(__doc__ or "").parse_args(arguments))
    theta = positions()
    sweep = (5,) if report.smoke else (3, 10, 30, 100, 300, 1000)
    compile_s = {}
    for n in sweep:
        m, size = members_of(n), {"members": n}
        lens, at = lens_of(m), jnp.asarray(theta)
        of_both = lambda at, m=m: of_members(m, at) + of_halo(**HALO, theta=at)
        alone = columns_of(lambda at, m=m: of_members(m, at), theta)
        both = columns_of(of_both, theta)
        for name, one, expected in (
            ("members", Lens(members=lens.components["members"]), alone),
            ("halo and members", lens, both),
        ):
            error = lambda found, expected=expected: error_of(columns(*found), expected)
            report.measure(name, value, one, at, size=size, error=error)
        row = report.measure(
            "gradient",
            jax.grad(merit),
            lens,
            at,
            size=size,
            compilations=2,
            error=lambda result, lens=lens, at=at: gradient_error(lens, at, result),
        )
        compile_s[n] = row.compile_s
        circular_members(report, m, theta, size)
    maps(report)
    growth = compile_s[sweep[-1]] / compile_s[sweep[0]]
    report.check(
        f"compiling the gradient takes {growth:.2f} times as long for {sweep[-1]} members as for {sweep[0]} "
        "(limit 1.5)",
        growth < 1.5,
        smoke=False,
    )
    worst = lambda *names: max(row.error or 0.0 for row in report.rows if row.name in names)
    found = worst("members", "halo and members", "circular members")
    report.check(f"deflection and Hessian equal plain sums to {found:.0e} (limit 1e-12)", found < ROUNDING)
    found = worst("gradient")
    report.check(f"the gradient equals differences to {found:.0e} (limit 1e-6)", found < 1e-6)
    return report.finish()


if __name__ == "__main__":
    sys.exit(main())
