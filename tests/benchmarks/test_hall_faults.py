"""The benchmark of a hall to which everything bad happens: what it counts as lost or late, and that it runs."""

import json

import pytest
from benchmarks.hall import WINDOW
from benchmarks.hall_faults import FaultFigures, RestartFigures, broken_promises, judged, main
from click.testing import CliRunner

from otolith.health.schema import CostDocument, CountersDocument, ReportDocument
from tests.storage.histories import document

SECONDS = 4 * WINDOW
KEPT = RestartFigures(machines=2, learned=2, published=10, kept=10, seconds=3.0)


def reports(late: float = 0.05, missed: int = 0, lost: int = 0, gap: int = 0) -> list[ReportDocument]:
    """A report before the trouble and four since, of which the last has something wrong."""
    rows = []
    for number in range(5):
        is_last = number == 4
        counters = CountersDocument(windows_missed=missed * is_last, lost=lost * is_last)
        cost = CostDocument(latency_s=late if is_last else 0.05)
        sequence = 1 + number + gap * is_last
        changes = {"counters": counters, "cost": cost, "sequence": sequence, "previous": sequence - 1}
        rows.append(document(number, 2.0 * number).model_copy(update=changes))
    return rows


@pytest.mark.parametrize(
    "wrong",
    [reports(late=1.1 * WINDOW), reports(missed=1), reports(lost=1), reports(gap=1), reports()[:3]],
    ids=["late", "missed", "lost", "gap", "silent"],
)
def test_a_machine_is_late_that_missed_anything(wrong: list[ReportDocument]) -> None:
    row = judged("a worker killed", [reports(), wrong], SECONDS)
    assert (row.machines, row.on_time) == (2, 1)
    assert judged("a worker killed", [reports(), reports()], SECONDS).on_time == 2


def test_what_was_promised_and_not_kept_is_named() -> None:
    def row(trouble: str, on_time: int, lost: int = 0) -> FaultFigures:
        return FaultFigures(trouble, 2, on_time, 8, 0, lost, 50.0, 60.0, 70.0)

    assert broken_promises([row("nothing", 2)], KEPT) == []
    assert broken_promises([row("the daemon stopped for 3 s", 0)], KEPT) == []  # all are late then
    assert len(broken_promises([row("disk full", 1)], KEPT)) == 1
    assert len(broken_promises([row("the daemon stopped for 3 s", 0, lost=1)], KEPT)) == 1
    assert len(broken_promises([], RestartFigures(2, 1, 10, 9, 3.0))) == 2


@pytest.mark.full
def test_a_small_hall_loses_nothing() -> None:
    done = CliRunner().invoke(main, ["--machines", "3", "--seconds", "2", "--json"])
    result = json.loads(done.stdout)
    assert [row["samples_lost"] for row in result["troubles"]] == [0] * len(result["troubles"])
    restart = result["restart"]
    assert restart["learned"] == restart["machines"] == 2
    assert restart["published"] > 0
    assert restart["published"] - restart["kept"] <= restart["machines"]  # one each, published in the last milliseconds
