"""Kaiser-Squires on square maps of 64 to 2048 pixels a side, beside NumPy, SciPy and lenspack.

    python benchmarks/ks.py [--smoke] [--full] [--out FILE]

E and B map of a periodic complex shear field, no padding, in double precision. The NumPy and SciPy rows are
the leanest form of the same equation: one complex transform each way, kappa_E + i kappa_B = F^-1[D* F gamma],
with the multiplier D made beforehand; SciPy may use all cores. The field is made from a convergence without
Nyquist modes, which is the reference: all programs agree on what is well defined.
"""

import sys
from typing import Any

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
from _akra_plain import workers  # noqa: E402
from _harness import Report, Row, parser  # noqa: E402
from _peers import find  # noqa: E402
from scipy import fft  # noqa: E402

from jaxlens import weak  # noqa: E402


def multiplier(n: int) -> np.ndarray:
    """D(k) = (k_x^2 - k_y^2 + 2 i k_x k_y)/k^2 on the full spectrum, D(0) = 0."""
    k_y, k_x = np.fft.fftfreq(n)[:, None], np.fft.fftfreq(n)[None, :]
    k2 = k_x**2 + k_y**2
    return (k_x**2 - k_y**2 + 2j * k_x * k_y) / np.where(k2 > 0.0, k2, 1.0)


def field(n: int) -> tuple[np.ndarray, np.ndarray]:
    """A convergence with zero mean and no modes on the Nyquist lines, and its shear, `(n, n)` each."""
    modes = np.fft.fft2(np.random.default_rng(n).normal(size=(n, n)))
    modes[0, 0] = 0.0
    modes[n // 2], modes[:, n // 2] = 0.0, 0.0
    return np.fft.ifft2(modes).real, np.fft.ifft2(multiplier(n) * modes)


PEERS = {"NumPy": 1.0, "SciPy": None, "lenspack": None}
"""How much faster than each we should be; the others are for information."""
ROUNDING = 1e-11


def judge(report: Report, n: int, ours: Row, others: dict[str, Row]) -> None:
    """Not slower than NumPy at this size, and as exact as all."""
    what = f"Kaiser-Squires, {n} x {n}"
    for name, least in PEERS.items():
        if name in others:
            report.faster(what, ours, others[name], least, error=ROUNDING)
        else:
            report.unmeasured(f"{what}, times faster than {name}", f"{name} missing", least=least)


def main(arguments: list[str] | None = None) -> int:
    """Run the sweep."""
    report = Report("ks", parser(__doc__ or "").parse_args(arguments))
    inversion = find(report, "lenspack", "image.inversion")
    sides = (32, 64) if report.smoke else (64, 128, 256, 512, 1024, 2048)
    seconds = {}
    for n in sides:
        kappa, gamma = field(n)
        size, d, threads = {"side": n}, np.conj(multiplier(n)), workers((n, n))

        def error(found: Any, kappa: np.ndarray = kappa) -> float:
            e, b = found if isinstance(found, tuple) else (found.real, found.imag)
            return float(max(np.abs(np.asarray(e) - kappa).max(), np.abs(np.asarray(b)).max()))

        make = lambda gamma: weak.kaiser_squires(gamma, padding=1.0, band="none")
        same = {"size": size, "error": error, "seconds": 1.0}
        ours = report.measure("E and B map", make, jnp.asarray(gamma), **same)
        same |= {"compiled": False, "traced": True}
        others = {
            "NumPy": lambda g=gamma, d=d: np.fft.ifft2(d * np.fft.fft2(g)),
            "SciPy": lambda g=gamma, d=d, threads=threads: fft.ifft2(
                d * np.asarray(fft.fft2(g, workers=threads)), overwrite_x=True, workers=threads
            ),
        }
        if inversion is not None:
            g1, g2 = np.ascontiguousarray(gamma.real), np.ascontiguousarray(gamma.imag)
            others["lenspack"] = lambda g1=g1, g2=g2: inversion.ks93(g1, g2)
        judge(
            report,
            n,
            ours,
            {name: report.measure(f"E and B map, {name}", run, **same) for name, run in others.items()},
        )
        seconds[n] = ours.median_ms
    slope = np.polyfit(np.log(np.array(sides) ** 2.0), np.log(list(seconds.values())), 1)[0]
    print(f"time grows as pixels^{slope:.2f}")
    worst = max(row.error for row in report.rows if row.error is not None)
    report.check(f"all agree with the convergence to {worst:.0e} (limit {ROUNDING:.0e})", worst < ROUNDING)
    return report.finish()


if __name__ == "__main__":
    sys.exit(main())
