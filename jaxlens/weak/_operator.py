"""The linear map D between convergence and shear on a padded torus, with its exact adjoint, by FFT."""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxlens._types import Array, ComplexMap, Float, Map

BANDS = ("disc", "none")


class ShearOperator(eqx.Module):
    """D in Fourier space: D(k) = (k_x^2 - k_y^2 + 2 i k_x k_y)/k^2 = c + i s, D(0) = 0; gamma = D kappa.

    The field occupies one corner of the padded torus (where it lies there has no meaning). With the band
    `"disc"` only modes with 0 < |k| < k_Nyquist exist, so that c^2 + s^2 = 1 on all of them and D^T D is a
    projector. With `"none"` all modes exist and s = 0 on the Nyquist lines of an even side (s is odd
    there, and a real field keeps only the even part; at the crossing of the lines it is our choice); the
    modes near the corner of Fourier space are then nearly degenerate and make the reconstruction
    unstable. The band is our choice.

    A set of modes is a real array `(2, p_y, p_x//2 + 1)`: real and imaginary part of the half spectrum,
    scaled so that the scalar product of modes is that of maps.

    Attributes:
        shape: rows and columns of the field.
        padded: rows and columns of the torus.
        band: `"disc"` or `"none"`.
    """

    shape: tuple[int, int] = eqx.field(static=True)
    padded: tuple[int, int] = eqx.field(static=True)
    band: str = eqx.field(static=True, default="disc")

    def __check_init__(self) -> None:
        if self.band not in BANDS:
            raise ValueError(f"`band` is {self.band!r}; give one of {BANDS}.")
        if any(p < n for p, n in zip(self.padded, self.shape, strict=True)) or min(self.padded) < 4:
            raise ValueError(
                f"`padded` is {self.padded} for a field of {self.shape}; the torus must hold the field and "
                "have at least 4 pixels a side."
            )

    @classmethod
    def of(cls, shape: Sequence[int], padding: float = 2.0, band: str = "disc") -> "ShearOperator":
        """The operator for a field of `shape` on a torus `padding` (>= 1) times as long."""
        if not 1.0 <= padding <= 16.0:
            raise ValueError(f"`padding` is {padding}; give the ratio of padded to field size, 1 to 16.")
        n_y, n_x = shape
        return cls((n_y, n_x), (round(padding * n_y), round(padding * n_x)), band)

    def _disc(self) -> np.ndarray:
        """Largest |column| of each row of modes within the band, `(p_y, 1)`; -1 where there is none."""
        p_y, p_x = self.padded
        room = 0.25 * (1.0 - 1e-12) - np.fft.fftfreq(p_y)[:, None] ** 2
        return np.where(room > 0.0, np.ceil(p_x * np.sqrt(np.maximum(room, 0.0))) - 1.0, -1.0)

    def _both(self, xp: Any, dtype: Any, *, half: bool = True) -> tuple[Any, Any]:
        """c and s with the arrays of `xp` (NumPy or its twin in JAX), of the real type `dtype`.

        Made of two axes, so that a program holds a few hundred numbers in place of one for each mode.
        """
        p_y, p_x = self.padded
        rows, columns = np.fft.fftfreq(p_y)[:, None], np.fft.fftfreq(p_x)[None, :]
        if half:
            columns = np.abs(columns[:, : p_x // 2 + 1])
        k_y, k_x = xp.asarray(rows, dtype), xp.asarray(columns, dtype)
        k2 = k_x**2 + k_y**2
        safe = xp.where(k2 > 0.0, k2, 1.0)
        c, s = (k_x**2 - k_y**2) / safe, 2.0 * k_x * k_y / safe
        nyquist = xp.asarray(np.abs(rows) == 0.5) | xp.asarray(np.abs(columns) == 0.5)
        s = xp.where(nyquist, 0.0, s)
        if self.band == "none":
            return c, s
        inside = xp.asarray(np.round(np.abs(columns) * p_x)) <= xp.asarray(self._disc())
        return xp.where(inside, c, 0.0), xp.where(inside, s, 0.0)

    def multipliers(self) -> tuple[np.ndarray, np.ndarray]:
        """c and s on the half spectrum, float64, `(p_y, p_x//2 + 1)` each."""
        return self._both(np, np.float64)

    def _scale(self, values: Array) -> Array:
        """sqrt(multiplicity)/sqrt(pixels): the half spectrum holds most modes for two."""
        p_y, p_x = self.padded
        twice = np.full(p_x // 2 + 1, 2.0)
        twice[0] = 1.0
        if p_x % 2 == 0:
            twice[-1] = 1.0
        scale = np.sqrt(twice / (p_y * p_x)).reshape((1,) * (values.ndim - 1) + (-1,))
        return jnp.asarray(scale, values.real.dtype)

    def modes(self, values: Float[Array, "*b y x"]) -> Array:
        """Modes of a map of the field or of the torus (zeros around it)."""
        half = jnp.fft.rfft2(values, s=self.padded)
        half = half * self._scale(half)
        return jnp.stack([half.real, half.imag], axis=-3)

    def values(self, modes: Array, *, crop: bool = True) -> Array:
        """The map that modes make, of the field (`crop`) or of the torus; the adjoint of `modes`."""
        half = lax.complex(modes[..., 0, :, :], modes[..., 1, :, :])
        full = jnp.fft.irfft2(half / self._scale(half), s=self.padded)
        return full[..., : self.shape[0], : self.shape[1]] if crop else full

    def _parts(self, dtype: Any) -> Array:
        """c and s, `(2, 1, p_y, p_x//2 + 1)`."""
        return jnp.stack(self._both(jnp, dtype))[:, None]

    def shear(self, modes: Array, *, crop: bool = True) -> Array:
        """gamma = D kappa from the modes of kappa, complex."""
        both = self.values(self._parts(modes.dtype) * modes[None], crop=crop)
        return lax.complex(both[0], both[1])

    def adjoint(self, gamma: Array) -> Array:
        """Modes of D^T gamma, the exact adjoint of `shear`: D^T(a, b) = F^-1(c F a + s F b)."""
        both = self.modes(jnp.stack([gamma.real, gamma.imag]))
        return jnp.sum(self._parts(both.dtype) * both, axis=0)

    def spectrum(self, dtype: Any = None) -> Array:
        """c + i s on the full spectrum, complex, `(p_y, p_x)`; even in k, as both multipliers are.

        Args:
            dtype: of real and imaginary part; the default precision if None.
        """
        return lax.complex(*self._both(jnp, jnp.asarray(0.0, dtype).dtype, half=False))

    def e_and_b(self, gamma: ComplexMap) -> tuple[Map, Map]:
        """D^T gamma and D^T(-i gamma) in the field.

        By one complex transform each way: both multipliers are real and even, so that the two maps are real
        and imaginary part of F^-1[(c - i s) F gamma].
        """
        modes = jnp.conj(self.spectrum(gamma.real.dtype)) * jnp.fft.fft2(gamma, s=self.padded)
        both = jnp.fft.ifft2(modes)[: self.shape[0], : self.shape[1]]
        return both.real, both.imag

    def e_mode(self, gamma: ComplexMap) -> ComplexMap:
        """D D^T gamma in the field: the part of a shear of the field that a convergence makes.

        By one complex transform each way: the convergence is real, so its modes are the part of
        conj(D) gamma(k) that is even under k -> -k and complex conjugation.
        """
        d = self.spectrum(gamma.real.dtype)  # made anew each time: measured as fast as one kept in memory
        half = jnp.conj(d) * jnp.fft.fft2(gamma, s=self.padded)
        turned = jnp.conj(jnp.roll(half[::-1, ::-1], (1, 1), (0, 1)))
        full = jnp.fft.ifft2(0.5 * d * (half + turned))
        return full[: self.shape[0], : self.shape[1]]


def kaiser_squires(gamma: ComplexMap, *, padding: float = 2.0, band: str = "disc") -> tuple[Map, Map]:
    """Convergence of a shear field: kappa = D^T gamma (E mode) and D^T(-i gamma) (B mode).

    Kaiser & Squires (1993). The shear outside the field counts as zero and the mean over the padded map
    is zero.

    Args:
        gamma: complex shear, `(y, x)`; zero where it is unknown.
        padding: size of the padded map over that of the field.
        band: `"disc"` or `"none"`, see `ShearOperator`.

    Returns:
        E and B maps, `(y, x)` each.
    """
    return ShearOperator.of(gamma.shape, padding, band).e_and_b(gamma)


def shear_of(kappa: Map, *, padding: float = 2.0, band: str = "disc") -> ComplexMap:
    """Shear of a convergence field, gamma = D kappa, complex `(y, x)`: the inverse of `kaiser_squires`.

    The convergence outside the field counts as zero. With `padding=1` the field is periodic.
    """
    operator = ShearOperator.of(kappa.shape, padding, band)
    return operator.shear(operator.modes(kappa))
