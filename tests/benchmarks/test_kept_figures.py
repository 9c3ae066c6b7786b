"""The figures that pages show are those that the commands kept."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

import counts
import figures


def test_pages_show_what_was_kept(project: Path) -> None:
    pages = [project / "README.md", *(project / "docs").rglob("*.md")]
    texts = [page.read_text(encoding="utf-8") for page in pages]
    for page, text in zip(pages, texts, strict=True):
        bare = figures.without_marks(text)
        assert figures.with_figures(bare, marks_older=False) == bare, (
            f"{page}: python benchmarks/figures.py"
        )
    places = {found[1] for text in texts for found in figures.SHOWN.findall(text)}
    assert places == {path.stem for path in figures.FOLDER.glob("*.json")}


def test_older_figures_are_marked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(figures, "FOLDER", tmp_path)
    table = {"columns": ["a", "b"], "rows": [["1", "2"]], "title": ""}
    content = {"date": "2026-01-02", "commit": "abc", "command": "measure", "tables": [table]}
    for was, is_older in ((figures.digest("core"), False), ("another", True)):
        described = json.dumps(content | {"describes": {"core": was}})
        (tmp_path / "some.json").write_text(described, encoding="utf-8")
        page = figures.with_figures("# Page\n\n<!-- figures some -->\n<!-- end -->\n")
        assert "| 1 | 2 |" in page
        assert (figures.OLDER in page) is is_older
        assert figures.with_figures(page) == page


def test_a_count_20_percent_above_the_kept_one_fails() -> None:
    found = {"frame": 121, "start": 119, "new": 5}
    assert counts.worse(found, {"frame": 100, "start": 100}) == [
        "frame: 121, more than 20 % above 100"
    ]


@pytest.mark.parametrize(
    ("name", "code", "commented", "other"),
    [
        ("a.py", "x = 1\n", '"""A module."""\n\nx = 1  # metres\n"""Width [m]."""\n', "x = 2\n"),
        ("a.c", "int x = 1;\n", "/* Width,\n in m. */\nint  x = 1; // m\n", "int x = 2;\n"),
    ],
)
def test_a_comment_makes_no_figure_older(
    tmp_path: Path, name: str, code: str, commented: str, other: str
) -> None:
    digests = []
    for number, text in enumerate((code, commented, other)):
        path = tmp_path / str(number) / name
        path.parent.mkdir()
        path.write_text(text, encoding="utf-8")
        digests.append(figures.digest(str(path)))
    assert digests[0] == digests[1] != digests[2]
