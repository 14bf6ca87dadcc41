"""``otolith install``: the service of one machine, or of all in a directory, step by step.

Each step of the installation is idempotent, and shown by ``--dry-run``.
"""

import contextlib
import os
import pwd
import re
import shlex
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

import click

from otolith.cli.common import HALL, MACHINE_OR_FOLDER, shipped_directory
from otolith.cli.operation.unit_file import addresses, comment, directive
from otolith.cli.terminal import echo
from otolith_drivers.errors import ConfigurationError, ServiceError, shown, some_names

if TYPE_CHECKING:
    from otolith.machine import LoadedMachine
    from otolith.machine_file import ZenohTable
    from otolith.outlet_tables import OutletsTable

UNIT, HALL_UNIT, SYSUSERS = "otolith@.service", "otolith.service", "otolith.sysusers.conf"
PROGRAM = Path("/opt/otolith/bin/otolith")  # that the unit starts
Table = Mapping[str, Any]
Endpoints = Sequence[str]  # of Zenoh
USER, ETC, CACHE = "otolith", Path("etc/otolith"), "/var/cache/otolith"
# Drivers whose addresses are in the keys 'host', 'endpoint' and 'channel'.
KNOWN_DRIVERS = {"can", "modbus", "mqtt", "opcua", "plant", "replay"}
# Interfaces of python-can that need a bus of the kernel, multicast, or the serial port that the channel names.
KNOWN_BUSES = {"socketcan", "udp_multicast", "slcan", "serial", "robotell"}


@dataclass(frozen=True, slots=True)
class InstalledFile:
    """A file of the service."""

    path: Path
    content: bytes
    is_private: bool = False  # Readable by root and the service only


@dataclass(frozen=True, slots=True)
class Target:
    """The service of one machine, or of the machines in a directory."""

    source: Path
    files: tuple[Path, ...]  # Of the machines

    @property
    def is_hall(self) -> bool:
        """Whether it is that of a directory."""
        return self.source.is_dir()

    @property
    def unit(self) -> str:
        """Name of its unit."""
        return "otolith" if self.is_hall else f"otolith@{self.source.stem}"

    @property
    def folder(self) -> Path:
        """The folder of its machine files."""
        return ETC / HALL if self.is_hall else ETC

    @property
    def compiled(self) -> Path:
        """What it runs."""
        return Path("/") / (self.folder if self.is_hall else self.folder / self.source.name)


@click.command()
@MACHINE_OR_FOLDER
@click.option("--dry-run", is_flag=True, help="Only print the steps.")
@click.option("--root", type=click.Path(path_type=Path, file_okay=False), default=Path("/"),
              help="Put the files under this folder, and run no command.")  # fmt: skip
def install(path: Path, dry_run: bool, root: Path) -> None:
    """Install the service of a machine, or of a hall, as root.

    It copies the unit, what the unit may access, and the files with those that they name, makes the user 'otolith', and
    compiles the twins. It starts nothing. Repeat it after an upgrade or a change of a file.

    \b
    Examples:
      otolith install --dry-run press-3.toml
      sudo /opt/otolith/bin/otolith install press-3.toml
      sudo /opt/otolith/bin/otolith install machines/
    """
    is_here = root == Path("/")
    if is_here and not dry_run and os.geteuid() != 0:
        raise ServiceError("install needs root: use sudo, or --root DIR to look at the files, or --dry-run")
    target = _target(path)
    files = list(_files(target, root))
    read = [folder for item in files for folder in item.path.parents if ETC in (folder, *folder.parents)]
    closed = closed_folders(list(dict.fromkeys([*read, Path("var/lib/otolith"), Path("var/cache/otolith")])), root)
    own = {file.name for file in target.files}
    for item in files:
        others = [other.name for other in _machines_with(root / item.path, root / target.folder)]
        others = [name for name in others if name not in own]
        if _put(item, root, dry_run=dry_run) and others:
            echo(f"warning: {root / item.path} is also a file of {some_names(others)}: {_remedy(item.path)}", err=True)
    for warning in _warnings(target, root):
        echo(f"warning: {warning}", err=True)
    private = [f"/{item.path}" for item in files if item.is_private]
    for command, user in _commands(target.compiled, private, closed):
        echo(f"{'run' if is_here and not dry_run else 'to run'}: {shlex.join(command)}")
        if is_here and not dry_run:
            _run(command, user)
    if not PROGRAM.exists():
        echo(f"missing: {PROGRAM}, which the unit starts: make the environment /opt/otolith first", err=True)
    echo(f"start it: systemctl enable --now {target.unit}")


