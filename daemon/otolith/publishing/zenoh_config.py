"""Settings of Zenoh sessions: endpoints, who may connect, who may read, and limits against floods."""

import os
import resource
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from pathlib import Path

from otolith.machine_file import LOCAL, ZenohTable, host_of
from otolith_drivers.common.credentials import stamp
from otolith_drivers.config_files import Context, read
from otolith_drivers.errors import ConfigurationError, NotValidNowError, ServiceError
from otolith_drivers.user_dirs import runtime_directory, runtime_folders

SOCKET = "unixsock-stream/"
ENCRYPTED = ("tls/", "quic/")
TLS = "transport/link/tls"
SOCKET_MODE = 0o660  # a socket is for its user and its group
OTHERS_WRITE = 0o002  # the bit of a umask; who may not write a socket cannot connect to it

# Thresholds: docs/reference/thresholds-runtime.md has the origin of each.
LEASE = 2000  # ms without a message after which Zenoh regards a peer as gone
MAX_SESSIONS = 200  # connections at a time
MAX_HALF_OPEN = 512  # connections at a time that have not finished their handshake
HANDSHAKE_TIMEOUT = 2000  # ms
TLS_TIMEOUT = 600_000  # ms for the TLS handshake, before that of Zenoh: one that fails stops Zenoh for 0.1 s
MAX_DESCRIPTORS = 16_384  # open files and connections of a daemon that listens with TLS
MAX_MESSAGE_BYTES = 1 << 20  # of a message from a reader or a router: a query
NOTICE_SHARES = (0.25, 0.1)  # rests of a certificate's lifetime from which people are told of its end, ...
NOTICE_DAYS = (30, 7)  # ... but at most these
SHORT_LIVED_DAYS = 14  # lifetime up to which only the last of them counts
MAX_SOCKET_PATH = 107  # bytes, of a unix socket under Linux

Settings = dict[str, object]  # Keys of Zenoh's configuration and their values


@dataclass(frozen=True, slots=True)
class Credentials:
    """The files by which a reader is recognised, and by which it recognises a daemon."""

    ca: Path | None = None
    certificate: Path | None = None
    key: Path | None = None
    login: Path | None = None  # A file with one line name:password


@dataclass(frozen=True, slots=True)
class Connection:
    """How a reader reaches daemons."""

    endpoints: tuple[str, ...] = ()  # Where they publish; empty for the sockets on this computer
    credentials: Credentials = field(default_factory=Credentials)


@dataclass(frozen=True, slots=True)
class Validity:
    """Until when the certificate of a daemon is valid; one without certificate needs none."""

    certificate: Path = Path()
    end: datetime | None = None
    lifetime: timedelta = timedelta()

    @property
    def notices(self) -> tuple[timedelta, ...]:
        """The rests of the validity from which people are told; an authority that renews by itself does so before."""
        rests = zip(NOTICE_SHARES, NOTICE_DAYS, strict=True)
        notices = tuple(min(share * self.lifetime, timedelta(days=days)) for share, days in rests)
        return notices[-1:] if self.lifetime <= timedelta(days=SHORT_LIVED_DAYS) else notices

    def warning(self, now: datetime) -> str:
        """Return that it expires soon or has expired; else an empty text."""
        if self.end is None or self.end - now >= self.notices[0]:
            return ""
        time = f"{'expired' if now > self.end else 'expires'} on {self.end:%Y-%m-%d}"
        return (
            f"{self.certificate}: {time}; then nobody can connect: replace it and its key, which the daemon takes over"
        )


