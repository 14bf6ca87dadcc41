"""What each outlet passes its knowledge on to, in the tests: real servers, and what they received."""

import email
import email.policy
import http.server
import json
import socket
import socketserver
import threading
import urllib.request
from abc import ABC, abstractmethod
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

from asyncua.sync import Client
from paho.mqtt import client as mqtt
from paho.mqtt.enums import CallbackAPIVersion
from prometheus_client.parser import text_string_to_metric_families
from tahutils.tahu.sparkplug_b_pb2 import Payload

from tests.conftest import free_port
from tests.drivers.mqtt_broker import mqtt_broker
from tests.waiting import wait_for


class Rig(ABC):
    """A receiver. Not each outlet has states and events: ``None`` is what it does not have."""

    name = ""
    tells = True  # Events

    def __init_subclass__(cls, name: str) -> None:
        cls.name = name

    def __init__(self, folder: Path) -> None:
        self.folder, self.port = folder, free_port(socket.SOCK_STREAM)
        self._stack, self.is_started = ExitStack(), False

    @abstractmethod
    def table(self) -> str:
        """The lines of its table in the file of a site."""

    def prevent(self) -> None:
        """Keep the outlet from passing anything on until :meth:`start`."""
        assert not self.is_started  # who has not started does so by itself

    @abstractmethod
    def start(self) -> None:
        """Start the receiver."""

    def stop(self) -> None:
        """End the receiver."""
        self._stack.close()

    def states(self) -> dict[str, str] | None:
        """The state of each machine, as a reader gets it who comes now."""
        return None

    @abstractmethod
    def events(self) -> list[tuple[str, str]] | None:
        """Machine and what was told, in the order in which it came."""


class _Posted(http.server.BaseHTTPRequestHandler):
    def do_POST(self) -> None:
        content = self.rfile.read(int(self.headers["content-length"]))
        self.server.received.append((dict(self.headers), content))  # type: ignore[attr-defined]
        self.send_response(204)
        self.end_headers()

    def log_message(self, format: str, *args: Any) -> None:  # noqa: A002 - as http.server has it
        """Keep quiet."""


class WebhookRig(Rig, name="webhook"):
    """A server of HTTP."""

    received: list[tuple[dict[str, str], bytes]]

    def table(self) -> str:
        (self.folder / "secret").write_text("of this test\n", encoding="utf-8")
        (self.folder / "secret").chmod(0o600)
        return f'url = "http://127.0.0.1:{self.port}/hook?a=1"\nsecret_file = "secret"'

    def start(self) -> None:
        self.received = []
        server = http.server.ThreadingHTTPServer(("127.0.0.1", self.port), _Posted)
        server.received = self.received  # type: ignore[attr-defined]
        _serve(server, self._stack)

    def events(self) -> list[tuple[str, str]]:
        documents = [json.loads(content) for _, content in self.received]
        return [(row["machine"], row["told"]) for row in documents]


class _Mailbox(socketserver.StreamRequestHandler):
    def handle(self) -> None:
        self.wfile.write(b"220 test\r\n")
        while line := self.rfile.readline(1000).strip().upper():
            if line.startswith(b"DATA"):
                self.wfile.write(b"354 go on\r\n")
                lines = iter(self.rfile.readline, b".\r\n")
                text = b"".join(line.removeprefix(b".") for line in lines)
                self.server.received.append(text)  # type: ignore[attr-defined]
            self.wfile.write(b"221 bye\r\n" if line.startswith(b"QUIT") else b"250 test\r\n")


