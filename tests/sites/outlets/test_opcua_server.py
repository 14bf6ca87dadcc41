"""What an OPC UA client reads of a machine, receives of its events, and may not do."""

import dataclasses
import socket
import time
from collections import deque
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import pytest
from asyncua import ua
from asyncua.crypto.security_policies import SecurityPolicyBasic256Sha256
from asyncua.sync import Client

from otolith.health.limits import Level
from otolith.health.schema import Status
from otolith.outlet_tables import OpcuaOutlet
from otolith.site.known import MAX_PARAMETERS
from otolith.site.outlets.base import MachineView, Notice, OutletError, OutletSetup, Told
from otolith.site.outlets.opcua import OWN_NAMES, OpcuaServer, build
from tests.conftest import free_port
from tests.drivers.certificates import certificate
from tests.hostile import HOSTILE
from tests.sites.machines import LIMIT, raised, report_of
from tests.storage.histories import SITE
from tests.waiting import wait_for

TEXTS = [text.encode(errors="replace").decode() for text in HOSTILE if len(text) < 1000]


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[OpcuaServer, str]]:
    listen = f"127.0.0.1:{free_port(socket.SOCK_STREAM)}"
    setup = OutletSetup(tmp_path_factory.mktemp("site"), "Works", "en")
    with closing(build(OpcuaOutlet(listen=listen), setup)) as outlet:
        yield outlet, f"opc.tcp://{listen}/otolith/"


def view(machine: str = "press-3", *, is_silent: bool = False, **update: Any) -> MachineView:
    report = report_of(machine, end=time.time(), state=Level.ACT, events=(raised(),)).model_copy(update=update)
    state = Level.NO_DATA if is_silent else Level.ACT
    own = None if is_silent else report
    return MachineView(SITE, machine, state, str(state), time.time(), "what it is", "what to do", own, (1,))


def child(client: Client, *path: str) -> Any:
    index = client.get_namespace_index("urn:otolith:site")
    return client.nodes.objects.get_child([f"{index}:{step}" for step in ("Otolith", SITE, *path)])


@contextmanager
def connected(address: str) -> Iterator[Client]:
    with Client(address) as client:
        yield client


def test_a_client_reads_state_values_units_and_limits(served: tuple[OpcuaServer, str]) -> None:
    outlet, address = served
    held = report_of().parameters["R_a"].model_copy(update={"status": Status.HELD, "limit": None})
    outlet.send([view(parameters={**report_of().parameters, "D": held})], [], deque())
    with connected(address) as client:
        assert child(client, "press-3", "State").read_value() == "ACT"
        assert child(client, "press-3", "Advice").read_value() == "what to do"
        assert child(client, "press-3", "OpenEvents").read_value() == ["ACT winding: short circuit between turns"]
        value = child(client, "press-3", "R_a").read_data_value()
        assert value.Value.Value == 6.5
        assert value.StatusCode.is_good()
        assert abs(value.SourceTimestamp.timestamp() - time.time()) < 60.0
        assert child(client, "press-3", "R_a", "Limit").read_value() == LIMIT
        assert child(client, "press-3", "R_a", "Low").read_value() == pytest.approx(6.48)
        assert child(client, "press-3", "R_a", "EngineeringUnits").read_value().DisplayName.Text == "ohm"
        kept = child(client, "press-3", "D").read_data_value(raise_on_bad_status=False)
        assert kept.StatusCode.value == ua.StatusCodes.UncertainLastUsableValue
        none = child(client, "press-3", "D", "Limit").read_data_value(raise_on_bad_status=False)
        assert none.StatusCode.value == ua.StatusCodes.BadNoData


