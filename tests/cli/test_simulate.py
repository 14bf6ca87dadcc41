"""``otolith simulate`` and the API for notebooks: tables, page and JSON agree, and each wrong input gets one line."""

import csv
import json
import math
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import click
import numpy as np
import pyarrow.parquet as pq
import pytest

from otolith import Twin, notebook
from otolith.adaptation.state import AdaptationState, OperatorDecisions
from otolith.machine import load_machine
from otolith.runtime import simulation_inputs
from otolith.storage.history import HOUR, history_directory
from otolith.storage.log_history import log_history
from otolith.storage.state_store import store_of
from otolith_drivers.errors import ConfigurationError
from tests.cli.commands import otolith
from tests.messages import assert_says, raises_saying
from tests.simulation.recorded_motor import PLAN, learned, save_learned, write_files
from tests.storage.histories import document

FILES = "monday.csv", "tuesday.csv"


@pytest.fixture
def machine(tmp_path: Path) -> Path:
    file = write_files(tmp_path)
    save_learned(file)
    return file


def test_table_parquet_and_json_have_the_same_numbers(machine: Path) -> None:
    plan, table, parquet = (machine.with_name(name) for name in ("plan.csv", "out.csv", "out.parquet"))
    wanted = ("--csv", table, "--parquet", parquet, "--json", "--seed", 5)
    document = json.loads(otolith("simulate", machine, "--inputs", plan, *wanted).stdout)
    with table.open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    columns = pq.read_table(parquet).to_pydict()
    speed = document["outputs"]["omega"]
    assert document["schema"] == "otolith.simulation/1"
    assert len(document["t"]) == len(rows) == 251
    for key, curve in (("omega [rad/s]", "value"), ("omega low [rad/s]", "low"), ("omega high [rad/s]", "high")):
        assert [float(row[key]) for row in rows] == columns[key] == speed[curve]
    assert all(map(math.isfinite, speed["low"]))
    assert columns["T_load [N*m]"][0] == pytest.approx(0.02)
    assert columns["V_a [V]"][99:101] == [12.0, 24.0]


@pytest.mark.parametrize("language", ["en", "de"])
def test_the_page_shows_outputs_with_bands_and_inputs(machine: Path, language: str) -> None:
    """In each language the points of a curve have decimal points."""
    text = machine.read_text(encoding="utf-8")
    machine.write_text(text.replace("[machine]", f'[machine]\nlanguage = "{language}"'), encoding="utf-8")
    page = machine.with_name("out.html")
    text = otolith("simulate", machine, "--inputs", machine.with_name("tuesday.csv"), "--report", page).stdout
    content = page.read_text(encoding="utf-8")
    assert content.count("<polygon") == 2
    assert content.count("<svg") == 4
    points = re.findall(r'points="([^"]*)"', content)
    assert len(points) == 8
    for curve in points:
        numbers = [tuple(map(float, pair.split(","))) for pair in curve.split(" ")]
        assert all(len(pair) == 2 and 0.0 <= min(pair) <= max(pair) <= 100.0 for pair in numbers)
    assert "nan" not in content.lower().replace("nano", "")
    assert len(content) < 300_000
    assert_says(text, "omega", "rad/s", "%")


def test_a_recording_is_predicted_after_its_first_window(machine: Path) -> None:
    predicted = Twin.load(machine).simulate(machine.with_name("tuesday.csv"))
    assert predicted.times[0] == pytest.approx(7.99)
    sd = (predicted.high - predicted.low) / (2.0 * 1.96)
    deviates = (predicted.measured - predicted.values) / sd
    assert np.sqrt(np.mean(deviates**2, axis=0)) == pytest.approx(1.0, abs=0.3)
    for name in predicted.outputs:
        assert 0.9 < (predicted.coverage(name) or 0.0) <= 1.0


@pytest.mark.parametrize(
    ("gaps", "begin", "end"), [((200,), 6.99, 12.99), ((400,), 1.99, 3.99), ((200, 600), 6.99, 8.99)]
)
def test_a_recording_is_predicted_up_to_a_gap_which_is_told(
    machine: Path, gaps: tuple[int, ...], begin: float, end: float
) -> None:
    """A window that no other one follows, as before the first gap, is none to begin with."""
    monday, tuesday = (machine.with_name(name).read_text(encoding="utf-8").split() for name in FILES)
    cells = [row.split(",") for row in (*monday[1:], *tuesday[1:])][:1000]
    moved = [[f"{float(row[0]) + 3.0 * sum(at >= gap for gap in gaps):.3f}", *row[1:]] for at, row in enumerate(cells)]
    data = machine.with_name("gap.csv")
    data.write_text("\n".join([monday[0], *map(",".join, moved)]) + "\n", encoding="utf-8")
    table = machine.with_name("out.csv")
    told = otolith("simulate", machine, "--inputs", data, "--csv", table).stderr
    with table.open(encoding="utf-8") as file:
        times = [float(row["t [s]"]) for row in csv.DictReader(file)]
    assert (times[0], times[-1]) == pytest.approx((begin, end))
    assert ("not predicted" in told) == (end < float(moved[-1][0]) - 1.0)


