"""A day of a bus that comes and goes once a minute: memory stays flat, no thread and no descriptor is left behind.

The day is simulated in that the pauses of the drivers are shortened; the flaps are real: connections that are cut,
sockets that are closed under the driver.
"""

import json
import subprocess
import sys
from typing import Any

import pytest

FLAPS = 24 * 60

PROGRAM = """
import gc, json, os, sys, threading, time, warnings
import psutil
from tests.drivers.flapping import RIGS

flaps, process = int(sys.argv[2]), psutil.Process()
seen = []
with RIGS[sys.argv[1]]() as (driver, flap):
    delivered = [0]
    def deliver(samples):
        delivered[0] += len(samples)
    driver.open(deliver)
    for index in range(flaps + 1):
        before, deadline = delivered[0], time.monotonic() + 20.0
        while delivered[0] == before:
            assert time.monotonic() < deadline, f"flap {index}: {driver.link()} {driver.counters()}"
            time.sleep(0.0005)
        if index % (flaps // 10) == 0:
            gc.collect()
            seen.append((process.memory_info().rss, process.num_threads(), process.num_fds()))
        flap()
    counters = driver.counters()
    driver.close()
print(json.dumps({"seen": seen, "reconnects": counters.reconnects, "lost": counters.lost}))
"""


def day(name: str, flaps: int) -> Any:
    command = [sys.executable, "-c", PROGRAM, name, str(flaps)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@pytest.mark.parametrize("name", ["can", "modbus"])
def test_a_day_of_flapping_leaves_nothing_behind(name: str) -> None:
    found = day(name, FLAPS)
    first, *_, last = found["seen"][1:]  # the first tenth of the day fills what is kept
    assert last[0] <= 1.05 * first[0]
    assert last[1:] == first[1:]
    assert found["reconnects"] >= 0.95 * FLAPS  # a cut while it connects is none
    if name == "modbus":
        assert found["lost"] > 0
