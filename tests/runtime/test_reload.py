"""A changed machine file: what a running daemon takes over, and what it names."""

from dataclasses import replace
from pathlib import Path

import pytest

from otolith.adaptation.fingerprints import fingerprint_of
from otolith.adaptation.state import with_problem
from otolith.health.prognosis import Baseline
from otolith.health.schema import EventChange
from otolith.machine import load_machine
from otolith.runtime.hall.changes import changes_of_one
from otolith.runtime.service import Reload, Service, reloaded
from otolith.storage.state_store import store_of
from otolith_drivers.errors import ConfigurationError
from tests.conftest import EXAMPLES
from tests.messages import assert_says

TEXT = """[machine]
name = "motor"
[twin]
name = "dc_motor"
[parameters]
R_a = { value = "6.5 ohm", estimate = true, act = "+40 %" }
[recording]
enabled = false
"""


def change(folder: Path, before: str, after: str) -> Reload:
    (folder / "machine.toml").write_text(TEXT, encoding="utf-8")
    running = load_machine(folder / "machine.toml", with_driver=False)
    assert before in TEXT
    (folder / "machine.toml").write_text(TEXT.replace(before, after), encoding="utf-8")
    return reloaded(running, load_machine(folder / "machine.toml", with_driver=False))


def test_limits_recording_and_outlets_change(tmp_path: Path) -> None:
    result = change(tmp_path, '"+40 %"', '"+60 %"')
    assert (result.limits, result.recording, result.needs_restart) == (True, False, ())
    assert any(limit.value == pytest.approx(6.5 * 1.6) for limit in result.machine.plan.parameters["R_a"].limits)
    rule = '[[rule]]\nid = "x"\nfinding = "limit"\ncondition = "c"\ncause = "c"\nadvice = "a"\n[recording]'
    result = change(tmp_path, "[recording]", rule)
    assert (result.limits, result.recording, result.needs_restart) == (True, False, ())
    assert result.machine.plan.rules[0].id == "x"
    result = change(tmp_path, "enabled = false", "enabled = true")
    assert (result.limits, result.recording, result.needs_restart) == (False, True, ())
    assert result.machine.file.recording.enabled
    assert result.text.endswith("reloaded, recording changed")
    result = change(tmp_path, "[recording]", '[outlets.prometheus]\nlisten = "127.0.0.1:9000"\n[recording]')
    assert (result.outlets, result.needs_restart) == (True, ())
    assert result.machine.file.outlets.names == ("prometheus",)


def test_readers_and_certificates_change_but_not_endpoints(tmp_path: Path) -> None:
    access = '[zenoh.tls]\nca = "a"\ncertificate = "b"\nkey = "c"\n[zenoh.access]\nreaders = ["x"]\n[recording]'
    result = change(tmp_path, "[recording]", access)
    assert (result.access, result.needs_restart) == (True, ())
    zenoh = result.machine.file.zenoh
    assert zenoh.tls is not None
    assert (zenoh.access.readers, zenoh.tls.certificate) == (("x",), Path("b"))
    result = change(tmp_path, "[recording]", '[zenoh]\nconnect = ["tcp/127.0.0.1:7447"]\n[recording]')
    assert (result.access, result.needs_restart) == (False, ("zenoh.connect",))
    assert result.machine.file.zenoh.connect == ()


@pytest.mark.parametrize(
    ("before", "after", "keys"),
    [
        ('name = "motor"', 'name = "other"', ("machine.name",)),
        ('"6.5 ohm"', '"7 ohm"', ("parameters.R_a.value",)),
        ('"6.5 ohm", estimate = true, act = "+40 %"', '"7 ohm", estimate = true, act = "+60 %"',
         ("parameters.R_a.value", "parameters.R_a.act")),
        ("[recording]", '[window]\nlength = "4 s"\n[recording]', ("window.length",)),
    ],
)  # fmt: skip
def test_all_else_needs_a_restart(tmp_path: Path, before: str, after: str, keys: tuple[str, ...]) -> None:
    result = change(tmp_path, before, after)
    assert (result.limits, result.recording, result.needs_restart) == (False, False, keys)
    assert result.machine.file.parameters["R_a"].value == "6.5 ohm"
    assert f"only a restart takes over {', '.join(keys)}" in result.text


@pytest.mark.parametrize(("key", "value"), [("language", "de"), ("timezone", "Europe/Berlin")])
def test_limits_wait_for_a_restart_with_the_language_or_the_zone_of_their_texts(
    tmp_path: Path, key: str, value: str
) -> None:
    (tmp_path / "machine.toml").write_text(TEXT, encoding="utf-8")
    running = load_machine(tmp_path / "machine.toml", with_driver=False)
    text = TEXT.replace('"+40 %"', '"+60 %"').replace('name = "motor"', f'name = "motor"\n{key} = "{value}"')
    (tmp_path / "machine.toml").write_text(text, encoding="utf-8")
    result = reloaded(running, load_machine(tmp_path / "machine.toml", with_driver=False))
    assert result.needs_restart == (f"machine.{key}", "parameters.R_a.act")
    assert result.machine.plan == running.plan


