"""The fit: many starts (`_descent`), the best of them, and the image-plane stage."""

import math
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxlens._types import Array, RandomKey
from jaxlens.strong import _bounds, _chi2, _descent, _image_plane, _sigma
from jaxlens.strong._bounds import Bounds, Params
from jaxlens.strong._chi2 import SIGMA, Prediction, Problem
from jaxlens.strong._descent import Data, End, Start
from jaxlens.strong._result import StrongFit, laplace_covariance

PLANES = ("source", "both", "image")
"""Where chi^2 can be formed."""

AGREE = 1e-3
"""Two starts agree when their chi^2 differ by less than this."""


def _require_double(u: Array) -> None:
    if u.dtype != jnp.float64:
        raise TypeError(
            f"The fit needs double precision, but the free numbers are {u.dtype}. "
            'Add `jax.config.update("jax_enable_x64", True)` before the first array is made.'
        )


class _Done(NamedTuple):
    """One start: its end, its record, whether its image-plane stage has converged, and if it broke down."""

    end: End
    start: Start
    polished: bool | None = None
    broken: bool = False


def _polished(end: End, start: Start, problem: Problem, definition: str) -> _Done:
    """The image-plane stage from the end of a start.

    Its chi^2 of the data and its information stay those of the source plane: a source fixed at the mean of
    the ray-traced images moves with the data, so that the rows of that definition are no likelihood. The
    source-plane rows are: they are the image-plane misfit, linearised, with free sources.
    """
    began = time.perf_counter()
    u, total, _, converged = _image_plane.polish(end.u, problem, definition)
    if not math.isfinite(float(total)):
        return _Done(end, start, False, True)
    data, information = _descent.chi2_and_information(u, problem)
    end = end._replace(u=u, chi2=total, chi2_data=data, information=information)
    start = start._replace(
        chi2=float(total),
        chi2_data=float(data),
        seconds=start.seconds + time.perf_counter() - began,
        at_bound=tuple(_bounds.at_bound(problem.bounds, u)),
    )
    return _Done(end, start, converged)


def starting_points(
    key: RandomKey, problem: Problem, n_starts: int, start: Mapping[str, Any] | None = None
) -> list[Array]:
    """Unbounded vectors of the starts: the given one (or the middle of every box), then prior draws."""
    if start is None:
        first = jnp.zeros(_bounds.total_size(problem.bounds))
    else:
        first = _bounds.unbounded(problem.bounds, start)
    if n_starts < 2:
        return [first][:n_starts]
    return [first, *(jnp.asarray(row) for row in np.asarray(_drawn(key, problem.bounds, n_starts - 1)))]


@eqx.filter_jit
def _drawn(key: RandomKey, bounds: Bounds, n: int) -> Array:
    """Unbounded vectors of `n` draws of the prior, `(n, m)`."""
    one = lambda key: _bounds.unbounded(bounds, _bounds.sample(key, bounds))
    return jax.lax.map(one, jax.random.split(key, n))


def fit(
    problem: Problem,
    *,
    key: RandomKey | None = None,
    n_starts: int = 8,
    start: Mapping[str, Any] | None = None,
    starts: Sequence[Array] | None = None,
    plane: str = "source",
    definition: str = "tensor",
    on_start: Callable[[Start], None] | None = None,
    on_step: Callable[[int, float, int], None] | None = None,
) -> StrongFit:
    """Fit a model to multiple images.

    Every start descends in the source plane. With `plane="both"` the best of them is then moved to the
    image-plane optimum nearby; with `plane="image"` every start is, and the best is chosen there.

    With a free factor on the position errors (`free_sigma`) the starts run with those of the catalogue;
    from the best, model and factor are then improved in turn until both rest, which is the joint maximum of
    the posterior with the sources integrated over.

    Args:
        problem: model, boxes, images and priors.
        key: random key of the starts; `jax.random.key(0)` if absent.
        n_starts: number of starts.
        start: physical numbers of the first start; the middle of every box if absent.
        starts: unbounded vectors `(n,)` to start from, instead of all the above.
        plane: `source`, `both` or `image`.
        definition: source definition of the image-plane stage, see `jaxlens.strong.polish`.
        on_start: called with every finished start.
        on_step: called with (number of the start, floor, steps so far) between runs.

    Returns:
        The best start. `converged`, `at_bound` and `starts` say how far it can be trusted; nothing
        is raised when it did not converge. An interrupt (Ctrl-C) after the first start returns the
        best so far with `interrupted` set. Where the image-plane stage ends without a finite chi^2, the
        numbers of the source plane stand, and `image_plane_failed` is set.

    Raises:
        TypeError: in single precision.
        ValueError: if the start does not match the model, or `plane` or `definition` is unknown.
        KeyboardInterrupt: if interrupted before the first start has ended.
    """
    began = time.perf_counter()
    if plane not in PLANES:
        raise ValueError(f"`plane` is {plane!r}; choose one of {', '.join(PLANES)}.")
    if SIGMA in problem.bounds:
        options = {"n_starts": n_starts, "plane": plane, "definition": definition}
        return _with_free_sigma(problem, key, start, starts, on_start, on_step, options)
    if starts is None:
        starts = starting_points(jax.random.key(0) if key is None else key, problem, n_starts, start)
    if not starts:
        raise ValueError("`n_starts` is 0; a fit needs at least one start.")
    # Through NumPy: a weakly typed start would compile the program a second time.
    starts = [jnp.asarray(np.asarray(u)) for u in starts]
    _require_double(starts[0])
    compile_seconds = _compile(starts[0], problem)

    done: list[_Done] = []
    interrupted = False
    try:
        for number, u in enumerate(starts, start=1):
            tick = (
                (lambda floor, steps, i=number: on_step(i, floor, steps))
                if on_step
                else (lambda floor, steps: None)
            )
            done.append(_Done(*_descent.descend(u, problem, number, tick)))
            if plane == "image":
                done[-1] = _polished(done[-1].end, done[-1].start, problem, definition)
            if on_start:
                on_start(done[-1].start)
    except KeyboardInterrupt:
        if not done:
            raise
        interrupted = True
    finite = [entry for entry in done if math.isfinite(entry.start.chi2)] or done
    end, best, polished, broken = min(finite, key=lambda entry: entry.start.chi2)
    agreeing = sum(entry.start.chi2 - best.chi2 < AGREE for entry in finite)
    if plane == "both" and not interrupted:
        try:
            end, best, polished, broken = _polished(end, best, problem, definition)
        except KeyboardInterrupt:  # the source-plane optimum is kept
            interrupted = True
    prediction, params, chi2_prior = _at(end.u, problem)
    total = time.perf_counter() - began
    return StrongFit(
        u=end.u,
        params=params,
        lens=prediction.lens,
        dls_ds=prediction.dls_ds,
        chi2=end.chi2_data,
        chi2_prior=chi2_prior,
        covariance=laplace_covariance(end.information),
        starts=tuple(entry.start for entry in done),
        at_bound=best.at_bound,
        agreeing=agreeing,
        converged=best.converged or agreeing > 1,
        interrupted=interrupted,
        seconds={"compile": compile_seconds, "fit": total - compile_seconds, "total": total},
        polished=polished,
        image_plane_failed=broken,
    )