@dataclass(frozen=True, slots=True)
class Access:
    """The tables of the machine file for the session of its daemon; ``path`` is that of the file."""

    zenoh: ZenohTable = field(default_factory=ZenohTable)
    path: Path = Path()

    def stamps(self) -> tuple[object, ...]:
        """Return what differs once one of the files of certificates or passwords is replaced."""
        table, folder = self.zenoh, self.path.parent.absolute()
        names = () if table.tls is None else (table.tls.ca, table.tls.certificate, table.tls.key)
        return tuple(stamp(folder / name) for name in (*names, table.access.passwords) if name is not None)

    def settings(self, prefixes: Sequence[str], listen: Iterable[str]) -> tuple[Settings, Validity]:
        """Return settings to publish below ``prefixes``, and their validity.

        Raises:
            NotValidNowError: an endpoint needs a certificate that is not valid now.
            ConfigurationError: a file is wrong.
        """
        listen = tuple(listen)
        try:
            encryption, validity = self._encryption(listen)
            passwords = self._passwords()
        except ConfigurationError as error:
            place = Context(read(self.path)).file.place(error.key)
            raise type(error)(f"{place}: {error}", error.key) from error
        return {**_limits(), **encryption, **passwords, "access_control": self._control(prefixes)}, validity

    def _encryption(self, listen: tuple[str, ...]) -> tuple[Settings, Validity]:
        """Settings of TLS, once its files have been checked, and until when its certificate is valid."""
        encrypted = [endpoint for endpoint in (*listen, *self.zenoh.connect) if endpoint.startswith(ENCRYPTED)]
        if self.zenoh.tls is None:
            if self.zenoh.access.commands:
                text = "nothing proves who sends a command: [zenoh.tls] with the ca of their certificates is missing"
                raise ConfigurationError(text, ("zenoh", "access", "commands"))
            if encrypted:
                remedy = "[zenoh.tls] with ca, certificate and key is missing; 'otolith keys' makes them"
                raise ConfigurationError(f"{encrypted[0]}: {remedy}", ("zenoh",))
            return {}, Validity()
        from otolith.publishing.certificates import Identity, check_identity, utc_now  # noqa: PLC0415 - slow to import

        table, folder = self.zenoh.tls, self.path.parent.absolute()
        identity = Identity(folder / table.ca, folder / table.certificate, folder / table.key)
        hosts = [host_of(endpoint) for endpoint in listen if endpoint.startswith(ENCRYPTED)]
        keys = [("zenoh", "tls", name) for name in ("ca", "certificate", "key")]
        try:
            own = check_identity(identity, keys, hosts, utc_now())
        except NotValidNowError:
            if encrypted:
                raise
            return {}, Validity()
        end = own.not_valid_after_utc
        validity = Validity(identity.certificate, end, end - own.not_valid_before_utc)
        files = {
            f"{side}_{kind}": str(path)
            for side in ("listen", "connect")
            for kind, path in (("certificate", identity.certificate), ("private_key", identity.key))
        }
        return {
            TLS: {**files, "root_ca_certificate": str(identity.ca), "enable_mtls": table.clients, **_VERIFIED}
        }, validity

    def _passwords(self) -> Settings:
        access = self.zenoh.access
        if access.passwords is None:
            has_clients = self.zenoh.tls is not None and self.zenoh.tls.clients
            if access.readers is not None and not has_clients:
                remedy = "set passwords, or [zenoh.tls] with clients = true"
                raise ConfigurationError(f"nothing proves a reader's name: {remedy}", ("zenoh", "access", "readers"))
            return {}
        from otolith_drivers.common.credentials import secret  # noqa: PLC0415 - slow to import

        key, path = ("zenoh", "access", "passwords"), self.path.parent.absolute() / access.passwords
        for number, line in enumerate(secret(path, key).decode(errors="replace").splitlines(), start=1):
            _login(line, f"{path}:{number}", key)
        return {"transport/auth/usrpwd": {"dictionary_file": str(path)}}

    def _control(self, prefixes: Sequence[str]) -> Settings:
        """Zenoh's access control: everything is denied but reading what this daemon publishes.

        A peer relays what others put, delete, declare and answer. Here it receives subscriptions and queries only, and
        sends only keys below its own ``prefixes``. ``@adv`` has the messages of Zenoh's advanced publisher.
        """
        published = ["put", "reply", "liveliness_token", "declare_queryable"]
        requested = ["declare_subscriber", "query", "declare_liveliness_subscriber", "liveliness_query"]
        rules = [
            _rule(
                "publish", "egress", published, [f"{each}/{rest}" for each in prefixes for rest in ("**", "**/@adv/**")]
            ),
            _rule("read", "ingress", requested, ["**", "**/@adv/**"]),
        ]
        readers = self.zenoh.access.readers
        subjects: list[Settings] = [{"id": "everyone"}]
        if readers is not None:
            # A socket has the permissions of its file. A router that the daemon connects to needs a name as well.
            subjects = [{"id": "socket", "link_protocols": ["unixsock-stream"]}]
            kinds = {"certificate": "cert_common_names", "user": "usernames"}
            subjects += [{"id": kind, key: list(readers)} for kind, key in kinds.items() if readers]
        policies = [{"rules": [rule["id"] for rule in rules], "subjects": [subject["id"] for subject in subjects]}]
        control: Settings = {"enabled": True, "default_permission": "deny"}
        return {**control, "rules": rules, "subjects": subjects, "policies": policies}


_VERIFIED: Settings = {"verify_name_on_connect": True, "close_link_on_expiration": True}


