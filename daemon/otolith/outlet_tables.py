"""The tables ``[outlets.*]`` of the file of a site or of a machine. Files are named relative to it."""

import ipaddress
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar, Self
from urllib.parse import urlsplit

from pydantic import AfterValidator, Field, model_validator

from otolith_drivers.common.credentials import CredentialOptions
from otolith_drivers.config_files import StrictModel, check_name

PerHour = Annotated[int, Field(ge=1, le=3600)]
Port = Annotated[int, Field(ge=1, le=65535)]


def _address(text: str) -> str:
    """Return ``text``, or raise ValueError if it is no address with a port."""
    host, _, port = text.rpartition(":")
    try:
        ipaddress.ip_address(host.strip("[]"))
        is_port = port.isdecimal() and 0 < int(port) < 65_536
    except ValueError:
        is_port = False
    if not is_port:
        raise ValueError(f'{text!r} is no address with a port: write it like "127.0.0.1:8420" or "[::1]:8420"')
    return text


def _topic(text: str) -> str:
    """Return ``text``, or raise ValueError if it cannot begin a topic that is published."""
    for part in text.split("/"):
        check_name(part)
    return text


def _web_address(text: str) -> str:
    """Return ``text``, or raise ValueError if it is no address of HTTP."""
    try:
        parts = urlsplit(text)
        is_address = parts.scheme in ("http", "https") and parts.hostname and parts.username is None and parts.port != 0
    except ValueError:  # of a port, or of an address in brackets
        is_address = False
    if not is_address or not text.isascii() or " " in text:
        raise ValueError(f'{text!r} is no address: write it like "https://example.org/hook", without a password')
    return text


def _mail_address(text: str) -> str:
    """Return ``text``, or raise ValueError if it is no address of a mailbox."""
    name, at, domain = text.rpartition("@")
    if not (name and at and domain) or not text.isprintable() or any(sign in text for sign in " ,;<>"):
        raise ValueError(f'{text!r} is no address: write it like "shift@example.org"')
    return text


Address = Annotated[str, AfterValidator(_address)]
Name = Annotated[str, AfterValidator(check_name)]
Topic = Annotated[str, AfterValidator(_topic)]
MailAddress = Annotated[str, AfterValidator(_mail_address)]


def _is_loopback(host: str) -> bool:
    """Whether a host is this computer."""
    try:
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return host.lower() == "localhost"


class NoticeOptions(StrictModel):
    """What all outlets have that tell events."""

    per_hour: PerHour = 60  # Notices at most


class BrokerOptions(NoticeOptions, CredentialOptions):
    """What outlets have that publish over MQTT."""

    host: Annotated[str, Field(min_length=1)]
    port: Port | None = None  # By default 1883, and 8883 with TLS
    tls: bool = False
    ca: Path | None = None  # By default the authorities of the computer
    client_id: str = ""  # By default a random one

    @property
    def place(self) -> str:
        """Where it passes on to."""
        return f"broker {self.host}"

    @model_validator(mode="after")
    def _is_consistent(self) -> Self:
        if not self.tls and (self.ca or self.certificate):
            raise ValueError("ca, certificate and key belong to tls = true")
        if self.user is not None and not self.tls and not _is_loopback(self.host):
            raise ValueError("user belongs to tls = true: the password would be sent as it is")
        return self


class MqttOutlet(BrokerOptions):
    """``[outlets.mqtt]``: JSON, and the discovery of Home Assistant."""

    prefix: Topic = "otolith"
    discovery: Topic | None = "homeassistant"


class SparkplugOutlet(BrokerOptions):
    """``[outlets.sparkplug]``: a node of Sparkplug B, with a device for each machine."""

    group: Name = "otolith"
    node: Name | None = None  # By default "site", and of a daemon site and name of its machine


class WebhookOutlet(NoticeOptions):
    """``[outlets.webhook]``: a request per notice."""

    url: Annotated[str, AfterValidator(_web_address)]
    secret_file: Path | None = None  # A file whose first line signs each request
    ca: Path | None = None  # By default the authorities of the computer

    @property
    def place(self) -> str:
        """Where it passes on to; an address may have a secret in its path."""
        return str(urlsplit(self.url).hostname)


