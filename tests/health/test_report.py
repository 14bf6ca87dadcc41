"""The report: what is published can be read back, and no number in it is anything but finite."""

import json
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from otolith.acquisition.window import Verdict
from otolith.adaptation.information import Identifiability, ParameterEstimate
from otolith.health.report import ParameterDocument, QualityDocument, ReportDocument, Status, WindowDocument
from otolith.health.status import Known, publish
from otolith.twin.definition import Parameter

RESISTANCE = Parameter("R_a", "ohm", 6.5, 3.0, 12.0, "armature resistance")


def report(**parameters: ParameterDocument) -> ReportDocument:
    quality = QualityDocument(verdict=Verdict.GOOD, missing=0.0, longest_gap_s=0.0, jitter_s=0.0, skew_s=0.0)
    window = WindowDocument(index=0, start=1.0, end=3.0, records=200, quality=quality)
    return ReportDocument(machine="m", site="s", twin="dc_motor", window=window, parameters=parameters)


@given(
    st.floats(allow_nan=True, allow_infinity=True),
    st.floats(0.0) | st.just(math.nan),
    st.sampled_from(Identifiability),
    st.none() | st.builds(Known, st.floats(3.0, 12.0), st.floats(0.0, 1.0)),
)
def test_nothing_but_finite_numbers_is_published(
    value: float, sd: float, verdict: Identifiability, known: Known | None
) -> None:
    after, document = publish(RESISTANCE, ParameterEstimate("R_a", value, sd, verdict, "why"), known)
    text = report(R_a=document).to_json()
    assert ReportDocument.from_json(text).parameters["R_a"] == document
    assert not any(word in text for word in ("NaN", "Infinity"))
    assert after is None or math.isfinite(after.value)


def test_absent_is_absent_and_schema_is_named() -> None:
    _, document = publish(RESISTANCE, None, None, "window not estimated from: no samples of i")
    found = json.loads(report(R_a=document).to_json())
    assert found["schema"] == "otolith.report/1"
    assert "value" not in found["parameters"]["R_a"]
    assert found["parameters"]["R_a"]["status"] == "unestimated"
    assert "fit" not in found


def test_the_interval_is_two_sided_95_percent() -> None:
    estimate = ParameterEstimate("R_a", 6.0, 0.1, Identifiability.DETERMINED, "")
    _, document = publish(RESISTANCE, estimate, None)
    assert document.status is Status.ESTIMATED
    assert [document.low, document.high] == pytest.approx([5.804, 6.196], abs=1e-4)


def test_a_document_with_an_unknown_field_is_refused() -> None:
    text = report().to_json().replace('"machine"', '"machin"')
    with pytest.raises(ValidationError):
        ReportDocument.from_json(text)
