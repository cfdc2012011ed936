"""What a `strong.toml` may say, and what is answered when it says something else."""

from pathlib import Path

import pytest

from jaxlens import config, datasets

HEAD = 'name = "A"\nz_l = 0.3\n'
HALO = '[[component]]\nname = "{}"\nprofile = "nfw"\n'
MEMBERS = "[members]\nr_cut_ref_kpc = 45.0\nsigma_ref_km_s = {}\n"

# What the file says; the key that must be named; the value or fact; the remedy.
MISTAKES = {
    "no redshift": ('name = "A"\n', "z_l", "is missing", "add it"),
    "unknown key": (HEAD + "colour = 1\n", "colour", "is not known", "remove it, or use one of name, z_l,"),
    "unknown key of a table": (
        HEAD + "[fit]\nstart = 3\n",
        "fit.start",
        "is not known",
        "use one of weak_prior, starts, plane",
    ),
    "unknown key of a number": (
        HEAD + MEMBERS.format("{ min = 1.0, max = 2.0, step = 0.1 }"),
        "members.sigma_ref_km_s.step",
        "is not known",
        "use one of min, max, start, log, mean, sigma",
    ),
    "negative redshift": ('name = "A"\nz_l = -1.0\n', "z_l", "-1.0", "greater than 0"),
    "limits exchanged": (
        HEAD + MEMBERS.format("{ min = 3.0, max = 2.0 }"),
        "members.sigma_ref_km_s",
        "min = 3.0 is not below max = 2.0",
        "correct the limits",
    ),
    "limits equal": (
        HEAD + MEMBERS.format("{ min = 2.0, max = 2.0 }"),
        "members.sigma_ref_km_s",
        "min = 2.0 is not below max = 2.0",
        "correct the limits",
    ),
    "infinite limit": (
        HEAD + MEMBERS.format("{ min = 3.0, max = inf }"),
        "members.sigma_ref_km_s.max",
        "given: inf",
        "finite",
    ),
    "logarithm of 0": (
        HEAD + MEMBERS.format("{ min = 0.0, max = 2.0, log = true }"),
        "members.sigma_ref_km_s",
        "log = true needs min > 0, but min = 0.0",
        "raise it, or leave out log",
    ),
    "start outside": (
        HEAD + MEMBERS.format("{ min = 1.0, max = 2.0, start = 3.0 }"),
        "members.sigma_ref_km_s",
        "start = 3.0 is outside min = 1.0, max = 2.0",
        "move it, or widen the box",
    ),
    "mean alone": (
        HEAD + MEMBERS.format("{ min = 1.0, max = 2.0, mean = 1.5 }"),
        "members.sigma_ref_km_s",
        "needs both mean and sigma",
        "add the other",
    ),
    "sigma of 0": (
        HEAD + MEMBERS.format("{ min = 1.0, max = 2.0, mean = 1.5, sigma = 0.0 }"),
        "members.sigma_ref_km_s.sigma",
        "given: 0.0",
        "greater than 0",
    ),
    "median alone": (
        HEAD + MEMBERS.format("{ min = 1.0, max = 2.0, median = 1.5 }"),
        "members.sigma_ref_km_s",
        "needs both median and sigma_ln",
        "add the other",
    ),
    "two laws": (
        HEAD
        + MEMBERS.format("{ min = 1.0, max = 2.0, median = 1.5, sigma_ln = 0.1, mean = 1.5, sigma = 1.0 }"),
        "members.sigma_ref_km_s",
        "mean, sigma and median, sigma_ln are two priors",
        "leave out one pair",
    ),
    "log-normal below 0": (
        HEAD + MEMBERS.format("{ min = -1.0, max = 2.0, median = 1.5, sigma_ln = 0.1 }"),
        "members.sigma_ref_km_s",
        "a log-normal prior needs min > 0, but min = -1.0",
        "raise it, or give mean and sigma",
    ),
    "log-normal at 0": (
        HEAD + MEMBERS.format("{ min = 0.0, max = 2.0, median = 1.5, sigma_ln = 0.1 }"),
        "members.sigma_ref_km_s",
        "but min = 0.0",
        "raise it",
    ),
    "negative median": (
        HEAD + MEMBERS.format("{ min = 1.0, max = 2.0, median = -1.5, sigma_ln = 0.1 }"),
        "members.sigma_ref_km_s.median",
        "given: -1.5",
        "greater than 0",
    ),
    "no spread": (
        HEAD + MEMBERS.format("{ min = 1.0, max = 2.0, median = 1.5, sigma_ln = 0.0 }"),
        "members.sigma_ref_km_s.sigma_ln",
        "given: 0.0",
        "greater than 0",
    ),
    "unknown law": (
        HEAD + MEMBERS.format('{ min = 1.0, max = 2.0, prior = "cauchy" }'),
        "members.sigma_ref_km_s.prior",
        "'cauchy'",
        "'uniform', 'normal' or 'log_normal'",
    ),
    "law of other keys": (
        HEAD + MEMBERS.format('{ min = 1.0, max = 2.0, prior = "normal", median = 1.5, sigma_ln = 0.1 }'),
        "members.sigma_ref_km_s",
        'prior = "normal" takes mean and sigma, but those of "log_normal"',
        "correct one of them",
    ),
    "unknown treatment of errors": (
        HEAD + '[errors]\nsigma_pos = "wide"\n',
        "errors.sigma_pos",
        "'wide'",
        "'fixed', 'rescaled' or 'free'",
    ),
    "negative draws": (HEAD + "[errors]\ndraws = -1\n", "errors.draws", "given: -1", "greater than"),
    "half a draw": (HEAD + "[errors]\ndraws = 1.5\n", "errors.draws", "given: 1.5", "integer"),
    "a number for a question": (
        HEAD + "[errors]\nleave_one_out = 7\n",
        "errors.leave_one_out",
        "given: 7",
        "boolean",
    ),
    "outliers everywhere": (
        HEAD + "[errors]\noutlier = 0.0\n",
        "errors.outlier",
        "given: 0.0",
        "greater than 0",
    ),
    "unknown key of errors": (
        HEAD + "[errors]\nsigma = 1.0\n",
        "errors.sigma",
        "is not known",
        "use one of sigma_pos, draws, leave_one_out, outlier",
    ),
    "text for a number": (
        HEAD + MEMBERS.format('"wide"'),
        "members.sigma_ref_km_s",
        "'wide'",
        "valid number",
    ),
    "both units of a length": (
        HEAD + MEMBERS.format(100.0) + "r_cut_ref_arcsec = 9.0\n",
        "members",
        "r_cut_ref_arcsec and r_cut_ref_kpc",
        "give exactly one",
    ),
    "neither unit of a length": (
        HEAD + "[members]\nsigma_ref_km_s = 100.0\n",
        "members",
        "r_cut_ref_arcsec and r_cut_ref_kpc",
        "give exactly one",
    ),
    "both units of the core": (
        HEAD + MEMBERS.format(100.0) + "r_core_ref_arcsec = 0.1\nr_core_ref_kpc = 0.5\n",
        "members",
        "r_core_ref_arcsec and r_core_ref_kpc",
        "give at most one",
    ),
    "unknown convention": (
        HEAD + MEMBERS.format(100.0) + 'convention = "lenstool"\n',
        "members.convention",
        "'lenstool'",
        "'dpie' or 'dpie_lenstool'",
    ),
    "name used twice": (
        HEAD + 2 * HALO.format("O1"),
        "component names",
        "used twice: O1",
        "rename one",
    ),
    "name with a dot": (HEAD + HALO.format("O.1"), "component 1.name", "'O.1'", "match pattern"),
    "angle that is no angle": (
        HEAD + HALO.format("O1") + HALO.format("O2") + 'pa_deg = "fre"\n',
        "component 2.pa_deg",
        "'fre'",
        "'free'",
    ),
    "shape beyond 1": (
        HEAD + HALO.format("O1") + "shape = { max = 1.5 }\n",
        "component 1.shape.max",
        "1.5",
        "less than 1",
    ),
    "RA alone": (HEAD + "ra_deg = 342.0\n", "ra_deg", "ra_deg and dec_deg", "or neither"),
    "impossible declination": (
        HEAD + "ra_deg = 342.0\ndec_deg = 95.0\n",
        "dec_deg",
        "95.0",
        "less than or equal to 90",
    ),
    "unknown plane": (HEAD + '[fit]\nplane = "lens"\n', "fit.plane", "'lens'", "'source', 'image' or 'both'"),
}