class MailOutlet(NoticeOptions):
    """``[outlets.mail]``: an e-mail with the notices of a moment."""

    host: Annotated[str, Field(min_length=1)]
    port: Port = 587
    security: Annotated[str, Field(pattern="^(starttls|tls|none)$")] = "starttls"
    ca: Path | None = None  # By default the authorities of the computer
    user: str | None = None
    password_file: Path | None = None  # A file whose first line is the password
    sender: MailAddress
    to: Annotated[tuple[MailAddress, ...], Field(min_length=1, max_length=20)]
    per_hour: PerHour = 20

    @property
    def place(self) -> str:
        """Where it passes on to."""
        return f"{', '.join(self.to)}, by {self.host}"

    @model_validator(mode="after")
    def _is_consistent(self) -> Self:
        if (self.user is None) != (self.password_file is None):
            raise ValueError("user and password_file belong together: set both")
        if self.user is not None and self.security == "none":
            raise ValueError('user belongs to security = "starttls" or "tls": the password would be sent as it is')
        return self


class OpcuaOutlet(NoticeOptions, CredentialOptions):
    """``[outlets.opcua]``: a server for HMI and SCADA."""

    listen: Address = "127.0.0.1:4840"

    @property
    def place(self) -> str:
        """Where it is read."""
        return f"opc.tcp://{self.listen}/otolith/"

    @model_validator(mode="after")
    def _is_consistent(self) -> Self:
        is_open = not _is_loopback(self.listen.rpartition(":")[0])
        if is_open and (self.certificate is None or self.user is None):
            keys = "certificate, key, user and password_file"
            raise ValueError(f"listen = {self.listen!r} is for other computers: set {keys}")
        return self


class HttpTable(StrictModel):
    """Where pages or metrics are read."""

    listen: Address = "127.0.0.1:8420"
    hosts: tuple[str, ...] = ()  # Names by which browsers reach it, beside those of this computer for itself

    @property
    def address(self) -> tuple[str, int]:
        """Host and port to listen on."""
        host, _, port = self.listen.rpartition(":")
        return host.strip("[]"), int(port)

    @model_validator(mode="after")
    def _has_names_where_others_reach_it(self) -> "HttpTable":
        if not ipaddress.ip_address(self.address[0]).is_loopback and not self.hosts:
            names = 'write hosts = ["site.plant.local"], the names by which browsers reach it'
            raise ValueError(f"listen = {self.listen!r} is for other computers: {names}")
        return self


class PrometheusOutlet(HttpTable):
    """``[outlets.prometheus]``: ``/metrics`` and ``/healthz`` at an address of their own."""

    listen: Address = "127.0.0.1:8421"
    per_hour: ClassVar[int] = 0  # It tells no notices

    @property
    def place(self) -> str:
        """Where it is read."""
        return f"http://{self.listen}/metrics"


class OutletsTable(StrictModel):
    """``[outlets]``: each table is one outlet."""

    mqtt: MqttOutlet | None = None
    sparkplug: SparkplugOutlet | None = None
    webhook: WebhookOutlet | None = None
    mail: MailOutlet | None = None
    opcua: OpcuaOutlet | None = None
    prometheus: PrometheusOutlet | None = None  # A site answers scrapes at the address of its pages, too

    @property
    def names(self) -> tuple[str, ...]:
        """The outlets that the file has."""
        return tuple(name for name in type(self).model_fields if getattr(self, name) is not None)

    @property
    def reached(self) -> tuple[str, ...]:
        """The computers that outlets connect to."""
        web = None if self.webhook is None else urlsplit(self.webhook.url).hostname
        hosts = [web] if web is not None else []
        return (*hosts, *(own.host for own in (self.mqtt, self.sparkplug, self.mail) if own is not None))

    @property
    def listening(self) -> tuple[str, ...]:
        """The addresses of this computer at which outlets are read."""
        own = (self.prometheus, self.opcua)
        return tuple(each.listen.rpartition(":")[0].strip("[]") for each in own if each is not None)


@dataclass(frozen=True, slots=True)
class MachineOutlets:
    """What a daemon passes on of a machine."""

    site: str
    machine: str
    file: Path  # That has the table
    table: OutletsTable

    @property
    def key(self) -> str:
        """Site and name."""
        return f"{self.site}/{self.machine}"
