"""The first start of a service on a core at a tenth of its speed. Runs in the guest, as root: 15 minutes."""

import shutil
import time
from pathlib import Path

from tests.vm.conftest import counters, run
from tests.vm.service import Instance, holds_truth, simulated_machine

PATIENCE = 3600.0  # s


def test_a_slow_computer_compiles_without_a_kill(tmp_path: Path) -> None:
    cold = Instance("press")
    cold.install(simulated_machine(tmp_path))
    shutil.rmtree("/var/cache/otolith/kernels")
    run("systemctl", "set-property", "--runtime", cold.unit, "CPUQuota=10%")
    begun = time.monotonic()
    run("systemctl", "start", cold.unit, seconds=PATIENCE)
    print(f"ready after {time.monotonic() - begun:.0f} s")
    deadline = begun + PATIENCE
    cold.wait_for_reports(1, seconds=PATIENCE)
    while cold.last().parameters["R_a"].low is None:
        assert time.monotonic() < deadline, cold.log()
        time.sleep(1.0)
    print(f"first estimate after {time.monotonic() - begun:.0f} s")
    holds_truth(cold.last())
    assert cold.shown("NRestarts") == "0"
    assert counters([cold.last()]).worker_restarts == 0