@eqx.filter_jit
def _at(u: Array, problem: Problem) -> tuple[Prediction, Params, Array]:
    """Lens, physical numbers and chi^2 of the priors at u."""
    params = _bounds.physical(problem.bounds, u)
    return problem.predict(u), params, jnp.sum(_chi2.prior_residuals(u, problem) ** 2)


FACTOR_TOLERANCE, FACTOR_ROUNDS = 1e-6, 30
"""Change of the free factor on the position errors at its end, and improvements before it is given up."""


def _with_free_sigma(
    problem: Problem,
    key: RandomKey | None,
    start: Mapping[str, Any] | None,
    starts: Sequence[Array] | None,
    on_start: Callable[[Start], None] | None,
    on_step: Callable[[int, float, int], None] | None,
    options: dict[str, Any],
) -> StrongFit:
    """The fit when a factor on the position errors is free."""
    began = time.perf_counter()
    plain, at = _sigma.without(problem), _sigma.place(problem)
    if start is not None:
        start = {name: value for name, value in start.items() if name != SIGMA}
    if starts is not None:
        starts = [jnp.delete(u, at) for u in starts]
    first = fit(plain, key=key, start=start, starts=starts, on_start=on_start, on_step=on_step, **options)
    u, factor, settled, polished = first.u, _sigma.best_factor(first.u, problem), False, first.polished
    broken = first.image_plane_failed
    for _ in range(0 if first.interrupted else FACTOR_ROUNDS):
        scaled = _sigma.scaled(plain, jnp.asarray(factor))
        if options["plane"] == "source":
            u = _descent.run(u, Data(scaled, jnp.asarray(_descent.FLOORS[-1]))).u
        else:
            moved, total, _, polished = _image_plane.polish(u, scaled, options["definition"])
            if broken := not math.isfinite(float(total)):
                break
            u = moved
        before, factor = factor, _sigma.best_factor(u, problem)
        settled = abs(factor / before - 1.0) < FACTOR_TOLERANCE
        if settled:
            break
    whole = jnp.insert(u, at, problem.bounds[SIGMA].unbounded(jnp.asarray(factor))[0])
    prediction, params, chi2_prior = _at(whole, problem)
    total = time.perf_counter() - began
    return StrongFit(
        u=whole,
        params=params,
        lens=prediction.lens,
        dls_ds=prediction.dls_ds,
        chi2=_sigma.chi2_at(u, plain),
        chi2_prior=chi2_prior,
        covariance=laplace_covariance(_sigma.free_information(whole, problem)),
        starts=first.starts,
        at_bound=tuple(_bounds.at_bound(problem.bounds, whole)),
        agreeing=first.agreeing,
        converged=first.converged and (settled or first.interrupted),
        interrupted=first.interrupted,
        seconds={**first.seconds, "fit": total - first.seconds["compile"], "total": total},
        polished=polished and not broken,
        image_plane_failed=broken,
        sigma_scale=factor,
    )


def _compile(u: Array, problem: Problem) -> float:
    """Compile the program before the first start by running it once; seconds it took."""
    began = time.perf_counter()
    jax.block_until_ready(_descent.run(u, Data(problem, jnp.asarray(_descent.FLOORS[0]))))
    return time.perf_counter() - began