def _target(path: Path) -> Target:
    """Return the service of a machine file or a directory; raise ConfigurationError if its name does not fit."""
    from otolith.runtime.hall.files import files_in

    if path.is_dir():
        if not (files := files_in([path])):
            raise ConfigurationError(f"{path}: there is no machine file (*.toml)")
        return Target(path, tuple(files))
    if not re.fullmatch(r"[A-Za-z0-9_][A-Za-z0-9_.-]*", path.stem) or path.suffix != ".toml":
        raise ConfigurationError(f"{path}: its name becomes that of the service: use letters, digits, '_', '-', .toml")
    if path.stem == HALL:
        raise ConfigurationError(f"{path}: {HALL!r} is the name of the service of a directory: give it another name")
    return Target(path, (path,))


def _files(target: Target, root: Path) -> Iterator[InstalledFile]:
    """Yield the files of a service; raise ConfigurationError if a machine file, or that of the service, is wrong."""
    from otolith.machine import load_machine
    from otolith.service_file import SERVICE_FILE

    machines = [load_machine(file) for file in target.files]
    shipped, etc = shipped_directory("systemd"), ETC.parent
    template = HALL_UNIT if target.is_hall else UNIT
    yield InstalledFile(etc / "systemd/system" / template, (shipped / template).read_bytes())
    yield InstalledFile(Path("usr/lib/sysusers.d/otolith.conf"), (shipped / SYSUSERS).read_bytes())
    zenoh: list[ZenohTable] = [_there(machine, root / target.folder, "zenoh") for machine in machines]
    text = drop_in(
        f"{HALL}/*" if target.is_hall else target.source.stem,
        [driver for machine in machines for driver in machine.file.drivers],
        list(dict.fromkeys(endpoint for table in zenoh for endpoint in table.listen)),
        list(dict.fromkeys(endpoint for table in zenoh for endpoint in table.connect)),
        command=any(machine.file.machine.on_event for machine in machines),
        networks=_networks(zenoh),
        outlets=[_there(machine, root / target.folder, "outlets") for machine in machines],
    )
    yield InstalledFile(etc / f"systemd/system/{target.unit}.service.d/machine.conf", text.encode())
    files, folder = list(target.files), target.files[0].parent
    if (folder / SERVICE_FILE).exists():
        files.append(folder / SERVICE_FILE)
    names = [name for file in files for name in (Path(file.name), *named_files(file))]
    for name in dict.fromkeys(names):
        source = folder / name
        is_private = not source.stat().st_mode & 0o004
        yield InstalledFile(target.folder / name, source.read_bytes(), is_private)


def _there(machine: "LoadedMachine", folder: Path, table: str) -> Any:
    """Return the table that a machine has once it is in ``folder``, where a file of the service may be already."""
    from otolith.service_file import service_file_in

    is_own = table in machine.file.model_fields_set
    there = None if is_own else service_file_in(folder)
    return getattr(machine.file if there is None else there, table)


def _networks(tables: "Sequence[ZenohTable]") -> list[str] | None:
    """Return the networks of the readers of several machines; None if those of one that listens are not known."""
    from otolith.machine_file import address_of, host_of

    hosts = {table: [host for endpoint in table.listen if (host := host_of(endpoint))] for table in tables}
    listening = [
        table
        for table, found in hosts.items()
        if any((address := address_of(host)) is None or not address.is_loopback for host in found)
    ]
    if any(table.access.networks is None for table in listening):
        return None
    return list(dict.fromkeys(network for table in listening for network in table.access.networks or ()))


def _remedy(path: Path) -> str:
    """Return what to do about a file of the service that was changed, and is also one of other machines."""
    from otolith.service_file import SERVICE_FILE

    if path.name == SERVICE_FILE:
        return "from their next start it holds for them too: install them again, or give them these tables themselves"
    return "if they need another one, give this file another name"


def _warnings(target: Target, root: Path) -> Iterator[str]:
    """Yield what is to be known of files that are installed already."""
    from otolith.cli.machines import identity_of
    from otolith.service_file import SERVICE_FILE

    source, there = target.files[0].parent, root / target.folder / SERVICE_FILE
    if there.exists() and not (source / SERVICE_FILE).exists():
        yield f"{there} is not in {source}, and stays in force: delete it, or copy it there if it is to hold"
    if target.is_hall:
        own = {file.name for file in target.files}
        left = [path for path in sorted((root / target.folder).glob("*.toml")) if path.name not in {*own, SERVICE_FILE}]
        yield from (f"{path} is not in {target.source}, and stays: delete it to end its machine" for path in left)
    other = root / (ETC if target.is_hall else ETC / HALL)
    named = {identity: path for path in sorted(other.glob("*.toml")) if (identity := identity_of(path))}
    for file in target.files:
        if (identity := identity_of(file)) in named:
            also = named[identity]
            unit = f"otolith@{also.stem}" if target.is_hall else "otolith"
            remedy = f"only one service may run it: disable {unit}, or delete this file"
            yield f"{also} is of the same machine, {identity.key}: {remedy}"


