"""The composite of 54 components in lenstronomy and in JAXtronomy: maps, chi^2, images. Optional imports.

Both classes take lenstronomy's profile names and keyword arguments (`jaxlens.lenstronomy` has the same
conversion for a lens of fixed numbers); here they are functions of the free numbers, for NumPy and for JAX.
"""

import warnings
from collections.abc import Callable
from importlib import import_module
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from _composite import CORE, MAIN, Composite
from _harness import Report

MAIN_NAMES = ["NFW_ELLIPSE_CSE"] * 2 + ["HERNQUIST_ELLIPSE_CSE"] * 2
NAMES = ["NFW_ELLIPSE_CSE", "HERNQUIST_ELLIPSE_CSE", "PJAFFE"]


def find(report: Report, package: str, module: str) -> Any:
    """A module of an optional package, or None, which the report then says."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return import_module(f"{package}.{module}")
    except ImportError:
        report.absent(package)
        return None


def names(composite: Composite) -> list[str]:
    """`lens_model_list` of the composite."""
    return MAIN_NAMES + ["PJAFFE"] * len(composite.x)


def keywords(p: Any, composite: Composite, xp: Any = np) -> list[dict[str, Any]]:
    """`kwargs_lens` of the free numbers p `(26,)`, with the arrays of `xp` (NumPy or its twin in JAX)."""
    found = main_keywords(p, xp)
    for light, x, y in zip(composite.luminosity, composite.x, composite.y, strict=True):
        found.append(member_keywords(p, light, x, y))
    return found


def member_keywords(p: Any, light: Any, x: Any, y: Any) -> dict[str, Any]:
    """Keywords of a member, or of several as arrays."""
    b, cut = p[-2] * np.sqrt(light), p[-1] * np.sqrt(light)
    sigma = 0.5 * b * (cut - CORE) / (CORE * cut)
    return {"sigma0": sigma, "Ra": CORE, "Rs": cut, "center_x": x, "center_y": y}


def main_keywords(p: Any, xp: Any) -> list[dict[str, Any]]:
    """Keywords of haloes and BCGs."""
    found = []
    for k in range(MAIN):
        strength, r_s, x, y, e, pa = (p[6 * k + j] for j in range(6))
        q = 1.0 - e
        size = (1.0 - q) / (1.0 + q)
        shape = {"e1": size * xp.cos(2.0 * pa), "e2": size * xp.sin(2.0 * pa), "center_x": x, "center_y": y}
        if MAIN_NAMES[k] == "NFW_ELLIPSE_CSE":
            found.append({"Rs": r_s, "alpha_Rs": 4.0 * strength * r_s * (1.0 - np.log(2.0)), **shape})
        else:
            found.append({"Rs": r_s / xp.sqrt(q), "sigma0": q * strength, **shape})
    return found


Fields = Callable[[Any], tuple[Any, Any]]


def chi2_from(fields: Fields, composite: Composite, xp: Any) -> Callable[[Any], Any]:
    """chi^2(p) of the source plane, as `jaxlens.strong` defines it, from another program's fields.

    Args:
        fields: from p to the deflection (x, y) and Hessian (xx, xy, yy) at the images, each `(i,)`.
        composite: the images.
        xp: NumPy, or its twin in JAX.
    """
    theta, source = np.asarray(composite.images.theta), np.asarray(composite.images.source)
    variance, ratio = np.asarray(composite.images.sigma_pos) ** 2, composite.dls_ds[source]
    member = (source == np.arange(source[-1] + 1)[:, None]).astype(float)  # (s, i)

    def chi2(p: Any) -> Any:
        (a_x, a_y), (xx, xy, yy) = fields(p)
        b_x, b_y = theta[:, 0] - ratio * a_x, theta[:, 1] - ratio * a_y
        j_xx, j_xy, j_yy = 1.0 - ratio * xx, -ratio * xy, 1.0 - ratio * yy
        # G = (sigma^2 A A^T)^-1 of every image, its sum and that of G beta over each system.
        c_xx, c_xy = variance * (j_xx**2 + j_xy**2), variance * (j_xx * j_xy + j_xy * j_yy)
        c_yy = variance * (j_xy**2 + j_yy**2)
        det = c_xx * c_yy - c_xy**2
        g_xx, g_xy, g_yy = c_yy / det, -c_xy / det, c_xx / det
        rows = [g_xx, g_xy, g_yy, g_xx * b_x + g_xy * b_y, g_xy * b_x + g_yy * b_y]
        s_xx, s_xy, s_yy, v_x, v_y = (member @ row for row in rows)
        norm = s_xx * s_yy - s_xy**2
        d_x = b_x - ((s_yy * v_x - s_xy * v_y) / norm)[source]
        d_y = b_y - ((s_xx * v_y - s_xy * v_x) / norm)[source]
        return xp.sum(g_xx * d_x**2 + 2.0 * g_xy * d_x * d_y + g_yy * d_y**2)

    return chi2


def by_class(model: Any, composite: Composite, theta: Any, xp: Any) -> Fields:
    """Fields of a `LensModel` of lenstronomy or of JAXtronomy at `theta (i, 2)`."""

    def fields(p: Any) -> tuple[Any, Any]:
        numbers = keywords(p, composite, xp)
        xx, xy, _, yy = model.hessian(theta[:, 0], theta[:, 1], numbers)
        return model.alpha(theta[:, 0], theta[:, 1], numbers), (xx, xy, yy)

    return fields


def by_bulk(model: Any, composite: Composite, theta: Any) -> Fields:
    """Fields of JAXtronomy's `LensModelBulk`, which knows deflections: their Jacobian by forward mode."""
    index = np.array([NAMES.index(name) for name in names(composite)])

    def fields(p: Any) -> tuple[Any, Any]:
        main = main_keywords(p, jnp)
        light, x, y = (np.asarray(one) for one in (composite.luminosity, composite.x, composite.y))
        members = member_keywords(p, light, x, y)
        keys = sorted({key for one in (*main, members) for key in one})
        stacked = {
            key: jnp.concatenate(
                [
                    jnp.stack([jnp.asarray(one.get(key, 0.0), float) for one in main]),
                    jnp.broadcast_to(jnp.asarray(members.get(key, 0.0), float), light.shape),
                ]
            )
            for key in keys
        }

        def deflection(x: Any, y: Any) -> tuple[Any, Any]:
            b_x, b_y = model.ray_shooting(x, y, {"all_kwargs": stacked, "index_list": index})
            return x - b_x, y - b_y

        x, y = jnp.asarray(theta[:, 0]), jnp.asarray(theta[:, 1])
        alpha, along_x = jax.jvp(deflection, (x, y), (jnp.ones_like(x), jnp.zeros_like(y)))
        _, along_y = jax.jvp(deflection, (x, y), (jnp.zeros_like(x), jnp.ones_like(y)))
        return alpha, (along_x[0], along_x[1], along_y[1])

    return fields
