"""Double precision, no implicit rank promotion, and the same hypothesis examples on every run.

Warnings are errors and shapes are checked through `[tool.pytest.ini_options]` in pyproject.toml.
"""

import gc
import os
import resource
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import jax
import pytest
from hypothesis import HealthCheck, Phase, settings

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")
# Half of the time is compilation of programs that run once: less of it, also in commands and notebooks.
# Read when the first array is made. `make test XLA_FLAGS=` tests the programs that users get.
os.environ.setdefault(
    "XLA_FLAGS", "--xla_backend_optimization_level=1 --xla_cpu_parallel_codegen_split_count=1"
)


def pytest_configure(config: pytest.Config) -> None:
    """Keep compiled programs from file to file and from run to run, also for notebooks and commands.

    Every process has a cache of its own: JAX does not lock the files.
    """
    where = config.cache.mkdir(f"jax_{os.environ.get('PYTEST_XDIST_WORKER', 'main')}")  # pyright: ignore[reportOptionalMemberAccess]
    os.environ["JAX_COMPILATION_CACHE_DIR"] = str(where)
    os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0.0"
    jax.config.update("jax_compilation_cache_dir", str(where))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)


# A first example compiles, so no deadline; derandomized, so that a failure is seen by everybody.
settings.register_profile(
    "jaxlens",
    deadline=None,
    derandomize=True,
    database=None,
    max_examples=25,
    phases=[Phase.explicit, Phase.generate, Phase.shrink],
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.function_scoped_fixture],
)
settings.load_profile("jaxlens")


MANY = 1.5e9
"""Resident memory of a process beyond which it drops its programs after a file, bytes."""

_FIRST = (
    "test_notebooks",
    "test_notebook_lambda",
    "test_notebook_weak",
    "test_notebook_real",
    "test_notebook_simulated",
    "test_simulate_sky",
    "test_cli_simulate",
    "test_cli",
    "test_results",
    "test_strong_fit",
    "test_lens_equation",
    "test_cli_weak",
)
# What takes longest starts first, so that several processes end at about the same time.

_TOGETHER: dict[str, str] = {
    "test_notebooks": "as1063",
    "test_cli": "as1063",
    "test_results": "as1063",
    "test_strong_fit": "as1063",
    "test_real": "as1063",
    "test_real_joint": "as1063",
    "test_prediction": "as1063",
    "test_notebook_simulated": "simulate",
    "test_notebook_lambda": "simulate",
    "test_simulate_sky": "simulate",
    "test_cli_simulate": "simulate",
}
# Files that share what one run of the command leaves behind, or the same compiled programs.


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """A file stays in one process: its tests share compiled programs and fixtures."""
    from xdist.scheduler import LoadScopeScheduling

    class ByFile(LoadScopeScheduling):
        def _split_scope(self, nodeid: str) -> str:
            stem = Path(nodeid.split("::")[0]).stem
            return _TOGETHER.get(stem, stem)

    return ByFile(config, log)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Sort the files of `_FIRST` to the front."""
    items.sort(key=lambda item: _FIRST.index(stem) if (stem := item.path.stem) in _FIRST else len(_FIRST))


@pytest.fixture(scope="module", autouse=True)
def _forget_programs() -> Iterator[None]:
    """Drop compiled programs once there are many: each further one is then compiled several times slower.

    A small program takes 1.7 MB, and with 1000 of them compilation takes twice as long. What is needed
    again comes back from the disk.
    """
    yield
    # Where the kernel does not say, drop them after every file.
    status = Path("/proc/self/statm")
    if not status.exists() or int(status.read_text().split()[1]) * resource.getpagesize() > MANY:
        jax.clear_caches()
        gc.collect()


class CommandRun(NamedTuple):
    """What `jaxlens strong as1063 --starts 2 --plane source --draws 3 --leave-one-out` left behind."""

    out: Path
    result: Any
    outcome: Any


@pytest.fixture(scope="session")
def as1063_run(tmp_path_factory: pytest.TempPathFactory) -> CommandRun:
    """The command, run once in this process for all tests that look at its files."""
    from typer.testing import CliRunner

    from jaxlens import results
    from jaxlens.cli import app

    out = tmp_path_factory.mktemp("strong") / "as1063"
    outcomes = []
    write = results.write

    def recording(outcome: results.Outcome, directory: str | Path) -> dict[str, Any]:
        outcomes.append(outcome)
        return write(outcome, directory)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(results, "write", recording)
        command = ["strong", "as1063", "--out", str(out), "--starts", "2", "--plane", "source", "--no-cache"]
        command += ["--draws", "3", "--leave-one-out"]
        result = CliRunner().invoke(app, command)
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    assert result.exit_code == 0, result.output
    return CommandRun(out, result, outcomes[0])
