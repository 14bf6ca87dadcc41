"""``otolith install``: the service of one machine, step by step.

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
from typing import Any
from urllib.parse import urlsplit

import click

from otolith.cli.common import MACHINE_FILE, shipped_directory
from otolith.cli.operation.unit_file import addresses, comment, directive
from otolith.cli.terminal import echo
from otolith_drivers.errors import ConfigurationError, ServiceError, shown, some_names

UNIT, SYSUSERS = "otolith@.service", "otolith.sysusers.conf"
PROGRAM = Path("/opt/otolith/bin/otolith")  # that the unit starts
Table = Mapping[str, Any]
Endpoints = Sequence[str]  # of Zenoh
USER, ETC = "otolith", Path("etc/otolith")
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


@click.command()
@MACHINE_FILE
@click.option("--dry-run", is_flag=True, help="Only print the steps.")
@click.option("--root", type=click.Path(path_type=Path, file_okay=False), default=Path("/"),
              help="Put the files under this folder, and run no command.")  # fmt: skip
def install(file: Path, dry_run: bool, root: Path) -> None:
    """Install the service of the machine in FILE, as root.

    It copies the unit, what the unit may access, and FILE with the files that it names, makes the user 'otolith', and
    compiles the twin. It starts nothing. Repeat it after an upgrade or a change of FILE.

    \b
    Examples:
      otolith install --dry-run press-3.toml
      sudo /opt/otolith/bin/otolith install press-3.toml
    """
    is_here = root == Path("/")
    if is_here and not dry_run and os.geteuid() != 0:
        raise ServiceError("install needs root: use sudo, or --root DIR to look at the files, or --dry-run")
    files = list(_files(file))
    read = [folder for item in files for folder in item.path.parents if ETC in (folder, *folder.parents)]
    closed = closed_folders([*read, Path("var/lib/otolith"), Path("var/cache/otolith")], root)
    for item in files:
        others = [other.name for other in _machines_with(root / item.path, root / ETC) if other.name != file.name]
        if _put(item, root, dry_run=dry_run) and others:
            remedy = "if they need another one, give this file another name"
            echo(f"warning: {root / item.path} is also a file of {', '.join(others)}: {remedy}", err=True)
    private = [f"/{item.path}" for item in files if item.is_private]
    for command, user in _commands(file.stem, private, closed):
        echo(f"{'run' if is_here and not dry_run else 'to run'}: {shlex.join(command)}")
        if is_here and not dry_run:
            _run(command, user, file.stem)
    if not PROGRAM.exists():
        echo(f"missing: {PROGRAM}, which the unit starts: make the environment /opt/otolith first", err=True)
    echo(f"start it: systemctl enable --now otolith@{file.stem}")


def _files(file: Path) -> Iterator[InstalledFile]:
    """Yield the files of the service of one machine; raise ConfigurationError if its file or its name is wrong."""
    from otolith.machine import load_machine

    if not re.fullmatch(r"[A-Za-z0-9_][A-Za-z0-9_.-]*", file.stem) or file.suffix != ".toml":
        raise ConfigurationError(f"{file}: its name becomes that of the service: use letters, digits, '_', '-', .toml")
    machine = load_machine(file)
    shipped, etc = shipped_directory("systemd"), ETC.parent
    yield InstalledFile(etc / "systemd/system" / UNIT, (shipped / UNIT).read_bytes())
    yield InstalledFile(Path("usr/lib/sysusers.d/otolith.conf"), (shipped / SYSUSERS).read_bytes())
    zenoh = machine.file.zenoh
    command = bool(machine.file.machine.on_event)
    networks = zenoh.access.networks
    text = drop_in(file.stem, machine.file.drivers, zenoh.listen, zenoh.connect, command=command, networks=networks)
    yield InstalledFile(etc / f"systemd/system/otolith@{file.stem}.service.d/machine.conf", text.encode())
    for name in [Path(file.name), *named_files(file)]:
        source = file.parent / name
        is_private = not source.stat().st_mode & 0o004
        yield InstalledFile(ETC / name, source.read_bytes(), is_private)


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
) -> str:
    """Return the drop-in of the unit: devices, addresses and kinds of sockets that the machine file needs, no others.

    ``command``: the daemon runs one for each event, which may use the network of this computer. ``networks`` are those
    of the readers, None if they are not known.
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
    buses = [_can_bus(driver) for driver in drivers if driver.get("type") == "can"]
    foreign = [f"driver {driver.get('type')!r}" for driver in drivers if driver.get("type") not in KNOWN_DRIVERS]
    foreign += [f"CAN interface {bus!r}" for bus in buses if bus not in KNOWN_BUSES]
    if not foreign:
        needs_ip = hosts or published or command or "udp_multicast" in buses
        sockets = (["AF_CAN"] if "socketcan" in buses else []) + (["AF_INET", "AF_INET6"] if needs_ip else [])
        lines += ["RestrictAddressFamilies=", " ".join(["RestrictAddressFamilies=AF_UNIX", *sockets])]
        lines += [] if sockets else ["PrivateNetwork=yes"]
    local = {host: (address := address_of(host)) and address.is_loopback for host in hosts + published}
    local["localhost"] = True
    unknown = [host for host in hosts if local[host] is None]
    unknown += [host for host in published if networks is None and not local[host]]
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
    """Yield the machine files in ``folder`` that name the file ``path``."""
    for machine in sorted(folder.glob("*.toml")):
        with contextlib.suppress(ConfigurationError, OSError, ValueError):  # it is no machine file, or not readable
            if path in [folder / name for name in named_files(machine)]:
                yield machine


def _put(item: InstalledFile, root: Path, *, dry_run: bool) -> bool:
    """Write a file as a whole; what it replaces is kept with a ``~``. Return whether it replaces another content."""
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
        return before is not None
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
    return before is not None


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


def _commands(name: str, private: list[str], closed: list[str]) -> list[tuple[list[str], str | None]]:
    """Return the commands of an installation, each with the user who runs it, root if None.

    The group of the service may enter ``closed`` folders afterwards, and nobody else.
    """
    cache, program = f"/var/cache/otolith/{name}", str(PROGRAM if PROGRAM.exists() else Path(sys.argv[0]).absolute())
    return [
        (["systemd-sysusers"], None),
        *([(["chgrp", USER, *private, *closed], None)] if private or closed else []),
        *([(["chmod", "g+x", *closed], None)] if closed else []),
        (["systemctl", "daemon-reload"], None),
        (["install", "-d", "-m", "0700", "-o", USER, "-g", USER, cache], None),
        ([program, "compile", f"/etc/otolith/{name}.toml"], USER),
    ]


def _run(command: list[str], user: str | None, name: str) -> None:
    environment = {"PATH": os.environ.get("PATH", ""), "CACHE_DIRECTORY": f"/var/cache/otolith/{name}"}
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
