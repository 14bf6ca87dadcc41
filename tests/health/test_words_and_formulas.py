"""The operator reads words; the equations are in the details, for the specialist."""

from dataclasses import replace

import pytest

from otolith.discovery.alternatives import WindowDecision
from otolith.health.observations import UNDECIDED
from otolith.health.schema import FindingKind, Language
from otolith.health.text import event_text
from tests.health.test_events import PLAN, assessed, report, unbalance, undecided


@pytest.mark.parametrize("language", ["en", "de"])
def test_the_line_of_an_event_has_words_and_its_details_have_the_formulas(language: Language) -> None:
    """Whatever they are of: several causes, a component, or what comes and goes."""
    formula = "shaft: 0.0047·sin(1·θ) N·m (33%); or winding: 2·i V (31%)"
    plan = replace(PLAN, language=language)
    of_class = [undecided(index, WindowDecision.AMBIGUOUS, text=formula) for index in range(UNDECIDED.rise)]
    of_shaft = [report(index, components=(unbalance(0.0047),)) for index in range(5)]
    doubtful = [WindowDecision.SUSPECTED if index % 4 == 0 else WindowDecision.LEARNED for index in range(41)]
    finding = undecided(0, WindowDecision.SUSPECTED, FindingKind.OPEN, text=formula).findings
    of_returns = [report(index, decision=each, findings=finding) for index, each in enumerate(doubtful)]
    for windows in (of_class, of_shaft, of_returns):
        events = [event for document in assessed(windows, plan=plan) for event in document.events]
        assert events
        assert not any("sin(" in event.text or "sin(" in event_text(event) for event in events)
        assert any("sin(" in event_text(event, details=True) for event in events)
