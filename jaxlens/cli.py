"""The command `jaxlens`: one sub-command for each part of the package."""

import os
import sys
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from rich.console import Console

    from jaxlens.workflow import Setup

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    help="Weigh galaxy clusters with light: strong and weak lensing.",
)


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
    seed: Annotated[int, typer.Option(min=0, help="Seed of the starts.")] = 0,
    plane: Annotated[
        Plane | None, typer.Option(help="Where the chi^2 is formed; else from the file.")
    ] = None,
    definition: Annotated[
        Definition | None, typer.Option(help="Source position of the image-plane stage; else from the file.")
    ] = None,
    cache: Annotated[
        bool, typer.Option(help="Keep compiled programs in the user's cache directory for the next run.")
    ] = True,
) -> None:
    """Fit a cluster to its multiple images and write the model, its maps and its figures."""
    from rich.console import Console

    from jaxlens import io, workflow

    console = Console(stderr=True)
    _prepare_jax(cache)
    try:
        # Only mistakes in the input are answered without a traceback; an error of the fit is ours.
        try:
            io.writable(out)
            setup = workflow.load(source)
        except (ValueError, OSError) as error:
            _say_error(console, error)
            raise typer.Exit(2) from error
        code = _strong(console, setup, out, starts, seed, plane, definition)
    except KeyboardInterrupt:
        console.print("Interrupted before there was a result; nothing was written.")
        raise typer.Exit(130) from None
    raise typer.Exit(code)


def _strong(
    console: "Console",
    setup: "Setup",
    out: Path,
    starts: int | None,
    seed: int,
    plane: Plane | None,
    definition: Definition | None,
) -> int:
    import jax
    from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    from jaxlens import _screen, results, strong
    from jaxlens.config import Fit

    said = setup.config.fit if setup.config else Fit(weak_prior=0.0)
    count = starts or said.starts
    where = plane.value if plane else said.plane
    how = definition.value if definition else said.definition
    images = setup.problem.images
    n_free = strong.total_size(setup.problem.bounds)
    console.print(
        f"[bold]{setup.name}[/]: {images.n_images} images of {images.n_systems} systems, "
        f"{n_free} free numbers, {count} starts",
        highlight=False,
    )
    columns = (SpinnerColumn(), TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn())
    with Progress(*columns, console=console, transient=True) as progress:
        task = progress.add_task("compiling", total=count)

        def on_step(number: int, floor: float, steps: int) -> None:
            progress.update(
                task, description=f"start {number}/{count}, floor {floor:g} arcsec, {steps} steps"
            )

        def on_start(start: strong.Start) -> None:
            progress.advance(task)
            bound = f"  at bound: {', '.join(start.at_bound)}" if start.at_bound else ""
            state = "converged" if start.converged else "not converged"
            progress.console.print(
                f"  start {start.number:>2}: chi2 = {start.chi2:10.3f}  {state}, {start.steps} steps, "
                f"{start.seconds:.1f} s{bound}",
                highlight=False,
            )
            if start.number == count:
                progress.update(task, description="image-plane stage" if where == "both" else "finishing")

        fit = strong.fit(
            setup.problem,
            key=jax.random.key(seed),
            n_starts=count,
            start=setup.start,
            plane=where,
            definition=how,
            on_start=on_start,
            on_step=on_step,
        )
        progress.update(task, description="solving the lens equation, writing results")
        try:
            outcome = results.derive(setup, fit, seed=seed, plane=where, definition=how)
            content = results.write(outcome, out)
        except KeyboardInterrupt:
            console.print(
                f"Interrupted after the fit (chi2 = {float(fit.chi2):.3f}); no results were written."
            )
            return 130
    console.print(_screen.numbers(outcome))
    console.print(results.verdict(content), markup=False, highlight=False)
    console.print(f"Results in {out}{os.sep}", markup=False, highlight=False)
    return 130 if fit.interrupted else 0


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
    cache: Annotated[
        bool, typer.Option(help="Keep compiled programs in the user's cache directory for the next run.")
    ] = True,
) -> None:
    """Predict the counter-images of an image: positions, magnifications, time delays."""
    from rich.console import Console

    from jaxlens import _screen, io, prediction

    console = Console(stderr=True)
    _prepare_jax(cache)
    try:
        source = prediction.load(model)
        theta = prediction.position(source, x=x, y=y, ra=ra, dec=dec)
        found = prediction.counter_images(
            source.lens, source.plane, theta, z, draws=source.draws, half_width=half_width
        )
        columns = prediction.table(found, source.reference)
        if out is not None:
            about = {"model": source.path.name, "z_s": z, "draws": found.n_draws, "complete": found.complete}
            io.write_table(out, columns, meta={**about, "beta_arcsec": found.beta.tolist()})
    except (ValueError, OSError) as error:
        _say_error(console, error)
        raise typer.Exit(2) from error
    Console().print(_screen.images(columns, z))
    console.print(_screen.remarks(found), markup=False, highlight=False)


def _say_error(console: "Console", error: Exception) -> None:
    """A mistake in the input, without a traceback."""
    console.print("error:", style="bold red", end=" ")
    console.print(str(error), markup=False, highlight=False, soft_wrap=True)


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
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 1.0)


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
    ridge: Annotated[float, typer.Option(help="Ridge of the masked fit.")] = 1e-2,
    padding: Annotated[float, typer.Option(help="Size of the padded over that of the field.")] = 2.0,
    bootstrap: Annotated[int, typer.Option(min=8, help="Pairs of null maps, and bootstrap samples.")] = 32,
    seed: Annotated[int, typer.Option(min=0, help="Seed of both.")] = 0,
    cache: Annotated[bool, typer.Option(help="Keep compiled programs for the next run.")] = True,
) -> None:
    """Map the mass of a field from the shapes of galaxies, with noise, null tests and profile."""
    from rich.console import Console

    console = Console(stderr=True)
    _prepare_jax(cache)
    from jaxlens import _command_weak, analysis_weak

    try:
        options = analysis_weak.Options(scheme, iterations, ridge, padding, bootstrap, seed, smoothing, model)
        code = _command_weak.run(console, source, out, options)
    except (ValueError, OSError) as error:
        _say_error(console, error)
        raise typer.Exit(2) from error
    except KeyboardInterrupt:
        console.print("Interrupted before there was a result; nothing was written.")
        raise typer.Exit(130) from None
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
    app(prog_name="jaxlens")


if __name__ == "__main__":
    sys.exit(main())
