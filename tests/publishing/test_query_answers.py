"""Queries of the history are answered in their turn, or refused; they take a share of the time."""

import threading
import time
from collections.abc import Iterator
from types import TracebackType
from typing import Any, cast

import pytest

from otolith.publishing import zenoh_session
from otolith.publishing.zenoh_session import BURST, MAX_QUERIES, SHARE, QueryAnswers
from tests.messages import assert_says
from tests.waiting import wait_for


class Query:
    """What Zenoh gives, as far as it is used."""

    def __init__(self) -> None:
        self.error, self.is_answered, self.is_over = "", False, False

    def __enter__(self) -> "Query":
        return self

    def __exit__(self, kind: type[BaseException] | None, _: BaseException | None, __: TracebackType | None) -> None:
        self.is_over = True

    def reply_err(self, text: str) -> None:
        """Keep the error."""
        self.error = text


@pytest.fixture
def answers() -> Iterator[QueryAnswers]:
    made = QueryAnswers()
    yield made
    made.close()


def ask(answers: QueryAnswers, reply: Any) -> Query:
    asked = Query()

    def answered(query: Any) -> None:
        reply()
        query.is_answered = True

    answers.add(cast("Any", asked), answered)
    return asked


def test_more_queries_than_can_wait_are_refused_at_once(answers: QueryAnswers) -> None:
    free = threading.Event()
    first = ask(answers, free.wait)
    wait_for(answers._waiting.empty)
    asked = [ask(answers, lambda: None) for _ in range(3 * MAX_QUERIES)]
    refused = [each for each in asked if each.is_over]
    assert len(refused) == answers.refused == 2 * MAX_QUERIES
    assert_says(refused[0].error, "queries", "again")
    free.set()
    wait_for(lambda: all(each.is_over for each in (first, *asked)))
    assert sum(each.is_answered for each in asked) == MAX_QUERIES


def test_what_nobody_waits_for_any_more_is_not_answered(answers: QueryAnswers, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(zenoh_session, "MAX_WAIT", 0.1)
    late = threading.Event()
    ask(answers, lambda: late.wait(0.3))
    asked = ask(answers, lambda: None)
    wait_for(lambda: asked.is_over)
    assert asked.error
    assert not asked.is_answered


def test_answers_take_their_share_of_the_time_and_no_more(
    answers: QueryAnswers, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(zenoh_session, "MAX_WAIT", 60.0)
    spent = [0.0]

    def compute() -> None:
        begun = time.thread_time()
        while time.thread_time() - begun < 0.1:
            pass
        spent[0] += time.thread_time() - begun

    begun = time.monotonic()
    last = [ask(answers, compute) for _ in range(16)][-1]
    wait_for(lambda: last.is_over)
    assert spent[0] - 0.2 <= BURST + SHARE * (time.monotonic() - begun)


def test_a_query_that_cannot_be_answered_ends_no_other(answers: QueryAnswers) -> None:
    ask(answers, lambda: 1 / 0)
    asked = ask(answers, lambda: None)
    wait_for(lambda: asked.is_answered)


def test_a_refusal_that_fails_ends_no_other_answer(answers: QueryAnswers, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(zenoh_session, "MAX_WAIT", -1.0)  # all have waited for too long

    class Gone(Query):
        def reply_err(self, text: str) -> None:
            raise RuntimeError(text)

    gone, following = Gone(), Query()
    answers.add(cast("Any", gone), lambda _: None)
    answers.add(cast("Any", following), lambda _: None)
    wait_for(lambda: bool(following.error))
    assert gone.is_over
