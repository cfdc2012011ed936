"""The command `jaxlens`: one sub-command for each part of the package."""

import atexit
import gc
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from rich.console import Console

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    help="Weigh galaxy clusters with light: strong and weak lensing.",
)


LARGEST_SEED = 2**63 - 1
"""Of which `jax.random.key` makes a key."""


class Plane(StrEnum):
    """Where the chi^2 is formed."""

    source = "source"
    image = "image"
    both = "both"


class Definition(StrEnum):
    """Source position of the image-plane stage."""

    tensor = "tensor"
    mean = "mean"
    mu_mean = "mu_mean"


class SigmaPos(StrEnum):
    """What is done about the position errors of the images."""

    fixed = "fixed"
    rescaled = "rescaled"
    free = "free"


NOTHING = "Interrupted before there was a result; nothing was written."
"""What most commands say when they are interrupted."""


def _say_error(console: "Console", message: str) -> None:
    console.print("error:", style="bold red", end=" ")
    console.print(message, markup=False, highlight=False, soft_wrap=True)


@contextmanager
def _mistakes_answered(console: "Console", extra: str | None = None) -> Iterator[None]:
    """Mistakes in the input, and a missing package of an `extra`, end the command with code 2."""
    try:
        yield
    except ModuleNotFoundError as error:
        if extra is None:
            raise
        _say_error(console, f"{error.name or error} is missing; install jaxlens-cluster[{extra}].")
        raise typer.Exit(2) from error
    except (ValueError, OSError) as error:
        _say_error(console, str(error))
        raise typer.Exit(2) from error


@contextmanager
def _interruptible(console: "Console", message: str = NOTHING) -> Iterator[None]:
    """Ctrl-C ends the command with code 130 and says what is left of its work."""
    try:
        yield
    except KeyboardInterrupt:
        console.print(message)
        raise typer.Exit(130) from None


def _prepare_jax(cache: bool) -> None:
    """Double precision, and (if wanted) the persistent cache of compiled programs."""
    import jax

    jax.config.update("jax_enable_x64", True)
    if cache and getattr(jax.config, "jax_compilation_cache_dir", None) is None:
        home = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
        try:
            (home / "jaxlens").mkdir(parents=True, exist_ok=True)
        except OSError:
            return  # a home that cannot be written to: compile every time
        jax.config.update("jax_compilation_cache_dir", str(home / "jaxlens"))
        # All programs: the many small ones of a fit take seconds if they are compiled again.
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)


@app.callback()
def _main() -> None:
    """Weigh galaxy clusters with light."""


@app.command()
def strong(
    source: Annotated[
        str,
        typer.Argument(
            metavar="INPUT",
            help="A data set that ships with jaxlens (as1063), a directory holding strong.toml, such a file "
            "itself, a glafic input file (*.input), or a Lenstool parameter file (*.par).",
            show_default=False,
        ),
    ],
    out: Annotated[
        Path, typer.Option(help="Directory for the results.", file_okay=False, show_default=False)
    ],
    starts: Annotated[
        int | None, typer.Option(min=1, help="Number of starts; else from the file, else 8.")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, max=LARGEST_SEED, help="Seed of the starts.")] = 0,
    plane: Annotated[
        Plane | None, typer.Option(help="Where the chi^2 is formed; else from the file.")
    ] = None,
    definition: Annotated[
        Definition | None, typer.Option(help="Source position of the image-plane stage; else from the file.")
    ] = None,
    sigma_pos: Annotated[
        SigmaPos | None,
        typer.Option(
            help="Position errors: fixed, rescaled so that chi2_nu = 1, or a free factor; else from the file."
        ),
    ] = None,
    draws: Annotated[
        int | None,
        typer.Option(
            min=0,
            max=10000,
            help="Convergence maps drawn from the posterior: a cube (4 bytes a pixel, 12 in memory), "
            "mean and standard deviation; else from the file.",
        ),
    ] = None,
    leave_one_out: Annotated[
        bool | None,
        typer.Option(
            "--leave-one-out/--no-leave-one-out",
            help="Fit again without each system and predict it; about the time of one start for each.",
        ),
    ] = None,
    shear: Annotated[
        bool, typer.Option("--shear", help="Fit again with one free external shear, and compare.")
    ] = False,
    cache: Annotated[
        bool, typer.Option(help="Keep compiled programs in the user's cache directory for the next run.")
    ] = True,
) -> None:
    """Fit a cluster to its multiple images and write the model, its maps and its figures."""
    from rich.console import Console

    from jaxlens import analysis_strong, io, workflow

    console = Console(stderr=True)
    _prepare_jax(cache)
    from jaxlens import _command_strong

    with _interruptible(console):
        # Only mistakes in the input are answered without a traceback; an error of the fit is ours.
        with _mistakes_answered(console):
            io.writable(out)
            setup = workflow.load(source)
            options = analysis_strong.options_of(
                setup,
                sigma_pos=sigma_pos.value if sigma_pos else None,
                draws=draws,
                leave_one_out=leave_one_out,
                shear=shear,
            )
            setup = analysis_strong.prepare(setup, options)
        code = _command_strong.run(
            console,
            setup,
            out,
            options,
            starts=starts,
            seed=seed,
            plane=plane.value if plane else None,
            definition=definition.value if definition else None,
        )
    raise typer.Exit(code)