def test_an_input_that_is_missing_for_a_window_is_told(machine: Path) -> None:
    rows = machine.with_name("tuesday.csv").read_text(encoding="utf-8").split()
    cells = [row.split(",") for row in rows]
    for row in cells[201:401]:
        row[2] = ""
    machine.with_name("tuesday.csv").write_text("\n".join(map(",".join, cells)) + "\n", encoding="utf-8")
    told = otolith("simulate", machine, "--inputs", machine.with_name("tuesday.csv")).stderr
    assert_says(told, "tuesday.csv", "1", "T_load", "bands")


def test_a_recording_that_contradicts_what_was_learned_is_predicted_nevertheless(machine: Path) -> None:
    """As one of a time before the machine has changed: its first window shows the state, and changes no parameter."""
    state = learned(machine)
    moved = state.posterior.reset_value(0, 6.0, 0.003)
    store_of(load_machine(machine, with_driver=False)).save(replace(state, posterior=moved))
    twin = Twin.load(machine)
    assert twin.parameters[0].value == pytest.approx(6.0)
    predicted = twin.simulate(machine.with_name("monday.csv"))
    assert predicted.records == 401
    assert (predicted.coverage("omega") or 0.0) < 0.5


def test_what_is_supposed_changes_the_prediction(machine: Path) -> None:
    twin = Twin.load(machine)
    limit, higher = twin.at_limit(), twin.with_value("R_a", "7000 mohm")
    assert limit.parameters[0].value == pytest.approx(0.95 * 6.5)
    assert_says(str(limit), "R_a", "ACT")
    slow, now = (each.simulate(machine.with_name("plan.csv")) for each in (higher, twin))
    assert slow.values[-1, 1] < now.values[-1, 1] - 1.0
    measured = higher.simulate(machine.with_name("tuesday.csv"))
    assert (measured.rmse("omega") or 0.0) > 0.1
    assert twin.supposed == ()


@pytest.mark.parametrize("value", [5.92, 6.1, 6.3])
def test_a_value_that_is_supposed_is_exact_also_beside_a_recording(machine: Path, value: float) -> None:
    """Also where the modes of the filter, each with this value, have a mean that rounding makes another one."""
    supposed = Twin.load(machine).with_value("R_a", value)
    assert (supposed.parameters[0].value, supposed.parameters[0].sd) == (value, 0.0)
    assert not supposed.parameters[0].is_estimated
    predicted = supposed.simulate(machine.with_name("tuesday.csv"))
    assert (predicted.rmse("omega") or 0.0) > 0.1
    assert 0.0 <= (predicted.coverage("omega") or 0.0) < 0.9


def test_the_values_of_an_earlier_time_come_from_the_history(machine: Path) -> None:
    names, begin = load_machine(machine, with_driver=False).file.machine, 1_700_000_000.0
    with log_history(history_directory(), names.site, names.name) as history:
        for index, value in enumerate((6.4, 6.3)):
            report = document(index, begin + 3600.0 * index, value)
            history.add(report.model_copy(update={"machine": names.name, "site": names.site}))
        history.describe("{}")
    then = Twin.load(machine).at(begin + 60.0)
    assert then.parameters[0].value == pytest.approx(6.4)
    assert then.parameters[0].sd == pytest.approx(0.01, rel=0.05)
    assert then.simulate(machine.with_name("plan.csv")).records == 251
    with raises_saying(ConfigurationError, "R_a", "history"):
        Twin.load(machine).at(begin - 100_000.0)


