"""An FMU of another tool is read, tried in a process of its own, or refused with its name and the reason."""

import re
import stat
import sys
import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from otolith.cli.main import cli
from otolith.exchange.model_description import Version
from otolith.fmu import archive, trial
from otolith.fmu.description import read_fmu
from otolith.fmu.instance import instance_of
from otolith.fmu.trial import try_fmu
from otolith.machine import LoadedMachine, load_machine
from otolith.storage.evidence import EVIDENCE, FMU, files_of, read_bundle
from otolith_drivers.errors import ConfigurationError
from tests.exchange.foreign import (
    DESCRIPTION,
    MODEL,
    described,
    description_of,
    exported,
    plain,
    rewritten,
    with_line,
    write_machine,
)
from tests.hostile import HOSTILE
from tests.messages import assert_says, raises_saying
from tests.variants import often


@pytest.fixture
def file(tmp_path: Path) -> Path:
    """The machine file of an exported motor."""
    return write_machine(tmp_path, plain())


def loaded(file: Path) -> LoadedMachine:
    return load_machine(file, with_driver=False)


@pytest.mark.parametrize("version", Version)
def test_it_is_a_twin_with_the_units_of_its_description(version: Version, tmp_path: Path) -> None:
    twin = loaded(write_machine(tmp_path, plain(version=version))).twin
    assert [(row.name, row.unit) for row in twin.states] == [("i", "A"), ("omega", "rad/s")]
    assert [(row.name, row.unit, row.hold) for row in twin.inputs] == [("V_a", "V", "zoh"), ("T_load", "N*m", "foh")]
    assert [(row.name, row.unit) for row in twin.outputs] == [("i", "A"), ("omega", "rad/s")]
    assert [row.name for row in twin.parameters] == ["R_a", "L_a", "J", "K_e", "K_t", "D"]
    assert {row.into for row in twin.sites} == {"entering_V_a", "entering_T_load"}


def test_without_names_it_has_those_of_the_fmu(tmp_path: Path) -> None:
    (tmp_path / "motor.fmu").write_bytes(plain())
    head, noise = '[machine]\nname = "m"\n[twin]\nfmu = "motor.fmu"\n', '[noise]\ni = "5 mA"\nomega = "0.02 rad/s"'
    text = f"{head}[parameters]\nR_a = {{}}\n{noise}"
    path = tmp_path / "machine.toml"
    path.write_text(text, encoding="utf-8")
    machine = loaded(path)
    assert [row.name for row in machine.twin.states] == ["state_i", "state_omega"]
    assert [row.name for row in machine.twin.outputs] == ["i", "omega"]
    assert [(row.name, row.nominal, row.low, row.high) for row in machine.problem.free] == [("R_a", 6.5, 0.65, 65.0)]


def test_a_quantity_may_have_another_unit_of_the_same_dimension(file: Path) -> None:
    twin = loaded(with_line(file, 'variable = "state.omega"', 'variable = "state.omega", unit = "rpm"')).twin
    assert twin.unit_of("omega") == "rpm"
    assert twin.fmu is not None
    assert [row.scale for row in twin.fmu.states] == [1.0, 1.0]


# What is wrong with an archive, and what its error must say.
def _traversing(name: str) -> Callable[[Path], object]:
    def change(path: Path) -> None:
        with zipfile.ZipFile(path, "a") as opened:
            opened.writestr(zipfile.ZipInfo(name), b"text")

    return change


def _linking(path: Path) -> None:
    entry = zipfile.ZipInfo("resources/link")
    entry.external_attr = (stat.S_IFLNK | 0o777) << 16
    with zipfile.ZipFile(path, "a") as opened:
        opened.writestr(entry, b"/etc/passwd")


def _bomb(path: Path) -> None:
    with zipfile.ZipFile(path, "a", zipfile.ZIP_DEFLATED) as opened:
        opened.writestr("resources/zeros", b"\0" * (archive.RATIO_BYTES + 1))


def _twice(path: Path) -> None:
    with zipfile.ZipFile(path, "a") as opened, pytest.warns(UserWarning, match="Duplicate"):
        opened.writestr(DESCRIPTION, b"text")


def _folder(path: Path) -> None:
    path.unlink()
    path.mkdir()


def _without_binary(path: Path) -> None:
    rewritten(path, lambda name, content: None if name.startswith("binaries") else content)


def _of_windows(path: Path) -> None:
    _without_binary(path)
    with zipfile.ZipFile(path, "a") as opened:
        opened.writestr("binaries/win64/otolith_dc_motor.dll", b"text")


