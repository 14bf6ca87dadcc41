"""The OPC UA tables of a machine file, and a connected client: security, user, causes of a refusal."""

import asyncio
import logging
import time
from collections import deque
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any, Literal, Self
from urllib.parse import unquote, urlsplit

from asyncua import Client, ua
from asyncua.crypto import security_policies
from asyncua.ua.ua_binary import struct_from_binary
from cryptography import x509
from cryptography.hazmat.primitives import hashes
from pydantic import BeforeValidator, Field, model_validator

from otolith_drivers.base import ScaledSource
from otolith_drivers.common.credentials import CredentialOptions, certificate, certificate_and_key, password
from otolith_drivers.common.message_times import ExchangeClock, unix_time
from otolith_drivers.common.reconnection import cause_of
from otolith_drivers.errors import nearest
from otolith_drivers.units import Quantity

CLOSE_TIMEOUT = 0.4  # s for the server to end the session; the driver interface asks for 1 s in all
MAX_BROWSED = 20_000  # nodes of a server that are looked at
MODES = {"sign": ua.MessageSecurityMode.Sign, "sign and encrypt": ua.MessageSecurityMode.SignAndEncrypt}
REFUSALS = {
    "certificate": (
        "BadCertificateUntrusted", "BadSecurityChecksFailed", "BadCertificateInvalid", "BadCertificateUriInvalid",
        "BadCertificateUseNotAllowed", "BadCertificateChainIncomplete",
    ),
    "user": ("BadIdentityTokenRejected", "BadIdentityTokenInvalid", "BadUserAccessDenied"),
}  # fmt: skip

logging.getLogger("asyncua").setLevel(logging.CRITICAL)  # it logs a traceback for each lost connection


class OpcuaOptions(CredentialOptions):
    """``[driver]`` with ``type = "opcua"``."""

    endpoint: str  # opc.tcp://host:port with the path that the server asks for
    security: Literal["none", "Basic256Sha256", "Aes128Sha256RsaOaep", "Aes256Sha256RsaPss"] = "none"
    mode: Literal["sign", "sign and encrypt"] = "sign and encrypt"
    server_certificate: Path | None = None  # The only certificate that is accepted from the server; without it, any
    timeout: Annotated[float, BeforeValidator(Quantity("s", 0.1, 60.0))] = 4.0  # Longest, from request to answer
    interval: Annotated[float, BeforeValidator(Quantity("s", 0.005, 10.0))] = 0.05  # From one message to the next
    stamps: Literal["source", "server"] = "source"  # Whose time stamps; a value without the source's has the server's

    @model_validator(mode="after")
    def _is_consistent(self) -> Self:
        place = urlsplit(self.endpoint)
        if place.scheme != "opc.tcp" or not place.hostname or "@" in place.netloc:
            raise ValueError(f'{self.endpoint!r} is no endpoint: write "opc.tcp://192.168.0.10:4840"')
        if (self.security == "none") == bool(self.certificate or self.key):
            text = 'certificate and key belong to security = "Basic256Sha256" or another policy: set all three'
            raise ValueError(text)
        return self

    def describe(self) -> list[str]:
        """Return endpoint and security, and what is not secure, a line each."""
        secure = "without security" if self.security == "none" else f"{self.security}, {self.mode}"
        lines = [f"OPC UA {self.endpoint}, {secure}, read only (subscription every {self.interval * 1e3:g} ms)"]
        if self.security != "none" and self.server_certificate is None:
            lines.append("warning: any certificate of the server is accepted: set server_certificate to its own")
        if self.security == "none" and self.user is not None:
            lines.append(
                "warning: values are not protected, and the password only if the server encrypts it: set security"
            )
        return lines


class OpcuaSource(ScaledSource):
    """Variable of a signal: ``{ node = "nsu=urn:maker;s=Speed" }``; its unit is the server's unless it is given."""

    node: Annotated[str, Field(min_length=1)]

    @model_validator(mode="after")
    def _is_a_node(self) -> Self:
        try:
            ua.NodeId.from_string(self.node)
        except ua.UaError:
            example = '"nsu=urn:maker;s=Motor.Speed", "ns=2;s=Motor.Speed" or "ns=3;i=1001"'
            raise ValueError(f"{self.node!r} is no node id: write {example}") from None
        return self