def test_a_plan_that_is_too_long_is_not_read_to_its_end(machine: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What is wrong behind the bound is not seen."""
    plan = machine.with_name("long.csv")
    rows = [f"{0.01 * index:.2f},12,20" for index in range(40_000)]
    plan.write_text("\n".join(["t,V_a [V],T_load [mN*m]", *rows, "no,number,here"]) + "\n", encoding="utf-8")
    monkeypatch.setattr(simulation_inputs, "MAX_RECORDS", 10_000)
    with raises_saying(ConfigurationError, str(plan), "10000", "shorten"):
        Twin.load(machine).simulate(plan)


@pytest.mark.parametrize(("after", "value"), [(300.0, 6.3), (3300.0, 6.2)])
def test_of_an_hour_the_value_that_is_nearest_counts(
    machine: Path, monkeypatch: pytest.MonkeyPatch, after: float, value: float
) -> None:
    """The history has that of the end of each hour, where it has no minutes any more."""
    names, begin = load_machine(machine, with_driver=False).file.machine, 472_222 * 3600.0
    with log_history(history_directory(), names.site, names.name) as history:
        for hour in range(4):
            report = document(hour, begin + 3600.0 * hour + 3590.0, 6.4 - 0.1 * hour)
            history.add(report.model_copy(update={"machine": names.name, "site": names.site}))
        history.describe("{}")
    monkeypatch.setattr(notebook, "RESOLUTIONS", {HOUR: "hour"})
    then = Twin.load(machine).at(begin + 7200.0 + after)
    assert then.parameters[0].value == pytest.approx(value)


def test_residuals_of_a_recording_that_is_explained_are_noise(machine: Path) -> None:
    residuals = Twin.load(machine).residuals(machine.with_name("tuesday.csv"))
    assert residuals.rms() == pytest.approx({"i": 1.0, "omega": 1.0}, abs=0.15)
    np.testing.assert_allclose(residuals.values, residuals.measured - residuals.predicted)


def test_loading_a_twin_changes_no_file(machine: Path, tmp_path: Path) -> None:
    files = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    twin = Twin.load(machine)
    assert isinstance(twin.learned, AdaptationState)
    assert twin.time == pytest.approx(5.99)
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == files


@pytest.mark.parametrize(
    ("plan", "options", "parts"),
    [
        ("t,V_a\n0,1\n1,2\n", (), ("plan.csv", "T_load")),
        (PLAN.replace("[V]", "[A]"), (), ("plan.csv", "V_a", "A")),
        (PLAN.replace("1,24", "1,"), (), ("plan.csv:3", "V_a", "V")),
        (PLAN.replace("1,24", "1,nan"), (), ("plan.csv:3", "V_a", "V")),
        (PLAN.replace("1,24", "1,high"), (), ("plan.csv", "line 3", "V_a", "high")),
        (PLAN.replace("2.5,24", "0.5,24"), (), ("plan.csv:4", "0.5", "1")),
        (PLAN.replace("2.5,24", "1,24"), (), ("plan.csv:4", "t = 1 s")),
        ("t,V_a,T_load\n0,12,0\n", (), ("plan.csv", "one row")),
        ("t,V_a,T_load\n0,12,0\n1e6,12,0\n", (), ("plan.csv", "1000000")),
        (PLAN, ("--set", "R_x=5"), ("R_x", "R_a")),
        ("t,V_a,V_a,T_load\n0,1,2,0\n1,1,2,0\n", (), ("plan.csv:1", "second column V_a")),
        ("t,V_a,T_load\n0,12,0\n1,1e300,0\n", (), ("plan.csv:3", "V_a", "so large")),
        ("t,V_a,T_load\n0,12,0\n1,inf,0\n", (), ("plan.csv", "line 3", "V_a", "inf")),
        ("t,V_a,T_load\n0,12,0\nnan,12,0\n2,12,0\n", (), ("plan.csv", "line 3", "t")),
        ("t,V_a,T_load\n0,12,0\n1,12\n2,12,0,5\n", (), ("plan.csv", "line 3", "2 cells", "3 columns")),
        ("t [m],V_a,T_load\n0,12,0\n1,12,0\n", (), ("plan.csv:1", "'m'", "'s'")),
        ("t,V_a,T_load\n", (), ("plan.csv", "no rows")),
        ("", (), ("plan.csv", "empty")),
        ("0,12,0\n1,12,0\n", (), ("plan.csv:1", "header", "V_a")),
        ("\0\1\2\3", (), ("plan.csv", "not text")),
        (PLAN, ("--set", "R_a=inf"), ("R_a=inf", "12 ohm")),
        (PLAN, ("--set", "R_a=5,2"), ("R_a=5,2", "point")),
        (PLAN, ("--set", "R_a=5", "--until-limit"), ("R_a=5", "--until-limit")),
        (PLAN, ("--set", "R_a=5 V"), ("R_a=5 V", "ohm")),
        (PLAN, ("--set", "R_a=500"), ("R_a=500", "12 ohm")),
        (PLAN, ("--without", "shaft/periodic"), ("shaft/periodic", "none")),
        (PLAN, ("--span", "0..1"), ("plan.csv", "span")),
    ],
)
def test_a_wrong_input_gets_one_line(
    machine: Path, plan: str, options: tuple[str, ...], parts: tuple[str, ...]
) -> None:
    machine.with_name("plan.csv").write_text(plan, encoding="utf-8")
    with pytest.raises(ConfigurationError) as caught:
        otolith("simulate", machine, "--inputs", machine.with_name("plan.csv"), *options)
    assert_says(str(caught.value), *parts)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "content",
    [
        ("\ufeff" + PLAN).encode(),
        PLAN.encode("utf-16"),
        PLAN.replace("\n", "\r\n").encode(),
        PLAN.replace(",", ";").replace("2.5", "2,5").encode(),
        PLAN.replace(",", "\t").replace("2.5", "2,5").encode(),
    ],
)
def test_each_form_of_a_table_is_the_same_plan(machine: Path, content: bytes) -> None:
    other, plan = machine.with_name("other.csv"), machine.with_name("plan.csv")
    other.write_bytes(content)
    twin = Twin.load(machine)
    np.testing.assert_array_equal(twin.simulate(other).values, twin.simulate(plan).values)


def test_without_a_state_nothing_is_predicted(tmp_path: Path) -> None:
    machine = write_files(tmp_path)
    with raises_saying(ConfigurationError, "plan.csv", "window", "daemon"):
        otolith("simulate", machine, "--inputs", machine.with_name("plan.csv"))
    with raises_saying(ConfigurationError, "R_a", "estimates"):
        otolith("simulate", machine, "--inputs", machine.with_name("plan.csv"), "--until-limit")


def test_what_cannot_be_used_any_more_does_not_matter_where_a_recording_is_adapted_to(machine: Path) -> None:
    """As after a change of the noise in the machine file, or of a damaged file."""
    plan, monday = machine.with_name("plan.csv"), machine.with_name("monday.csv")
    text = machine.read_text(encoding="utf-8")
    machine.write_text(text.replace('i = "5 mA"', 'i = "6 mA"'), encoding="utf-8")
    with raises_saying(ConfigurationError, "noise", "--after"):
        otolith("simulate", machine, "--inputs", plan)
    assert_says(otolith("simulate", machine, "--inputs", plan, "--after", monday).stdout, "251 records")
    assert "model" in otolith("twin", "export", machine, "--modelica", "--after", monday).stdout


def test_what_is_rejected_is_not_adapted_to_either(machine: Path) -> None:
    """As in a replay of the same recording."""
    key, store = "shaft/periodic/angle(omega)", store_of(load_machine(machine, with_driver=False))
    assert key not in Twin.fresh(machine).adapted(machine.with_name("monday.csv")).posterior.problem.excluded
    with store.locked():
        store.operator.write(OperatorDecisions(rejected=frozenset({key})))
    assert key in Twin.fresh(machine).adapted(machine.with_name("monday.csv")).posterior.problem.excluded


def test_options_that_exclude_each_other_are_a_usage_error(machine: Path) -> None:
    plan = machine.with_name("plan.csv")
    wrong: list[tuple[object, ...]] = [
        (),
        ("--inputs", plan, "--json", "--csv", "-"),
        ("--inputs", plan, "--at", "1d", "--after", plan),
        ("--inputs", plan, "--set", "R_a=5", "--set", "R_a=6"),
        ("--inputs", plan, "--set", "R_a="),
        ("--inputs", plan, "--csv", plan),  # it exists
        ("--inputs", plan, "--csv", plan.parent / "nowhere" / "out.csv"),
        ("--inputs", plan, "--parquet", plan.parent),
        ("--inputs", plan.parent),
    ]
    for options in wrong:
        with pytest.raises(click.UsageError):
            otolith("simulate", machine, *options)


def test_a_span_of_which_nothing_was_recorded_is_named(machine: Path) -> None:
    with raises_saying(ConfigurationError, "dc-motor", "2026-01-31", "there is none"):
        otolith("simulate", machine, "--span", "2026-01-31T10:00..2026-01-31T10:05")


def test_a_file_that_is_not_there_is_named(machine: Path) -> None:
    with raises_saying(ConfigurationError, "nowhere.csv"):
        otolith("simulate", machine, "--inputs", machine.with_name("nowhere.csv"))


def test_a_name_that_otolith_does_not_have_is_an_attribute_error() -> None:
    program = "import otolith, sys; assert not {'numpy', 'numba', 'pydantic'} & set(sys.modules); otolith.Twins"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert "AttributeError" in done.stderr
    assert "Twins" in done.stderr
