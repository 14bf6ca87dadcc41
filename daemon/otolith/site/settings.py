"""The file of a site: where its daemons are, where browsers reach it, and by which names."""

from collections.abc import Iterable
from pathlib import Path
from typing import Annotated

from pydantic import AfterValidator, Field, model_validator

from otolith.health.schema import Language
from otolith.machine_file import Endpoint
from otolith.outlet_tables import HttpTable, OutletsTable
from otolith.publishing.certificates import Identity
from otolith.publishing.commands.documents import MAX_USER
from otolith.publishing.zenoh_config import Connection, Credentials
from otolith.site.known import MAX_MACHINES
from otolith_drivers.common.time_zones import check_time_zone
from otolith_drivers.config_files import SourceFile, StrictModel, check_name, parse, read, validate

OWN_HOSTS = ("localhost", "127.0.0.1", "::1")


def _identity(text: str) -> str:
    """Return ``text``, or raise ValueError if it is no site with a machine."""
    site, _, name = text.partition("/")
    try:
        check_name(site)
        check_name(name)
    except ValueError as error:
        raise ValueError(f'{error}; write site and name like "hall-1/press-3"') from None
    return text


class ReadersTable(StrictModel):
    """Where the daemons publish, and the files by which they recognise the site."""

    connect: tuple[Endpoint, ...] = ()  # Empty for the daemons of this computer
    ca: Path | None = None
    certificate: Path | None = None
    key: Path | None = None
    login: Path | None = None  # A file with one line name:password

    @property
    def files(self) -> tuple[Path | None, Path | None, Path | None]:
        """Those of its certificate: authority, certificate, key."""
        return self.ca, self.certificate, self.key


class UsersTable(StrictModel):
    """Who may send commands to daemons; browsers then reach the site over TLS."""

    users: Annotated[tuple[Annotated[str, Field(min_length=1, max_length=MAX_USER)], ...], Field(min_length=1)]
    """The names in their certificates."""
    ca: Path | None = None  # The authority that issues their certificates, by default that of [zenoh]
    certificate: Path | None = None  # Of the site for browsers, with its key; by default those of [zenoh]
    key: Path | None = None

    def identity(self, zenoh: ReadersTable, folder: Path) -> Identity:
        """Return the files for browsers, relative to ``folder``."""
        return _identity_of((self.ca, self.certificate, self.key), zenoh, folder)

    def signer(self, zenoh: ReadersTable, folder: Path) -> Identity:
        """Return the files that sign commands, relative to ``folder``."""
        return _identity_of((None, None, None), zenoh, folder)


def _identity_of(own: Iterable[Path | None], zenoh: ReadersTable, folder: Path) -> Identity:
    pairs = zip(own, zenoh.files, strict=True)
    ca, certificate, key = (folder / path for mine, other in pairs if (path := mine or other) is not None)
    return Identity(ca, certificate, key)


class SiteFile(StrictModel):
    """The whole file."""

    title: str = "Otolith"
    language: Language | None = None  # By default that of the browser
    timezone: Annotated[str, AfterValidator(check_time_zone)] | None = None  # By default that of each machine
    machines: Annotated[tuple[Annotated[str, AfterValidator(_identity)], ...], Field(max_length=MAX_MACHINES)] = ()
    """Site and name of each machine that is shown; by default all that report."""
    http: HttpTable = HttpTable()
    zenoh: ReadersTable = ReadersTable()
    access: UsersTable | None = None
    outlets: OutletsTable = OutletsTable()

    @model_validator(mode="after")
    def _can_sign(self) -> "SiteFile":
        if self.access is not None and None in self.zenoh.files:
            raise ValueError("[access] needs ca, certificate and key of [zenoh]: the site signs commands with them")
        if self.access is not None and (self.access.certificate is None) != (self.access.key is None):
            raise ValueError("[access] certificate and key belong together: write both")
        return self

    def connection(self, folder: Path) -> Connection:
        """Return how the site reads daemons; files are named relative to ``folder``."""
        ca, certificate, key, login = (
            None if path is None else folder / path
            for path in (self.zenoh.ca, self.zenoh.certificate, self.zenoh.key, self.zenoh.login)
        )
        return Connection(self.zenoh.connect, Credentials(ca, certificate, key, login))


def load_site(path: Path) -> tuple[SiteFile, SourceFile]:
    """Return the site of a file, and its text; raise ConfigurationError with a line per fault."""
    file = read(path)
    return validate(parse(file), SiteFile, file), file
