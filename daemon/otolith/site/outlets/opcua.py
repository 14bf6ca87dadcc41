"""An OPC UA server for HMI and SCADA: an object per machine, which clients only read, and events as alarms.

asyncua keeps its address space in memory and has no conditions that can be acknowledged or refreshed: a client that
comes later reads ``OpenEvents``.
"""

import asyncio
import hashlib
import hmac
import logging
import threading
from collections import deque
from collections.abc import Awaitable, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Any

from asyncua import Server, ua
from asyncua.crypto.permission_rules import User, UserRole

from otolith.health.limits import Level
from otolith.health.schema import ParameterDocument, ReportDocument, Status
from otolith.health.text import texts_in
from otolith.outlet_tables import OpcuaOutlet
from otolith.site.known import MAX_PARAMETERS
from otolith.site.outlets.base import MachineView, Notice, OutletError, OutletSetup, Told
from otolith.site.outlets.connections import failure
from otolith_drivers.common.credentials import certificate_and_key, password
from otolith_drivers.outside_text import visible

# Thresholds: docs/reference/thresholds-site.md has the origin of each.
START_TIMEOUT = 30.0  # s to load the standard address space
UPDATE_TIMEOUT = 10.0  # s for what has changed
MAX_NAME = 100  # characters of the name of a node
OWN_NAMES = ("State", "What", "Advice", "Since", "OpenEvents")  # Of a machine; a parameter has another name
SEVERITIES = {Level.NO_DATA: 300, Level.WATCH: 500, Level.ACT: 800}  # Of OPC UA: 1 to 1000
CALM = 100  # Severity of an alarm that is over
NAMESPACE = "urn:otolith:site"
NUMBERS = ("value", "low", "high", "limit", "nominal")
STATUSES = {
    Status.ESTIMATED: ua.StatusCodes.Good,
    Status.HELD: ua.StatusCodes.UncertainLastUsableValue,
    Status.AMBIGUOUS: ua.StatusCodes.Uncertain,
    Status.INVALID: ua.StatusCodes.UncertainSensorNotAccurate,
    Status.UNESTIMATED: ua.StatusCodes.BadWaitingForInitialData,
}

log = logging.getLogger(__name__)


class _Readers:
    """Lets clients in: with the user of the options, or without one everybody; none may write."""

    def __init__(self, user: str | None, secret: str) -> None:
        self._user, self._secret = user, secret

    def get_user(self, _: Any, username: str | None = None, password: Any = None, certificate: Any = None) -> Any:
        """Return who a client is; None refuses it. The names are those of asyncua."""
        given = password.decode(errors="replace") if isinstance(password, bytes) else str(password or "")
        is_user = hmac.compare_digest(str(username).encode(), str(self._user).encode())
        is_known = is_user and hmac.compare_digest(given.encode(), self._secret.encode())
        return User(role=UserRole.User) if self._user is None or is_known else None


@dataclass(slots=True)
class _MachineNodes:
    node: Any
    texts: dict[str, Any]  # By name
    numbers: dict[tuple[str, str], Any] = field(default_factory=dict)  # By parameter and what it is


