"""A daemon whose clock runs many times faster: an hour of it in minutes, a day of it in one hour.

    python -m tests.vm.fast_clock MACHINE.toml STATE_DIRECTORY --hours 24 --speed 24

runs the daemon of a machine file so long, and prints memory, descriptors and threads of all its processes. With
``--speed 1`` the clock is the real one.
"""

import argparse
import json
import os
import re
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

from tests.vm.conftest import run

SOURCE = Path(__file__).with_suffix(".c")


def environment(folder: Path, speed: int) -> dict[str, str]:
    """Environment of a process, and of all that it starts, whose clock runs ``speed`` times faster from now on."""
    if speed == 1:
        return {}
    library = folder / "fast_clock.so"
    if not library.exists():
        options = ("-O2", "-Wall", "-Wextra", "-Werror", "-shared", "-fPIC")
        run("gcc", *options, "-o", str(library), str(SOURCE))
    since = f"{time.monotonic_ns()} {time.time_ns()}"
    return {"LD_PRELOAD": str(library), "FAST_CLOCK": str(speed), "FAST_CLOCK_SINCE": since}


def start(file: Path, state: Path, speed: int, since: str = "") -> "subprocess.Popen[bytes]":
    """The daemon of a machine file; ``since`` is FAST_CLOCK_SINCE of the one whose clock goes on."""
    state.mkdir(parents=True, exist_ok=True)
    added = environment(state, speed) | ({"FAST_CLOCK_SINCE": since} if since else {})
    with (state / "log").open("ab") as log:
        return subprocess.Popen(
            [sys.executable, "-m", "otolith", "run", str(file)],
            env={**os.environ, "XDG_STATE_HOME": str(state), **added},
            stdin=subprocess.DEVNULL, stdout=log, stderr=log,
        )  # fmt: skip


def family(process: int) -> Iterator[int]:
    """A process and those that it started."""
    yield process
    for child in Path(f"/proc/{process}/task/{process}/children").read_text(encoding="ascii").split():
        yield from family(int(child))


def taken(process: int) -> dict[str, float]:
    """Memory (MB), descriptors and threads of a process and those that it started.

    ``memory`` has shared pages in proportion, and changes with what else runs; ``private`` has none.
    """
    folders = [Path(f"/proc/{each}") for each in family(process)]
    text = "".join((folder / "smaps_rollup").read_text(encoding="ascii") for folder in folders)

    def megabytes(rows: str) -> float:
        return round(sum(map(int, re.findall(rf"^{rows}: +(\d+) kB$", text, re.MULTILINE))) / 1024, 1)

    return {
        "memory": megabytes("Pss"),
        "private": megabytes(r"Private_\w+"),
        "descriptors": sum(len(list((folder / "fd").iterdir())) for folder in folders),
        "threads": sum(len(list((folder / "task").iterdir())) for folder in folders),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file", type=Path)
    parser.add_argument("state", type=Path)
    parser.add_argument("--hours", type=float, default=24.0)
    parser.add_argument("--speed", type=int, default=24)
    parser.add_argument("--every", type=float, default=600.0, help="s of its clock between two lines")
    given = parser.parse_args()
    begun = time.monotonic()
    with start(given.file, given.state.absolute(), given.speed) as daemon:
        while (elapsed := (time.monotonic() - begun) * given.speed) < 3600.0 * given.hours and daemon.poll() is None:
            time.sleep(given.every / given.speed)
            print(json.dumps({"hours": round(elapsed / 3600.0, 2), **taken(daemon.pid)}), flush=True)
        daemon.terminate()
    sys.exit(daemon.returncode)


if __name__ == "__main__":
    main()