def test_a_client_receives_an_event_as_an_alarm(served: tuple[OpcuaServer, str]) -> None:
    outlet, address = served
    received: list[Any] = []

    class Handler:
        def event_notification(self, event: Any) -> None:
            received.append(event)

    event = raised()
    over = event.model_copy(update={"end": event.start + 60.0})
    outlet.send([view()], [], deque())
    with connected(address) as client:
        subscription = client.create_subscription(50, Handler())
        subscribe = subscription.aio_obj.subscribe_alarms_and_conditions  # which the blocking client lacks
        client.tloop.post(subscribe(ua.ObjectIds.Server, ua.ObjectIds.OffNormalAlarmType))
        waiting = deque([Notice(SITE, "press-3", Told.RAISED, event), Notice(SITE, "press-3", Told.CLEARED, over)])
        outlet.send([], [], waiting)
        assert not waiting
        wait_for(lambda: len(received) == 2)
        node = child(client, "press-3").nodeid
    first, last = received
    assert "short circuit between turns. measure resistance" in first.Message.Text
    assert (first.SourceName, first.SourceNode, first.Severity) == ("press-3", node, 800)
    assert (getattr(first, "ActiveState/Id"), first.Retain) == (True, True)
    assert (getattr(last, "ActiveState/Id"), last.Retain) == (False, False)
    assert first.NodeId == last.NodeId  # the same condition


def test_a_client_changes_nothing(served: tuple[OpcuaServer, str]) -> None:
    outlet, address = served
    outlet.send([view()], [], deque())
    with connected(address) as client:
        value, index = child(client, "press-3", "R_a"), client.get_namespace_index("urn:otolith:site")
        for attempt in (lambda: value.write_value(1.0), value.delete,
                        lambda: client.nodes.objects.add_folder(index, "x")):  # fmt: skip
            with pytest.raises(ua.UaStatusCodeError):
                attempt()
        assert value.read_value() == 6.5
    admin = Client(address)
    admin.set_user("admin")
    admin.set_password("admin")
    with pytest.raises(ua.UaError), admin:
        child(admin, "press-3", "R_a").write_value(1.0)


def test_texts_from_outside_are_texts_and_names_of_nodes(served: tuple[OpcuaServer, str]) -> None:
    outlet, address = served
    parameter = report_of().parameters["R_a"]
    rows = {text: parameter.model_copy(update={"unit": text}) for text in TEXTS}
    notices = deque(Notice(SITE, "hostile", Told.RAISED, raised().model_copy(update={
        "id": text, "part": text, "condition": text, "advice": text})) for text in TEXTS)  # fmt: skip
    outlet.send([view("hostile", parameters=rows)], [], notices)
    assert not notices
    with connected(address) as client:
        names = {node.read_browse_name().Name for node in child(client, "hostile").get_children()}
    assert len(names) == len(TEXTS) + 5
    assert not set("\n\r\0\x1b\u202e") & set("".join(names))


def test_no_name_hides_the_node_of_another(served: tuple[OpcuaServer, str]) -> None:
    """Names that would have one node id, or one name, without an escape."""
    outlet, address = served
    parameter = report_of().parameters["R_a"]
    names = ["a", "a/limit", "a/unit", "a%2Flimit", "State", "OpenEvents", "x" * 150, "x" * 151]
    rows = {name: parameter.model_copy(update={"value": float(index)}) for index, name in enumerate(names)}
    own = view("names", parameters=rows)
    outlet.send([own, dataclasses.replace(own, site="Otolith")], [], deque())
    with connected(address) as client:
        assert child(client, "names", "State").read_value() == "ACT"
        nodes = child(client, "names").get_children()
        names = [node.read_browse_name().Name for node in nodes]
        assert len(set(names)) == len(names) == len(rows) + 5
        values = {node.read_value() for name, node in zip(names, nodes, strict=True) if name not in OWN_NAMES}
        assert values == set(map(float, range(len(rows))))
        other = client.nodes.objects.get_child([f"{child(client, 'names').nodeid.NamespaceIndex}:{step}"
                                                for step in ("Otolith", "Otolith", "names", "State")])  # fmt: skip
        assert other.read_value() == "ACT"


def test_the_names_of_a_machine_are_bounded_also_one_after_the_other(served: tuple[OpcuaServer, str]) -> None:
    outlet, address = served
    parameter = report_of().parameters["R_a"]
    for index in range(0, 2 * MAX_PARAMETERS, 32):
        rows = {f"p{index + offset}": parameter for offset in range(32)}
        outlet.send([view("many", parameters=rows)], [], deque())
    with connected(address) as client:
        assert len(child(client, "many").get_children()) == MAX_PARAMETERS + 5
        gone = child(client, "many", "p0").read_data_value(raise_on_bad_status=False)
        assert gone.StatusCode.value == ua.StatusCodes.BadNoCommunication


