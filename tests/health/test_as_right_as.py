"""An estimate that is only as right as a held value says so wherever it is shown, in words and as data."""

from io import StringIO
from pathlib import Path

import pytest
from rich.console import Console

from otolith.cli.commissioning.check import describe
from otolith.cli.commissioning.commission import _value_lines
from otolith.cli.commissioning.machine_lines import with_keys
from otolith.cli.replay import ReplaySummary
from otolith.commissioning.dependence import Dependence
from otolith.commissioning.value_search import OwnValue, OwnValues
from otolith.health.schema import HeldDocument, Language
from otolith.health.text import texts_in
from otolith.publishing.recorder import report_text
from otolith_drivers.errors import ConfigurationError
from tests.health.test_hints import shown as live_table
from tests.health.test_without_baseline import EXAMPLE, machine_of, shown
from tests.messages import assert_says, raises_saying
from tests.publishing.test_html_report import Page, shown_text, written
from tests.publishing.test_html_report import reports as history_reports

FLAG = '[parameters]\nR_a = { value = "4.9 ohm", estimate = true, as_right_as = ["K_e"] }\n'
HELD = "K_e = 38 mV·s/rad"


def test_what_commissioning_writes_is_told_in_the_terminal_in_the_file_and_by_the_check(tmp_path: Path) -> None:
    machine = machine_of(tmp_path, EXAMPLE)
    constant = OwnValue("K_e", 0.038, None, "not determined beside R_a")
    resistance = OwnValue("R_a", 4.9, 0.01, only_with=(Dependence("K_e", 0.038, -0.22),))
    lines, remarks = _value_lines(machine, OwnValues((resistance, constant), {}, 1.0, 6), Path("monday.csv"))
    (remark,) = (line for line in remarks if line.startswith("R_a"))
    assert_says(remark, "4.900 ± 0.020 Ω", HELD, "1 % more K_e", "0.22 % less R_a")
    text = with_keys(EXAMPLE, "parameters", lines)
    (line,) = (line for line in text.splitlines() if line.startswith("R_a"))
    assert_says(line.partition("#")[2], HELD, "0.22 % less R_a", "monday.csv")
    again = machine_of(tmp_path, text)
    assert again.file.parameters["R_a"].as_right_as == ("K_e",)
    (checked,) = (line for line in describe(again) if line.startswith("R_a"))
    assert_says(checked, HELD)


def test_a_value_that_is_known_depends_too(tmp_path: Path) -> None:
    """The inertia is not estimated by the daemon, so the line in the file has the value alone."""
    inertia = OwnValue("J", 2e-3, 1e-6, only_with=(Dependence("K_t", 0.038, 1.0),))
    lines, _ = _value_lines(machine_of(tmp_path, EXAMPLE), OwnValues((inertia,), {}, 1.0, 6), Path("a.csv"))
    machine = machine_of(tmp_path, with_keys(EXAMPLE, "parameters", lines))
    assert dict(machine.problem.known)["J"] == 2e-3
    (checked,) = (line for line in describe(machine) if line.startswith("J "))
    assert_says(checked, "K_t = 38 mN·m/A")


@pytest.mark.parametrize("language", ["en", "de"])
def test_every_screen_says_it(language: Language, tmp_path: Path) -> None:
    spoken = EXAMPLE.replace('"motor"', f'"motor"\nlanguage = "{language}"')
    report = shown(machine_of(tmp_path, spoken + FLAG).plan, R_a=4.9, D=1e-3)
    parameters = report.parameters
    assert parameters["R_a"].as_right_as == {"K_e": HeldDocument(value=0.038, unit="V*s/rad")}
    assert parameters["D"].as_right_as is None
    said = texts_in(language).translated(f"only as right as what is held: {HELD}")
    assert_says(report.to_json(), said)
    assert_says(report_text(report), said)
    assert_says(live_table(report, details=False), f"R_a: {texts_in(language).decimals(said)}")
    summary, console = ReplaySummary(), Console(file=StringIO(), width=120)
    summary.add(report)
    console.print(summary)
    assert isinstance(console.file, StringIO)
    assert_says(" ".join(console.file.getvalue().split()), texts_in(language).decimals(said))


def test_the_page_says_it_beside_the_curve(tmp_path: Path) -> None:
    report = shown(machine_of(tmp_path, EXAMPLE + FLAG).plan, R_a=4.9)
    own = {"R_a": report.parameters["R_a"]}
    rows = [row.model_copy(update={"parameters": own}) for row in history_reports(3)]
    assert_says(Page(shown_text(written(rows))).text, f"only as right as what is held: {HELD}")


def test_without_a_value_nothing_depends(tmp_path: Path) -> None:
    row = shown(machine_of(tmp_path, EXAMPLE + FLAG).plan, D=1e-3).parameters["R_a"]
    assert row.as_right_as is None
    assert HELD not in row.reason


def test_what_is_estimated_beside_it_is_not_held(tmp_path: Path) -> None:
    more = 'K_e = { value = "0.05 V*s/rad", estimate = true }\n'
    assert machine_of(tmp_path, EXAMPLE + FLAG + more).plan.held_with("R_a") == {}


def test_a_held_parameter_that_the_twin_does_not_have_is_an_error(tmp_path: Path) -> None:
    with raises_saying(ConfigurationError, "machine.toml", "parameters.R_a.as_right_as", "K_f"):
        machine_of(tmp_path, EXAMPLE + FLAG.replace("K_e", "K_f"))
