"""The driver: blocks of realisations, two compiled programs, a state that survives the process."""

import hashlib
from collections.abc import Callable
from importlib.metadata import version
from typing import Any, Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxlens._types import Array, Float, Map, RandomKey
from jaxlens.monte_carlo._draw import draws, reconstructions
from jaxlens.monte_carlo._measure import Measured, aligned_clean, measure_all, without_galaxies
from jaxlens.monte_carlo._setup import BLOCK, METHODS, Setup


@runtime_checkable
class Checkpoint(Protocol):
    """Keeps finished blocks outside the process, e.g. `io.BlockFiles`."""

    def load(self, block: int) -> dict[str, np.ndarray] | None:
        """The arrays of a finished block, or None."""
        ...

    def save(self, block: int, arrays: dict[str, np.ndarray]) -> None:
        """Keep the arrays of a block, whole or not at all."""
        ...


class _Block(eqx.Module):
    """64 realisations, and sums over the good ones; `maps` is empty unless they are kept."""

    measured: Measured
    maps: Array
    n_good: Array
    kappa: Array
    kappa2: Array
    pdf: Array
    pdf2: Array


class LambdaProfiles(eqx.Module):
    """The Monte Carlo of one cluster.

    Attributes:
        measured: numbers of each realisation, leading axis n; those of bad ones are NaN.
        kappa, sigma: mean and standard deviation of the corrected A2 map over the good ones, `(y, x)`.
        pdf, pdf_scatter: mean and standard deviation of the densities of single maps on `pdf_x`,
            `(2 + range, k)`: lambda_map of A2 and of K2 in the last range, then lambda_rec in each.
            These four are over whole blocks: n rounded up to a multiple of 64.
        pdf_x: `(k,)`.
        maps: the A2 maps, not corrected, `(n, y, x)`; None unless they were kept.
        n_bad: realisations that did not converge, are not finite, or overflowed.
        n_empty: realisations with an unmasked pixel that has no galaxy.
    """

    measured: Measured
    kappa: Map
    sigma: Map
    pdf: Float[Array, "q k"]
    pdf_scatter: Float[Array, "q k"]
    pdf_x: Float[Array, " k"]
    maps: Float[Array, "n y x"] | None
    n_bad: int = eqx.field(static=True)
    n_empty: int = eqx.field(static=True)

    @property
    def good(self) -> Measured:
        """The good realisations alone."""
        keep = np.flatnonzero(np.asarray(self.measured.good))
        return jax.tree.map(lambda part: part[keep], self.measured)

    @property
    def sigma_wl2(self) -> Float[Array, " b"]:
        """Variance of the noise of the aligned map in each annulus, for `transition.excess_variance`."""
        return jnp.mean(self.good.noise2, axis=0)


def _block(key: RandomKey, first: Array, setup: Setup, clean: Map) -> _Block:
    """In two programs: that of the draws depends on the number of galaxies, the larger one does not."""
    return _of_shear(*_draws(key, first, setup), without_galaxies(setup), clean)


@eqx.filter_jit
def _draws(key: RandomKey, first: Array, setup: Setup) -> tuple[Array, Array, Array]:
    return draws(key, first, setup, BLOCK)


@eqx.filter_jit
def _of_shear(g: Array, empty: Array, overflow: Array, setup: Setup, clean: Map) -> _Block:
    """A block from its smoothed shear, `(64, y, x)`."""
    made = reconstructions(g, setup)
    finite = jnp.isfinite(g).all(axis=(1, 2))
    good = finite & ~overflow & jnp.stack([made[name].converged for name in METHODS]).all(axis=0)
    kappas = {name: made[name].kappa for name in METHODS}

    def one(given: tuple[dict[str, Array], Array, Array]) -> tuple[Measured, Array, Array]:
        maps, fine, none = given
        return measure_all(maps, setup, fine, none, clean)

    found, corrected, density = lax.map(one, (kappas, good, empty))
    blank = lambda part: jnp.where(
        good.reshape(-1, *[1] * (part.ndim - 1)), part, jnp.nan if part.dtype.kind == "f" else part
    )
    kept = eqx.tree_at(lambda m: (m.good, m.empty), jax.tree.map(blank, found), (found.good, found.empty))
    only = lambda part: jnp.where(good.reshape(-1, *[1] * (part.ndim - 1)), part, 0.0)
    kappa, density = only(corrected), only(density)
    return _Block(
        kept,
        kappas["A2"],
        good.sum(),
        kappa.sum(axis=0),
        (kappa**2).sum(axis=0),
        density.sum(axis=0),
        (density**2).sum(axis=0),
    )


