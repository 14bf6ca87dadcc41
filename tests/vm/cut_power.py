"""Takes the power from the guest while the daemon replaces its learned state. Runs in the guest, as root."""

import ctypes
import sys
import time
from pathlib import Path

from tests.vm.service import Instance

POWER_OFF = 0x4321FEDC  # of reboot(2), which does not write what is in memory to the disk
LOOK = 2e-4  # s between two looks: without a pause it would take the processor from the daemon
SECONDS = 90.0  # in which the state is saved at least once


def main() -> None:
    press = Instance("press")
    press.remember(press.before())
    before, folder = press.wait_for_reports(1)[-1], press.state / "components"
    names, deadline = set(folder.iterdir()), time.monotonic() + SECONDS
    while not (new := set(folder.iterdir()) - names):
        if time.monotonic() > deadline:
            sys.exit(f"the state was not saved in {SECONDS:g} s: {press.log()}")
        time.sleep(LOOK)
    Path("/mnt/share/rc").write_text("0", encoding="ascii")  # the exit code for run.sh, in a folder of the host
    sys.stdout.write(f"power cut while {new} is written, after report {before.sequence}\n")
    sys.stdout.flush()
    ctypes.CDLL(None).reboot(POWER_OFF)


if __name__ == "__main__":
    main()
