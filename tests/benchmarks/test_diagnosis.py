"""The benchmark of the diagnosis: situations of the motor, one run each."""

import pytest
from benchmarks.diagnosis import SITUATIONS, machine_of, run


@pytest.mark.parametrize("name", ["step of R_a", "frozen speed sensor", "load change"])
def test_a_situation_of_the_motor_is_announced(name: str) -> None:
    result = run(name, 1)
    (situation,) = [item for item in SITUATIONS if item.name == name]
    assert result.is_right, result.announced
    assert (result.severity, result.false_events) == (situation.severity, 0)


def test_there_are_thirteen_situations_of_three_machines() -> None:
    assert len({item.name for item in SITUATIONS}) == 13
    for kind in {item.machine for item in SITUATIONS}:
        machine = machine_of(kind)
        assert {item.name for item in machine.problem.free} == set(machine.plan.parameters)
