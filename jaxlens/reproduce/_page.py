"""The report of one cluster as a page: numbers and statements of the paper, models, figures."""

import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from jaxlens.report import Figure, Link, Mark, Page, Section, Table
from jaxlens.reproduce._analysis import Analysis
from jaxlens.reproduce._cluster import ClusterRun
from jaxlens.reproduce._figures import CAPTIONS
from jaxlens.reproduce._numbers import numbers, own_numbers
from jaxlens.reproduce._paper import Row, rows
from jaxlens.reproduce._statements import OURS, Judged, judge

LEAD = (
    "Strong and weak lensing of a simulated merging cluster, compared pixel by pixel: each number of the "
    "paper beside this run's, and each of its statements with a verdict."
)


def _number(measured: Any) -> str:
    if not math.isfinite(measured.value):
        return "not measured"
    text = f"{measured.value:.4g}"
    return text if not measured.error > 0.0 else f"{text} \N{PLUS-MINUS SIGN} {measured.error:.2g}"


def statement_table(judged: Sequence[Judged], drawn: Iterable[str]) -> Table:
    """Statements with their numbers and verdicts; links only to figures that are there."""
    known = set(drawn)

    def link(name: str) -> str | Link:
        return Link(name.replace("_", " "), name) if name in known else ""

    return Table(
        ("statement", "measured", "value", "claimed", "verdict", "figure"),
        [
            (
                one.claim.text,
                one.claim.quantity,
                _number(one.measured) + (f" {one.claim.unit}" if one.claim.unit else ""),
                one.claim.range,
                Mark(one.verdict),
                link(one.claim.figure),
            )
            for one in judged
        ],
        numeric=frozenset({2, 3}),
    )


def number_table(table: Sequence[Row], drawn: Iterable[str]) -> Table:
    """The paper's numbers beside the run's."""
    known = set(drawn)
    return Table(
        ("number", "paper", "this run", "unit", "figure"),
        [
            (
                row.text,
                f"{row.paper:g}",
                _number(row.measured),
                row.unit,
                Link(row.figure.replace("_", " "), row.figure) if row.figure in known else "",
            )
            for row in table
        ],
        numeric=frozenset({1, 2}),
    )


def page(
    found: ClusterRun,
    made: Analysis,
    content: dict[str, Any],
    pictures: dict[str, Path],
    more: Sequence[Section] = (),
) -> Page:
    """The report of one cluster."""
    strong = content["strong"]
    images = [Figure.read(path, CAPTIONS[name]) for name, path in pictures.items()]
    models = Table(
        (
            "model",
            "members",
            "source-plane chi^2",
            "rms [arcsec]",
            "chi^2/nu",
            "starts that agree",
            "at a bound",
        ),
        [
            (
                name,
                str(one["n_members"]),
                f"{one['chi2_source_plane']:.1f}",
                f"{one['rms_arcsec']:.3f}" if "rms_arcsec" in one else "",
                f"{one['chi2_nu']:.2f}" if one.get("chi2_nu") is not None else "",
                f"{one['starts_agreeing']} of {one['starts']}",
                ", ".join(one["at_bound"]) or "none",
            )
            for name, one in strong.items()
        ],
        numeric=frozenset({1, 2, 3, 4}),
    )
    return Page(
        title="Where strong and weak lensing change places",
        lead=LEAD,
        facts={
            "seed": str(found.seed),
            "noise realisations": f"{found.n}, {found.base.noisy.n_bad} of them bad",
            "jaxlens": content["version"],
            **{f"seconds, {name}": f"{value:.0f}" for name, value in content["seconds"].items()},
        },
        sections=(
            Section(
                "numbers",
                "Numbers of the paper",
                (
                    "The paper has one cluster whose shape and concentrations are not stated; this one is "
                    "drawn from the same recipe. Errors are the scatter of one noise realisation. The "
                    "absolute value of lambda_P depends on padding, ridge and band of the reconstruction: "
                    "compare differences.",
                    number_table(rows(found, strong["rectangle"]), pictures),
                ),
            ),
            Section(
                "statements",
                "Statements of the paper",
                (
                    "A statement holds here when the measured number lies inside the claimed range with its "
                    "error, it does not when it lies outside, and it is undecided in between. One cluster "
                    "decides for itself only.",
                    statement_table(judge(numbers(found, made)), pictures),
                ),
            ),
            Section(
                "own",
                "The excess-variance transition and the combined map",
                (statement_table(judge(own_numbers(made), OURS), pictures),),
            ),
            Section("strong", "Strong-lensing models", (models,)),
            *more,
            Section("figures", "Figures", images),
        ),
    )
