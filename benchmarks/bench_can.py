"""Cost of a CAN frame from the socket into the rings, compared with a bare python-can loop on the same frames.

Another process sends 8000 frames per second of ten messages, each with one used signal and a counter, on the virtual
bus of this computer. ``python -m benchmarks.bench_can 12`` takes 12 s for each loop instead of 60. They take turns,
so that a computer that is busy meanwhile disturbs both alike.
"""

import subprocess
import sys
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import can

from otolith.acquisition.ring import Rings
from otolith_drivers.base import Setup, Signal
from otolith_drivers.canbus.bus import BusOptions, enlarge_buffer, open_bus
from otolith_drivers.canbus.driver import CanOptions, build
from otolith_drivers.canbus.options import CanSource
from otolith_drivers.common.guard import GuardedSource

RATE, MESSAGES, FIRST_ID = 8000.0, 10, 0x180  # frames/s
SETTLE = 0.5  # s after the last frame
MAX_TURNS = 4  # of each loop, of a second or more
MULTICAST_GROUP, PORT = "239.74.163.88", 43188
BUS = BusOptions(interface="udp_multicast", channel=MULTICAST_GROUP, port=PORT)


@dataclass(frozen=True, slots=True)
class Result:
    sent: int
    received: int
    seconds: float
    cpu: float

    def __add__(self, other: "Result") -> "Result":
        sent, received = self.sent + other.sent, self.received + other.received
        return Result(sent, received, self.seconds + other.seconds, self.cpu + other.cpu)

    @property
    def share(self) -> float:
        return self.cpu / self.seconds

    def line(self, title: str) -> str:
        lost = self.sent - self.received
        per_frame = self.cpu / max(self.received, 1) * 1e6
        rate = self.sent / self.seconds
        text = f"{title:<28} {rate:6.0f} frames/s, lost {lost} of {self.sent}"
        return f"{text}, {self.share:6.1%} of a core, {per_frame:5.1f} us a frame"


def database() -> str:
    lines = ['VERSION ""', "NS_ :", "BS_:", "BU_: Drive"]
    for index in range(MESSAGES):
        lines.append(f"BO_ {FIRST_ID + index} Axis{index}: 8 Drive")
        lines.append(f' SG_ Speed{index} : 0|16@1- (0.01,0) [-320|320] "rad/s" Drive')
        lines.append(f' SG_ Axis{index}AliveCounter : 56|8@1+ (1,0) [0|255] "" Drive')
        lines.append("")
    return "\n".join(lines)


def send(seconds: float) -> int:
    """The other process: prints the number of frames sent."""
    frames = [
        can.Message(arbitration_id=FIRST_ID + index, data=bytes(8), is_extended_id=False) for index in range(MESSAGES)
    ]
    sent, total = 0, int(RATE * seconds)
    with open_bus(BUS) as bus:
        start = time.monotonic()
        while sent < total:
            due = min(total, int((time.monotonic() - start) * RATE) + 1)
            while sent < due:
                frame = frames[sent % MESSAGES]
                cycle = sent // MESSAGES
                frame.data[0], frame.data[7] = cycle % 200, cycle % 256
                bus.send(frame)
                sent += 1
            time.sleep(1.0 / RATE)
    print(sent)
    return 0


def sender(seconds: float) -> int:
    command = [sys.executable, "-m", "benchmarks.bench_can", "send", str(seconds)]
    return int(subprocess.run(command, check=True, capture_output=True, text=True).stdout)  # noqa: S603 - a module of this project


def receive_bare(seconds: float) -> Result:
    received, cpu = 0, 0.0
    stop = threading.Event()

    def loop() -> None:
        nonlocal received, cpu
        start = time.thread_time()
        while not stop.is_set():
            received += bus.recv(0.2) is not None
        cpu = time.thread_time() - start

    with open_bus(BUS) as bus:
        enlarge_buffer(bus)
        thread = threading.Thread(target=loop)
        thread.start()
        start = time.monotonic()
        sent = sender(seconds)
        time.sleep(SETTLE)
        elapsed = time.monotonic() - start
        stop.set()
        thread.join()
    return Result(sent, received, elapsed, cpu)


def receive_with_driver(seconds: float) -> Result:
    names = [f"omega_{index}" for index in range(MESSAGES)]
    rings = Rings(names, int(4 * RATE / MESSAGES))
    with TemporaryDirectory() as folder:
        (Path(folder) / "bench.dbc").write_text(database(), encoding="utf-8")
        signals = tuple(Signal(name, "rad/s", CanSource(signal=f"Speed{index}")) for index, name in enumerate(names))
        options = CanOptions(dbc=Path("bench.dbc"), **BUS.model_dump(exclude_unset=True))
        period = MESSAGES / RATE
        setup = Setup(signals, Path(folder), period)
        driver = GuardedSource.built("bench", names, period, lambda: build(options, setup))  # as the daemon has it
    driver.open(rings.deliver)
    thread = next(thread for thread in threading.enumerate() if thread.name == "can-receive")
    clock = time.pthread_getcpuclockid(thread.ident or 0)
    before, start = time.clock_gettime(clock), time.monotonic()
    sent = sender(seconds)
    time.sleep(SETTLE)
    cpu, elapsed = time.clock_gettime(clock) - before, time.monotonic() - start
    if (counters := driver.counters()).lost or counters.bad:
        print(f"  {counters}; {driver.link().warnings}")
    driver.close()
    return Result(sent, rings.counters().received, elapsed, cpu)


def main(seconds: float) -> int:
    plain = whole = Result(0, 0, 0.0, 0.0)
    turns = max(1, min(MAX_TURNS, int(seconds)))
    for _ in range(turns):
        plain += receive_bare(seconds / turns)
        whole += receive_with_driver(seconds / turns)
    print(plain.line("python-can, bus.recv alone"))
    print(whole.line("Otolith, into the rings"))
    print(f"ratio {whole.cpu / whole.received * plain.received / plain.cpu:.2f}")
    return 0


if __name__ == "__main__":
    if sys.argv[1:2] == ["send"]:
        sys.exit(send(float(sys.argv[2])))
    sys.exit(main(float(sys.argv[1]) if len(sys.argv) > 1 else 60.0))