@dataclass(frozen=True, slots=True)
class OpcUaCredentials:
    """Certificate, key and password, read from their files."""

    certificate: x509.Certificate | None = None
    key: Any = None
    server: x509.Certificate | None = None
    password: str = ""

    @classmethod
    def load(cls, options: OpcuaOptions, folder: Path) -> Self:
        """Return the content of the files of ``options`` in ``folder``; raise ConfigurationError if one is wrong."""
        own = key = server = None
        if options.certificate is not None and options.key is not None:
            own, key = certificate_and_key(folder / options.certificate, folder / options.key)
        if options.server_certificate is not None:
            server = certificate(folder / options.server_certificate, "server_certificate")
        secret = None if options.password_file is None else folder / options.password_file
        return cls(own, key, server, password(secret))


class RefusedError(Exception):
    """The server refuses the connection; the text has the cause and what to do."""


@asynccontextmanager
async def connected(options: OpcuaOptions, credentials: OpcUaCredentials) -> AsyncIterator[tuple[Client, list[str]]]:
    """Yield a client with a session and what is wrong with the server's certificate, a line each; end both.

    Raises:
        RefusedError: the server refuses the certificate, the user or the security policy, or its certificate is wrong.
    """
    client, warnings = Client(options.endpoint, timeout=options.timeout), list[str]()
    if options.user is not None:
        client.set_user(options.user)
        client.set_password(credentials.password)
    try:
        if credentials.certificate is not None:
            presented = await _secure(client, options, credentials)
            host = str(urlsplit(options.endpoint).hostname) if credentials.server is None else None
            warnings = certificate_warnings(presented, host, datetime.now(UTC))
        await client.connect()
        yield client, warnings
    except ua.UaError as error:
        raise RefusedError(_cause(error, options)) from error
    finally:
        # A task of its own, as the library swallows the cancellation by which a timeout would end it.
        ending = asyncio.create_task(_end(client))
        try:
            await asyncio.wait({ending}, timeout=CLOSE_TIMEOUT)
        finally:
            ending.cancel()
            with suppress(Exception):
                client.disconnect_socket()


async def _end(client: Client) -> None:
    """End the session and the connection of a server that may no longer answer."""
    with suppress(Exception):
        await client.disconnect()


async def _secure(client: Client, options: OpcuaOptions, credentials: OpcUaCredentials) -> x509.Certificate:
    """Set the security policy with the certificate that the server presents, and return that.

    Raises:
        RefusedError: the server has not the policy, or not the certificate that the machine file names.
    """
    own = credentials.certificate
    assert own is not None  # noqa: S101 - for the type checker
    endpoints = await client.connect_and_get_server_endpoints()
    policy: Any = getattr(security_policies, f"SecurityPolicy{options.security}")
    suited = [
        one for one in endpoints if (one.SecurityPolicyUri, one.SecurityMode) == (policy.URI, MODES[options.mode])
    ]
    if not suited:
        offered = {f"{(one.SecurityPolicyUri or '').rpartition('#')[2]} {one.SecurityMode.name}" for one in endpoints}
        text = f"the server has not {options.security}, {options.mode}; it offers {', '.join(sorted(offered))}"
        raise RefusedError(text)
    try:
        presented = x509.load_der_x509_certificate(suited[0].ServerCertificate)
    except ValueError:  # the certificate is followed by those of its issuers
        size = int.from_bytes(suited[0].ServerCertificate[2:4]) + 4
        presented = x509.load_der_x509_certificate(suited[0].ServerCertificate[:size])
    if credentials.server is not None and presented != credentials.server:
        print_of = presented.fingerprint(hashes.SHA256()).hex(":")
        raise RefusedError(f"the server's certificate is not that of server_certificate: it has the SHA-256 {print_of}")
    with suppress(x509.ExtensionNotFound):  # the server compares it with the certificate
        names = own.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
        client.application_uri = (*names.get_values_for_type(x509.UniformResourceIdentifier), client.application_uri)[0]
    client.security_policy = policy(presented, own, credentials.key, MODES[options.mode])
    client.uaclient.set_security(client.security_policy)
    return presented


