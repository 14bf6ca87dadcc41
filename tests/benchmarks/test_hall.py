"""The benchmark of a hall runs, and its exponents are those of the figures."""

import json

import pytest
from benchmarks.hall import HallFigures, exponents, main
from click.testing import CliRunner


def figures(machines: int) -> HallFigures:
    return HallFigures(
        machines=machines, on_buses=0, seconds=30.0,
        cores=0.01 * machines, cores_of_each=(), pss_mb=3.0 * machines**0.5,
        pss_of_each_mb=(), threads=1, latency_median_ms=20.0, latency_99_ms=50.0, latency_max_ms=90.0, reports=10,
        windows_missed=0, samples_lost=0, ms_per_window=20.0, history_bytes=100 * machines,
    )  # fmt: skip


def test_exponents_say_how_costs_grow_with_machines() -> None:
    assert exponents([figures(20), figures(50), figures(100)]) == pytest.approx(
        {"cores": 1.0, "pss_mb": 0.5, "history_bytes": 1.0}
    )
    assert exponents([figures(20)]) == {}


@pytest.mark.full
def test_a_hall_of_two_is_measured() -> None:
    """One of them is replayed, and the frames of the other one come over a bus."""
    options = ["--machines", "2", "--can", "0.5", "--buses", "1", "--seconds", "5", "--json"]
    done = CliRunner().invoke(main, options, catch_exceptions=False)
    (hall,) = json.loads(done.stdout)["halls"]
    assert (hall["machines"], hall["on_buses"]) == (2, 1)
    assert hall["reports"] >= 2
    assert hall["samples_lost"] == 0
    assert sum(hall["pss_of_each_mb"]) == pytest.approx(hall["pss_mb"])
