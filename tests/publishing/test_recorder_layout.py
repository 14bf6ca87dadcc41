"""The operator's tab of a recording: in words, as lanes, with limits. Each file has it from its first window on."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from otolith.health.limits import Level, Limit, MonitoredQuantity
from otolith.health.schema import CrossingDocument, ForecastDocument, Report, ReportDocument
from otolith.machine import load_machine
from otolith.publishing.recorder import Recording, limit_lines, near_values, operator_text
from otolith.publishing.recording_layout import layout_file
from otolith_drivers.base import Sampling
from tests.conftest import EXAMPLES
from tests.publishing.test_events import documents
from tests.publishing.test_recording_size import BEGIN, LENGTH, noise, rows


def at(level: Level) -> ReportDocument:
    return next(document for document in documents() if document.health and document.health.state is level)


def test_the_text_has_state_what_since_when_how_sure_and_what_to_do() -> None:
    text = operator_text(at(Level.ACT))
    assert text.startswith("# ACT\n\n## winding: short circuit between turns of the winding\nsince ")
    assert text.count("ACT") == text.count("since ") == 1
    for part in (
        "R_a is 5.800 ± 0.020 Ω",
        "% probability)",
        "**What to do: plan a replacement of the winding",
    ):
        assert part in text
    assert operator_text(documents()[0]).startswith("# OK\nsince ")


def test_a_forecast_that_is_not_announced_is_no_matter_of_the_operator() -> None:
    """Each slope of a load cycle has one."""
    document = documents()[0]
    end = document.window.end
    forecast = ForecastDocument(
        computed=end, watch=CrossingDocument(limit=6.3, at=end + 80.0, low=end + 70.0, high=end + 90.0)
    )
    parameters = {"R_a": document.parameters["R_a"].model_copy(update={"forecast": forecast})}
    text = operator_text(document.model_copy(update={"parameters": parameters}))
    assert text.startswith("# OK\nsince ")
    assert "reaches WATCH" not in text


def test_text_of_a_machine_is_no_markdown() -> None:
    document = at(Level.ACT)
    event = document.events[0].model_copy(update={"text": "0.005 N*m, [now] 5 N*m | <b> &lt;", "advice": "`a`"})
    text = operator_text(document.model_copy(update={"events": (event,)}))
    assert r"0.005 N\*m, \[now\] 5 N\*m \| \<b\> \&lt;" in text
    assert r"\`a\`**" in text


@pytest.fixture
def recorded(tmp_path: Path) -> tuple[Path, Path]:
    """Two files; the second begins while the winding is at ACT."""
    machine = load_machine(EXAMPLES / "dc-motor.toml", with_driver=False)
    paths = tmp_path / "first.rrd", tmp_path / "second.rrd"
    recording = Recording(paths[0], machine.recorded(Sampling.TRUE))
    for document, one in zip(documents(), noise(21), strict=True):
        if document.window.index == 14:
            recording.open(paths[1])
        changed = document.model_copy(update={"window": one.document.window})
        recording.add(Report(changed, one.traces))
    recording.close()
    return paths


def test_lanes_change_with_the_state_and_begin_each_file(recorded: tuple[Path, Path]) -> None:
    lanes = [[state[0] for state in rows(path, "/state/winding", "StateChange:state")[1]] for path in recorded]
    assert lanes == [["OK", "WATCH", "ACT"], ["ACT", "OK"]]
    begin = rows(recorded[1], "/state/whole_machine", "StateChange:state")[0][0]
    assert begin == round((BEGIN + 15 * LENGTH) * 1e9)
    shown = [text[0].split("\n")[0] for text in rows(recorded[1], "/operator", "TextDocument:text")[1]]
    assert (shown[0], shown[-1]) == ("# ACT", "# OK")


def test_events_are_on_change_only(recorded: tuple[Path, Path]) -> None:
    events = [text[0].partition(":")[0] for path in recorded[:1] for text in rows(path, "/events", "TextLog:text")[1]]
    assert events == ["WATCH", "ACT"]
    assert [text[0].partition(":")[0] for text in rows(recorded[1], "/events", "TextLog:text")[1]] == ["cleared"]


def test_each_parameter_has_nominal_value_and_near_limits_all_the_time(recorded: tuple[Path, Path]) -> None:
    """Far ones have no values, so that the legend does not name them; their names are the last."""
    times, values = rows(recorded[0], "/limits/R_a")
    assert len(times) == 14
    assert np.unique(np.array(values), axis=0) == pytest.approx(np.array([[6.5, 6.37, 6.175]]))
    plan = load_machine(EXAMPLES / "dc-motor.toml", with_driver=False).plan
    names = [name for name, _, _ in limit_lines(plan.parameters["R_a"], plan.texts)]
    assert names == ["nominal 6.5 Ω", "WATCH 6.37 Ω", "ACT 6.175 Ω", "WATCH 9.425 Ω", "ACT 10.725 Ω"]


def test_a_far_limit_is_shown_to_a_value_near_it() -> None:
    limits = tuple(Limit(Level.WATCH, value, value < 6.5) for value in (6.37, 8.125))
    quantity = MonitoredQuantity(nominal=6.5, limits=limits)
    assert near_values(quantity, 6.5) == pytest.approx([6.5, 6.37, math.nan], nan_ok=True)
    assert near_values(quantity, 7.4) == pytest.approx([6.5, 6.37, 8.125])


def test_alike_machines_share_a_layout_and_others_have_their_own() -> None:
    """Rerun keeps threads and memory of each layout that it writes; a hall has hundreds of machines."""
    machine = load_machine(EXAMPLES / "dc-motor.toml", with_driver=False).recorded(Sampling.TRUE)
    other = load_machine(EXAMPLES / "pump-vfd.toml", with_driver=False).recorded(Sampling.TRUE)
    assert layout_file(machine) == layout_file(replace(machine, title="another")) != layout_file(other)
