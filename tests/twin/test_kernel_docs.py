"""The kernels printed in docs/explanation are those that the generator writes.

``OTOLITH_UPDATE_GOLDEN=1 python -m pytest tests/twin/test_kernel_docs.py`` prints them anew. A marker
``<!-- kernel: TWIN FUNCTION -->`` stands before a whole function; ``<!-- kernel: TWIN FUNCTION LOOP -->`` before its
last loop whose line begins with LOOP.
"""

import os
import re
import textwrap
from pathlib import Path

import pytest

from otolith.machine import find_twin
from otolith.twin.kernel_sources import kernel_source

PAGES = sorted((Path(__file__).parents[2] / "docs" / "explanation").glob("*.md"))
BLOCK = re.compile(r"<!-- kernel: (\w+) (\w+)(?: ([\w ]+))? -->\n```python\n(.*?)```", re.DOTALL)


def printed(twin: str, function: str, loop: str | None) -> str:
    """The generated function, or its last ``loop``, as the page prints it."""
    (text,) = re.findall(
        rf"^@njit\(.*\)\ndef {function}\(.*(?:\n(?: .*)?)*", kernel_source(find_twin(twin)), re.MULTILINE
    )
    lines = text.rstrip().splitlines()
    if loop:
        start = max(index for index, line in enumerate(lines) if line.strip().startswith(loop))
        depth = len(lines[start]) - len(lines[start].lstrip())
        end = next(i for i in range(start + 1, len(lines)) if len(lines[i]) - len(lines[i].lstrip()) <= depth)
        lines = textwrap.dedent("\n".join(lines[start:end])).splitlines()
    return "\n".join(lines) + "\n"


@pytest.mark.parametrize(
    "page", [page for page in PAGES if BLOCK.search(page.read_text("utf-8"))], ids=lambda p: p.stem
)
def test_printed_kernels_are_generated(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    generated = BLOCK.sub(lambda m: m[0].replace(f"```python\n{m[4]}", f"```python\n{printed(m[1], m[2], m[3])}"), text)
    if os.environ.get("OTOLITH_UPDATE_GOLDEN"):
        page.write_text(generated, encoding="utf-8")
        text = generated
    assert text == generated


def test_the_predictor_is_printed() -> None:
    blocks = [match.group(1, 2) for page in PAGES for match in BLOCK.finditer(page.read_text("utf-8"))]
    assert ("dc_motor", "simulate") in blocks
