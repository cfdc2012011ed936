"""The HTML report: one file, escaped text, links that lead somewhere."""

from base64 import b64decode
from html.parser import HTMLParser

import pytest

from jaxlens import report

PNG = b64decode(
    "iVBORw0KGgoAAAANSUhEUgAAAAEAAAABCAYAAAAfFcSJAAAADUlEQVR42mNk+M9QDwADhgGAWjR9awAAAABJRU5ErkJggg=="
)


class Reader(HTMLParser):
    """What a browser would find: attributes of every tag, and the text."""

    def __init__(self) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.words: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))

    def handle_data(self, data: str) -> None:
        self.words.append(data)


TABLE = report.Table(
    ["statement", "value", "verdict", "figure"],
    [
        ["A < K", "3.2", report.Mark("holds here"), report.Link("PDF", "pdf")],
        ["A > K", "0.3", report.Mark("does not hold here"), ""],
        ["A = K", "1.0", report.Mark("undecided"), ""],
    ],
    numeric=frozenset({1}),
)
SECTION = report.Section(
    "statements", "Statements", ["It is said.", TABLE, report.Figure("pdf", PNG, 'The "PDF" of lambda.')]
)


def page(*sections: report.Section) -> report.Page:
    return report.Page("lambda <r>", "A & B", sections, {"seed": "3"})


def test_page_holds_everything_and_needs_no_other_file():
    text = report.html(page(SECTION))
    reader = Reader()
    reader.feed(text)
    images = [a for tag, a in reader.tags if tag == "img"]
    assert [b64decode((a["src"] or "").split(",")[1]) for a in images] == [PNG]
    assert images[0]["alt"] == 'The "PDF" of lambda.'
    outside = [v for _, a in reader.tags for k, v in a.items() if k in ("src", "href") and "//" in (v or "")]
    assert not outside and "<script" not in text and "@import" not in text
    marks = [a["class"] for _, a in reader.tags if "verdict" in (a.get("class") or "")]
    assert marks == ["verdict yes", "verdict no", "verdict open"]
    assert {"lambda <r>", "A & B", "A < K", "3.2", "holds here"} <= set(reader.words)
    assert [a["href"] for tag, a in reader.tags if tag == "a"] == ["#pdf"]


def test_numbers_are_set_flush_right():
    reader = Reader()
    reader.feed(report.html(page(SECTION)))
    assert sum(tag == "td" and a.get("class") == "number" for tag, a in reader.tags) == 3


def test_a_link_to_nothing_is_refused():
    table = report.Table(["a"], [[report.Link("x", "nowhere")]])
    with pytest.raises(ValueError, match="lead nowhere: nowhere"):
        report.html(page(report.Section("s", "S", [table])))


def test_a_key_used_twice_is_refused():
    with pytest.raises(ValueError, match="twice: s"):
        report.html(page(report.Section("s", "S"), report.Section("s", "T")))


def test_a_row_of_another_length_is_refused():
    with pytest.raises(ValueError, match="Row 1 of a table has 1 cells for 2 columns"):
        report.Table(["a", "b"], [["1", "2"], ["3"]])