def test_a_machine_that_cannot_be_shown_hinders_no_other(
    served: tuple[OpcuaServer, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    outlet, address = served
    show = OpcuaServer._show

    async def refuse(server: OpcuaServer, own: MachineView) -> None:
        if own.name == "bad":
            raise ua.UaStatusCodeError(ua.StatusCodes.BadNodeIdExists)
        await show(server, own)

    monkeypatch.setattr(OpcuaServer, "_show", refuse)
    outlet.send([view("bad"), view("good")], [], deque())
    with connected(address) as client:
        assert child(client, "good", "State").read_value() == "ACT"


def test_a_notice_that_cannot_be_told_is_lost_and_hinders_no_other(
    served: tuple[OpcuaServer, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    outlet, _ = served
    outlet.send([view()], [], deque())

    async def refuse(server: OpcuaServer, own: Notice) -> None:
        raise ua.UaStatusCodeError(ua.StatusCodes.BadInternalError)

    monkeypatch.setattr(OpcuaServer, "_trigger", refuse)
    waiting = deque([Notice(SITE, "press-3", Told.RAISED, raised())] * 2)
    with pytest.raises(OutletError) as caught:
        outlet.send([], [], waiting)
    assert (len(waiting), caught.value.refused) == (0, 2)
    outlet.send([], [], waiting)


def test_a_site_without_machines_has_no_folder(served: tuple[OpcuaServer, str]) -> None:
    outlet, address = served
    outlet.send([dataclasses.replace(view(), site="hall-9")], [], deque())
    outlet.send([], ["hall-9/press-3"], deque())
    with connected(address) as client:
        folder = client.nodes.objects.get_child(f"{client.get_namespace_index('urn:otolith:site')}:Otolith")
        assert "hall-9" not in {node.read_browse_name().Name for node in folder.get_children()}
    outlet.send([dataclasses.replace(view(), site="hall-9")], [], deque())  # it comes back


def test_a_silent_machine_has_bad_values_and_one_that_is_gone_no_node(served: tuple[OpcuaServer, str]) -> None:
    outlet, address = served
    outlet.send([view("quiet"), view("gone")], [], deque())
    outlet.send([view("quiet", is_silent=True)], [f"{SITE}/gone"], deque())
    with connected(address) as client:
        assert child(client, "quiet", "State").read_value() == "NO DATA"
        value = child(client, "quiet", "R_a").read_data_value(raise_on_bad_status=False)
        assert value.StatusCode.value == ua.StatusCodes.BadNoCommunication
        with pytest.raises(ua.UaStatusCodeError):
            child(client, "gone")
    outlet.send([view("gone")], [], deque())  # it comes back


def test_others_reach_it_encrypted_and_by_name_only(tmp_path: Path) -> None:
    certificate(tmp_path, "server")
    own, key = certificate(tmp_path, "client")
    (tmp_path / "password").write_text("secret\n", encoding="utf-8")
    (tmp_path / "password").chmod(0o600)
    with pytest.raises(ValueError, match="certificate"):
        OpcuaOutlet(listen="0.0.0.0:4840")
    listen = f"127.0.0.1:{free_port(socket.SOCK_STREAM)}"
    options = OpcuaOutlet(listen=listen, certificate=Path("server.der"), key=Path("server.pem"), user="hmi",
                          password_file=Path("password"))  # fmt: skip
    address = f"opc.tcp://{listen}/otolith/"
    with closing(build(options, OutletSetup(tmp_path, "Works", "en"))) as outlet:
        outlet.send([view()], [], deque())

        def reads(secret: str | None, *, is_encrypted: bool = True, user: str = "hmi") -> bool:
            client = Client(address)
            try:
                if is_encrypted:
                    client.application_uri = "urn:client"
                    client.set_security(SecurityPolicyBasic256Sha256, str(own), str(key))
                if secret is not None:
                    client.set_user(user)
                    client.set_password(secret)
                with client:
                    return bool(child(client, "press-3", "R_a").read_value() == 6.5)
            except (ua.UaError, OSError, TimeoutError):
                return False

        assert reads("secret")
        assert not reads("wrong")
        assert not reads("secret", user="admin")
        assert not reads(None)
        assert not reads("secret", is_encrypted=False)