@app.command()
def predict(
    model: Annotated[
        str,
        typer.Argument(
            metavar="MODEL",
            help="A result directory of `jaxlens strong`, or a model.toml.",
            show_default=False,
        ),
    ],
    z: Annotated[float, typer.Option(help="Redshift of the source.", show_default=False)],
    x: Annotated[float | None, typer.Option(help="Position of the image: West, arcsec.")] = None,
    y: Annotated[float | None, typer.Option(help="Position of the image: North, arcsec.")] = None,
    ra: Annotated[float | None, typer.Option(help="Position of the image: RA, degrees.")] = None,
    dec: Annotated[float | None, typer.Option(help="Position of the image: Dec, degrees.")] = None,
    out: Annotated[
        Path | None, typer.Option(help="Table to write (ECSV).", dir_okay=False, show_default=False)
    ] = None,
    half_width: Annotated[
        float | None,
        typer.Option(
            min=0.1, help="Half the side of the window that is searched, arcsec.", show_default=False
        ),
    ] = None,
    sigma: Annotated[
        float, typer.Option(min=0.0, help="Error of the position on each axis, arcsec; joins the errors.")
    ] = 0.0,
    cache: Annotated[
        bool, typer.Option(help="Keep compiled programs in the user's cache directory for the next run.")
    ] = True,
) -> None:
    """Predict the counter-images of an image: positions, magnifications, time delays."""
    from rich.console import Console

    from jaxlens import _screen, io, prediction

    console = Console(stderr=True)
    _prepare_jax(cache)
    with _mistakes_answered(console):
        source = prediction.load(model)
        theta = prediction.position(source, x=x, y=y, ra=ra, dec=dec)
        found = prediction.counter_images(
            source.lens, source.plane, theta, z, draws=source.draws, half_width=half_width, sigma=sigma
        )
        columns = prediction.table(found, source.reference)
        if out is not None:
            about = {"model": source.path.name, "z_s": z, "draws": found.n_draws, "complete": found.complete}
            about |= {"sigma_arcsec": sigma, "warning": source.warning or ""}
            meta = {**about, "beta_arcsec": found.beta.tolist()}
            io.write_table(out, columns, meta=meta, descriptions=_screen.DESCRIPTIONS)
    Console().print(_screen.images(columns, z))
    console.print(_screen.remarks(found, source.warning, sigma), markup=False, highlight=False)


@app.command()
def weak(
    source: Annotated[
        str,
        typer.Argument(
            metavar="INPUT",
            help="A data set (as1063, abell2744, cosmos), a directory holding weak.toml, such a file, or a "
            "shear map (FITS with images G1, G2).",
            show_default=False,
        ),
    ],
    out: Annotated[
        Path, typer.Option(help="Directory for the results.", file_okay=False, show_default=False)
    ],
    scheme: Annotated[
        str, typer.Option(help="K1, K2 (Kaiser-Squires), A1, A2 (masked fit), A3 (A2 from a model).")
    ] = "A2",
    model: Annotated[
        str | None,
        typer.Option(
            help="What A3 starts from: a result directory of `jaxlens strong`, or a model.toml.",
            show_default=False,
        ),
    ] = None,
    smoothing: Annotated[
        float | None,
        typer.Option(
            help="Standard deviation of the Gaussian, arcsec; else from the input.", show_default=False
        ),
    ] = None,
    iterations: Annotated[int, typer.Option(min=1, help="Iterations on the reduced shear.")] = 5,
    axis: Annotated[
        str | None,
        typer.Option(
            help="Of a shear map: where g1 > 0 points, west, east or north; west if not given, g2 > 0 from "
            "West towards North. A wrong frame hides the lens; no null test shows it.",
            show_default=False,
        ),
    ] = None,
    ridge: Annotated[float, typer.Option(help="Ridge of the masked fit.")] = 1e-2,
    padding: Annotated[float, typer.Option(help="Size of the padded over that of the field.")] = 2.0,
    bootstrap: Annotated[int, typer.Option(min=8, help="Pairs of null maps, and bootstrap samples.")] = 32,
    seed: Annotated[int, typer.Option(min=0, max=LARGEST_SEED, help="Seed of both.")] = 0,
    cache: Annotated[bool, typer.Option(help="Keep compiled programs for the next run.")] = True,
) -> None:
    """Map the mass of a field from the shapes of galaxies, with noise, null tests and profile."""
    from rich.console import Console

    console = Console(stderr=True)
    _prepare_jax(cache)
    from jaxlens import _command_weak, analysis_weak

    with _interruptible(console), _mistakes_answered(console):
        options = analysis_weak.Options(
            scheme, iterations, ridge, padding, bootstrap, seed, smoothing, model, axis
        )
        code = _command_weak.run(console, source, out, options)
    raise typer.Exit(code)


