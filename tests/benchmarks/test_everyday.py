"""How the benchmark of everyday situations judges what was named."""

import pytest
from benchmarks.everyday import HONEST, SITUATIONS, verdict

BY_NAME = {situation.name: situation for situation in SITUATIONS}
A_CLASS = min(HONEST)


@pytest.mark.parametrize(
    ("name", "named", "expected"),
    [
        ("healthy: constant speed", set(), "right"),
        ("healthy: constant speed", {"sensor"}, "wrong"),
        ("current reads 10 % more", {"sensor"}, "right"),
        ("current reads 10 % more", {"sensor", A_CLASS}, "right"),
        ("current reads 10 % more", {"sensor", "winding-turns"}, "wrong"),
        ("current reads 10 % more", {A_CLASS}, "honest"),
        ("current reads 10 % more", set(), "wrong"),
    ],
)
def test_a_wrong_cause_is_wrong_also_beside_the_right_one(name: str, named: set[str], expected: str) -> None:
    assert verdict(BY_NAME[name], named) == expected