def fingerprint(key: RandomKey, setup: Setup) -> str:
    """Name of a Monte Carlo: SHA-256 of its key, of every array and setting, and of the versions."""
    digest = hashlib.sha256()
    leaves, structure = jax.tree.flatten((jax.random.key_data(key), setup))
    for leaf in leaves:
        array = np.ascontiguousarray(leaf)
        digest.update(f"{array.dtype}{array.shape}".encode())
        digest.update(array.tobytes())
    digest.update(f"{structure} {jax.__version__} {version('jaxlens-cluster')} {BLOCK}".encode())
    return digest.hexdigest()


def _named(tree: Any) -> dict[str, np.ndarray]:
    return {
        jax.tree_util.keystr(path): np.asarray(leaf)
        for path, leaf in jax.tree_util.tree_leaves_with_path(tree)
    }


def _restored(arrays: dict[str, np.ndarray], like: _Block, block: int) -> _Block:
    named, structure = jax.tree_util.tree_flatten_with_path(like)
    leaves = []
    for path, leaf in named:
        found = arrays.get(jax.tree_util.keystr(path))
        if found is None or found.shape != leaf.shape or found.dtype != leaf.dtype:
            raise ValueError(
                f"The state of block {block} does not belong to this Monte Carlo "
                f"({jax.tree_util.keystr(path)} differs); start in an empty directory."
            )
        leaves.append(found)
    return jax.tree_util.tree_unflatten(structure, leaves)


def lambda_profiles(
    key: RandomKey,
    setup: Setup,
    n: int,
    *,
    chunk: int = 4,
    keep_maps: bool = False,
    checkpoint: Checkpoint | None = None,
    on_progress: Callable[[int, int], None] = lambda done, total: None,
) -> LambdaProfiles:
    """Many realisations: counts, ellipticities, shear, both reconstructions, lambda, distributions, profiles.

    Realisation i depends on the key and on i alone. Blocks of 64 are computed by the same programs, so the
    result has the same bytes for any chunk and after a resume, on the same machine and versions. A
    realisation that fails is a flag and does not touch its neighbours.

    Args:
        key: of the cluster; the same for its masks, methods and strong-lensing variants.
        setup: from `prepare`.
        n: realisations.
        chunk: blocks between two saves; memory does not depend on it.
        keep_maps: keep the A2 maps, 8 bytes a pixel and realisation, also in the checkpoint.
        checkpoint: keeps finished blocks, see `Checkpoint`; blocks it has are not computed again.
        on_progress: told realisations done and wanted, after each chunk.

    Raises:
        ValueError: if n or chunk is below 1, or the state belongs to something else.
    """
    if n < 1 or chunk < 1:
        raise ValueError(f"`n` is {n} and `chunk` {chunk}; give at least one of each.")
    clean = aligned_clean(without_galaxies(setup))
    count = -(-n // BLOCK)
    chosen = lambda part: part if keep_maps else eqx.tree_at(lambda b: b.maps, part, part.maps[:0])
    like = jax.eval_shape(lambda k, f, s, c: chosen(_block(k, f, s, c)), key, jnp.asarray(0), setup, clean)
    parts: list[_Block] = []
    for start in range(0, count, chunk):
        fresh: list[tuple[int, _Block]] = []
        for block in range(start, min(start + chunk, count)):
            known = checkpoint.load(block) if checkpoint is not None else None
            if known is not None:
                parts.append(_restored(known, like, block))
                continue
            made = jax.tree.map(np.asarray, chosen(_block(key, jnp.asarray(block * BLOCK), setup, clean)))
            parts.append(made)
            fresh.append((block, made))
        if checkpoint is not None:
            for block, made in fresh:
                checkpoint.save(block, _named(made))
        on_progress(min((start + chunk) * BLOCK, n), n)
    return _summary(parts, setup, n)


def _summary(parts: list[_Block], setup: Setup, n: int) -> LambdaProfiles:
    measured = jax.tree.map(lambda *each: jnp.asarray(np.concatenate(each)[:n]), *[p.measured for p in parts])
    maps = np.concatenate([p.maps for p in parts])
    total = max(int(sum(int(p.n_good) for p in parts)), 1)

    def moments(first: str, second: str) -> tuple[np.ndarray, np.ndarray]:
        mean, square = (
            np.sum([np.asarray(getattr(p, name), float) for p in parts], axis=0) / total
            for name in (first, second)
        )
        return mean, np.sqrt(np.maximum(square - mean**2, 0.0) * total / max(total - 1, 1))

    kappa, sigma = moments("kappa", "kappa2")
    pdf, pdf_scatter = moments("pdf", "pdf2")
    return LambdaProfiles(
        measured,
        jnp.asarray(kappa),
        jnp.asarray(sigma),
        jnp.asarray(pdf),
        jnp.asarray(pdf_scatter),
        setup.pdf_x,
        jnp.asarray(maps[:n]) if len(maps) else None,
        n_bad=int(np.sum(~np.asarray(measured.good))),
        n_empty=int(np.sum(np.asarray(measured.empty) > 0)),
    )