def refusal(path: Path) -> str:
    with pytest.raises(config.ConfigError) as caught:
        config.read(path)
    return str(caught.value)


@pytest.mark.parametrize(("text", "key", "value", "remedy"), MISTAKES.values(), ids=list(MISTAKES))
def test_a_mistake_is_answered_with_file_key_value_and_remedy(
    tmp_path: Path, text: str, key: str, value: str, remedy: str
):
    path = tmp_path / "strong.toml"
    path.write_text(text, encoding="utf-8")
    message = refusal(path)
    assert message.startswith(f"{path}: {key}" if key not in ("ra_deg",) else f"{path}: ")
    assert key in message and value in message and remedy in message, message
    assert "\n" not in message, "one mistake, one line"
    assert "function-after" not in message and "Extra inputs" not in message, "the reader's words"


@pytest.mark.parametrize("name", ["members", "dls_ds", "z", "errors"])
def test_names_of_the_package_itself_are_reserved(tmp_path: Path, name: str):
    path = tmp_path / "strong.toml"
    path.write_text(HEAD + HALO.format(name), encoding="utf-8")
    message = refusal(path)
    assert str(path) in message and f"component names {name} are reserved; choose others" in message


def test_two_mistakes_are_two_lines(tmp_path: Path):
    path = tmp_path / "strong.toml"
    path.write_text("z_l = -1.0\ncolour = 1\n", encoding="utf-8")
    lines = refusal(path).splitlines()
    assert len(lines) == 3
    assert [line.removeprefix(f"{path}: ").split(":")[0] for line in lines] == ["name", "z_l", "colour"]


