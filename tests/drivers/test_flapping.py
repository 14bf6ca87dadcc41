"""A bus that fails once a minute for a day: memory stays flat, and no thread and no descriptor is left behind.

The day is simulated in that the pauses of the drivers are shortened; the failures are real: connections that are cut,
sockets that become invalid under the driver.
"""

import json
import subprocess
import sys
from typing import Any

import pytest

from tests.variants import often

FEW, HOUR, DAY = 20, 60, 24 * 60  # failures

PROGRAM = """
import gc, json, os, sys, time
import psutil
from tests.drivers.flapping import RIGS
from tests.waiting import wait_for

flaps, process = int(sys.argv[2]), psutil.Process()
measured, files = [], []

def open_files():
    for descriptor in os.listdir("/proc/self/fd"):
        try:
            yield f"{descriptor} {os.readlink('/proc/self/fd/' + descriptor)}"
        except OSError:
            pass  # that of the listing

def resources():
    # Threads and sockets of the other end remain for a moment after a failure: the least of some moments is ours. On a
    # busy computer they remain for longer, so that more moments count until they are as few as at first.
    gc.collect()
    threads, descriptors, first = [], [], measured[1][1:] if len(measured) > 1 else (1000, 1000)
    for moment in range(1000):
        threads.append(process.num_threads())
        descriptors.append(process.num_fds())
        if moment >= 30 and min(threads) <= first[0] and min(descriptors) <= first[1]:
            break
        time.sleep(0.01)
    return process.memory_info().rss, min(threads), min(descriptors)

with RIGS[sys.argv[1]]() as (driver, flap):
    delivered = [0]
    def deliver(samples):
        delivered[0] += len(samples)
    driver.open(deliver)
    for index in range(flaps + 1):
        before = delivered[0]
        wait_for(lambda: delivered[0] > before)
        if index % (flaps // 10) == 0:
            measured.append(resources())
            files.append(sorted(open_files()))
        flap()
    wait_for(lambda: driver.counters().reconnects >= 0.95 * flaps)
    counters = driver.counters()
    driver.close()
print(json.dumps({"measured": measured, "reconnects": counters.reconnects, "lost": counters.lost, "files": files}))
"""


def flap(name: str, flaps: int) -> Any:
    command = [sys.executable, "-c", PROGRAM, name, str(flaps)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=1200, check=False)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@pytest.mark.parametrize("flaps", often([FEW], [FEW, HOUR, DAY]))
@pytest.mark.parametrize("name", ["can", "modbus"])
def test_flapping_leaves_nothing_behind(name: str, flaps: int) -> None:
    result = flap(name, flaps)
    first, *_, last = result["measured"][1:]  # caches fill in the first tenth
    assert last[0] <= 1.05 * first[0]
    assert last[1:] == first[1:], (result["files"][1], result["files"][-1])
    assert result["reconnects"] >= 0.95 * flaps  # a connection that is cut while it connects is not reconnected
    if name == "modbus":
        assert result["lost"] > 0
