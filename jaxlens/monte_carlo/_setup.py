"""Everything of a Monte Carlo that does not depend on the noise, worked out once."""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxlens import weak
from jaxlens._types import Array, ComplexMap, Float, Int, Map, Points
from jaxlens.grid import Grid
from jaxlens.mass_sheet import median
from jaxlens.radial import Annuli, annuli
from jaxlens.transition import aligned
from jaxlens.weak import AkraDense

BLOCK = 64
"""Realisations that share one matrix product; its rounding depends on its size, so that is always this."""

METHODS = ("A2", "K2")
"""Reconstructions of each realisation; the first is compared with the strong-lensing map."""

RANGES = ((100.0, 300.0), (300.0, 700.0), (100.0, 700.0))
"""Radial ranges of the distributions of the paper, kpc/h; lambda_P of the first corrects the map."""

_HALF_RANGE, _POINTS = 0.3, 241

_GROUP = 256
# The pixels of a range are filled up to a multiple of this.


class Setup(eqx.Module):
    """Truth, strong-lensing map, mask and inversion of one cluster; from `prepare`.

    Attributes:
        g: true reduced shear, not smoothed, `(y, x)`.
        counts: expected galaxies per pixel, `(y, x)`.
        weight: 1 in unmasked pixels, else 0, `(y, x)`.
        kappa_true, kappa_sl: smoothed like the data, `(y, x)`.
        bias: error b of the method, see `transition.moments`, `(y, x)`.
        clean: reconstructions without noise by method, `(y, x)` each.
        inverse: dense map of A2.
        rings: annuli of the profiles.
        pixels: flat indices of the pixels of each range, masked ones included, filled up to a round length
            with one beyond the map: masks and clusters share compiled programs. See `sample`.
        pdf_x: lambda at which distributions are averaged, `(k,)`.
        position: of the pixels, `(y, x, 2)`, kpc/h.
        grid, ranges, smoothing, n_iter, sigma_eps, capacity, correct_by: as given to `prepare`.
    """

    g: ComplexMap
    counts: Map
    weight: Map
    kappa_true: Map
    kappa_sl: Map
    bias: Map
    clean: dict[str, Map]
    inverse: AkraDense
    rings: Annuli
    pixels: tuple[Int[Array, " _"], ...]
    pdf_x: Float[Array, " k"]
    position: Points
    grid: Grid = eqx.field(static=True)
    ranges: tuple[tuple[float, float], ...] = eqx.field(static=True)
    smoothing: float = eqx.field(static=True)
    n_iter: int = eqx.field(static=True)
    sigma_eps: float = eqx.field(static=True)
    capacity: int = eqx.field(static=True)
    correct_by: str = eqx.field(static=True)
    mask: str = eqx.field(static=True)

    @property
    def radius(self) -> Map:
        """Distance of the pixels from the centre, `(y, x)`, kpc/h."""
        return jnp.hypot(self.position[..., 0], self.position[..., 1])

    def sample(self, lam: Map, weight: Map, which: int) -> tuple[Array, Array]:
        """Values of the pixels of range `which` and whether each counts, `(m,)`; places filled up do not."""
        flat = lambda values, fill: values.ravel().at[self.pixels[which]].get(mode="fill", fill_value=fill)
        return flat(lam, 1.0), flat(weight > 0.0, False)


def reconstruct(
    g: Array, weight: Map, grid: Grid, inverse: AkraDense, n_iter: int, mask: str
) -> dict[str, weak.ReconstructionBatch]:
    """A2 and K2 of smoothed reduced shear `(m, y, x)`, all with the same mask."""
    counts = jnp.ones(weight.shape, jnp.int32)
    many = jax.vmap(lambda one: weak.ShearMap(one, weight, counts))(g)
    same = {"n_iter": n_iter, "smoothing": 0.0}
    padding = inverse.operator.padded[0] / grid.shape[0]
    return {
        "A2": weak.reconstruct_many(many, grid, inverse=inverse, block=BLOCK, **same),
        "K2": weak.reconstruct_many(
            many, grid, scheme="K2", mask=mask, padding=padding, band=inverse.operator.band, **same
        ),
    }


