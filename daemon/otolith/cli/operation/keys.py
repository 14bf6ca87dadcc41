"""``otolith keys``: the certificates of a site."""

import re
from pathlib import Path

import click

from otolith.cli.common import AS_JSON
from otolith.cli.terminal import echo, echo_json
from otolith_drivers.errors import counted

FOLDER = click.argument("folder", metavar="DIR", type=click.Path(path_type=Path, file_okay=False))


def _name(_: click.Context, __: click.Parameter, name: str) -> str:
    from otolith_drivers.config_files import check_name

    try:
        return check_name(name)
    except ValueError as error:
        raise click.BadParameter(str(error)) from error


def _hosts(_: click.Context, __: click.Parameter, hosts: tuple[str, ...]) -> tuple[str, ...]:
    for host in hosts:
        if not re.fullmatch(r"[A-Za-z0-9]([A-Za-z0-9.\-]*[A-Za-z0-9])?|[0-9a-fA-F:]+", host):
            raise click.BadParameter(f"{host!r} is no host name or address")
    return hosts


@click.group()
def keys() -> None:
    """Make certificates for daemons and readers.

    \b
    Examples:
      otolith keys init keys
      otolith keys add keys press-3 --host press-3.local --host 10.0.0.7
      otolith keys add keys control-room
      otolith keys renew keys press-3
      otolith keys list keys
    """


@keys.command("init")
@FOLDER
def init(folder: Path) -> int:
    """Make the certificate authority of a site in DIR.

    Keep DIR/ca.key where no daemon runs: with it, anyone can make certificates that daemons accept.

    \b
    Examples:
      otolith keys init keys
    """
    from otolith.publishing.certificates import make_authority, utc_now

    expiry = make_authority(folder, utc_now())
    echo(f"{folder / 'ca.crt'}: certificate of the authority, for every daemon and reader; expires {expiry:%F}")
    echo(f"{folder / 'ca.key'}: its private key; keep it where no daemon runs")
    return 0


@keys.command("add")
@FOLDER
@click.argument("name", callback=_name)
@click.option("--host", "hosts", multiple=True, callback=_hosts, metavar="HOST",
              help="Name or address of a computer with a daemon; may be repeated.")  # fmt: skip
def add(folder: Path, name: str, hosts: tuple[str, ...]) -> int:
    """Make a certificate for NAME with the authority in DIR.

    With --host it is for a daemon that listens there, without for a reader.

    \b
    Examples:
      otolith keys add keys press-3 --host press-3.local --host 10.0.0.7
      otolith keys add keys control-room
    """
    from otolith.publishing.certificates import make_certificate, utc_now

    expiry = make_certificate(folder, name, hosts, utc_now())
    purpose = f"a daemon at {', '.join(hosts)}" if hosts else "a reader"
    echo(f"{folder / name}.crt: certificate of {purpose}; expires {expiry:%F}")
    echo(f"{folder / name}.key: its private key, for {name} alone")
    return 0


@keys.command("renew")
@FOLDER
@click.argument("name", callback=_name)
@click.option("--host", "hosts", multiple=True, callback=_hosts, metavar="HOST",
              help="Name or address of a daemon; may be repeated.  [default: those of the old one]")  # fmt: skip
def renew(folder: Path, name: str, hosts: tuple[str, ...]) -> int:
    """Make another certificate for NAME, before the one in DIR expires.

    The old one stays valid until its own date, and is kept in DIR.

    \b
    Examples:
      otolith keys renew keys press-3
    """
    from otolith.publishing.certificates import renew_certificate, utc_now

    renewal = renew_certificate(folder, name, hosts, utc_now())
    echo(f"{folder / name}.crt: new certificate of {name}; expires {renewal.end:%F}")
    echo(f"{folder / name}.key: its private key, for {name} alone; copy both to where the old ones are")
    valid = "stays valid" if renewal.old_end > utc_now() else "was valid"
    echo(f"{renewal.kept}: the old certificate, {valid} until {renewal.old_end:%F}")
    return 0


@keys.command("list")
@FOLDER
@AS_JSON
def list_(folder: Path, as_json: bool) -> int:
    """List the certificates in DIR, and until when they are valid.

    The exit code is 1 if a file *.crt cannot be read.

    \b
    Examples:
      otolith keys list keys
    """
    from otolith.publishing.certificates import issued, utc_now

    rows, faults = issued(folder)
    code = 1 if faults else 0
    if as_json:
        documents = [{"file": str(path), "expires": f"{end:%FT%TZ}", "hosts": hosts}
                     for path, (end, hosts) in rows.items()]  # fmt: skip
        unreadable = [{"file": str(path), "reason": reason} for path, reason in faults.items()]
        echo_json({"certificates": documents, "unreadable": unreadable})
        return code
    width = max((len(path.stem) for path in rows), default=0)
    for path, (end, hosts) in rows.items():
        left = (end - utc_now()).days
        rest = f"{counted(left, 'day')} left" if left >= 0 else "expired"
        use = "authority" if path.stem == "ca" else ", ".join(hosts) or "reader"
        echo(f"{path.stem:<{width}}  {end:%F}  {rest:>14}  {use}")
    for reason in faults.values():
        echo(reason, err=True)
    if not rows and not faults:
        echo(f"{folder}: no certificate; 'otolith keys init {folder}' makes an authority", err=True)
    return code
