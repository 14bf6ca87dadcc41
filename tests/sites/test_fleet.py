"""The files of docs/fleet.md: a machine, the routers of its cell and its plant, and a site, with certificates."""

import json
import re
import time
import tomllib
from collections.abc import Iterator
from contextlib import AbstractContextManager, ExitStack, closing, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from socket import SOCK_STREAM

import pytest
import zenoh

from otolith.health.limits import Level
from otolith.machine_file import ZenohTable
from otolith.publishing.certificates import Identity, make_authority, make_certificate, utc_now
from otolith.publishing.commands.signatures import signed
from otolith.publishing.reader_sessions import NotCarriedOutError, ReaderSessions
from otolith.publishing.subscriber import Subscriber
from otolith.publishing.zenoh_config import TLS, Access, Connection, Credentials, reader_settings
from otolith.publishing.zenoh_session import COMMAND, REPORT, close_session, session
from otolith_drivers.errors import ServiceError
from tests.cli.commands import otolith
from tests.conftest import free_port
from tests.publishing.test_commands import LIMIT, command
from tests.sites.machines import Daemon, report_of, sent
from tests.sites.serving import router, serving
from tests.storage.histories import MACHINE, SITE
from tests.waiting import wait_for

PAGE = (Path(__file__).parents[2] / "docs" / "fleet.md").read_text(encoding="utf-8")
ROUTER = """
import sys, zenoh
with zenoh.open(zenoh.Config.from_file(sys.argv[1])):
    print("open", flush=True)
    sys.stdin.read()
"""


@dataclass
class Fleet:
    """The files of the page in a folder, for ports of this computer."""

    folder: Path
    ports: dict[str, int] = field(
        default_factory=lambda: {name: free_port(SOCK_STREAM) for name in ("plant", "cell-1")}
    )

    def block(self, language: str, begin: str) -> str:
        """A block of the page with hosts, ports and folders of the test."""
        blocks = re.findall(rf"^```{language}\n(.*?)^```", PAGE, re.MULTILINE | re.DOTALL)
        text: str
        (text,) = (each for each in blocks if begin in each)
        for name, port in self.ports.items():
            text = text.replace(f"tls/{name}.local:7447", self.endpoint(name))
            if f'"/etc/zenohd/{name}.crt"' in text:
                text = text.replace("tls/0.0.0.0:7447", f"tls/localhost:{port}")
        return text.replace("/etc/zenohd", str(self.folder / "keys"))

    def endpoint(self, name: str) -> str:
        """That of a router."""
        return f"tls/localhost:{self.ports[name]}"

    def write(self) -> None:
        """Write the files, and certificates as the page says."""
        for line in re.findall(r"^    otolith (keys .*)$", PAGE, re.MULTILINE):
            words = [str(self.folder / word) if word == "keys" and at else word for at, word in enumerate(line.split())]
            assert otolith(*words, *(["--host", "localhost"] if "--host" in words else [])).exit_code == 0
        cell = self.block("json5", "// cell-1.json5")
        (self.folder / "cell-1.json5").write_text(cell, encoding="utf-8")
        plant = cell.replace("cell-1.crt", "plant.crt").replace("cell-1.key", "plant.key")
        plant = plant.replace(self.endpoint("cell-1"), self.endpoint("plant"))
        config = zenoh.Config.from_json5(plant)
        differences = self.block("json5", "// differences of plant.json5")
        access = zenoh.Config.from_json5(differences).get_json("access_control")
        config.insert_json5("connect/endpoints", "[]")
        config.insert_json5("listen/endpoints", json.dumps([self.endpoint("plant")]))
        config.insert_json5("access_control", access)
        (self.folder / "plant.json5").write_text(str(config), encoding="utf-8")

    def credentials(self, name: str, folder: str = "keys") -> Credentials:
        """What proves a name."""
        own = self.folder / folder
        return Credentials(self.folder / "keys" / "ca.crt", own / f"{name}.crt", own / f"{name}.key")

    def client(self, name: str, router: str, folder: str = "keys") -> zenoh.Session:
        """A session to a router under a name."""
        endpoint = self.endpoint(router)
        return session((), [endpoint], reader_settings(self.credentials(name, folder), [endpoint]), "client")

    def machine(self, machine: str = MACHINE, commands: tuple[str, ...] = ()) -> Daemon:
        """The daemon of the machine file of the page; ``commands`` are who may send them."""
        table = ZenohTable.model_validate(tomllib.loads(self.block("toml", "[zenoh.tls]"))["zenoh"])
        table = table.model_copy(update={"access": table.access.model_copy(update={"commands": commands})})
        return Daemon(self.folder, machine, access=Access(table, self.folder / "machine.toml"))

    def router(self, name: str) -> AbstractContextManager[None]:
        """A router with its file."""
        return router(ROUTER, str(self.folder / f"{name}.json5"))


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Fleet]:
    """The fleet of the page, with both routers."""
    made = Fleet(tmp_path_factory.mktemp("fleet"))
    made.write()
    with made.router("plant"):
        yield made


@contextmanager
def reading(fleet: Fleet, router: str, name: str) -> Iterator[list[str]]:
    """The keys of what a reader gets at a router."""
    got: list[str] = []
    with closing(fleet.client(name, router)) as own:
        own.declare_subscriber("otolith/**", lambda sample: got.append(str(sample.key_expr)))
        yield got