@app.command(name="lambda")
def lambda_(
    wl: Annotated[Path, typer.Option(help="Weak-lensing convergence (FITS).", show_default=False)],
    sl: Annotated[Path, typer.Option(help="Strong-lensing convergence (FITS).", show_default=False)],
    out: Annotated[
        Path, typer.Option(help="Directory for the results.", file_okay=False, show_default=False)
    ],
    truth: Annotated[Path | None, typer.Option(help="True convergence of a simulation (FITS).")] = None,
    sigma: Annotated[Path | None, typer.Option(help="Noise of the weak-lensing map (FITS).")] = None,
    snr: Annotated[
        Path | None, typer.Option(help="Its signal to noise instead, as `jaxlens weak` writes it.")
    ] = None,
    mask: Annotated[Path | None, typer.Option(help="Map that is 0 in pixels not to use (FITS).")] = None,
    z_lens: Annotated[float | None, typer.Option(help="Redshift of the lens; else ZLENS.")] = None,
    z_wl: Annotated[float | None, typer.Option(help="Source redshift of --wl; else its header.")] = None,
    z_sl: Annotated[float | None, typer.Option(help="Source redshift of --sl; else its header.")] = None,
    z_truth: Annotated[float | None, typer.Option(help="Source redshift of --truth.")] = None,
    dls_ds_wl: Annotated[float | None, typer.Option(help="D_LS/D_S of --wl; else DLSDS.")] = None,
    dls_ds_sl: Annotated[float | None, typer.Option(help="D_LS/D_S of --sl; else DLSDS.")] = None,
    dls_ds_truth: Annotated[float | None, typer.Option(help="D_LS/D_S of --truth.")] = None,
    smoothing_wl: Annotated[
        float | None, typer.Option(help="Standard deviation of the smoothing of --wl, arcsec; else SMOOTHAS.")
    ] = None,
    smoothing_sl: Annotated[float | None, typer.Option(help="That of --sl; else SMOOTHAS, else 0.")] = None,
    smoothing_truth: Annotated[float | None, typer.Option(help="That of --truth.")] = None,
    h: Annotated[float, typer.Option("--h", help="H_0/(100 km/s/Mpc).")] = 0.7,
    omega_m: Annotated[float, typer.Option(help="Matter density of a flat universe.")] = 0.3,
    x: Annotated[float, typer.Option("--x", help="Centre of the annuli: West, arcsec.")] = 0.0,
    y: Annotated[float, typer.Option("--y", help="Centre of the annuli: North, arcsec.")] = 0.0,
    width: Annotated[float, typer.Option(help="Width of the annuli, kpc/h.")] = 50.0,
    r_min: Annotated[float, typer.Option(help="Inner edge, kpc/h.")] = 50.0,
    r_max: Annotated[float, typer.Option(help="Outer edge, kpc/h.")] = 700.0,
    inner: Annotated[
        tuple[float, float], typer.Option(help="Range whose lambda corrects the map, kpc/h.")
    ] = (100.0, 300.0),
    lam: Annotated[float | None, typer.Option("--lambda", help="External mass-sheet factor.")] = None,
    lam_error: Annotated[float | None, typer.Option("--lambda-error", help="Its error.")] = None,
    bootstrap: Annotated[int, typer.Option(min=20, help="Samples of the block bootstrap.")] = 200,
    seed: Annotated[int, typer.Option(min=0, max=LARGEST_SEED, help="Seed of the bootstrap.")] = 0,
    cache: Annotated[bool, typer.Option(help="Keep compiled programs for the next run.")] = True,
) -> None:
    """Compare a weak- and a strong-lensing map: mass-sheet factor, transition radius, corrected map."""
    from rich.console import Console

    console = Console(stderr=True)
    _prepare_jax(cache)
    from jaxlens import _command_lambda, workflow_lambda

    with _interruptible(console), _mistakes_answered(console):
        options = workflow_lambda.Options(
            z_lens=z_lens, z_wl=z_wl, z_sl=z_sl, z_truth=z_truth,
            dls_ds_wl=dls_ds_wl, dls_ds_sl=dls_ds_sl, dls_ds_truth=dls_ds_truth,
            smoothing_wl=smoothing_wl, smoothing_sl=smoothing_sl, smoothing_truth=smoothing_truth,
            h=h, omega_m=omega_m, x=x, y=y, width=width, r_min=r_min, r_max=r_max, inner=inner,
            lam=lam, lam_error=lam_error, bootstrap=bootstrap, seed=seed,
        )  # fmt: skip
        files = {"truth": truth, "mask": mask, "sigma": sigma, "snr": snr}
        code = _command_lambda.run(console, wl, sl, out, options, **files)
    raise typer.Exit(code)