def prepare(
    g: ComplexMap,
    kappa_true: Map,
    kappa_sl: Map,
    counts: Map,
    weight: Map,
    grid: Grid,
    *,
    position: Points,
    edges: Sequence[float] | np.ndarray | Array,
    ranges: tuple[tuple[float, float], ...] = RANGES,
    g_sl: ComplexMap | None = None,
    smoothing: float = 15.0,
    n_iter: int = 5,
    ridge: float = 1e-2,
    padding: float = 2.0,
    band: str = "disc",
    mask: str = "binary",
    sigma_eps: float = 0.24,
    correct_by: str = "median",
    dtype: str = "float64",
    inverse: AkraDense | None = None,
) -> Setup:
    """Set up the Monte Carlo of one cluster: seconds, most of them for the dense map.

    Convergences are those of one source redshift, not smoothed: they are smoothed here like the data, over
    the full field and without mask weights. Masks, methods and strong-lensing variants of one cluster share
    their noise if `lambda_profiles` gets the same key; give each cluster a key of its own.

    Args:
        g: true reduced shear, `(y, x)`; where the weight is 0 it may be anything finite.
        kappa_true, kappa_sl: true and strong-lensing convergence, `(y, x)`.
        counts: expected galaxies per pixel, `(y, x)`, see `weak.mean_counts`.
        weight: 0 in masked pixels, `(y, x)`, e.g. |g| > 0.5.
        grid: the grid, at most 6400 pixels.
        position: of the pixels relative to the cluster centre, `(y, x, 2)`, kpc/h.
        edges: of the annuli, kpc/h.
        ranges: (low, high) of the distributions, kpc/h.
        g_sl: reduced shear of the strong-lensing model, `(y, x)`; None takes the method as free of error.
        smoothing: standard deviation of the Gaussian, arcsec.
        n_iter, ridge, padding, band: as in `weak.reconstruct`; one set for noisy and noiseless maps.
        mask: "binary" as in the paper, or "cosine".
        sigma_eps: standard deviation of each intrinsic ellipticity component.
        correct_by: number of the distribution of lambda_rec in the first range that corrects the map:
            "median" (most stable), "biweight" or "peak" (the paper's lambda_P).
        dtype: "float64", or "float32" for half the time and errors of 1e-5.
        inverse: from an earlier `Setup` with the same mask and settings, to save its seconds.

    Raises:
        ValueError: for shapes, names or values that cannot be used.
    """
    for name, values in (("kappa_true", kappa_true), ("kappa_sl", kappa_sl), ("counts", counts)):
        if values.shape != grid.shape:
            raise ValueError(
                f"`{name}` has shape {values.shape} but `grid.shape` is {grid.shape}; use the map's own grid."
            )
        if not np.isfinite(np.asarray(values)).all():
            raise ValueError(f"`{name}` is not finite everywhere; smoothing would spread it.")
    if correct_by not in ("median", "biweight", "peak"):
        raise ValueError(f'`correct_by` is {correct_by!r}; give "median", "biweight" or "peak".')
    if dtype not in ("float64", "float32"):
        raise ValueError(f"`dtype` is {dtype!r}; use 'float64' or 'float32'.")
    if not (np.asarray(counts) >= 0.0).all():
        raise ValueError("`counts` has negative entries; give expected galaxies per pixel.")
    kind = jnp.dtype(dtype)
    known = (jnp.asarray(weight) > 0.0).astype(kind)
    table = inverse
    if table is None:
        table = weak.dense_inverse(known, grid, ridge=ridge, padding=padding, band=band, mask=mask)
    # Its indices stay what they are.
    dense: AkraDense = jax.tree.map(lambda leaf: leaf.astype(kind) if leaf.dtype.kind == "f" else leaf, table)
    as_complex = lambda a: jnp.asarray(a).astype(jnp.result_type(kind, jnp.complex64))
    blur = lambda kappa: weak.smooth(jnp.asarray(kappa), grid, smoothing).astype(kind)
    true, model = blur(kappa_true), blur(kappa_sl)
    rings = annuli(position, jnp.asarray(edges, float), weight=known)
    rings = eqx.tree_at(lambda a: a.edges, rings, rings.edges.astype(kind))
    radius = np.hypot(*np.moveaxis(np.asarray(position), -1, 0))
    used = np.asarray(known).ravel() > 0.0
    places = [np.flatnonzero(((radius >= low) & (radius < high)).ravel()) for low, high in ranges]
    for (low, high), inside in zip(ranges, places, strict=True):
        if used[inside].sum() < 8:
            raise ValueError(
                f"`ranges`: {low:g}-{high:g} kpc/h holds {used[inside].sum()} unmasked pixels; widen it."
            )
    pixels = tuple(
        jnp.asarray(np.pad(inside, (0, -len(inside) % _GROUP), constant_values=used.size), jnp.int32)
        for inside in places
    )

    def clean(shear: Array) -> dict[str, Map]:
        known_g = jnp.where(known > 0.0, as_complex(shear), 0.0)
        one = jnp.where(known > 0.0, weak.smooth(known_g, grid, smoothing, known), 0.0)[None]
        return {
            name: made.kappa[0] for name, made in reconstruct(one, known, grid, dense, n_iter, mask).items()
        }

    bias = jnp.zeros_like(true)
    if g_sl is not None:
        made = clean(g_sl)["A2"]
        bias = aligned(made, model, rings) - model
    free = clean(g)
    last = jnp.zeros(known.size, kind).at[pixels[-1]].set(1.0, mode="drop").reshape(known.shape)
    middle = median(free["A2"], true, known * last)
    return Setup(
        g=as_complex(g),
        counts=jnp.asarray(counts).astype(kind),
        weight=known,
        kappa_true=true,
        kappa_sl=model,
        bias=bias,
        clean=free,
        inverse=dense,
        rings=rings,
        pixels=pixels,
        pdf_x=(middle + jnp.linspace(-_HALF_RANGE, _HALF_RANGE, _POINTS)).astype(kind),
        position=jnp.asarray(position).astype(kind),
        grid=grid,
        ranges=tuple((float(low), float(high)) for low, high in ranges),
        smoothing=smoothing,
        n_iter=n_iter,
        sigma_eps=sigma_eps,
        capacity=weak.capacity_of(float(jnp.sum(jnp.asarray(counts)))),
        correct_by=correct_by,
        mask=mask,
    )
