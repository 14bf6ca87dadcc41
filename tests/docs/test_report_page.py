"""The subscriber of docs/reference/report.md reads a daemon; what it prints is what was published."""

import re
import subprocess
import sys
import threading
from pathlib import Path

from otolith.health.limits import Level
from tests.sites.machines import daemons, report_of
from tests.waiting import PATIENCE

PAGE = (Path(__file__).parents[2] / "docs" / "reference" / "report.md").read_text(encoding="utf-8")


def test_the_subscriber_of_the_page_has_at_most_ten_lines_and_reads_a_daemon(tmp_path: Path) -> None:
    (program,) = re.findall(r"^```python\n(.*?)^```", PAGE, re.MULTILINE | re.DOTALL)
    assert len([line for line in program.splitlines() if line]) <= 10
    (tmp_path / "reader.py").write_text(program, encoding="utf-8")
    over = threading.Event()
    with daemons(tmp_path, "press-3") as (daemon,):

        def publish() -> None:
            while not over.wait(0.1):
                daemon.publish(report_of(state=Level.WATCH))

        thread = threading.Thread(target=publish)
        thread.start()
        command = [sys.executable, str(tmp_path / "reader.py"), daemon.endpoint]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as reader:
            try:
                assert reader.stdout is not None
                line = reader.stdout.readline()
            finally:
                reader.terminate()
                reader.communicate(timeout=PATIENCE)
                over.set()
                thread.join()
    assert line.startswith("press-3 WATCH {'R_a': {")