def named_files(file: Path) -> list[Path]:
    """Return the files that a machine file names, relative to it; raise ConfigurationError if one is elsewhere."""
    from otolith_drivers.config_files import parse, read

    names = []
    for text in _strings(parse(read(file))):
        name = Path(text)
        if text and len(text) < 255 and (file.parent / name).is_file() and not text.startswith("/dev/"):
            folder = file.parent.resolve()
            if name.is_absolute() or ".." in name.parts or folder not in (folder / name).resolve().parents:
                remedy = "the service reads /etc/otolith alone: copy it beside and name it so"
                raise ConfigurationError(f"{file}: {text!r} is not in the folder of the machine file: {remedy}")
            names.append(name)
    return list(dict.fromkeys(names))


def _strings(value: Any) -> Iterator[str]:
    if isinstance(value, str):
        yield value
    elif isinstance(value, Mapping | list | tuple):
        for item in value.values() if isinstance(value, Mapping) else value:
            yield from _strings(item)


def drop_in(
    name: str,
    drivers: Sequence[Table],
    listen: Endpoints,
    connect: Endpoints,
    *,
    command: bool = False,
    networks: Sequence[str] | None = None,
    outlets: "Sequence[OutletsTable]" = (),
) -> str:
    """Return the drop-in of the unit: devices, addresses and kinds of sockets that the machine file needs, no others.

    ``command``: the daemon runs one for each event, which may use the network of this computer. ``networks`` are those
    of the readers, None if they are not known. ``outlets`` reach other computers, or are reached by readers.
    """
    from otolith.machine_file import address_of, host_of

    lines = [comment(f"Made by 'otolith install' from /etc/otolith/{name}.toml."), "[Service]"]
    devices = [text.partition("@")[0] for text in _strings(drivers) if text.startswith("/dev/")]
    if devices:
        lines += ["PrivateDevices=no", "DevicePolicy=closed"]
        lines += [directive("DeviceAllow", device, "rw") for device in dict.fromkeys(devices)]
        lines += ["SupplementaryGroups=dialout"]
    hosts = [host for endpoint in connect if (host := host_of(endpoint))]
    hosts += [host for driver in drivers for host in _hosts_of(driver)]
    published = [host for endpoint in listen if (host := host_of(endpoint))]
    hosts += [host for table in outlets for host in table.reached]
    served = [host for table in outlets for host in table.listening]
    buses = [_can_bus(driver) for driver in drivers if driver.get("type") == "can"]
    foreign = [f"driver {driver.get('type')!r}" for driver in drivers if driver.get("type") not in KNOWN_DRIVERS]
    foreign += [f"CAN interface {bus!r}" for bus in buses if bus not in KNOWN_BUSES]
    if not foreign:
        needs_ip = hosts or published or served or command or "udp_multicast" in buses
        sockets = (["AF_CAN"] if "socketcan" in buses else []) + (["AF_INET", "AF_INET6"] if needs_ip else [])
        lines += ["RestrictAddressFamilies=", " ".join(["RestrictAddressFamilies=AF_UNIX", *sockets])]
        lines += [] if sockets else ["PrivateNetwork=yes"]
    local = {host: (address := address_of(host)) and address.is_loopback for host in hosts + published + served}
    local["localhost"] = True
    unknown = [host for host in hosts if local[host] is None]
    unknown += [host for host in published if networks is None and not local[host]]
    unknown += [host for host in served if not local[host]]
    if unknown or foreign:
        names = some_names([shown(name) for name in dict.fromkeys([*unknown, *foreign])])
        lines += [comment(f"No IPAddressDeny: the addresses of these are not known: {names}")]
        lines += ["# Its devices are hidden: 'Run Otolith as a service' shows how to allow them."] if foreign else []
        return "\n".join([*lines, ""])
    multicast = ["multicast"] if "udp_multicast" in buses else []
    allowed = ["localhost", *multicast, *addresses([*hosts, *(networks or ())])]
    lines += ["IPAddressDeny=any", *(directive("IPAddressAllow", host) for host in dict.fromkeys(allowed))]
    return "\n".join([*lines, ""])


def _can_bus(driver: Table) -> str:
    """Return the interface of python-can that a table ``[driver]`` uses on this computer."""
    from otolith_drivers.canbus.bus import BusOptions

    given = {key: driver[key] for key in ("interface", "channel") if key in driver}
    return BusOptions.model_validate(given).resolved()[0]


