"""The report: what is published can be read back, and no number in it is anything but finite."""

import json
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from otolith.acquisition.window import Verdict
from otolith.discovery.decision import WindowDecision
from otolith.estimation.information import Identifiability, ParameterEstimate
from otolith.health.schema import ParameterDocument, QualityDocument, ReportDocument, Status, WindowDocument
from otolith.health.status import MarginalPosterior, PreviousStatus, WindowEvidence, publish
from otolith.twin.definition import Parameter

RESISTANCE = Parameter("R_a", "ohm", 6.5, 3.0, 12.0, "armature resistance")


def report(**parameters: ParameterDocument) -> ReportDocument:
    quality = QualityDocument(verdict=Verdict.GOOD, missing=0.0, longest_gap_s=0.0, jitter_s=0.0, skew_s=0.0)
    window = WindowDocument(index=0, start=1.0, end=3.0, records=200, quality=quality)
    return ReportDocument(
        machine="m", site="s", twin="dc_motor", window=window, decision=WindowDecision.BAD, parameters=parameters
    )


NUMBER = st.floats(allow_nan=True, allow_infinity=True)
DEVIATION = st.floats(0.0) | st.just(math.nan)
ALLOWED = 0.65  # ohm


@given(
    st.builds(MarginalPosterior, NUMBER, DEVIATION, NUMBER, DEVIATION, st.floats(0.0, 2.0)),
    st.none()
    | st.builds(ParameterEstimate, st.just("R_a"), NUMBER, DEVIATION, st.sampled_from(Identifiability), st.just("")),
    st.sampled_from(WindowDecision),
    st.integers(0, 5),
    st.builds(PreviousStatus, st.booleans(), st.sampled_from(Status)),
)
def test_nothing_but_finite_numbers_is_published(
    fused: MarginalPosterior,
    estimate: ParameterEstimate | None,
    decision: WindowDecision,
    contradictions: int,
    before: PreviousStatus,
) -> None:
    heard = WindowEvidence(estimate, decision, contradictions, 1.0, "why")
    after, document = publish(RESISTANCE, ALLOWED, fused, heard, before)
    text = report(R_a=document).to_json()
    assert ReportDocument.from_json(text).parameters["R_a"] == document
    assert not any(word in text for word in ("NaN", "Infinity"))
    assert document.status is not Status.ESTIMATED or after.known
    assert document.status is Status.ESTIMATED or document.reason
    assert 0.0 <= document.progress <= 1.0


def test_absent_is_absent_and_schema_is_named() -> None:
    heard = WindowEvidence(reason="window not estimated from: no samples of i")
    _, document = publish(RESISTANCE, ALLOWED, MarginalPosterior(6.5, 3.0, 0.0, 1.0), heard, PreviousStatus())
    found = json.loads(report(R_a=document).to_json())
    assert found["schema"] == "otolith.report/1"
    assert "value" not in found["parameters"]["R_a"]
    assert found["parameters"]["R_a"]["status"] == "unestimated"
    assert found["decision"] == WindowDecision.BAD
    assert "fit" not in found


def said(
    sd: float,
    kept: float = 1.0,
    decision: WindowDecision = WindowDecision.LEARNED,
    contradictions: int = 0,
    before: PreviousStatus | None = None,
) -> tuple[PreviousStatus, ParameterDocument]:
    """Of a parameter that is known to 0.1 ohm, after a window that alone knows it to ``sd``."""
    estimate = ParameterEstimate("R_a", 6.0, sd, Identifiability.DETERMINED, "")
    fused = MarginalPosterior(6.0, 0.1, 1e-4, 1e-5, kept)
    return publish(
        RESISTANCE, ALLOWED, fused, WindowEvidence(estimate, decision, contradictions), before or PreviousStatus()
    )


def test_the_interval_is_two_sided_95_percent() -> None:
    _, document = said(0.1)
    assert document.status is Status.ESTIMATED
    assert [document.low, document.high] == pytest.approx([5.804, 6.196], abs=1e-4)
    assert document.trend_per_hour == pytest.approx(0.36)


def test_the_status_does_not_flicker_at_its_limit() -> None:
    """An interval a little too wide begins nothing, but what has begun goes on."""
    a_little_wide = 1.3 * ALLOWED / 1.96
    estimated, held = PreviousStatus(True, Status.ESTIMATED), PreviousStatus(True, Status.HELD)
    assert said(a_little_wide, before=estimated)[1].status is Status.ESTIMATED
    assert said(a_little_wide, before=held)[1].status is Status.HELD
    assert said(3.0, before=estimated)[1].status is Status.HELD
    assert said(3.0, kept=0.5, before=held)[1].status is Status.ESTIMATED


def test_one_contradiction_holds_and_two_make_invalid() -> None:
    before = PreviousStatus(True, Status.ESTIMATED)
    assert said(0.1, decision=WindowDecision.SUSPECTED, contradictions=1, before=before)[1].status is Status.HELD
    assert said(0.1, decision=WindowDecision.SUSPECTED, contradictions=2, before=before)[1].status is Status.INVALID


def test_progress_grows_as_the_interval_shrinks() -> None:
    found = [
        publish(RESISTANCE, ALLOWED, MarginalPosterior(6.0, sd, 0.0, 0.0), WindowEvidence(), PreviousStatus())[
            1
        ].progress
        for sd in (3.0, 2.0, 1.0, 0.5, 0.3)
    ]
    assert found[0] == 0.0
    assert found == sorted(found)
    assert found[-1] == 1.0


def test_a_document_with_an_unknown_field_is_refused() -> None:
    text = report().to_json().replace('"machine"', '"machin"')
    with pytest.raises(ValidationError):
        ReportDocument.from_json(text)
