"""The screens of the docs: what a reader must find at once, and that the pictures are those of today's program."""

import html
import io
import re
from pathlib import Path

import pytest
from benchmarks.screens import DOCS, NAME, WIDTHS, Story, plain_demo, story, watched
from benchmarks.site_pictures import pages

from otolith.cli.console import Terminal

PICTURES = DOCS / "pictures"
PAGE = (DOCS / "screens.md").read_text(encoding="utf-8")


def words(svg: Path) -> str:
    return " ".join(
        html.unescape(re.sub(r"<[^>]*>", " ", svg.read_text(encoding="utf-8"))).replace("\xa0", " ").split()
    )


def test_each_picture_is_shown_and_each_shown_picture_is_there() -> None:
    named = set(re.findall(r"pictures/([\w.-]+)", PAGE))
    made = {path.name for pattern in ("watch-*", "page-*") for path in PICTURES.glob(pattern)}
    assert named == made


@pytest.mark.parametrize("name", ["demo", *(f"watch-{width}" for width in WIDTHS)])
def test_a_picture_of_the_table_has_state_begin_and_advice(name: str) -> None:
    text = words(PICTURES / f"{name}.svg")
    for part in ("ACT since 2026-", "What to do:", "balance the rotor", NAME):
        assert part in text


def test_the_texts_of_terminals_fit_into_them() -> None:
    blocks = dict(re.findall(r"^## ([^\n]*)\n\n```text\n(.*?)\n```$", PAGE, re.MULTILINE | re.DOTALL))
    widths = {title: max(map(len, text.splitlines())) for title, text in blocks.items()}
    assert all(width <= 80 for title, width in widths.items() if "history" in title)
    lines = blocks["The demo without a terminal"].splitlines()
    assert [line for line in lines if len(line) > 100 and not line.startswith(("recording: ", "report page: "))] == []


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Story:
    return story(tmp_path_factory.mktemp("story"))


@pytest.mark.full
@pytest.mark.parametrize("width", WIDTHS)
@pytest.mark.parametrize("moment", ["healthy", "undecided", "end"])
def test_state_begin_and_advice_are_in_the_first_lines(run: Story, moment: str, width: int) -> None:
    console = Terminal(file=io.StringIO(), width=width)
    console.print(watched(run.until(moment)))
    lines = console.file.getvalue().splitlines()  # type: ignore[attr-defined]
    assert re.match("(ACT|OK) since 2026-", lines[0])
    assert all(len(line) <= width for line in lines)
    assert ("What to do:" in " ".join(lines[:10])) is (moment != "healthy")


@pytest.mark.full
def test_the_demo_says_once_what_is_new_and_ends_with_what_to_do_next(run: Story, tmp_path: Path) -> None:
    text = plain_demo(run, tmp_path)
    assert text.count("cause not yet known") in {1, 2}
    assert "otolith report " in text.splitlines()[-1]
    assert str(tmp_path) not in text


@pytest.mark.full
def test_the_pages_of_a_site_can_be_made() -> None:
    made = pages()
    assert {f"{name}-{width}.png" for name in made for width in (1280, 390)} == {
        path.name for path in PICTURES.glob("site*")
    }
    assert all("press-3" in page for page in made.values())