class OpcuaServer:
    """Implements :class:`otolith.site.outlets.base.Outlet`; asyncua runs in a loop of its own."""

    def __init__(self, options: OpcuaOutlet, secret: str, setup: OutletSetup) -> None:
        self._options, self._secret, self._setup = options, secret, setup
        self._loop = asyncio.new_event_loop()
        self._thread: threading.Thread | None = None
        self._server: Any = None
        self._index = 0
        self._folders: dict[str, Any] = {}
        self._machines: dict[str, _MachineNodes] = {}
        self._alarm: Any = None
        self._refused = 0  # Notices that cannot be told

    def send(self, views: Sequence[MachineView], gone: Sequence[str], notices: deque[Notice]) -> bool:
        """Write what has changed, and trigger events; see :class:`otolith.site.outlets.base.Outlet`."""
        if self._thread is None:
            self._thread = threading.Thread(target=self._loop.run_forever, name="opcua-server", daemon=True)
            self._thread.start()
        try:
            if self._server is None:
                self._wait(self._start(), START_TIMEOUT)
            self._wait(self._update(views, gone, notices), UPDATE_TIMEOUT)
        except (OSError, TimeoutError, ua.UaError) as error:
            raise OutletError(failure(error, self._options.listen)) from error
        if refused := self._refused:
            self._refused = 0
            raise OutletError(f"{self._options.listen}: {refused} notices cannot be events of OPC UA", refused)
        return True

    def close(self) -> None:
        """End the server."""
        if self._thread is not None:
            if self._server is not None:
                self._wait(self._server.stop(), UPDATE_TIMEOUT)
            self._loop.call_soon_threadsafe(self._loop.stop)
            self._thread.join(UPDATE_TIMEOUT)
            self._thread = None
        self._loop.close()

    def _wait(self, task: Awaitable[None], timeout: float) -> None:
        async def run() -> None:
            await asyncio.wait_for(task, timeout)

        asyncio.run_coroutine_threadsafe(run(), self._loop).result(timeout + 1.0)

    async def _start(self) -> None:
        options, folder = self._options, self._setup.folder
        host, _, port = options.listen.rpartition(":")
        probe = await asyncio.get_running_loop().create_server(asyncio.Protocol, host.strip("[]"), int(port))
        probe.close()  # The address is free: the address space takes seconds
        await probe.wait_closed()
        server = Server(user_manager=_Readers(options.user, self._secret))
        await server.init()
        server.set_endpoint(f"opc.tcp://{options.listen}/otolith/")
        server.set_server_name(visible(f"Otolith: {self._setup.title}"))
        if options.certificate is not None and options.key is not None:
            await server.load_certificate(str(folder / options.certificate))
            await server.load_private_key(str(folder / options.key))
            server.set_security_policy([ua.SecurityPolicyType.Basic256Sha256_SignAndEncrypt])
        else:
            server.set_security_policy([ua.SecurityPolicyType.NoSecurity])
        kinds = (ua.UserNameIdentityToken,) if options.user is not None else (ua.AnonymousIdentityToken,)
        server.set_identity_tokens(kinds)
        self._index = await server.register_namespace(NAMESPACE)
        root = await server.nodes.objects.add_folder(self._id(""), self._named("Otolith"))  # no site has an empty name
        self._folders = {"": root}
        self._machines.clear()
        self._alarm = await server.get_event_generator(ua.ObjectIds.OffNormalAlarmType)
        await server.start()
        self._server = server

    async def _update(self, views: Sequence[MachineView], gone: Sequence[str], notices: deque[Notice]) -> None:
        for view in views:
            try:
                await self._show(view)
            except ua.UaError as error:  # what one machine publishes keeps no other from being shown
                log.warning("opcua: %s is not shown: %s", view.key, visible(str(error)))
        for key in gone:
            if (nodes := self._machines.get(key)) is not None:
                await self._server.delete_nodes([nodes.node], recursive=True)
                del self._machines[key]
                await self._leave(key.partition("/")[0])
        while notices:
            try:
                await self._trigger(notices[0])
            except ua.UaError as error:
                log.warning("opcua: %s is not told: %s", visible(notices[0].key), visible(str(error)))
                self._refused += 1
            notices.popleft()

    async def _leave(self, site: str) -> None:
        """Delete the folder of a site that has no machine."""
        if not any(key.startswith(f"{site}/") for key in self._machines) and site in self._folders:
            await self._server.delete_nodes([self._folders[site]], recursive=True)
            del self._folders[site]

    async def _show(self, view: MachineView) -> None:
        nodes = self._machines.get(view.key) or await self._add(view)
        texts = {"State": str(view.state), "What": view.what, "Advice": view.advice}
        for name, text in texts.items():
            await nodes.texts[name].write_value(_plain(text), ua.VariantType.String)
        since = None if view.since is None else _moment(view.since)
        code = ua.StatusCodes.Good if since is not None else ua.StatusCodes.BadNoData
        await nodes.texts["Since"].write_value(_value(since, ua.VariantType.DateTime, code))
        events = [] if view.report is None else [self._title(event) for event in view.report.open_events]
        await nodes.texts["OpenEvents"].write_value(ua.DataValue(ua.Variant(events, ua.VariantType.String)))
        shown = set() if view.report is None else await self._show_parameters(nodes, view, view.report)
        for name, kind in nodes.numbers.keys() - shown:
            node = nodes.numbers[name, kind]
            last = await node.read_data_value(raise_on_bad_status=False)
            code = ua.StatusCodes.BadNoCommunication
            await node.write_value(_value(last.Value.Value if last.Value else None, ua.VariantType.Double, code))

    def _title(self, event: Any) -> str:
        texts = texts_in(event.language)
        return _plain(visible(f"{texts.translated(event.state)} {texts.part(event.part)}: {event.condition}"))

    async def _show_parameters(
        self, nodes: _MachineNodes, view: MachineView, report: ReportDocument
    ) -> set[tuple[str, str]]:
        """Return what has a value; the others are of earlier reports."""
        at, shown = _moment(report.window.end), set[tuple[str, str]]()
        for name, row in list(report.parameters.items())[:MAX_PARAMETERS]:
            own = _shown_name(name)
            if (own, "value") not in nodes.numbers:
                if len(nodes.numbers) >= MAX_PARAMETERS * len(NUMBERS):  # names of now and before
                    continue
                await self._add_parameter(nodes, view.key, own, row)
            for kind in NUMBERS:
                number: float | None = getattr(row, kind)
                code = STATUSES[row.status] if kind in ("value", "low", "high") else ua.StatusCodes.Good
                code = ua.StatusCodes.BadNoData if number is None and code == ua.StatusCodes.Good else code
                await nodes.numbers[own, kind].write_value(_value(number, ua.VariantType.Double, code, at))
                shown.add((own, kind))
        return shown

    async def _add(self, view: MachineView) -> _MachineNodes:
        area = self._folders.get(view.site)
        if area is None:
            area = await self._folders[""].add_folder(self._id(view.site), self._named(view.site))
            self._folders[view.site] = area
        node = await area.add_object(self._id(view.key), self._named(view.name))
        texts = {}
        for name in OWN_NAMES[:3]:
            texts[name] = await self._variable(node, f"{view.key}/{name}", name, ua.Variant("", ua.VariantType.String))
        empty = ua.Variant([], ua.VariantType.String, is_array=True)
        texts["OpenEvents"] = await self._variable(node, f"{view.key}/OpenEvents", "OpenEvents", empty)
        begin = ua.Variant(datetime.fromtimestamp(0.0, UTC), ua.VariantType.DateTime)
        texts["Since"] = await self._variable(node, f"{view.key}/Since", "Since", begin)
        self._machines[view.key] = _MachineNodes(node, texts)
        return self._machines[view.key]

    async def _add_parameter(self, nodes: _MachineNodes, key: str, name: str, row: ParameterDocument) -> None:
        zero, place = ua.Variant(0.0, ua.VariantType.Double), f"{key}/parameters/{_escaped(name)}"
        value = await self._variable(nodes.node, place, name, zero)
        nodes.numbers[name, "value"] = value
        text = ua.LocalizedText(_plain(visible(row.unit)))
        unit = ua.EUInformation(NamespaceUri=NAMESPACE, UnitId=-1, DisplayName=text, Description=text)
        await value.add_property(self._id(f"{place}/unit"), self._named("EngineeringUnits"), unit)
        for kind in NUMBERS[1:]:
            node = await value.add_property(self._id(f"{place}/{kind}"), self._named(kind.title()), zero)
            nodes.numbers[name, kind] = node

    async def _variable(self, parent: Any, place: str, name: str, value: Any) -> Any:
        return await parent.add_variable(self._id(place), self._named(name), value)

    async def _trigger(self, notice: Notice) -> None:
        alarm, event = self._alarm.event, notice.event
        is_active = notice.told is not Told.CLEARED
        place = f"{notice.site}/{notice.machine}"
        alarm.SourceNode, alarm.SourceName = self._id(place), notice.machine
        alarm.NodeId = self._id(f"{place}/events/{_escaped(event.id)}")  # Of the condition
        alarm.ConditionName = _plain(visible(event.id))
        alarm.ConditionClassId = ua.NodeId(ua.ObjectIds.MaintenanceConditionClassType)
        alarm.ConditionClassName = ua.LocalizedText("MaintenanceConditionClassType")
        alarm.Severity = SEVERITIES.get(event.state, CALM) if is_active else CALM
        alarm.Retain = is_active
        for name, text in (("ActiveState", "Active" if is_active else "Inactive"), ("EnabledState", "Enabled"),
                           ("AckedState", "Acknowledged" if event.acknowledged else "Unacknowledged")):  # fmt: skip
            setattr(alarm, name, ua.LocalizedText(text))
            setattr(alarm, f"{name}/Id", not text.startswith(("In", "Un")))
        advice = f". {event.advice}" if is_active and event.advice else ""
        text = f"{self._title(event)}{advice}"
        time = _moment(event.since if event.end is None else event.end) or datetime.now(UTC)
        await self._alarm.trigger(time_attr=time, message=_plain(text))

    def _id(self, place: str) -> Any:
        return ua.NodeId(_plain(place), self._index)

    def _named(self, name: str) -> Any:
        return ua.QualifiedName(name, self._index)


