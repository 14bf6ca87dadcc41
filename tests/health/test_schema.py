"""The report: a published document can be read back, and all its numbers are finite."""

import json
import math
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from otolith.acquisition.window import Verdict
from otolith.discovery.alternatives import WindowDecision
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
def test_report_contains_only_finite_numbers(
    marginal: MarginalPosterior,
    estimate: ParameterEstimate | None,
    decision: WindowDecision,
    contradictions: int,
    before: PreviousStatus,
) -> None:
    evidence = WindowEvidence(estimate, decision, contradictions, 1.0, reason="why")
    after, document = publish(RESISTANCE, ALLOWED, marginal, evidence, before)
    text = report(R_a=document).to_json()
    assert ReportDocument.from_json(text).parameters["R_a"] == document
    assert not any(word in text for word in ("NaN", "Infinity"))
    assert document.status is not Status.ESTIMATED or after.known
    assert document.status is Status.ESTIMATED or document.reason
    assert 0.0 <= document.progress <= 1.0


def test_report_omits_absent_fields_and_names_its_schema() -> None:
    evidence = WindowEvidence(reason="nothing is estimated from this window: no samples of i")
    _, document = publish(RESISTANCE, ALLOWED, MarginalPosterior(6.5, 3.0, 0.0, 1.0), evidence, PreviousStatus())
    published = json.loads(report(R_a=document).to_json())
    assert published["schema"] == "otolith.report/1"
    assert "value" not in published["parameters"]["R_a"]
    assert published["parameters"]["R_a"]["status"] == "unestimated"
    assert published["decision"] == WindowDecision.BAD
    assert "fit" not in published


def publish_after(
    sd: float,
    kept: float = 1.0,
    decision: WindowDecision = WindowDecision.LEARNED,
    contradictions: int = 0,
    before: PreviousStatus | None = None,
) -> tuple[PreviousStatus, ParameterDocument]:
    """Publish after a window with standard deviation ``sd`` (ohm); that of the posterior is 0.1 ohm."""
    estimate = ParameterEstimate("R_a", 6.0, sd, Identifiability.DETERMINED, "")
    marginal = MarginalPosterior(6.0, 0.1, 1e-4, 1e-5, kept)
    return publish(
        RESISTANCE, ALLOWED, marginal, WindowEvidence(estimate, decision, contradictions), before or PreviousStatus()
    )


def test_report_interval_is_two_sided_95_percent() -> None:
    _, document = publish_after(0.1)
    assert document.status is Status.ESTIMATED
    assert [document.low, document.high] == pytest.approx([5.804, 6.196], abs=1e-4)
    assert document.trend_per_hour == pytest.approx(0.36)


def test_the_interval_of_a_positive_parameter_has_no_negative_end() -> None:
    before, wide = PreviousStatus(True, Status.ESTIMATED), MarginalPosterior(0.5, 0.5, 0.0, 1e-6)
    positive, signed = (replace(RESISTANCE, low=low) for low in (0.1, -5.0))
    _, document = publish(positive, ALLOWED, wide, WindowEvidence(), before)
    assert document.low == 0.0
    assert document.high == pytest.approx(0.5 + 1.96 * 0.5, rel=1e-3)
    assert publish(signed, ALLOWED, wide, WindowEvidence(), before)[1].low == pytest.approx(-0.48, rel=1e-2)


def test_status_has_hysteresis_at_its_limit() -> None:
    """A slightly too wide interval keeps an estimated parameter estimated, but does not make a held one estimated."""
    a_little_wide = 1.3 * ALLOWED / 1.96
    estimated, held = PreviousStatus(True, Status.ESTIMATED), PreviousStatus(True, Status.HELD)
    assert publish_after(a_little_wide, before=estimated)[1].status is Status.ESTIMATED
    assert publish_after(a_little_wide, before=held)[1].status is Status.HELD
    assert publish_after(3.0, before=estimated)[1].status is Status.HELD
    assert publish_after(3.0, kept=0.5, before=held)[1].status is Status.ESTIMATED


@pytest.mark.parametrize("value", [RESISTANCE.low, RESISTANCE.low - 1.0, RESISTANCE.high])
def test_a_known_value_at_its_bound_is_invalid_and_never_estimated(value: float) -> None:
    """The window alone may lie inside the bounds, or determine too little for a word on them."""
    estimate = ParameterEstimate("R_a", 6.0, 0.1, Identifiability.DETERMINED, "")
    evidence = WindowEvidence(estimate, WindowDecision.LEARNED)
    _, document = publish(RESISTANCE, ALLOWED, MarginalPosterior(value, 0.1, 0.0, 1e-6), evidence, PreviousStatus())
    assert document.status is Status.INVALID
    assert document.identifiability is Identifiability.AT_BOUND
    assert document.reason.startswith("at its bound ")


@pytest.mark.parametrize(("explained", "status"), [(True, Status.ESTIMATED), (False, Status.INVALID)])
def test_a_bound_that_the_twin_alone_reaches_does_not_count_where_hypotheses_explain_the_window(
    explained: bool, status: Status
) -> None:
    """A flow reads too little, so that the twin alone has no leakage left; the sensor's hypothesis has its leakage."""
    estimate = ParameterEstimate("R_a", RESISTANCE.low, 0.1, Identifiability.AT_BOUND, "at its bound")
    evidence = WindowEvidence(estimate, WindowDecision.AMBIGUOUS, is_mixture=True, is_explained=explained)
    before = PreviousStatus(True, Status.ESTIMATED)
    _, document = publish(RESISTANCE, ALLOWED, MarginalPosterior(6.0, 0.1, 0.0, 1e-6), evidence, before)
    assert document.status is status


def test_status_is_held_then_invalid_after_contradictions() -> None:
    before = PreviousStatus(True, Status.ESTIMATED)
    assert publish_after(0.1, decision=WindowDecision.REFUSED, contradictions=1, before=before)[1].status is Status.HELD
    assert (
        publish_after(0.1, decision=WindowDecision.REFUSED, contradictions=2, before=before)[1].status is Status.INVALID
    )


def test_progress_grows_as_the_interval_shrinks() -> None:
    progress = [
        publish(RESISTANCE, ALLOWED, MarginalPosterior(6.0, sd, 0.0, 0.0), WindowEvidence(), PreviousStatus())[
            1
        ].progress
        for sd in (3.0, 2.0, 1.0, 0.5, 0.3)
    ]
    assert progress[0] == 0.0
    assert progress == sorted(progress)
    assert progress[-1] == 1.0


def test_report_with_an_unknown_field_is_refused() -> None:
    text = report().to_json().replace('"machine"', '"machin"')
    with pytest.raises(ValidationError):
        ReportDocument.from_json(text)