def _replacing(old: str, new: str) -> Callable[[Path], object]:
    return lambda path: described(path, old, new)


def _with_description(text: str) -> Callable[[Path], object]:
    return lambda path: rewritten(path, lambda name, own: text.encode() if name == DESCRIPTION else own)


ARCHIVES: dict[str, tuple[Callable[[Path], object], tuple[str, ...]]] = {
    "no archive": (lambda path: path.write_bytes(b"text"), ("no archive",)),
    "cut short": (lambda path: path.write_bytes(path.read_bytes()[:900]), ("no archive",)),
    "empty": (lambda path: path.write_bytes(b""), ("no archive",)),
    "missing": (lambda path: path.unlink(), ("no such file",)),
    "a folder": (_folder, ("is no file",)),
    "leads out": (_traversing("../../evil"), ("../../evil", "leads out")),
    "absolute": (_traversing("/etc/cron.d/evil"), ("/etc/cron.d/evil", "leads out")),
    "of Windows": (_traversing("C:\\evil"), ("leads out",)),
    "a link": (_linking, ("resources/link", "is a link")),
    "a bomb": (_bomb, ("resources/zeros", "bomb")),
    "twice": (_twice, (DESCRIPTION, "twice")),
    "no description": (_with_description(""), (DESCRIPTION, "FMI")),
    "no XML": (_with_description('<fmiModelDescription fmiVersion="2.0"'), (DESCRIPTION, "is wrong")),
    "entities": (_replacing("<fmiModel", '<!DOCTYPE a [<!ENTITY b "c">]><fmiModel'), (DESCRIPTION, "entities")),
    "FMI 1.0": (_replacing('fmiVersion="2.0"', 'fmiVersion="1.0"'), (DESCRIPTION, "'1.0'", "2.0 and 3.0")),
    "another schema": (_replacing("<ModelVariables>", "<Variables>"), (DESCRIPTION, "is wrong")),
    "name of a folder": (
        _replacing('modelIdentifier="otolith_dc_motor"', 'modelIdentifier="../../evil"'),
        ("modelIdentifier", "../../evil", "no name in C"),
    ),
    "no binary": (_without_binary, ("no binary for this computer", "it has none")),
    "another system": (_of_windows, ("no binary for this computer", "win64")),
}


@pytest.mark.parametrize("case", ARCHIVES)
def test_a_hostile_or_broken_archive_is_refused(case: str, file: Path) -> None:
    change, parts = ARCHIVES[case]
    change(file.parent / "motor.fmu")
    with pytest.raises(ConfigurationError) as caught:
        loaded(file)
    assert_says(str(caught.value), "machine.toml", "twin.fmu", *parts)
    assert len(str(caught.value).splitlines()) == 1
    assert not list(file.parent.parent.glob("**/evil"))


def test_without_a_description_it_is_no_fmu(file: Path) -> None:
    rewritten(file.parent / "motor.fmu", lambda name, content: None if name == DESCRIPTION else content)
    with raises_saying(ConfigurationError, "twin.fmu", DESCRIPTION, "no FMU"):
        loaded(file)


