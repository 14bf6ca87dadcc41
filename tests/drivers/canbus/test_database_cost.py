"""A small database is little work: what costs is bounded, and the rest takes time in proportion to the file."""

import time
from pathlib import Path

import pytest

from otolith_drivers.canbus.database import MAX_MESSAGES, load_database
from otolith_drivers.errors import ConfigurationError

SECONDS = 8.0  # of processor time; each took from 10 s to hours
HEAD = 'VERSION ""\nNS_ :\nBS_:\nBU_: A\n'


def signal(name: str, place: str = "0|8") -> str:
    return f' SG_ {name} : {place}@1+ (1,0) [0|0] "" A\n'


def message(*signals: str, length: int = 8) -> str:
    return f"{HEAD}BO_ 1 M: {length} A\n{''.join(signals)}"


def muxed(count: int) -> str:
    rows = (signal(f"s{number} m{number}", "16|8") for number in range(count))
    return message(signal("x M", "0|16"), *rows)


READ = {
    "signals that overlap": message(*(signal(f"s{number}") for number in range(1500))),
    "a long frame": message(*(signal(f"s{n}", f"{8 * n}|8") for n in range(2000)), length=4096),
    "multiplexed signals": muxed(3000),
    "blank lines": message(signal("s")) + "\n" * 3_000_000,
    "lines of spaces": message(signal("s")) + " \n" * 1_500_000,
}
REFUSED = {
    "more signals in a message": (muxed(5000), "signals"),
    "ranges of multiplexers": (
        muxed(50) + "".join(f"SG_MUL_VAL_ 1 s{number % 50} x 0-65000;\n" for number in range(2000)), "values",
    ),
    "extended multiplexers without an end": (message(signal("s")) + "SG_MUL_VAL_ 1 \n" * 250_000, "ends within"),
    "types without an end": (message(signal("s")) + "SIG_VALTYPE_ 1 \n" * 200_000, "ends within"),
    "types without an end before a value": (
        message(signal("s")) + "SIG_VALTYPE_ 1 \n" * 200_000 + 'VAL_ 1 s 1 "on" ;\n', "not a CAN database",
    ),
    "incomplete messages": (HEAD + "BO_ \n" * 500_000, str(MAX_MESSAGES)),
}  # fmt: skip


@pytest.mark.parametrize("kind", [*READ, *REFUSED])
def test_a_small_database_is_little_work(tmp_path: Path, kind: str) -> None:
    path = tmp_path / "small.dbc"
    path.write_text(READ[kind] if kind in READ else REFUSED[kind][0], encoding="utf-8")
    begin = time.process_time()
    if kind in READ:
        assert [row.name for row in load_database(path).messages] == ["M"]
    else:
        with pytest.raises(ConfigurationError) as caught:
            load_database(path)
        assert str(caught.value).startswith(f"{path}: ")
        assert REFUSED[kind][1] in str(caught.value)
    assert time.process_time() - begin < SECONDS


def test_each_signal_that_overlaps_is_named(tmp_path: Path) -> None:
    path = tmp_path / "overlaps.dbc"
    path.write_text(message(*(signal(f"s{number}") for number in range(100)), signal("t", "8|8")), encoding="utf-8")
    database = load_database(path)
    (row,) = database.messages
    assert all(database.faults_of(row, f"s{number}") for number in range(100))
    assert not database.faults_of(row, "t")
    assert len(database.faults) < 200
