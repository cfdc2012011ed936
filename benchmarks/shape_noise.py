"""One realisation of shape noise, and a thousand, beside NumPy: counts, ellipticities, means of pixels.

    python benchmarks/shape_noise.py [--smoke] [--full] [--out FILE]

Poisson counts, two Gaussian numbers a galaxy, the exact transformation by the reduced shear, the mean of each
pixel. The error is that of the mean over the realisations, in its own standard errors (the largest of all
pixels with |g| < 0.5; about 4 for 2304 pixels by chance).
"""

import sys
from typing import Any

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
from _harness import Report, parser  # noqa: E402
from _mock import Mock, two_clumps  # noqa: E402

from jaxlens import weak  # noqa: E402


def numpy_noise(rng: np.random.Generator, g: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """One noise realisation by NumPy."""
    number = rng.poisson(counts).ravel()
    pixel = np.repeat(np.arange(g.size), number)
    eps = 0.24 * (rng.standard_normal(len(pixel)) + 1j * rng.standard_normal(len(pixel)))
    true = g.ravel()[pixel]
    strong = np.abs(true) > 1.0
    up, down = eps + true, 1.0 + np.conj(true) * eps
    seen = np.where(strong, np.conj(down / np.where(strong, up, 1.0)), up / down)
    total = np.bincount(pixel, np.real(seen), g.size) + 1j * np.bincount(pixel, np.imag(seen), g.size)
    return (total / np.maximum(number, 1)).reshape(g.shape)


def pull(maps: np.ndarray, mock: Mock) -> float:
    """Largest difference of the mean of maps `(m, y, x)` from the true shear, in standard errors."""
    use = mock.weight > 0
    error = np.sqrt(maps.real.var(axis=0, ddof=1) / len(maps))
    return float((np.abs(maps.real.mean(axis=0) - mock.g.real) / error)[use].max())


def main(arguments: list[str] | None = None) -> int:
    """Sweep the pixels, then a thousand realisations."""
    report = Report("shape_noise", parser(__doc__ or "").parse_args(arguments))
    for side in (16,) if report.smoke else (24, 48, 96):
        mock = two_clumps(n=side, oversample=2)
        counts = weak.mean_counts(mock.grid, mock.plane)
        capacity = weak.capacity_of(float(counts.sum()))
        g, weight = jnp.asarray(mock.g), jnp.asarray(mock.weight)
        draw = lambda key, g, counts, weight, c=capacity: weak.shape_noise(
            key, g, counts, capacity=c, weight=weight
        )
        size = {"pixels": g.size, "galaxies": round(float(counts.sum()))}
        ours = report.measure("one realisation", draw, jax.random.key(0), g, counts, weight, size=size)
        rng, truth, expected = np.random.default_rng(0), np.asarray(mock.g), np.asarray(counts)
        theirs = report.measure(
            "one realisation, NumPy",
            lambda r=rng, t=truth, e=expected: numpy_noise(r, t, e),
            size=size,
            compiled=False,
            traced=True,
        )
        # The generators of NumPy are fast, and ours keeps one key per realisation.
        report.ratio(f"shape noise, {side} x {side} pixels, time over NumPy", ours, theirs, most=3.3)
        if side != (16 if report.smoke else 48):
            continue
        maps = 100 if report.smoke else 1000
        keys = jax.random.split(jax.random.key(1), maps)
        many: Any = lambda keys, *rest, draw=draw: jax.lax.map(lambda k: draw(k, *rest).g, keys)
        error = lambda found, mock=mock: pull(np.asarray(found), mock)
        size = {**size, "realisations": maps}
        row = report.measure(
            "realisations", many, keys, g, counts, weight, size=size, error=error, seconds=0.5
        )
        plain = report.measure(
            "realisations, NumPy",
            lambda r=rng, t=truth, e=expected, n=maps: np.stack([numpy_noise(r, t, e) for _ in range(n)]),
            size=size,
            error=error,
            compiled=False,
            seconds=0.5,
            least=1,
        )
        what = f"mean of {maps} realisations, largest pull in standard errors"
        report.as_exact(what, row, plain, 6.0)
    return report.finish()


if __name__ == "__main__":
    sys.exit(main())
