"""What a user gets: the wheel holds the modules, the data beside them, and the command."""

import importlib.metadata
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> zipfile.ZipFile:
    folder = tmp_path_factory.mktemp("wheel")
    command = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(folder)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=ROOT)
    assert done.returncode == 0, done.stderr
    (path,) = folder.glob("*.whl")
    return zipfile.ZipFile(path)


def test_wheel_holds_every_file_of_the_package(wheel: zipfile.ZipFile):
    held = set(wheel.namelist())
    owed = {
        path.relative_to(ROOT).as_posix()
        for path in (ROOT / "jaxlens").rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }
    assert not owed - held
    assert not {name for name in held if name.startswith(("tests/", "benchmarks/"))}


def test_wheel_has_the_name_the_version_and_the_command(wheel: zipfile.ZipFile):
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    info = f"jaxlens_cluster-{project['version']}.dist-info"
    assert "jaxlens = jaxlens.cli:main" in wheel.read(f"{info}/entry_points.txt").decode()
    assert "Name: jaxlens-cluster" in wheel.read(f"{info}/METADATA").decode()


def test_constraints_are_bare_pins():
    for name in ("constraints.txt", "constraints-bench.txt"):
        lines = (ROOT / name).read_text(encoding="utf-8").splitlines()
        pins = [line for line in lines if not line.startswith(("#", "-c "))]
        assert all(line.count("==") == 1 and "/" not in line and "@" not in line for line in pins), name


def test_the_version_lives_in_one_place():
    version = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["version"]
    assert f"## {version}" in (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    assert "\nversion:" not in (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    assert importlib.metadata.version("jaxlens-cluster") == version


def test_the_profile_in_contributing_is_the_one_in_the_package():
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    example = text.split("```python\n")[1].split("```")[0]
    assert example == (ROOT / "jaxlens/profiles/sheet.py").read_text(encoding="utf-8")