def test_too_much_of_anything_is_refused(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("MAX_ARCHIVE_BYTES", "MAX_UNPACKED_BYTES", "MAX_MEMBERS", "MAX_DESCRIPTION_BYTES"):
        with monkeypatch.context() as patch:
            patch.setattr(archive, name, 2)
            with raises_saying(
                ConfigurationError, "twin.fmu", "at most" if name != "MAX_ARCHIVE_BYTES" else "may have"
            ):
                loaded(file)


@pytest.mark.parametrize("text", HOSTILE[:-1])
def test_hostile_texts_of_a_description_are_shown_and_not_obeyed(text: str, file: Path) -> None:
    """XML cannot have all of them; each other one stays one line."""
    escaped = "".join(f"&#{ord(letter)};" for letter in text)
    path = described(file.parent / "motor.fmu", 'modelName="', f'modelName="{escaped}')
    try:
        said = read_fmu(path).name
    except ValueError as error:
        said = str(error)
    assert len(said.splitlines()) == 1
    assert "\x1b" not in said


def test_without_fmpy_it_says_what_to_install(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "fmpy", None)
    with raises_saying(ConfigurationError, "twin.fmu", "FMPy", "pip install"):
        loaded(file)


def test_check_says_what_it_offers(file: Path) -> None:
    with_line(file, "L_a =", "# L_a =")
    result = CliRunner().invoke(cli, ["check", "--no-device", str(file)])
    assert result.exit_code == 0, result.output
    assert_says(result.output, "motor.fmu", "FMI 2.0", "model exchange", "central differences", "omega (rad/s)", "L_a")


def test_its_complete_file_loads(file: Path) -> None:
    result = CliRunner().invoke(cli, ["config", "show", str(file)])
    assert result.exit_code == 0, result.output
    again = file.with_name("again.toml")
    again.write_text(result.output, encoding="utf-8")
    assert loaded(again).twin == loaded(file).twin


def test_a_bundle_names_it_and_does_not_run_it(file: Path) -> None:
    files = files_of(loaded(file))
    assert_says(files[FMU], "motor.fmu", "SHA-256")
    path = file.with_name("bundle.zip")
    with zipfile.ZipFile(path, "w") as bundle:
        for name, text in {**files, EVIDENCE: "{}"}.items():
            bundle.writestr(name, text)
    with raises_saying(ConfigurationError, "bundle.zip", "FMU"):
        read_bundle(path)


LINES: dict[str, tuple[str, str, tuple[str, ...]]] = {
    "unknown variable": ('"state.omega"', '"state.omeg"', ("twin.variables.omega", "no such", "state.omega")),
    "two names": ("i = { variable", 'again = "state.i"\ni = { variable', ("twin.variables.i", "already")),
    "another dimension": (
        'variable = "state.omega"',
        'variable = "state.omega", unit = "V"',
        ("twin.variables.omega", "unit", "V"),
    ),
    "a derivative": ('i = { variable = "state.i"', 'i = { variable = "der(state.i)"', ("twin.variables.i", "neither")),
    "unknown parameter": ("L_a =", "L_b =", ("parameters.L_b", "no such tunable parameter", "L_a")),
    "no noise": ('omega = "0.02 rad/s"\n', "", ("noise.omega", "states no noise")),
    "no speed": ('variable = "state.i"', 'variable = "state.i", derivative = "speed"', ("derivative", "omega")),
    "name and fmu": ("fmu =", 'name = "dc_motor"\nfmu =', ("twin", "either")),
    "variables without fmu": ("fmu =", "name = 'dc_motor' #", ("twin.variables", "fmu")),
}


@pytest.mark.parametrize("case", LINES)
def test_a_wrong_line_of_the_machine_file_is_named(case: str, file: Path) -> None:
    old, new, parts = LINES[case]
    with raises_saying(ConfigurationError, "machine.toml", *parts):
        loaded(with_line(file, old, new))


def _unknown_unit(found: re.Match[str]) -> str:
    return '"per blink"/>' if found[1] else '"per blink"'


# What is replaced in a description, by what, and what the error must say.
DESCRIPTIONS: dict[str, tuple[str, str | Callable[[re.Match[str]], str], tuple[str, ...]]] = {
    "no unit": (' unit="rad/s"', "", ("twin.variables", "no unit", "rad/s")),
    "unknown unit": ('"rad/s"(>\\s*<BaseUnit[^>]*/>\\s*</Unit>)?', _unknown_unit, ("not known", "blink")),
    "unit that is not what it says": (
        '(<Unit name="N\\*m">\\s*<BaseUnit[^>]*kg=")1',
        r"\g<1>2",
        ("N*m", "base units"),
    ),
    "fixed parameter": ('(name="R_a".*?)variability="tunable"', r'\1variability="fixed"', ("parameters.R_a", "fixed")),
}


@pytest.mark.parametrize("case", DESCRIPTIONS)
def test_a_description_that_does_not_fit_is_named(case: str, file: Path) -> None:
    old, new, parts = DESCRIPTIONS[case]
    path = file.parent / "motor.fmu"
    text = description_of(path)
    changed = re.sub(old, new, text)
    assert changed != text
    rewritten(path, lambda name, own: changed.encode() if name == DESCRIPTION else own)
    with raises_saying(ConfigurationError, "machine.toml", *parts):
        loaded(file)


def test_a_unit_that_is_not_known_is_that_of_its_base_units(file: Path) -> None:
    path = file.parent / "motor.fmu"
    text = description_of(path).replace('"rad/s"', '"per blink"')
    rewritten(path, lambda name, own: text.encode() if name == DESCRIPTION else own)
    assert loaded(file).twin.unit_of("omega") == "s^(-1)*rad^(1)"


# An FMU that does something while it is loaded, or computes what no twin can.
def _at_load(code: str) -> Callable[[str], str]:
    return lambda text: text.replace(
        "/* Compute all", f"__attribute__((constructor)) static void loaded(void) {{ {code} }}\n/* Compute all", 1
    )


def _in_equations(code: str) -> Callable[[str], str]:
    return lambda text: text.replace("(void)elapsed;", f"(void)elapsed; {code}", 1).replace(
        "v[4] = (", "v[4] = extra + (", 1
    )


CODE: dict[str, tuple[Callable[[str], str], tuple[str, ...]]] = {
    "crash": (_at_load("abort();"), ("SIGABRT",)),
    "end": (_at_load("exit(3);"), ("exit code 3",)),
    "hang": (_at_load("for (volatile int i = 1; i;) { }"), ("did not answer",)),
    "time": (_in_equations("const double extra = v[0];"), ("der(state.omega)", "time")),
    "memory": (_in_equations("static double extra; extra += 1.0;"), ("der(state.omega)", "before")),
    "no number": (_in_equations("const double extra = sqrt(-1.0 - v[1] * v[1]);"), ("no rates",)),
}


@pytest.mark.parametrize("case", often(["crash"], CODE))
def test_a_binary_that_cannot_be_used_is_refused(case: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    if case == "hang":
        monkeypatch.setattr(trial, "TIMEOUT", 8.0)
    change, parts = CODE[case]
    machine = loaded(write_machine(tmp_path, exported("dc_motor", changes={MODEL: change})))
    with pytest.raises(ConfigurationError) as caught:
        machine.try_fmu()
    assert_says(str(caught.value), "motor.fmu", *parts)
    assert len(str(caught.value).splitlines()) == 1


def _failing(text: str) -> str:
    return text.replace(
        "return copy(own, values, count, FIRST_RATE, STATES);",
        "if (((Instance *)own)->memory.variables[FIRST_STATE] > 1e6) { return fmi2Error; }\n"
        "    return copy(own, values, count, FIRST_RATE, STATES);",
    )


def test_after_an_error_another_instance_computes(tmp_path: Path) -> None:
    machine = loaded(write_machine(tmp_path, exported("dc_motor", changes={"sources/both_versions.h": _failing})))
    assert machine.twin.fmu is not None
    instance = instance_of(machine.twin.fmu)
    ordinary = np.array([[item.start for item in machine.twin.fmu.arguments]])
    failing = ordinary.copy()
    failing[0, 0] = 2e6
    before = instance.rows(ordinary)
    assert np.isnan(instance.rows(failing)).all()
    assert (instance.rows(ordinary) == before).all()


def test_nothing_of_it_runs_before_it_is_tried(tmp_path: Path) -> None:
    mark = tmp_path / "loaded"
    code = f'FILE *mark = fopen("{mark}", "a"); if (mark) {{ fputs("x", mark); fclose(mark); }}'
    machine = loaded(write_machine(tmp_path, exported("dc_motor", changes={MODEL: _at_load(code)})))
    assert not mark.exists()
    assert machine.try_fmu() is not None
    assert mark.read_text(encoding="ascii") == "x"  # in a process that has ended
    assert machine.try_fmu() is not None
    assert mark.read_text(encoding="ascii") == "x"  # what has passed is not tried again
    assert machine.twin.fmu is not None
    assert machine.twin.fmu.digest not in Path("/proc/self/maps").read_text(encoding="utf-8")


def test_a_file_that_was_changed_after_it_was_read_is_refused(tmp_path: Path) -> None:
    machine = loaded(write_machine(tmp_path, exported("dc_motor", changes={MODEL: lambda text: f"{text}\n"})))
    described(tmp_path / "motor.fmu", "a note", "another note")
    with raises_saying(ConfigurationError, "motor.fmu", "changed"):
        machine.try_fmu()


@pytest.mark.full
def test_a_position_has_the_speed_that_the_file_names(tmp_path: Path) -> None:
    """Without it the trial finds that they are the same."""
    path = write_machine(tmp_path, plain("servo_axis"), "servo_axis")
    position, speed = (row.name for row in loaded(path).twin.states)
    found = loaded(path).try_fmu()
    assert found is not None
    assert found.integrals == ((0, 1),)
    named = loaded(with_line(path, f'{position} = {{ variable = "state.{position}"',
                             f'{position} = {{ derivative = "{speed}", variable = "state.{position}"'))  # fmt: skip
    assert dict(named.twin.equations)[f"der({position})"] == speed
    assert named.try_fmu() is not None
    assert named.twin.fmu is not None
    with raises_saying(ConfigurationError, "motor.fmu", f"der(state.{speed})", "is not", position):
        try_fmu(replace(named.twin.fmu, integrals=((1, 0),)))
    with raises_saying(ConfigurationError, "machine.toml", f"der({speed})", "m/s^2"):
        loaded(with_line(path, f'variable = "state.{speed}"', f'derivative = "{position}", variable = "state.{speed}"'))