def _rule(name: str, flow: str, messages: list[str], keys: list[str]) -> Settings:
    return {"id": name, "permission": "allow", "flows": [flow], "messages": messages, "key_exprs": keys}


def raise_descriptor_limit() -> None:
    """Let connections in their TLS handshake, which Zenoh neither counts nor closes in time, exhaust no descriptors."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    allowed = MAX_DESCRIPTORS if hard == resource.RLIM_INFINITY else min(MAX_DESCRIPTORS, hard)
    if soft != resource.RLIM_INFINITY and soft < allowed:
        resource.setrlimit(resource.RLIMIT_NOFILE, (allowed, hard))


def _limits() -> Settings:
    unicast = {"max_sessions": MAX_SESSIONS, "accept_pending": MAX_HALF_OPEN, "accept_timeout": HANDSHAKE_TIMEOUT}
    limits: Settings = {f"transport/unicast/{key}": value for key, value in unicast.items()}
    return {**limits, "transport/link/rx/max_message_size": MAX_MESSAGE_BYTES}


def _login(line: str, place: str, key: tuple[str, ...] = ()) -> tuple[str, str]:
    """Return user name and password of a line; the error does not repeat the line."""
    name, colon, password = line.partition(":")
    if not (name and colon and password) or line != line.strip():
        raise ConfigurationError(f"{place}: write one user per line, like name:password, without spaces around", key)
    return name, password


def reader_settings(credentials: Credentials, connect: Iterable[str]) -> Settings:
    """Return the settings of a reader's session; raise ConfigurationError if a file cannot be used."""
    settings: Settings = {}
    if credentials.login is not None:
        from otolith_drivers.common.credentials import secret  # noqa: PLC0415 - slow to import

        lines = secret(credentials.login, ()).decode(errors="replace").splitlines()
        name, password = _login(lines[0] if len(lines) == 1 else "", str(credentials.login))
        settings["transport/auth/usrpwd"] = {"user": name, "password": password}
    encrypted = [endpoint for endpoint in connect if endpoint.startswith(ENCRYPTED)]
    if credentials.ca is None and (encrypted or credentials.certificate or credentials.key):
        text = f"{' '.join(encrypted) or 'a certificate'}: needs --ca, the certificate of the site's CA"
        raise ConfigurationError(text)
    if (credentials.certificate is None) != (credentials.key is None):
        raise ConfigurationError("--certificate and --key belong together: give both")
    if credentials.ca is None:
        return settings
    from otolith.publishing.certificates import Identity, authorities, check_identity, utc_now  # noqa: PLC0415 - slow

    authorities(credentials.ca, ())
    encryption: Settings = {"root_ca_certificate": str(credentials.ca.absolute()), **_VERIFIED}
    if credentials.certificate is not None and credentials.key is not None:
        identity = Identity(credentials.ca, credentials.certificate, credentials.key)
        check_identity(identity, ((), (), ()), (), utc_now())
        encryption["connect_certificate"] = str(credentials.certificate.absolute())
        encryption["connect_private_key"] = str(credentials.key.absolute())
        encryption["enable_mtls"] = True
    return {**settings, TLS: encryption}


def listening(endpoints: Iterable[str], name: str) -> tuple[str, ...]:
    """Return ``endpoints`` with the socket of the machine ``site.machine`` in the place of ``local``.

    Raises:
        ServiceError: the folder of the socket cannot be used, or its path is too long.
    """
    return tuple(_socket(name) if endpoint == LOCAL else endpoint for endpoint in endpoints)


def _socket(name: str) -> str:
    path = runtime_directory() / f"{name}.sock"
    if len(os.fsencode(path)) > MAX_SOCKET_PATH:
        remedy = "set zenoh.listen to unixsock-stream/ and a shorter path"
        raise ServiceError(f"{path}: longer than the {MAX_SOCKET_PATH} bytes of a socket's path; {remedy}")
    return f"{SOCKET}{path}"


def local_sockets() -> list[str]:
    """Return the endpoints of the daemons of this computer that this user may read."""
    paths = {path for folder in runtime_folders() if os.access(folder, os.X_OK) for path in folder.glob("*.sock")}
    return [f"{SOCKET}{path}" for path in sorted(paths) if os.access(path, os.W_OK)]


def is_own(endpoint: str) -> bool:
    """Whether the socket of an endpoint belongs to this user; False if it is gone."""
    try:
        return Path(endpoint.removeprefix(SOCKET)).stat().st_uid == os.geteuid()
    except OSError:
        return False
