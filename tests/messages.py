"""What a message must contain, so that its wording can improve: file, key, value, bound and remedy."""

from pathlib import Path

LISTED = "error-contains.txt"  # of a golden case: what its message contains, one text a line


def assert_says(message: str, *parts: str) -> None:
    """Assert that ``message`` contains each of ``parts``."""
    lost = [part for part in parts if part not in message]
    assert not lost, f"{message!r} lacks {lost}"


def assert_says_what_is_listed(message: str, case: Path) -> None:
    """Assert that ``message`` contains each line of the golden case's list."""
    parts = (case / LISTED).read_text(encoding="utf-8").splitlines()
    assert parts
    assert_says(message, *parts)


def assert_refuses(error: Exception, file: Path | str) -> None:
    """Assert that each line names ``file`` and a reason."""
    lines = str(error).split("\n")
    assert all(line.startswith(str(file)) and len(line.removeprefix(str(file)).split()) > 1 for line in lines), lines
