"""The memory of the histories of a hall does not grow with what they have written."""

import os
import re
import subprocess
import sys
from pathlib import Path

UNIT = Path(__file__).parents[2] / "systemd" / "otolith.service"
WRITERS, GROWTH = 20, 15.0  # kB for each, from one minute of windows to the next: a page cache that stays gains 60
PROGRAM = f"""
import gc, sys
from itertools import islice
from pathlib import Path
from otolith.storage.history_writer import Bounds, HistoryWriter
from tests.storage.histories import START, documents

def anonymous():
    gc.collect()
    with open("/proc/self/smaps_rollup") as file:
        return next(int(line.split()[1]) for line in file if line.startswith("Anonymous:"))

folder = Path(sys.argv[1]) / "history"
paths = [folder / f"hall.motor-{{number}}.sqlite" for number in range({WRITERS})]
writers = [HistoryWriter(path, Bounds(20_000_000, 30, 24)) for path in paths]
numbers, reports = [writer.open(START)[0] for writer in writers], documents(200)
for minute in range(5):
    batch = list(islice(reports, 30))
    for writer, own in zip(writers, numbers):
        for report in batch:
            writer.add(own.number(report))
            writer._write_waiting(0.0)
        writer._merge()
    if minute == 0:
        before = anonymous()
print((anonymous() - before) / 4 / {WRITERS})
"""


def test_what_a_history_has_written_does_not_stay_in_memory(tmp_path: Path) -> None:
    settings = re.findall(r"^Environment=(.+)$", UNIT.read_text(encoding="utf-8"), re.MULTILINE)
    environment = dict(pair.split("=", 1) for setting in settings for pair in setting.split())
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, str(tmp_path)],
        env={**os.environ, **environment},
        capture_output=True,
        check=True,
        text=True,
    )
    assert float(done.stdout) < GROWTH
