"""Takes the power from the guest while the daemon replaces its learned state. Runs in the guest, as root."""

import ctypes
import os
import select
import struct
import sys
from pathlib import Path

from tests.vm.conftest import PATIENCE
from tests.vm.service import Instance

POWER_OFF = 0x4321FEDC  # of reboot(2), which does not write what is in memory to the disk
IN_CREATE, EVENT = 0x100, struct.Struct("iIII")  # inotify(7): a file is made; what comes before its name


def main() -> None:
    press, libc = Instance("press"), ctypes.CDLL(None)
    press.remember(press.before())
    before, folder = press.last(), press.state / "components"
    events = libc.inotify_init1(0)
    libc.inotify_add_watch(events, os.fsencode(folder), IN_CREATE)
    # Before the daemon, which would finish its file first.
    os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(10))
    if not select.select([events], [], [], PATIENCE)[0]:
        sys.exit(f"the state was not saved in {PATIENCE:g} s: {press.log()}")
    name = os.read(events, 4096)[EVENT.size :].split(b"\0")[0].decode()
    Path("/mnt/share/rc").write_text("0", encoding="ascii")  # the exit code for run.sh, in a folder of the host
    sys.stdout.write(f"power cut while {name} is written, after report {before.sequence}\n")
    sys.stdout.flush()
    libc.reboot(POWER_OFF)


if __name__ == "__main__":
    main()
