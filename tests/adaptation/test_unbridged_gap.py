"""A window is refused for a gap only if the gap is what makes it useless, and the reason names it."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from benchmarks.sampling.measure import replayed
from benchmarks.sampling.plant import Motor
from benchmarks.sampling.schedules import Recording, Samples, Schedule, Timing, record

from otolith.discovery.alternatives import ACCEPTED, WindowDecision
from otolith.health.schema import ReportDocument
from otolith.machine import load_machine

START, LENGTH = 4.04, 1.92  # s: of the gap, in the third window


def without(recording: Recording, name: str) -> Recording:
    """Return the recording without the samples of one signal during the gap."""
    sample = recording.samples[name]
    kept = (sample.times < START) | (sample.times >= START + LENGTH)
    rest = Samples(*(getattr(sample, key)[kept] for key in ("times", "values", "stated", "fresh")))
    return replace(recording, samples=recording.samples | {name: rest})


ONLY_RESISTANCE = """
[machine]
name = "motor"
[twin]
name = "dc_motor"
[parameters]
R_a = { value = "6.5 ohm", estimate = true }
D = "0.00143 N*m*s/rad"
J = "0.001171 kg*m^2"
[signals]
V_a = { on_change = false }
[noise]
i = "5 mA"
omega = "0.02 rad/s"
T_load = "0.2 mN*m"
[estimation]
determined_within = "0.5 %"
"""


def reports(folder: Path, missing: str) -> list[ReportDocument]:
    schedule = Schedule(rows=Timing(0.01), voltage="sine", load="walk", load_noise=True)
    recording = without(record(schedule, Motor(), 11.0, np.random.default_rng(3)), missing)
    (folder / "log.csv").write_text(recording.table(), encoding="utf-8")
    (folder / "machine.toml").write_text(ONLY_RESISTANCE, encoding="utf-8")
    return replayed(load_machine(folder / "machine.toml", with_driver=False), folder / "log.csv")


def test_a_gap_of_the_voltage_is_named_with_time_length_and_remedy(tmp_path: Path) -> None:
    documents = reports(tmp_path, "V_a")
    refused = documents[2]
    assert refused.decision is WindowDecision.BAD
    reason = refused.parameters["R_a"].reason
    assert f"V_a has no sample for {LENGTH} s from t = {START} s" in reason
    assert "look at its source" in reason
    assert all(document.decision in ACCEPTED for index, document in enumerate(documents) if index != 2)


@pytest.mark.parametrize("output", ["i", "omega"])
def test_a_gap_of_an_output_costs_information_only(tmp_path: Path, output: str) -> None:
    documents = reports(tmp_path, output)
    assert all(document.decision in ACCEPTED for document in documents)
    gap, whole = documents[2].parameters["R_a"].raw_sd, documents[1].parameters["R_a"].raw_sd
    assert gap is not None
    assert whole is not None
    assert gap > whole
