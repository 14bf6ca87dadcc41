"""Changes of single keys of a machine file leave all its other lines as they are."""

import os
import tomllib
from pathlib import Path

import pytest

from otolith.cli.commissioning.machine_lines import NewLine, Unchangeable, with_delay, with_keys, write_machine_file
from otolith_drivers.errors import ConfigurationError, ServiceError
from tests.cli.replays import MACHINE
from tests.hostile import HOSTILE
from tests.messages import raises_saying

TEXT = """# a comment, which stays
[signals]
V_a = { column = "U } [V]", unit = "V" }  # not { here }
i = { column = "I", delay = "1 ms", unit = "A" }
[signals.omega]
column = "n"

[parameters]
# R_a = { value = "6.5 ohm", estimate = true }  # of the twin
L_a = "0.6 H"     # by a bridge
[noise]
i = "5 mA"
"""


def test_a_key_replaces_its_line_or_its_default() -> None:
    text = with_keys(TEXT, "parameters", {"R_a": NewLine("2.1 ohm", "new"), "L_a": NewLine({"value": "0.1 H"})})
    lines = text.splitlines()
    assert 'R_a = "2.1 ohm"  # otolith commission: new' in lines
    assert 'L_a = { value = "0.1 H" }  # by a bridge' in lines
    kept = [line for line in TEXT.splitlines() if "R_a" not in line and "L_a" not in line]
    assert [line for line in lines if "R_a" not in line and "L_a" not in line] == kept


def test_a_new_key_is_the_last_of_its_table_and_a_new_table_the_last_of_the_file() -> None:
    text = with_keys(
        with_keys(TEXT, "noise", {"omega": NewLine("1 rad/s")}), "process_noise", {"i": NewLine("1 A/s^0.5")}
    )
    assert text.endswith('i = "5 mA"\nomega = "1 rad/s"\n\n[process_noise]\ni = "1 A/s^0.5"\n')


@pytest.mark.parametrize("keys", ['i = "5 mA"\n', "# none is known\n", ""])
def test_a_new_key_stands_above_the_comment_of_the_next_table(keys: str) -> None:
    below = '\n## one estimate for each\n[window]\nlength = "2 s"\n\n## also without a key\n# [swarm]\n# seed = 1\n'
    text = f"[noise]\n{keys}{below}"
    assert with_keys(text, "noise", {"i": NewLine("1 A"), "omega": NewLine("1 rad/s")}).endswith(f'"1 rad/s"\n{below}')
    seconds = with_keys(text, "window", {"sample_period": NewLine("10 ms")}).partition('length = "2 s"\n')[2]
    assert seconds.startswith('sample_period = "10 ms"\n\n##')


@pytest.mark.parametrize("table", ["noise", "process_noise"])
def test_without_a_key_the_file_stays_as_it_is(table: str) -> None:
    for text in (TEXT, TEXT.replace('i = "5 mA"\n', ""), TEXT.partition("[noise]")[0]):
        assert with_keys(text, table, {}) == text


COMMENTED = [
    ('i = "5 mA"  ', "# data sheet, page 3", "noise", "i"),
    ('i = "5 mA"  ', "# ± 5 mA, data sheet", "noise", "i"),
    ('i = "5 mA"  ', "# of the machine: ± 0.1  # 2nd amplifier # since May", "noise", "i"),
    ('i = "5 mA"  ', "# not significant: up to about 0.02 A, says Ann", "noise", "i"),
    ('R_a = "6.5 ohm"     ', "# by a bridge; at 20 °C", "parameters", "R_a"),
    ("R_a = '6 # ohm' ", "# by a bridge", "parameters", "R_a"),
]