@app.command()
def real(
    source: Annotated[
        str,
        typer.Argument(
            metavar="DATASET",
            help="as1063, abell2744, or a directory holding strong.toml and weak.toml in one frame.",
            show_default=False,
        ),
    ],
    out: Annotated[
        Path, typer.Option(help="Directory for the results.", file_okay=False, show_default=False)
    ],
    draws: Annotated[int, typer.Option(min=8, help="Draws of each source of error.")] = 100,
    starts: Annotated[int, typer.Option(min=1, help="Starts of the fit of the images.")] = 4,
    width: Annotated[float, typer.Option(help="Width of the annuli, kpc/h.")] = 50.0,
    max_g: Annotated[
        float, typer.Option(help="Pixels with a larger reduced shear in the model are left out.")
    ] = 0.5,
    seed: Annotated[int, typer.Option(min=0, max=LARGEST_SEED, help="Seed of everything random.")] = 0,
    cache: Annotated[bool, typer.Option(help="Keep compiled programs for the next run.")] = True,
) -> None:
    """lambda(r) of a real cluster from its images and the shapes behind it, with an error budget."""
    from rich.console import Console

    console = Console(stderr=True)
    _prepare_jax(cache)
    from jaxlens import _command_real, workflow_real

    with _interruptible(console), _mistakes_answered(console):
        options = workflow_real.Options(draws=draws, starts=starts, width=width, max_g=max_g, seed=seed)
        code = _command_real.run(console, source, out, options)
    raise typer.Exit(code)


@app.command()
def simulate(
    out: Annotated[
        Path, typer.Option(help="Directory for the results.", file_okay=False, show_default=False)
    ],
    seed: Annotated[
        int | None,
        typer.Option(
            min=0,
            max=LARGEST_SEED,
            help="Seed of everything that is drawn; else from the file, else the default cluster.",
        ),
    ] = None,
    config: Annotated[
        Path | None,
        typer.Option(
            help="Settings (TOML), or a result directory to make again; what it does not say is the paper's.",
            show_default=False,
        ),
    ] = None,
    cache: Annotated[bool, typer.Option(help="Keep compiled programs for the next run.")] = True,
) -> None:
    """Simulate a cluster with its multiple images and the shapes of galaxies behind it."""
    from rich.console import Console

    console = Console(stderr=True)
    _prepare_jax(cache)
    from jaxlens import _command_simulate

    with _interruptible(console), _mistakes_answered(console):
        code = _command_simulate.run(console, out, seed, config)
    raise typer.Exit(code)


