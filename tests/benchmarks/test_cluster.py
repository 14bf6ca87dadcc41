"""The benchmark of a cluster runs, and its reports are the same although a worker is killed."""

import json

import pytest
from benchmarks.cluster import main
from click.testing import CliRunner


@pytest.mark.full
def test_two_machines_are_replayed_on_a_cluster_that_loses_a_worker() -> None:
    options = ["--machines", "2", "--minutes", "0.5", "--kill", "--json"]
    done = CliRunner().invoke(main, options, catch_exceptions=False)
    figures = json.loads(done.stdout)
    assert figures["is_same"]
    assert figures["killed"] == 1
    assert figures["reports"] == 2 * 12
    assert figures["speed_up"] > 0.0
