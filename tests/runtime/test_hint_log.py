"""A hint concerns the specialist: it is in the log once, and calls nobody."""

import logging
from types import SimpleNamespace

import pytest

from otolith.health.schema import EventChange, EventDocument, FindingKind
from otolith.machine import load_machine
from otolith.runtime.service import Service
from tests.conftest import EXAMPLES
from tests.health.test_events import assessed
from tests.health.test_hints import SETTING, late, with_finding


@pytest.mark.parametrize(
    ("kind", "level", "calls"), [(FindingKind.TIMING, "INFO", 0), (FindingKind.SENSOR, "ERROR", 1)]
)
def test_a_hint_starts_no_command(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, kind: FindingKind, level: str, calls: int
) -> None:
    service, called = Service(load_machine(EXAMPLES / "dc-motor-in-process.toml")), list[EventDocument]()
    monkeypatch.setattr(service, "_command", SimpleNamespace(run=called.append))
    caplog.set_level(logging.INFO)
    for document in assessed(with_finding(late(0.0, kind), 0)):
        service._log(document, 0.0)
    (line,) = [record for record in caplog.records if SETTING in record.getMessage() and " since " in record.message]
    assert line.levelname == level
    assert [event.change for event in called] == [EventChange.RAISED] * calls