@pytest.mark.parametrize(("before", "comment", "table", "name"), COMMENTED)
@pytest.mark.parametrize(
    "remarks",
    [
        ("of the machine: ± 0.2", "of the machine: ± 0.1", "of the machine: ± 0.1"),
        ("not significant: up to about 0.02 A", "not significant: up to about 0.03 A", "± 2 %"),
        ("load: 1 to 2 N*m in monday #1.csv", "load: 1 to 3 N*m in a  # b.csv", "± 0.1 Ω, from a\t#2\n# 3.csv"),
    ],
    ids=["interval", "none", "name of a log"],
)
def test_of_remarks_the_last_one_stays_and_all_that_a_person_wrote(
    before: str, comment: str, table: str, name: str, remarks: tuple[str, ...]
) -> None:
    """Commissioned again and again: a person may have written anything, also what looks like a remark."""
    text, empty = f"[{table}]\n{before}{comment}\n", f"[{table}]\n"
    for remark in remarks:
        text = with_keys(text, table, {name: NewLine("7 V", remark)})
        alone = with_keys(empty, table, {name: NewLine("7 V", remark)}).rstrip()
        assert alone.startswith(f'{empty}{name} = "7 V"  # otolith commission: ')
        assert text == f"{alone}  {comment}\n"
    assert with_keys(text, table, {name: NewLine("8 V")}) == f'{empty}{name} = "8 V"  {comment}\n'


@pytest.mark.parametrize("comment", ["# terminal 7", "# ± 2 ms, data sheet"])
@pytest.mark.parametrize("row", ['i = { column = "I", delay = "1 ms" }', 'i = { column = "I" }'])
def test_a_delay_has_its_interval_beside_what_a_person_wrote(row: str, comment: str) -> None:
    text = f"[signals]\n{row}  {comment}\n"
    for interval in ("± 0.2 ms", "± 0.1 ms"):
        text = with_delay(text, "i", "9.7 ms", interval)
    new = 'i = { column = "I", delay = "9.7 ms" }  # otolith commission: ± 0.1 ms'
    assert text == f"[signals]\n{new}  {comment}\n"


@pytest.mark.parametrize("name", ["V_a", "i", "omega", "T_load"])
def test_a_delay_enters_the_signal_however_it_is_written(name: str) -> None:
    before, after = tomllib.loads(TEXT), tomllib.loads(with_delay(TEXT, name, "9.7 ms", "± 0.1 ms"))
    assert after["signals"][name]["delay"] == "9.7 ms"
    del after["signals"][name]["delay"]
    before["signals"].setdefault(name, {}).pop("delay", None)
    assert after == before


LIMITS = {"watch": ["-10 %", "+10 %"], "low": "1 ohm", "temperature": "T_w"}
FOUND = {"value": "2.1 ohm", "estimate": True, "low": "0.5 ohm", "high": "8.4 ohm"}
INLINE = '{ watch = ["-10 %", "+10 %"], low = "1 ohm", temperature = "T_w" }'


@pytest.mark.parametrize(
    "before",
    [
        f"[parameters]\nR_a = {INLINE}\nJ = 1\n",
        f"[parameters]\nR_a = {INLINE}  # of the {{ data sheet }}\n",
        '[parameters.R_a]\nwatch = [\n  "-10 %",  # kept\n  "+10 %",\n]\nlow = "1 ohm"\ntemperature = "T_w"\n[noise]\n',
    ],
    ids=["inline", "with a remark", "with a header"],
)
def test_a_table_that_is_there_keeps_what_a_person_has_stated(before: str) -> None:
    text = with_keys(before, "parameters", {"R_a": NewLine(FOUND, "found")})
    assert tomllib.loads(text)["parameters"]["R_a"] == FOUND | LIMITS
    for remark in ("# of the { data sheet }", "# kept"):
        assert (remark in text) == (remark in before)
    short = tomllib.loads(with_keys(before, "parameters", {"R_a": NewLine("2.1 ohm")}))
    assert short["parameters"]["R_a"] == LIMITS | {"value": "2.1 ohm"}


