"""The environment of the service: what the windows of a flood of frames needed goes back to the system."""

import os
import re
import subprocess
import sys
from pathlib import Path

UNIT = Path(__file__).parents[2] / "systemd" / "otolith@.service"
LEFT = 10.0  # MB; without the setting five times as much is left
FLOOD = """
import numpy as np

def anonymous():
    with open("/proc/self/smaps_rollup") as file:
        return next(int(line.split()[1]) / 1024 for line in file if line.startswith("Anonymous:"))

random, kept, before = np.random.default_rng(1), [], anonymous()
for _ in range(20):
    arrays = []
    for size in random.integers(1 << 17, 1 << 21, 40):  # bytes of the values of a signal
        arrays.append(np.ones(size // 8))
        kept.append(bytearray(2000))  # what lives longer lies between them
    del arrays
print(anonymous() - before)
"""


def test_the_unit_returns_the_memory_of_a_flood() -> None:
    settings = re.findall(r"^Environment=(.+)$", UNIT.read_text(encoding="utf-8"), re.MULTILINE)
    environment = dict(pair.split("=", 1) for setting in settings for pair in setting.split())
    done = subprocess.run(
        [sys.executable, "-c", FLOOD], env={**os.environ, **environment}, capture_output=True, check=True, text=True
    )
    assert float(done.stdout) < LEFT
