"""Parameters of tests of which ``make test`` runs some, and ``make test-full`` the others."""

from collections.abc import Collection, Iterable
from typing import Any

import pytest


def often(chosen: Collection[Any], every: Iterable[Any]) -> list[Any]:
    """Parameters of a test: those not ``chosen`` are marked full."""
    return [value if value in chosen else pytest.param(value, marks=pytest.mark.full) for value in every]


def often_rows(chosen: Collection[tuple[Any, ...]], every: Iterable[tuple[Any, ...]]) -> list[Any]:
    """Rows of several parameters: those not ``chosen`` are marked full."""
    return [row if row in chosen else pytest.param(*row, marks=pytest.mark.full) for row in every]
