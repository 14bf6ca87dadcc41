"""What a message must contain, so that its wording can improve: file, key, value, bound and remedy."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import pytest

LISTED = "error-contains.txt"  # of a golden case: what its message contains, one text a line


def assert_says(message: str, *parts: str) -> None:
    """Assert that ``message`` contains each of ``parts``."""
    lost = [part for part in parts if part not in message]
    assert not lost, f"{message!r} lacks {lost}"


def assert_each_says(messages: Sequence[str], *parts: Sequence[str]) -> None:
    """Assert that there is a message for each of ``parts``, in this order, and that it contains all of them."""
    assert len(messages) == len(parts), messages
    for message, wanted in zip(messages, parts, strict=True):
        assert_says(message, *wanted)


@contextmanager
def raises_saying(kind: type[Exception], *parts: str) -> Iterator[None]:
    """Assert that the block raises ``kind`` with a message that contains each of ``parts``."""
    with pytest.raises(kind) as caught:
        yield
    assert_says(str(caught.value), *parts)


def assert_says_what_is_listed(message: str, case: Path) -> None:
    """Assert that ``message`` contains each line of the golden case's list."""
    parts = (case / LISTED).read_text(encoding="utf-8").splitlines()
    assert parts
    assert_says(message, *parts)


def assert_refuses(error: Exception, file: Path | str) -> None:
    """Assert that each line names ``file`` and a reason."""
    lines = str(error).split("\n")
    assert all(line.startswith(str(file)) and len(line.removeprefix(str(file)).split()) > 1 for line in lines), lines
