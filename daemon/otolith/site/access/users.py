"""Who asks: the name in the certificate of a browser, which TLS has verified. No password is stored or asked for."""

import asyncio
import ssl
from asyncio import Server as Listening
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from weakref import WeakKeyDictionary, ref

from otolith.publishing.certificates import Identity, check_identity, utc_now
from otolith.site.settings import SiteFile
from otolith_drivers.errors import ConfigurationError

# Thresholds: docs/reference/thresholds-site.md has the origin of each.
MAX_SHAKING = 1000  # TLS handshakes at a time
HANDSHAKE = 10.0  # s for the TLS handshake of a browser


@dataclass(frozen=True, slots=True)
class User:
    """Whose certificate a connection has."""

    name: str
    until: float  # Unix s at which it expires


def user_of(transport: asyncio.BaseTransport) -> User | None:
    """Return who has proved its name on a connection; None without a certificate, or if it has several names."""
    connection: ssl.SSLObject | None = transport.get_extra_info("ssl_object")
    certificate: Any = connection.getpeercert() if connection is not None else None
    if not certificate:
        return None
    pairs = [pair for group in certificate.get("subject", ()) for pair in group]
    names = [value for key, value in pairs if key == "commonName"]
    return User(names[0], ssl.cert_time_to_seconds(certificate["notAfter"])) if len(names) == 1 else None


@dataclass(frozen=True, slots=True)
class SiteAccess:
    """Who may send commands, and the files that prove who asks and who sends."""

    users: tuple[str, ...]
    tls: ssl.SSLContext  # Of the connections of browsers
    signer: Identity  # Of the site, which signs commands


def access_of(settings: SiteFile, folder: Path) -> SiteAccess | None:
    """Return what ``[access]`` says, with files relative to ``folder``; None without it.

    Raises:
        ConfigurationError: a file cannot be used.
    """
    table = settings.access
    if table is None:
        return None
    signer = table.signer(settings.zenoh, folder)
    return SiteAccess(table.users, _context(table.identity(settings.zenoh, folder), settings.http.hosts), signer)


def _context(own: Identity, hosts: Iterable[str]) -> ssl.SSLContext:
    """Return what encrypts the connections of browsers, and asks for their certificates."""
    keys = [("access", name) for name in ("ca", "certificate", "key")]
    check_identity(own, keys, hosts, utc_now())
    try:
        context = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH, cafile=own.ca)
        context.load_cert_chain(own.certificate, own.key, password=lambda: b"")
    except (OSError, ValueError) as error:
        raise ConfigurationError(f"{own.certificate}: cannot be used: {error}", keys[1]) from error
    context.verify_mode = ssl.CERT_OPTIONAL  # who has none may read
    context.verify_flags &= ~ssl.VERIFY_X509_STRICT  # it asks for key identifiers, which many authorities leave out
    return context


class Loop(asyncio.SelectorEventLoop):
    """An event loop that bounds the TLS handshakes under way, and their time, which uvicorn does not."""

    def __init__(self) -> None:
        super().__init__()
        self._shaking: WeakKeyDictionary[asyncio.BaseProtocol, ref[asyncio.Transport]] = WeakKeyDictionary()

    def has_shaken(self, protocol: asyncio.BaseProtocol) -> None:
        """Its handshake has ended well; those that failed are gone by themselves."""
        self._shaking.pop(protocol, None)

    async def create_server(self, *arguments: Any, **options: Any) -> Listening:
        """Listen as the loop does."""
        if options.get("ssl") is not None:
            options["ssl_handshake_timeout"] = HANDSHAKE
        return await super().create_server(*arguments, **options)

    def _make_ssl_transport(
        self, connection: Any, protocol: asyncio.BaseProtocol, *arguments: Any, **options: Any
    ) -> Any:
        """Begin a handshake as the loop does; of too many, the oldest is cut."""
        made: Any = super()._make_ssl_transport(connection, protocol, *arguments, **options)  # type: ignore[misc]  # typeshed has no private methods
        self._shaking[protocol] = ref(made)
        if len(self._shaking) > MAX_SHAKING:
            oldest = self._shaking.pop(next(iter(self._shaking)))()
            if oldest is not None:
                oldest.abort()
        return made