def certificate_warnings(presented: x509.Certificate, host: str | None, now: datetime) -> list[str]:
    """Return what is wrong with a server's certificate at ``now``, a line each; ``host`` is None if any may have it.

    Both are warnings: a plant goes on when a certificate expires, and many controllers have one of another name.
    """
    begin, end = presented.not_valid_before_utc, presented.not_valid_after_utc
    lines = []
    if not begin <= now <= end:
        lines.append(f"the server's certificate is valid from {begin:%Y-%m-%d} to {end:%Y-%m-%d} only: renew it")
    with suppress(x509.ExtensionNotFound, x509.DuplicateExtension, ValueError):  # controllers write faulty ones
        names = presented.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
        hosts = [*names.get_values_for_type(x509.DNSName), *map(str, names.get_values_for_type(x509.IPAddress))]
        if host is not None and hosts and host.lower() not in map(str.lower, hosts):
            lines.append(f"the server's certificate is of {', '.join(hosts)} instead of {host}: set server_certificate")
    return lines


def _cause(error: ua.UaError, options: OpcuaOptions) -> str:
    """Return why the server refuses, and what to do."""
    name = type(error).__name__
    if name == "BadCertificateTimeInvalid":
        return f"the server takes the certificate {options.certificate} as expired: renew it, or set the server's clock"
    if name in REFUSALS["certificate"]:
        return f"the server refuses the certificate {options.certificate} ({name}): let the server trust it"
    if name in REFUSALS["user"]:
        who = f"user {options.user!r}: is the password right?" if options.user else "a client without a user: set user"
        return f"the server refuses {who} ({name})"
    if "No matching endpoints" in str(error):
        return "the server has no endpoint without security: set security, certificate and key"
    return f"{name}: {error}"


def reason(error: BaseException, timeout: float) -> str:
    """Return why the connection failed."""
    if isinstance(error, TimeoutError) and not error.errno:
        return f"no answer within {timeout:g} s: is an OPC UA server there?"
    return cause_of(error)


async def exchange(client: Client, clock: ExchangeClock) -> None:
    """Ask the server for its time, which is in the header of each answer, and note it in ``clock``."""
    protocol = client.uaclient.protocol
    if protocol is None:
        raise ConnectionError("the connection was closed")
    request = ua.ReadRequest()
    moment = ua.ReadValueId(NodeId=ua.NodeId(ua.ObjectIds.Server_ServerStatus_State), AttributeId=ua.AttributeIds.Value)
    request.Parameters.NodesToRead = [moment]
    sent = time.monotonic()
    data = await protocol.send_request(request)
    received = time.monotonic()
    response = struct_from_binary(ua.ReadResponse, data)
    clock.exchange(sent, unix_time(response.ResponseHeader.Timestamp), received)


async def next_message(client: Client, received: list[ua.SubscriptionAcknowledgement]) -> ua.PublishResult:
    """Wait for the next message of any subscription, and confirm those ``received`` (Part 4, 5.14.5: Publish)."""
    protocol = client.uaclient.protocol
    if protocol is None:
        raise ConnectionError("the connection was closed")
    request = ua.PublishRequest()
    request.Parameters.SubscriptionAcknowledgements = received
    data = await protocol.send_request(request, timeout=0)
    result: ua.PublishResult = struct_from_binary(ua.PublishResponse, data).Parameters
    return result


async def namespaces(client: Client) -> list[str]:
    """Return the URIs of the server's namespaces, in their order of this session; empty if it does not tell them."""
    try:
        return list(map(str, await client.get_namespace_array()))
    except (ua.UaStatusCodeError, TypeError):
        return []


@dataclass(frozen=True, slots=True)
class PlacedNode:
    """A node of a machine file, as it is in a session."""

    node: ua.NodeId
    namespace: str  # URI; empty if it is not known
    moved: str = ""  # What has changed if the number of its namespace is another than in the file