def test_reports_pass_both_routers_and_come_once_in_order_after_one_was_away(fleet: Fleet, tmp_path: Path) -> None:
    table = tomllib.loads(fleet.block("toml", 'certificate = "keys/site.crt"'))["zenoh"]
    files = "\n".join(f'{key} = "{fleet.folder / table[key]}"' for key in ("ca", "certificate", "key"))
    texts: list[str] = []
    connection = Connection(tuple(table["connect"]), fleet.credentials("site"))
    with ExitStack() as stack:
        cell = stack.enter_context(ExitStack())
        cell.enter_context(fleet.router("cell-1"))
        daemon = stack.enter_context(closing(fleet.machine()))
        first = daemon.keep(report_of(end=time.time() - 60.0))
        subscriber = stack.enter_context(Subscriber(connection, texts.append, after=0))

        def comes(state: Level) -> None:
            def is_here() -> bool:
                daemon.publish(report_of(end=time.time(), state=state))
                time.sleep(0.05)
                return any(f'"state":"{state}"' in text for text in texts)

            wait_for(is_here)

        comes(Level.WATCH)
        cell.close()  # the router of the cell is killed
        wait_for(lambda: not fleet_is_alive(fleet))
        for _ in range(40):
            daemon.publish(report_of(end=time.time(), state=Level.WATCH))
        cell.enter_context(fleet.router("cell-1"))
        comes(Level.ACT)
        numbers = [json.loads(text)["sequence"] for text in texts]
        assert numbers == sorted(set(numbers))
        assert numbers[0] == first.sequence
        assert subscriber.order.missed == 0
        served = stack.enter_context(serving(tmp_path, *table["connect"], tables=files))  # one that starts later
        wait_for(lambda: 'id="count-ACT">1<' in served.ask("/").text)
        assert served.ask(f"/machine/{SITE}/{MACHINE}").status == 200


def test_a_signed_command_passes_both_routers_and_the_daemon_knows_who_sent_it(fleet: Fleet) -> None:
    endpoint, files = fleet.endpoint("plant"), fleet.folder / "keys"
    with ExitStack() as stack:
        stack.enter_context(fleet.router("cell-1"))
        daemon = stack.enter_context(closing(fleet.machine(commands=("site",))))
        reader = ReaderSessions(Connection((endpoint,), fleet.credentials("site")), (REPORT,), lambda _: None)
        stack.enter_context(closing(reader))
        reader.start()
        wait_for(lambda: bool(reader.where(f"otolith/{SITE}/{MACHINE}")))
        daemon.publish(report_of(end=time.time(), events=(LIMIT,)))
        for name in ("plant", "press-3"):
            own = Identity(files / "ca.crt", files / f"{name}.crt", files / f"{name}.key")
            with pytest.raises(NotCarriedOutError):
                reader.command(COMMAND.under(SITE, MACHINE), signed(command(), own))
        own = Identity(files / "ca.crt", files / "site.crt", files / "site.key")
        assert b"true" in reader.command(COMMAND.under(SITE, MACHINE), signed(command(), own))
        assert [note.by for note in daemon.decisions.read().notes] == ["anna (site)"]


def fleet_is_alive(fleet: Fleet) -> bool:
    """Whether the router of the plant hears a machine."""
    with closing(fleet.client("site", "plant")) as own:
        return any(reply.ok for reply in own.liveliness().get("otolith/**", timeout=2.0))


@pytest.mark.parametrize("who", ["without certificate", "of another authority", "in the clear"])
def test_who_has_no_certificate_of_the_authority_is_refused(fleet: Fleet, who: str) -> None:
    endpoint, folder = fleet.endpoint("plant"), fleet.folder / who
    close_session(fleet.client("site", "plant"))  # who has one is not
    own = reader_settings(fleet.credentials("site"), [endpoint])
    if who == "without certificate":
        own = reader_settings(Credentials(fleet.folder / "keys" / "ca.crt"), [endpoint])
    elif who == "of another authority":
        make_authority(folder, utc_now())
        make_certificate(folder, "site", [], utc_now())
        files = {"connect_certificate": str(folder / "site.crt"), "connect_private_key": str(folder / "site.key")}
        own[TLS] = {**dict(own[TLS]), **files}  # type: ignore[call-overload]  # a setting may be of any type
    else:
        endpoint, own = endpoint.replace("tls/localhost", "tcp/127.0.0.1"), {}
    with pytest.raises(ServiceError):
        session((), [endpoint], own, "client")


def test_nobody_publishes_for_others_or_reads_without_a_policy(fleet: Fleet) -> None:
    make_certificate(fleet.folder / "keys", "visitor", [], utc_now())
    forged = report_of("press-4")
    with ExitStack() as stack:
        stack.enter_context(fleet.router("cell-1"))
        daemon = stack.enter_context(closing(fleet.machine()))
        site, visitor = (stack.enter_context(reading(fleet, "plant", name)) for name in ("site", "visitor"))
        forgers = {
            ("press-3", "cell-1"): sent(forged)[0],
            ("plant", "cell-1"): "otolith/hall-1/press-5/report",
            ("site", "plant"): "otolith/hall-1/press-3/event",
            ("cell-1", "plant"): "otolith/hall-2/mill-1/report",
            ("visitor", "cell-1"): "otolith/hall-1/press-3/start",
        }
        opened = {who: stack.enter_context(closing(fleet.client(*who))) for who in forgers}

        def has_come() -> bool:
            for who, key in forgers.items():
                opened[who].put(key, sent(forged)[1])
            daemon.publish(report_of())
            time.sleep(0.05)
            return site.count("otolith/hall-1/press-3/report") >= 5

        wait_for(has_come)
        opened["press-3", "cell-1"].put("otolith/hall-1/press-3/event", b"{}")  # its own
        wait_for(lambda: "otolith/hall-1/press-3/event" in site)
        forged_keys = {*forgers.values()} - {"otolith/hall-1/press-3/event"}
        assert not forged_keys & {*site}
        assert site.count("otolith/hall-1/press-3/event") == 1
        assert visitor == []