@app.command()
def reproduce(
    out: Annotated[
        Path, typer.Option(help="Directory for the results.", file_okay=False, show_default=False)
    ],
    seed: Annotated[
        int | None,
        typer.Option(
            min=0, max=LARGEST_SEED, help="Seed of everything that is drawn; else the default cluster's."
        ),
    ] = None,
    realisations: Annotated[int, typer.Option(min=8, help="Realisations of the shape noise.")] = 256,
    config: Annotated[
        Path | None,
        typer.Option(help="Settings of the simulation (TOML), see `jaxlens simulate`.", show_default=False),
    ] = None,
    quick: Annotated[
        bool, typer.Option("--quick", help="Coarser, with 64 realisations and without the checks.")
    ] = False,
    clusters: Annotated[
        int | None,
        typer.Option(
            min=1,
            help="So many clusters, seeds from --seed on; resumable; extra `cluster`.",
            show_default=False,
        ),
    ] = None,
    sweep: Annotated[
        str,
        typer.Option(help="Vary n0 (galaxies per arcmin^2), m_tele (depth of the images), or n0,m_tele."),
    ] = "",
    cache: Annotated[bool, typer.Option(help="Keep compiled programs for the next run.")] = True,
) -> None:
    """Repeat the paper: simulate, fit, reconstruct, compare; figures, tables and a report."""
    from rich.console import Console

    console = Console(stderr=True)
    _prepare_jax(cache)
    from jaxlens import _command_reproduce

    kept = "Interrupted; finished blocks and clusters are kept, the same command goes on with them."
    with _interruptible(console, kept), _mistakes_answered(console, "cluster"):
        options = _command_reproduce.Options(
            realisations, quick, clusters, tuple(part.strip() for part in sweep.split(",") if part.strip())
        )
        code = _command_reproduce.run(console, out, seed, config, options)
    raise typer.Exit(code)


@app.command()
def population(
    out: Annotated[
        Path | None, typer.Option(help="Directory for the results.", file_okay=False, show_default=False)
    ] = None,
    n: Annotated[int, typer.Option(min=1, help="Clusters.")] = 10,
    config: Annotated[
        Path | None,
        typer.Option(help="Laws of the population and settings of its clusters (TOML).", show_default=False),
    ] = None,
    seed: Annotated[
        int, typer.Option(min=0, max=LARGEST_SEED, help="Seed of the first cluster; the others follow it.")
    ] = 1000,
    realisations: Annotated[int, typer.Option(min=64, help="Realisations of the shape noise.")] = 256,
    scheduler: Annotated[
        str | None,
        typer.Option(
            help="Address of a running Dask scheduler; else one is started here.", show_default=False
        ),
    ] = None,
    workers: Annotated[
        int | None,
        typer.Option(min=1, help="Worker processes here; else one per core.", show_default=False),
    ] = None,
    report: Annotated[
        Path | None,
        typer.Option(
            help="Only table and report of the clusters that are finished in this directory; nothing is run.",
            file_okay=False,
            show_default=False,
        ),
    ] = None,
    cache: Annotated[bool, typer.Option(help="Keep compiled programs for the next run.")] = True,
) -> None:
    """Many clusters drawn from a population, with Dask; resumable; a table, figures and a report."""
    from rich.console import Console

    console = Console(stderr=True)
    _prepare_jax(cache)
    from jaxlens import _command_population

    kept = "Interrupted; finished clusters are kept, the same command goes on with the others."
    with _interruptible(console, kept), _mistakes_answered(console, "cluster"):
        if report is not None:
            code = _command_population.report(console, report)
        elif out is None:
            raise ValueError("give --out DIR for the results, or --report DIR for the report on those there.")
        else:
            code = _command_population.run(
                console, out, config, n=n, first=seed, realisations=realisations, scheduler=scheduler,
                workers=workers,
            )  # fmt: skip
    raise typer.Exit(code)


@app.command()
def datasets(
    name: Annotated[str | None, typer.Argument(help="Data set to cite.", show_default=False)] = None,
) -> None:
    """List the data sets that ship with jaxlens, or say what to cite for one."""
    from jaxlens import datasets as shipped

    if name is None:
        for each in shipped.names():
            typer.echo(f"{each}: {shipped.title(each)} [{', '.join(shipped.holds(each))}]")
        return
    try:
        typer.echo(shipped.citation(name))
        typer.echo(f"\nLicence: {shipped.licence(name)}")
    except ValueError as error:
        typer.echo(f"error: {error}", err=True)
        raise typer.Exit(2) from error


def main() -> None:
    """Entry point of the command `jaxlens`."""
    # Tracing makes millions of small objects that live on: looking through them again and again for garbage,
    # and a last time at the end, took a sixth of a fit. Here, where the process is ours.
    gc.set_threshold(100_000, 20, 20)
    atexit.register(gc.freeze)
    app(prog_name="jaxlens")


if __name__ == "__main__":
    sys.exit(main())