def _escaped(name: str) -> str:
    """Return a name without the sign between the parts of a node id."""
    return name.replace("%", "%25").replace("/", "%2F")


def _shown_name(name: str) -> str:
    """Return the name of the node of a parameter; two parameters have two."""
    own = _plain(visible(name))
    if len(own) > MAX_NAME:
        digest = hashlib.sha256(name.encode(errors="replace")).hexdigest()[:8]
        own = f"{own[: MAX_NAME - 9]}~{digest}"
    return f"parameter_{own}" if own in OWN_NAMES else own


def _plain(text: str) -> str:
    """Return a text that UTF-8 can have."""
    return text.encode(errors="replace").decode()


def _moment(seconds: float) -> datetime | None:
    try:
        return datetime.fromtimestamp(seconds, UTC)
    except (OverflowError, OSError, ValueError):  # no clock has such a time, but a report may
        return None


def _value(content: Any, kind: Any, code: int, at: datetime | None = None) -> Any:
    variant = ua.Variant(None, ua.VariantType.Null) if content is None else ua.Variant(content, kind)
    return ua.DataValue(variant, ua.StatusCode(code), at, ServerTimestamp=datetime.now(UTC))


def build(options: OpcuaOutlet, setup: OutletSetup) -> OpcuaServer:
    """Return the outlet; raise ConfigurationError if a file cannot be used."""
    if options.certificate is not None and options.key is not None:
        certificate_and_key(setup.folder / options.certificate, setup.folder / options.key)
    logging.getLogger("asyncua").setLevel(logging.ERROR)  # it warns of each client without encryption
    secret = password(None if options.password_file is None else setup.folder / options.password_file)
    return OpcuaServer(options, secret, setup)
