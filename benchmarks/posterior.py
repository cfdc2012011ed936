"""Are the Laplace errors right? The posterior of Abell S1063 by NUTS beside them.

Samples `strong.log_posterior` by the No-U-Turn sampler of numpyro, with the Laplace covariance of the fit as
the inverse mass matrix: no adaptation but of the step size. numpyro, because its sampler takes a plain
potential function and a given dense mass matrix, and brings effective sample sizes and R-hat along. It is
optional, the extra `sample`; without it nothing is sampled.

    python benchmarks/posterior.py [--smoke] [--sources marginal] [--free-sigma] [INPUT]
"""

import sys
import time
from typing import Any

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
from _harness import Report, parser  # noqa: E402

from jaxlens import strong, workflow  # noqa: E402

try:
    from numpyro.diagnostics import effective_sample_size, split_gelman_rubin
    from numpyro.infer import MCMC, NUTS
except ImportError:
    MCMC = None


def sample(
    problem: strong.Problem, fit: strong.StrongFit, sources: str, *, warmup: int, draws: int, chains: int
) -> tuple[np.ndarray, dict[str, float]]:
    """Unbounded vectors `(chains, draws, n)` of the posterior, and how the sampler did."""
    potential = lambda u: -strong.log_posterior(u, problem, sources=sources)
    covariance = strong.without_edges(fit.covariance, strong.edge(problem.bounds, fit.u))
    # A number at its bound has no curvature there; its scale is that of the prior of its box.
    covariance += jnp.diag(jnp.where(jnp.diag(covariance) == 0.0, 0.3, 0.0))
    kernel = NUTS(
        potential_fn=potential, inverse_mass_matrix=covariance, dense_mass=True, adapt_mass_matrix=False
    )
    root = jnp.linalg.cholesky(covariance)
    spread = jax.random.normal(jax.random.key(1), (chains, len(fit.u))) @ root.T
    first = fit.u[None] + 0.5 * spread
    mcmc = MCMC(
        kernel,
        num_warmup=warmup,
        num_samples=draws,
        num_chains=chains,
        chain_method="sequential",
        progress_bar=False,
    )
    began = time.perf_counter()
    fields = ("accept_prob", "num_steps", "diverging")
    mcmc.run(jax.random.key(0), init_params=first if chains > 1 else first[0], extra_fields=fields)
    said = {name: np.asarray(value) for name, value in mcmc.get_extra_fields().items()}
    found = {
        "seconds": time.perf_counter() - began,
        "acceptance": float(said["accept_prob"].mean()),
        "steps": float(said["num_steps"].mean()),
        "diverging": float(said["diverging"].sum()),
    }
    return np.asarray(mcmc.get_samples(group_by_chain=True)), found


def compare(setup: workflow.Setup, problem: strong.Problem, fit: strong.StrongFit, u: np.ndarray) -> float:
    """Print the table; returns the smallest effective sample size."""
    numbers = lambda v: strong.reported(setup.model, strong.physical(problem.bounds, v))
    slopes: Any = jax.jit(jax.jacfwd(numbers))(fit.u)
    best: Any = jax.jit(numbers)(fit.u)
    flat = jax.jit(jax.vmap(numbers))(jnp.asarray(u.reshape(-1, u.shape[-1])))
    covariance = np.asarray(strong.without_edges(fit.covariance, strong.edge(problem.bounds, fit.u)))
    smallest = np.inf
    print(
        f"{'number':28s} {'best':>10s} {'Laplace':>9s} {'NUTS median':>11s} {'NUTS':>9s}  NUTS/Laplace"
        "   ESS  R-hat"
    )
    for name in best:
        row = np.asarray(slopes[name])
        laplace = float(np.sqrt(row @ covariance @ row))
        values = np.asarray(flat[name])
        if name.endswith("pa_deg"):  # nearest turn to the best one
            values = values - 180.0 * np.round((values - float(best[name])) / 180.0)
        low, middle, high = np.percentile(values, [15.865, 50.0, 84.135])
        chains = values.reshape(u.shape[:2])
        size = float(effective_sample_size(chains))
        smallest = min(smallest, size)
        r_hat = float(split_gelman_rubin(chains)) if chains.shape[1] >= 4 else np.nan
        half = 0.5 * (high - low)
        print(
            f"{name:28s} {float(best[name]):10.4g} {laplace:9.3g} {middle:11.4g} {half:9.3g} "
            f"{half / laplace if laplace else np.nan:13.2f} {size:5.0f} {r_hat:6.3f}"
        )
    return smallest


def main(arguments: list[str] | None = None) -> int:
    """Fit, sample, compare."""
    options = parser(__doc__ or "")
    options.add_argument("input", nargs="?", default="as1063", help="data set, directory or file")
    options.add_argument("--sources", choices=("profile", "marginal"), default="profile")
    options.add_argument("--free-sigma", action="store_true", help="a free factor on the position errors")
    options.add_argument("--chains", type=int, default=2)
    options.add_argument("--draws", type=int, default=1000)
    report = Report("posterior", options.parse_args(arguments))
    said = report.options
    if MCMC is None:
        print("numpyro is not installed: nothing is sampled.")
        return 0
    setup = workflow.load(said.input)
    problem = strong.free_sigma(setup.problem) if said.free_sigma else setup.problem
    fit = strong.fit(problem, n_starts=1 if report.smoke else 3, start=setup.start)
    density = lambda u: strong.log_posterior(u, problem, sources=said.sources)
    size = {"free": len(fit.u), "images": problem.images.n_images}
    report.measure("log posterior and gradient", jax.value_and_grad(density), fit.u, size=size)
    warmup, draws, chains = (20, 20, 1) if report.smoke else (300, said.draws, said.chains)
    u, how = sample(problem, fit, said.sources, warmup=warmup, draws=draws, chains=chains)
    print(
        f"{setup.name}, sources: {said.sources}; {chains} chains of {draws} draws after {warmup}: "
        f"acceptance {how['acceptance']:.2f}, {how['steps']:.1f} steps a draw, {how['diverging']:.0f} "
        f"diverging, {how['seconds']:.0f} s with compilation"
    )
    smallest = compare(setup, problem, fit, u)
    report.check(
        f"acceptance {how['acceptance']:.2f} (limits 0.6, 0.99)", 0.6 < how["acceptance"] < 0.99, smoke=False
    )
    report.check(f"smallest effective sample size {smallest:.0f} (limit 200)", smallest > 200, smoke=False)
    report.check(
        f"{how['diverging']:.0f} diverging (limit 1 %)",
        how["diverging"] <= 0.01 * chains * draws,
        smoke=False,
    )
    return report.finish()


if __name__ == "__main__":
    sys.exit(main())