def place(text: str, spaces: Sequence[str], namespace: str) -> PlacedNode:
    """Return the node that ``text`` names on a server with the namespaces ``spaces``.

    The number of a namespace may be another after each restart of the server; its URI is not. So a number means the
    namespace that it had at the first connection: ``namespace``, which is empty then.

    Raises:
        ValueError: the server lacks that namespace.
    """
    node = ua.NodeId.from_string(text)
    written = node.NamespaceIndex
    if (uri := getattr(node, "NamespaceUri", None)) is not None:
        known = next((name for name in (uri, unquote(uri)) if name in spaces), None)
        if known is None:
            raise ValueError(f"the server has no namespace {uri!r}: {nearest(uri, list(spaces))}")
        return PlacedNode(_with_index(node, spaces.index(known)), known)
    now = spaces[written] if written < len(spaces) else ""
    if not written or now == namespace or not namespace:
        return PlacedNode(node, now or namespace)
    if namespace not in spaces:
        was = f"at the first connection ns={written} was the namespace {namespace!r}, which the server lacks now"
        raise ValueError(f"{was}: restart Otolith if {now!r} is meant" if now else was)
    index = spaces.index(namespace)
    renumbered = f"the server has renumbered its namespaces: {namespace!r} was ns={written} and is ns={index} now"
    moved = f"{renumbered}, where its nodes are read: write nsu={namespace} instead of ns={written}"
    return PlacedNode(_with_index(node, index), namespace, moved)


def _with_index(node: ua.NodeId, index: int) -> ua.NodeId:
    return ua.NodeId(node.Identifier, index, node.NodeIdType)


def lasting_name(node: ua.NodeId, spaces: Sequence[str]) -> str:
    """Return the name of a node for a machine file, with the URI of its namespace instead of its number."""
    number, name = node.NamespaceIndex, str(node.to_string())
    if not 0 < number < len(spaces) or spaces.count(spaces[number]) > 1:
        return name
    uri = spaces[number].replace("%", "%25").replace(";", "%3B")
    return f"nsu={uri};{_with_index(node, 0).to_string()}"


async def unit_of(client: Client, node: ua.NodeId) -> str:
    """Return the unit in the property EngineeringUnits of a variable; empty if it has none."""
    try:
        unit = await (await client.get_node(node).get_child("0:EngineeringUnits")).read_value()
    except ua.UaStatusCodeError:
        return ""
    text = getattr(getattr(unit, "DisplayName", None), "Text", None)
    return str(text or "").strip()


@dataclass(frozen=True, slots=True)
class Variable:
    """A variable of a server."""

    node: str  # With the URI of its namespace
    path: str  # Names from the folder of objects down to it
    value: Any  # The present value; None if it has none
    type: str
    unit: str  # Empty if it has none
    status: str


async def browse(client: Client, most: int) -> list[Variable]:
    """Return the variables below the folder of objects, except those of OPC UA itself, ``most`` at most."""
    waiting: deque[tuple[ua.NodeId, str]] = deque([(client.nodes.objects.nodeid, "")])
    seen, variables = set[str](), list[Variable]()
    spaces = await namespaces(client)
    while waiting and len(variables) < most:
        parent, path = waiting.popleft()
        for child in await client.get_node(parent).get_children_descriptions(includesubtypes=True):
            node = ua.NodeId(child.NodeId.Identifier, child.NodeId.NamespaceIndex, child.NodeId.NodeIdType)
            if (text := node.to_string()) in seen or not node.NamespaceIndex or len(seen) >= MAX_BROWSED:
                continue
            seen.add(text)
            name = f"{path}/{child.BrowseName.Name}".lstrip("/")
            if child.NodeClass == ua.NodeClass.Variable:
                is_property = child.ReferenceTypeId == ua.NodeId(ua.ObjectIds.HasProperty)
                variables += [] if is_property else [await _variable(client, node, name, spaces)]
            if child.NodeClass in {ua.NodeClass.Object, ua.NodeClass.Variable}:
                waiting.append((node, name))
    return variables[:most]


async def _variable(client: Client, node: ua.NodeId, path: str, spaces: Sequence[str]) -> Variable:
    read = await client.get_node(node).read_data_value(raise_on_bad_status=False)
    variant, status = read.Value, read.StatusCode or ua.StatusCode()
    kind = variant.VariantType.name if variant is not None and variant.VariantType is not None else ""
    value = None if variant is None else variant.Value
    return Variable(lasting_name(node, spaces), path, value, kind, await unit_of(client, node), status.name)
