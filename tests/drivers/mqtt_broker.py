"""A real MQTT broker in a process of its own: mosquitto where it is installed, else amqtt."""

import asyncio
import atexit
import getpass
import json
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from functools import cache
from pathlib import Path
from typing import Any

from amqtt.broker import Broker
from paho.mqtt import client as mqtt
from paho.mqtt.enums import CallbackAPIVersion

from tests.conftest import free_port
from tests.waiting import PATIENCE, wait_for

ACCESS = {"publishClientSend": True, "publishClientReceive": True, "subscribe": False, "unsubscribe": True}


async def serve(listener: dict[str, Any], passwords: str) -> None:
    plugins: dict[str, Any] = {}
    if passwords:
        plugins["amqtt.plugins.authentication.FileAuthPlugin"] = {"password_file": passwords}
    else:
        plugins["amqtt.plugins.authentication.AnonymousAuthPlugin"] = {"allow_anonymous": True}
    broker = Broker({"listeners": {"default": {"type": "tcp", **listener}}, "plugins": plugins})
    await broker.start()
    await asyncio.Event().wait()


@contextmanager
def mqtt_broker(
    port: int, folder: Path, *, tls: tuple[Path, Path] | None = None, may_subscribe: bool = True
) -> "Iterator[subprocess.Popen[bytes]]":
    """The process of a broker on 127.0.0.1; ``tls`` is its certificate and key."""
    if (mosquitto := shutil.which("mosquitto")) is not None:
        # As root it would become another user, who cannot read the certificate.
        lines = [f"listener {port} 127.0.0.1", "allow_anonymous true", f"user {getpass.getuser()}"]
        lines += [f"certfile {tls[0]}", f"keyfile {tls[1]}"] if tls else []
        if not may_subscribe:  # a file of access lists refuses no subscription, but its messages
            (plugin,) = Path("/usr/lib").glob("*/mosquitto_dynamic_security.so")
            (folder / "access.json").write_text(json.dumps({"defaultACLAccess": ACCESS}), encoding="utf-8")
            lines += [f"plugin {plugin}", f"plugin_opt_config_file {folder / 'access.json'}"]
        (folder / "mosquitto.conf").write_text("\n".join(lines), encoding="utf-8")
        command = [mosquitto, "-c", str(folder / "mosquitto.conf")]
    else:
        assert may_subscribe, "access lists need mosquitto"
        listener: dict[str, Any] = {"bind": f"127.0.0.1:{port}"}
        listener |= {"ssl": True, "certfile": str(tls[0]), "keyfile": str(tls[1])} if tls else {}
        command = [sys.executable, "-m", "tests.drivers.mqtt_broker", json.dumps(listener)]
    with (folder / "broker.log").open("wb") as log, subprocess.Popen(command, stdout=log, stderr=log) as process:
        try:
            deadline = time.monotonic() + PATIENCE
            while not listens(port):
                assert time.monotonic() < deadline, (folder / "broker.log").read_text()
                time.sleep(0.02)
            yield process
        finally:
            process.kill()


@cache
def broker_of_this_process() -> int:
    """The port of a broker that ends with this process."""
    port, stack = free_port(socket.SOCK_STREAM), ExitStack()
    folder = stack.enter_context(tempfile.TemporaryDirectory())
    stack.enter_context(mqtt_broker(port, Path(folder)))
    atexit.register(stack.close)
    return port


@contextmanager
def publisher(port: int) -> Iterator[mqtt.Client]:
    """A client that is connected, with a thread of its own."""
    client = mqtt.Client(CallbackAPIVersion.VERSION2)
    client.connect("127.0.0.1", port)
    client.loop_start()
    try:
        wait_for(client.is_connected)
        yield client
    finally:
        client.disconnect()
        client.loop_stop()


def listens(port: int) -> bool:
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) == 0


if __name__ == "__main__":
    asyncio.run(serve(json.loads(sys.argv[1]), sys.argv[2] if len(sys.argv) > 2 else ""))
