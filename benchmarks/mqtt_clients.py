"""One client of an MQTT broker for ten machines, or one for each: what they cost, and who loses when one is flooded.

    python -m benchmarks.mqtt_clients

A broker has a queue for each client. So in a client of all, messages of one machine that come faster than they are read
cost the others theirs. Needs mosquitto.
"""

import json
import shutil
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path

import click
from paho.mqtt import client as mqtt
from paho.mqtt.enums import CallbackAPIVersion
from rich.table import Table

from benchmarks.command_line import print_pages
from otolith_drivers import mqtt as driver
from otolith_drivers.base import Setup, Signal

MACHINES = 10
SECONDS = 10.0  # s for which messages are sent
RATES = (20, 100)  # messages per second of each machine
FLOOD = 20_000  # messages per second of the first one at most
FLOOD_BYTES = 1000  # of each of them
SETTLING = 3.0  # s until the last message has come
SENDER = """
import sys, time
from paho.mqtt import client as mqtt
from paho.mqtt.enums import CallbackAPIVersion
port, rate, seconds, size, *topics = sys.argv[1:]
client = mqtt.Client(CallbackAPIVersion.VERSION2)
client.connect("127.0.0.1", int(port))
client.loop_start()
begun, rounds = time.monotonic(), 0
while time.monotonic() - begun < float(seconds):
    for topic in topics:
        client.publish(topic, '{"i": %d}' % rounds + " " * int(size))
    rounds += 1
    time.sleep(max(0.0, begun + rounds / float(rate) - time.monotonic()))
client.loop_stop()
print(rounds)
"""


@dataclass(frozen=True, slots=True)
class ClientFigures:
    """What one arrangement of clients cost."""

    clients: int
    rate: int  # Messages per second of each machine
    is_flooded: bool
    cores: float  # Processor time of the process that listens, per second
    lost_share: float  # Of the messages of the machines that are not flooded


@contextmanager
def broker(folder: Path) -> Iterator[int]:
    """Run a broker, and yield its port."""
    program = shutil.which("mosquitto")
    if program is None:
        raise SystemExit("mosquitto is not installed: apt-get install mosquitto")
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = int(probe.getsockname()[1])
    (folder / "broker.conf").write_text(f"listener {port} 127.0.0.1\nallow_anonymous true\n", encoding="utf-8")
    with subprocess.Popen([program, "-c", str(folder / "broker.conf")], stderr=subprocess.DEVNULL) as process:  # noqa: S603 - a program of this computer
        time.sleep(1.0)
        try:
            yield port
        finally:
            process.terminate()


def send(port: int, rate: float, seconds: float, size: int, topics: Sequence[str]) -> "subprocess.Popen[str]":
    """Send messages of each topic from another process."""
    arguments = [str(port), str(rate), str(seconds), str(size), *topics]
    return subprocess.Popen([sys.executable, "-c", SENDER, *arguments], stdout=subprocess.PIPE, text=True)  # noqa: S603 - our own command


@contextmanager
def one_client(port: int, messages: Sequence[driver.Messages]) -> Iterator[None]:
    """Listen to the topics of all machines with one client and one thread."""
    by_topic = {topic: each for each in messages for topic in each.topics}
    client, stop = mqtt.Client(CallbackAPIVersion.VERSION2), threading.Event()

    def take(_: object, __: object, message: mqtt.MQTTMessage) -> None:
        each = by_topic[message.topic]
        each.take(message.topic, bytes(message.payload), time.monotonic(), retained=message.retain)

    def listen() -> None:
        while not stop.is_set():
            client.loop(driver.LOOP_TIMEOUT)

    client.on_message = take
    client.connect("127.0.0.1", port)
    client.subscribe([(topic, 0) for topic in by_topic])
    thread = threading.Thread(target=listen)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()
        client.disconnect()


def measure(folder: Path, *, shared: bool, rate: int, is_flooded: bool) -> ClientFigures:
    """Measure ten machines with one client, or with one for each."""
    with ExitStack() as stack:
        port = stack.enter_context(broker(folder))
        options = driver.Options(host="127.0.0.1", port=port)
        signals = [Signal("i", "A", driver.Source(topic=f"m/{n}", field="i", unit="A")) for n in range(MACHINES)]
        messages = [driver.Messages(options, (signal,)) for signal in signals]
        if shared:
            stack.enter_context(one_client(port, messages))
        for signal, each in zip(signals, messages, strict=True) if not shared else ():
            listening = driver.listener(options, Setup((signal,), folder, 0.01), each)
            listening.open(lambda _: None)
            stack.callback(listening.close)
        time.sleep(1.0)
        senders = [send(port, rate, SECONDS, 0, [f"m/{number}" for number in range(MACHINES)])]
        if is_flooded:
            senders.append(send(port, FLOOD / 100, SECONDS - 2.0, FLOOD_BYTES, ["m/0"] * 100))
        spent, begun = time.process_time(), time.monotonic()
        sent = [int(sender.communicate()[0]) for sender in senders]
        cores = (time.process_time() - spent) / (time.monotonic() - begun)
        time.sleep(SETTLING)
        lost = 1.0 - sum(each.received for each in messages[1:]) / (sent[0] * (MACHINES - 1))
    return ClientFigures(1 if shared else MACHINES, rate, is_flooded, cores, lost)


@click.command()
@click.option("--json", "as_json", is_flag=True, help="Print a JSON document.")
def main(as_json: bool) -> None:
    """Measure one client for all machines against one for each."""
    cases = [*((rate, False) for rate in RATES), (RATES[0], True)]
    with tempfile.TemporaryDirectory(prefix="otolith-mqtt-") as name:
        figures = [
            measure(Path(name), shared=shared, rate=rate, is_flooded=is_flooded)
            for rate, is_flooded in cases
            for shared in (True, False)
        ]
    if as_json:
        print(json.dumps([asdict(each) for each in figures], indent=2))
        return
    table = Table("messages/s of each", "one is flooded", "clients", "cores", "lost by the others")
    for each in figures:
        flooded = f"{FLOOD}/s of {FLOOD_BYTES} bytes" if each.is_flooded else "no"
        table.add_row(str(each.rate), flooded, str(each.clients), f"{each.cores:.3f}", f"{each.lost_share:.1%}")
    print_pages(table)


if __name__ == "__main__":
    main()