def _hosts_of(driver: Table) -> Iterator[str]:
    """Yield the computers that a table ``[driver]`` names."""
    if isinstance(host := driver.get("host"), str):
        yield host
    if isinstance(endpoint := driver.get("endpoint"), str):
        yield urlsplit(endpoint).hostname or endpoint


def _machines_with(path: Path, folder: Path) -> Iterator[Path]:
    """Yield the machine files in ``folder`` that use the file ``path``: all use that of the service, and its files."""
    from otolith.runtime.hall.files import files_in
    from otolith.service_file import SERVICE_FILE

    service, machines = folder / SERVICE_FILE, files_in([folder]) if folder.is_dir() else []
    is_of_all = path == service or path in _named_by(service, folder)
    yield from (machine for machine in machines if is_of_all or path in _named_by(machine, folder))


def _named_by(file: Path, folder: Path) -> list[Path]:
    with contextlib.suppress(ConfigurationError, OSError, ValueError):  # it is not there, or not readable
        return [folder / name for name in named_files(file)]
    return []


def _put(item: InstalledFile, root: Path, *, dry_run: bool) -> bool:
    """Write a file as a whole; what it replaces is kept with a ``~``. Return whether it changes what is there."""
    from otolith.storage.disk import replace_file

    path = root / item.path
    before = path.read_bytes() if path.is_file() else None
    if before == item.content:
        is_open = item.is_private and bool(path.stat().st_mode & 0o007)
        echo(f"{('to ' if dry_run else '') + 'restrict' if is_open else 'unchanged'}: {path}")
        if is_open and not dry_run:
            path.chmod(0o640)
        return False
    echo(f"{'to ' if dry_run else ''}{'write' if before is None else 'replace'}: {path}")
    if dry_run:
        return True
    umask = os.umask(0o022)  # that of root may close the folders to the service
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    finally:
        os.umask(umask)
    target, mode = path.parent.resolve() / path.name, 0o640 if item.is_private else 0o644
    if before is not None:
        status, kept = path.stat(), f"{path.name}~"
        replace_file(target.with_name(kept), before, f".{kept}.new", status.st_mode & mode, status)
    replace_file(target, item.content, f".{path.name}.new", mode)
    return True


def closed_folders(folders: Sequence[Path], root: Path) -> list[str]:
    """Return the ``folders`` below ``root`` that exist and that the user of the service may not enter.

    Raises ServiceError for one that is open to a group of its own: only its owner can decide who else may enter it.
    """
    user = group = -1  # before the first installation
    with contextlib.suppress(KeyError):
        user, group = pwd.getpwnam(USER)[2:4]
    closed: dict[str, None] = {}
    for folder in filter(lambda each: (root / each).is_dir(), folders):
        status = (root / folder).stat()
        needed = 0o100 if status.st_uid == user else 0o010 if status.st_gid == group else 0o001
        if not status.st_mode & needed:
            if status.st_gid not in (0, group, os.getegid()) and status.st_mode & 0o070:
                remedy = f"'chmod o+x {root / folder}' lets it, and every other user of this computer"
                raise ServiceError(f"{root / folder}: user {USER!r} may not enter it: {remedy}")
            closed[f"/{folder}"] = None
    return list(closed)


def _commands(compiled: Path, private: list[str], closed: list[str]) -> list[tuple[list[str], str | None]]:
    """Return the commands of an installation, each with the user who runs it, root if None.

    The group of the service may enter ``closed`` folders afterwards, and nobody else.
    """
    program = str(PROGRAM if PROGRAM.exists() else Path(sys.argv[0]).absolute())
    return [
        (["systemd-sysusers"], None),
        *([(["chgrp", USER, *private, *closed], None)] if private or closed else []),
        *([(["chmod", "g+x", *closed], None)] if closed else []),
        (["systemctl", "daemon-reload"], None),
        (["install", "-d", "-m", "0700", "-o", USER, "-g", USER, CACHE], None),
        ([program, "compile", str(compiled)], USER),
    ]


def _run(command: list[str], user: str | None) -> None:
    environment = {"PATH": os.environ.get("PATH", ""), "CACHE_DIRECTORY": CACHE}
    extra_groups = None if user is None else ()
    try:
        done = subprocess.run(  # noqa: S603 - the commands above, without a shell
            command, env=environment, user=user, group=user, extra_groups=extra_groups, check=False
        )
    except PermissionError as error:
        remedy = "open it, its environment, and the folders of both and of their Python to all users (chmod go+rX)"
        raise ServiceError(f"{command[0]}: user {user or 'root'!r} may not run it: {remedy}") from error
    if done.returncode:
        raise ServiceError(f"{shlex.join(command)}: ended with exit code {done.returncode}; repeat the installation")