def test_a_file_with_the_ends_of_lines_of_windows_keeps_them() -> None:
    lines = {"R_a": NewLine("2.1 ohm", "new"), "J": NewLine("1 kg*m^2")}
    text, crlf = TEXT, TEXT.replace("\n", "\r\n")
    for table in ("parameters", "process_noise"):
        text, crlf = with_keys(text, table, lines), with_keys(crlf, table, lines)
    for signal in ("V_a", "i", "omega", "T_load"):
        text, crlf = with_delay(text, signal, "9.7 ms", "± 1 ms"), with_delay(crlf, signal, "9.7 ms", "± 1 ms")
    assert crlf == text.replace("\n", "\r\n")


def test_a_layout_that_is_not_understood_is_refused() -> None:
    array = '[noise]\ni = [\n  "5 mA",\n]\n'
    with pytest.raises(Unchangeable):
        with_keys(array, "noise", {"i": NewLine("6 mA")})
    with pytest.raises(Unchangeable):
        with_keys('parameters.R_a = "1 ohm"\n', "parameters", {"R_a": NewLine("2 ohm")})


@pytest.mark.parametrize("hostile", HOSTILE, ids=range(len(HOSTILE)))
def test_a_text_from_outside_stays_a_value_or_a_remark(hostile: str) -> None:
    text = with_keys(TEXT, "noise", {"i": NewLine("6 mA", hostile)})
    assert tomllib.loads(text)["noise"] == {"i": "6 mA"}
    assert set(tomllib.loads(text)) == set(tomllib.loads(TEXT))


def test_what_the_daemon_refuses_is_not_written(tmp_path: Path) -> None:
    file = tmp_path / "machine.toml"
    text = MACHINE.read_text(encoding="utf-8")
    file.write_text(text, encoding="utf-8")
    file.chmod(0o640)
    with pytest.raises(ConfigurationError, match="nosie"):
        write_machine_file(file, text + '\n[nosie]\ni = "5 mA"\n')
    assert file.read_text(encoding="utf-8") == text
    write_machine_file(file, text + "\n# more\n")
    assert file.read_text(encoding="utf-8").endswith("# more\n")
    assert file.stat().st_mode & 0o777 == 0o640
    assert list(tmp_path.iterdir()) == [file]


def test_a_link_its_owner_and_the_ends_of_lines_stay(tmp_path: Path) -> None:
    target, link = tmp_path / "there" / "machine.toml", tmp_path / "machine.toml"
    target.parent.mkdir()
    target.write_bytes(MACHINE.read_bytes().replace(b"\n", b"\r\n"))
    link.symlink_to(target)
    owner = (4711, 4712) if os.geteuid() == 0 else (os.geteuid(), os.getegid())
    os.chown(target, *owner)
    target.chmod(0o660)
    text = target.read_bytes().decode() + "# more\r\n"
    write_machine_file(link, text)
    status = target.stat()
    assert link.is_symlink()
    assert target.read_bytes() == text.encode()
    assert (status.st_uid, status.st_gid, status.st_mode & 0o777) == (*owner, 0o660)


@pytest.mark.parametrize("call", ["fsync", "fchown"])
def test_a_file_that_cannot_be_replaced_as_it_is_stays(
    call: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The disk fails, or another user owns the file, who would lose it."""
    file, status = tmp_path / "machine.toml", os.stat_result

    def refused(*_: object) -> None:
        raise PermissionError(1, "Operation not permitted")

    file.write_bytes(MACHINE.read_bytes())
    monkeypatch.setattr(os, call, refused)
    if call == "fchown":
        real = Path.stat
        monkeypatch.setattr(
            Path, "stat", lambda path, **given: status([*real(path, **given)[:4], 4711, 4712, *real(path, **given)[6:]])
        )
    with raises_saying(ServiceError, str(file), *(["4711", "root"] if call == "fchown" else [])):
        write_machine_file(file, MACHINE.read_text(encoding="utf-8") + "# more\n")
    assert file.read_bytes() == MACHINE.read_bytes()
    assert list(tmp_path.iterdir()) == [file]