def test_a_file_that_vanishes_during_a_reload_does_not_end_the_daemon(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    service = Service(load_machine(EXAMPLES / "dc-motor-in-process.toml"))

    def vanished(_: object) -> dict[str, str]:
        raise ConfigurationError("dc-motor-in-process.toml: no such file")

    monkeypatch.setattr("otolith.runtime.service.files_of", vanished)
    changes = changes_of_one(service)
    assert not changes.revised
    ((kept, reason),) = changes.kept
    kept.refuse(reason)
    assert "not reloaded, the daemon goes on as before: dc-motor-in-process.toml: no such file" in caplog.text


def test_limits_that_are_reloaded_still_refer_to_the_baselines(tmp_path: Path) -> None:
    text = (EXAMPLES / "dc-motor-in-process.toml").read_text(encoding="utf-8")
    text = text.replace('"scenarios/', f'"{EXAMPLES}/scenarios/')
    path = tmp_path / "motor.toml"
    path.write_text(text, encoding="utf-8")
    service = Service(load_machine(path))
    store = store_of(service._loaded)
    store.operator.write(replace(store.decisions(), baselines={"R_a": Baseline(6.1, 0.01, 50, 1.0)}))
    path.write_text(text.replace('"+65 %"', '"+80 %"'), encoding="utf-8")
    service.take_over(service.revision(load_machine(path)))
    limited = service.machine.next_state().plan.parameters["R_a"]
    assert (limited.nominal, limited.has_baseline) == (6.1, True)
    assert max(limit.value for limit in limited.limits) == pytest.approx(1.8 * 6.1)


def test_a_decision_during_a_reload_is_not_undone(tmp_path: Path) -> None:
    """The files of a large hall are read for seconds: a baseline that is found meanwhile still counts afterwards."""
    text = (EXAMPLES / "dc-motor-in-process.toml").read_text(encoding="utf-8")
    text = text.replace('"scenarios/', f'"{EXAMPLES}/scenarios/')
    path = tmp_path / "motor.toml"
    path.write_text(text, encoding="utf-8")
    service = Service(load_machine(path))
    service.machine.begin(0.0)
    store = store_of(service._loaded)
    path.write_text(text.replace('"+65 %"', '"+80 %"'), encoding="utf-8")
    revision = service.revision(load_machine(path))
    store.operator.write(replace(store.decisions(), baselines={"R_a": Baseline(6.1, 0.01, 50, 1.0)}))
    service._writer.read()
    service.take(1.0)
    service.take_over(revision)
    limited = service.machine.next_state().plan.parameters["R_a"]
    assert (limited.nominal, limited.has_baseline) == (6.1, True)
    assert max(limit.value for limit in limited.limits) == pytest.approx(1.8 * 6.1)


def test_a_baseline_of_other_values_waits_for_a_restart_and_is_a_hint(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Until then limits refer to what the daemon estimates with the values of its start."""
    text = (EXAMPLES / "dc-motor-in-process.toml").read_text(encoding="utf-8")
    text = text.replace('"scenarios/', f'"{EXAMPLES}/scenarios/')
    path = tmp_path / "motor.toml"
    path.write_text(text, encoding="utf-8")
    service = Service(load_machine(path))
    service._started_at = 1.0
    path.write_text(text.replace("[parameters]", '[parameters]\nL_a = "0.2 H"'), encoding="utf-8")
    new = load_machine(path)
    assert new.problem.known != service._loaded.problem.known
    store = store_of(service._loaded)
    found = Baseline(3.1, 0.01, 50, 1.0, fingerprint_of(new.problem))
    store.operator.write(replace(store.decisions(), baselines={"R_a": found}))
    for _ in range(2):  # a note of a person comes later
        after = service._decided(service.machine.state, store.decisions())
        assert after.plan.parameters == service._loaded.plan.parameters
    (event,) = service._noted
    assert (event.is_hint, event.change) == (True, EventChange.NOTED)
    assert_says(event.text, "R_a", "restart", str(path))
    assert caplog.text.count(event.text) == 1
    restarted = Service(new)
    state = restarted._decided(restarted.machine.state, store.decisions())
    assert (state.plan.parameters["R_a"].nominal, restarted._noted) == (3.1, ())
    path.write_text(text, encoding="utf-8")
    back = Service(load_machine(path))
    assert back._decided(back.machine.state, store.decisions()).plan.parameters == back._loaded.plan.parameters
    assert_says(back._noted[0].text, "R_a", f"otolith commission {path}")


@pytest.mark.parametrize(("declared", "left"), [("", ("V_a",)), (', times = "polled"', ())])
def test_a_command_that_was_found_to_change_unseen_and_is_declared_so_needs_no_advice(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, declared: str, left: tuple[str, ...]
) -> None:
    text = (EXAMPLES / "dc-motor-in-process.toml").read_text(encoding="utf-8")
    path = tmp_path / "motor.toml"
    text = text.replace('"scenarios/', f'"{EXAMPLES}/scenarios/').replace('Voltage"', f'Voltage"{declared}')
    path.write_text(text, encoding="utf-8")
    service = Service(load_machine(path))
    state = service.machine.state
    learned = with_problem(state, replace(state.problem, changing=("V_a",)))
    monkeypatch.setattr(service._store, "restore", lambda *_: (learned, ""))
    assert service._restored(state).problem.changing == left