class MailRig(Rig, name="mail"):
    """A server of SMTP."""

    received: list[bytes]

    def table(self) -> str:
        own = f'host = "127.0.0.1"\nport = {self.port}\nsecurity = "none"\nsender = "site@works.example"'
        return f'{own}\nto = ["shift@works.example"]'

    def start(self) -> None:
        self.received = []
        server = socketserver.ThreadingTCPServer(("127.0.0.1", self.port), _Mailbox, bind_and_activate=False)
        server.allow_reuse_address = server.daemon_threads = True
        server.server_bind()
        server.server_activate()
        server.received = self.received  # type: ignore[attr-defined]
        _serve(server, self._stack)

    def messages(self) -> list[email.message.EmailMessage]:
        """What was received."""
        return [email.message_from_bytes(text, policy=email.policy.default) for text in self.received]

    def events(self) -> list[tuple[str, str]]:
        words = {"OK": "cleared", "WATCH": "raised", "ACT": "raised"}
        found = []
        for message in self.messages():
            body = message.get_content()
            for line in body.splitlines():
                word, _, rest = line.partition(" ")
                if word in words and rest.count(": ") >= 2:
                    found.append((rest.partition(":")[0], words[word]))
        return found


class MqttRig(Rig, name="mqtt"):
    """A broker, and a subscriber that comes before all, and one that comes now."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self._received: list[mqtt.MQTTMessage] = []

    def table(self) -> str:
        return f'host = "127.0.0.1"\nport = {self.port}'

    def start(self) -> None:
        self._stack.enter_context(mqtt_broker(self.port, self.folder))
        client, is_subscribed = self.subscriber(self._received)
        self._stack.callback(client.loop_stop)
        self._stack.callback(client.disconnect)
        wait_for(is_subscribed.is_set)

    def subscriber(self, received: list[mqtt.MQTTMessage]) -> tuple[mqtt.Client, threading.Event]:
        """A client that subscribes all, and what says that it has."""
        client, is_subscribed = mqtt.Client(CallbackAPIVersion.VERSION2), threading.Event()
        client.on_message = lambda _, __, message: received.append(message)
        client.on_subscribe = lambda *_: is_subscribed.set()
        client.connect("127.0.0.1", self.port)
        client.subscribe("#", 1)
        client.loop_start()
        return client, is_subscribed

    def retained(self) -> dict[str, bytes]:
        """What a subscriber gets that comes now."""
        received: list[mqtt.MQTTMessage] = []
        client, is_subscribed = self.subscriber(received)
        wait_for(is_subscribed.is_set)
        client.publish("end", b"of what is retained", qos=1)
        wait_for(lambda: any(message.topic == "end" for message in received))
        client.disconnect()
        client.loop_stop()
        return {message.topic: bytes(message.payload) for message in received if message.topic != "end"}

    def states(self) -> dict[str, str]:
        found = {topic: json.loads(text) for topic, text in self.retained().items() if topic.endswith("/state")}
        return {row["machine"]: row["state"] for row in found.values()}

    def events(self) -> list[tuple[str, str]]:
        own = [json.loads(each.payload) for each in list(self._received) if each.topic.endswith("/event")]
        return [(row["machine"], row["told"]) for row in own]


class SparkplugRig(MqttRig, name="sparkplug"):
    """A host that follows the node by the official schema; one that comes now asks for births."""

    def decoded(self, received: list[mqtt.MQTTMessage]) -> list[tuple[str, str, Any]]:
        """Kind, device and payload of each message of the node."""
        found = []
        for message in list(received):
            parts = message.topic.split("/")
            if parts[0] == "spBv1.0" and parts[2] != "NCMD":
                found.append((parts[2], "/".join(parts[4:]), Payload.FromString(bytes(message.payload))))
        return found

    @property
    def messages(self) -> list[tuple[str, str, Any]]:
        """What came to the host that was there before all."""
        return self.decoded(self._received)

    def command(self, client: mqtt.Client, topic: str) -> None:
        """Ask for births."""
        asked = Payload(timestamp=1)
        asked.metrics.add(name="Node Control/Rebirth", datatype=11, boolean_value=True)
        client.publish(topic, asked.SerializeToString(), qos=1)

    def states(self) -> dict[str, str]:
        nodes = {message.topic.split("/")[3] for message in list(self._received) if "/NBIRTH/" in message.topic}
        received: list[mqtt.MQTTMessage] = []
        client, is_subscribed = self.subscriber(received)
        wait_for(is_subscribed.is_set)
        for node in nodes:
            self.command(client, f"spBv1.0/otolith/NCMD/{node}")

        def is_born() -> bool:
            own = self.decoded(received)
            counts = [metrics_of(born)["Machines"].int_value for kind, _, born in own if kind == "NBIRTH"]
            return len(counts) >= len(nodes) and len([1 for kind, _, _ in own if kind == "DBIRTH"]) >= sum(counts)

        wait_for(is_born)
        client.disconnect()
        client.loop_stop()
        births = [(device, metrics_of(born)) for kind, device, born in self.decoded(received) if kind == "DBIRTH"]
        return {device.rpartition(".")[2]: own["State"].string_value for device, own in births}

    def events(self) -> list[tuple[str, str]]:
        own = [metrics_of(data)["Event"] for kind, _, data in self.messages if kind == "NDATA"
               if "Event" in metrics_of(data)]  # fmt: skip
        rows = [json.loads(metric.string_value) for metric in own]
        return [(row["machine"], row["told"]) for row in rows]


def metrics_of(payload: Any) -> dict[str, Any]:
    """The metrics of a payload by name."""
    return {metric.name: metric for metric in payload.metrics}


class OpcuaRig(Rig, name="opcua"):
    """A client that reads: events come to those who have subscribed them, which has a test of its own."""

    _held: socket.socket | None = None

    def table(self) -> str:
        return f'listen = "127.0.0.1:{self.port}"'

    def prevent(self) -> None:
        self._held = socket.create_server(("127.0.0.1", self.port))

    def start(self) -> None:
        if self._held is not None:
            self._held.close()

    def client(self) -> Client:
        """A client, not connected."""
        return Client(f"opc.tcp://127.0.0.1:{self.port}/otolith/")

    def states(self) -> dict[str, str]:
        found = {}
        with suppress(OSError), self.client() as client:  # it may not listen yet
            index = client.get_namespace_index("urn:otolith:site")
            for area in client.nodes.objects.get_child(f"{index}:Otolith").get_children():
                for machine in area.get_children():
                    state = machine.get_child(f"{index}:State").read_value()
                    found[machine.read_browse_name().Name] = state
        return found

    def events(self) -> None:
        return None


def _serve(server: socketserver.TCPServer, stack: ExitStack) -> None:
    thread = threading.Thread(target=server.serve_forever, args=(0.02,), daemon=True)
    thread.start()
    stack.callback(thread.join)
    stack.callback(server.server_close)
    stack.callback(server.shutdown)


class PrometheusRig(Rig, name="prometheus"):
    """Who scrapes."""

    tells = False
    _held: socket.socket | None = None

    def table(self) -> str:
        return f'listen = "127.0.0.1:{self.port}"'

    def prevent(self) -> None:
        self._held = socket.create_server(("127.0.0.1", self.port))

    def start(self) -> None:
        if self._held is not None:
            self._held.close()

    def is_open(self) -> bool:
        """Whether scrapes are answered."""
        with socket.socket() as probe:
            return probe.connect_ex(("127.0.0.1", self.port)) == 0

    def states(self) -> dict[str, str]:
        with suppress(OSError):  # it may not listen yet
            return {sample.labels["machine"]: sample.labels["state"].upper().replace("_", " ")
                    for family in text_string_to_metric_families(scraped(self.port)) for sample in family.samples
                    if sample.name == "otolith_machine_state" and sample.value}  # fmt: skip
        return {}

    def events(self) -> None:
        return None


def scraped(port: int) -> str:
    """What a scrape answers."""
    with urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics", timeout=10.0) as answer:
        return str(answer.read().decode())


RIGS: dict[str, type[Rig]] = {
    kind.name: kind for kind in (MqttRig, SparkplugRig, WebhookRig, MailRig, OpcuaRig, PrometheusRig)
}