def test_a_missing_file(tmp_path: Path):
    path = tmp_path / "strong.toml"
    assert refusal(path) == f"{path} does not exist; check the name and the directory."


def test_a_file_that_is_not_toml_is_named_with_the_line(tmp_path: Path):
    path = tmp_path / "strong.toml"
    path.write_text(HEAD + "[images\n", encoding="utf-8")
    message = refusal(path)
    assert message.startswith(f"{path} is not valid TOML:")
    assert "line 3" in message


@pytest.mark.parametrize("value", [True, "wide", [1.0, 2.0], float("nan"), float("inf")], ids=str)
def test_numbers_of_a_component_are_numbers_or_boxes(value: object):
    with pytest.raises(config.ConfigError) as caught:
        config.free_number(value, "O1.r_core_arcsec", "strong.toml")
    message = str(caught.value)
    assert "strong.toml: O1.r_core_arcsec is" in message
    assert repr(value) in message and "; give a" in message


def test_a_box_of_a_component_is_checked_like_any_other():
    with pytest.raises(config.ConfigError) as caught:
        config.free_number({"min": 3.0, "max": 2.0}, "O1.r_core_arcsec", "strong.toml")
    assert "strong.toml: O1.r_core_arcsec: min = 3.0 is not below max = 2.0" in str(caught.value)
    with pytest.raises(config.ConfigError, match=r"O1\.r_core_arcsec: max: is missing; add it"):
        config.free_number({"min": 3.0}, "O1.r_core_arcsec", "strong.toml")
    with pytest.raises(config.ConfigError, match=r"step: is not known; .* one of min, max, start"):
        config.free_number({"min": 3.0, "max": 4.0, "step": 1}, "O1.r_core_arcsec", "strong.toml")


def test_integers_are_numbers():
    assert config.free_number(6, "O1.r_core_arcsec", "strong.toml") == 6.0


def test_defaults(tmp_path: Path):
    path = tmp_path / "strong.toml"
    path.write_text(HEAD, encoding="utf-8")
    said = config.read(path)
    assert (said.cosmology.h, said.cosmology.omega_m) == (0.7, 0.3)
    assert said.images.file == "images.csv"
    assert said.members is None
    assert said.reference is None
    assert (said.fit.weak_prior, said.fit.starts, said.fit.plane) == (0.55, 8, "source")
    errors = said.errors
    assert (errors.sigma_pos, errors.draws, errors.leave_one_out, errors.outlier) == ("fixed", 0, False, 3.0)


@pytest.mark.parametrize("name", datasets.names("strong"))
def test_every_shipped_configuration_is_read(name: str):
    said = config.read(datasets.path(name) / "strong.toml")
    assert said.reference is not None
    assert said.component and said.members is not None
