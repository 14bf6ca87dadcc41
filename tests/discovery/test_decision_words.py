"""What a window led to, in words that need no second reading; programs read the value, which stays."""

import pytest

from otolith.discovery.alternatives import WindowDecision
from otolith.health.schema import LANGUAGES, Language
from otolith.health.text import texts_in


@pytest.mark.parametrize("decision", WindowDecision)
def test_a_decision_is_one_sentence_in_each_language(decision: WindowDecision) -> None:
    words = decision.in_words
    assert words.count(":") <= 1
    assert ";" not in words
    own: list[Language] = [language for language in LANGUAGES if language != "en"]
    if decision is not WindowDecision.LEARNED:  # which nobody has to read
        assert all(texts_in(language).translated(words) != words for language in own)
    assert WindowDecision(decision.value) is decision
