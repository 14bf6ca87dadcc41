"""``otolith keys``: a small certificate authority for the daemons and readers of a site."""

import re
from pathlib import Path

import click

FOLDER = click.argument("folder", metavar="DIR", type=click.Path(path_type=Path, file_okay=False))


def _name(_: click.Context, __: click.Parameter, name: str) -> str:
    from otolith.machine_file import check_name

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
    click.echo(f"{folder / 'ca.crt'}: certificate of the authority, for every daemon and reader; expires {expiry:%F}")
    click.echo(f"{folder / 'ca.key'}: its private key; keep it where no daemon runs")
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
    click.echo(f"{folder / name}.crt: certificate of {purpose}; expires {expiry:%F}")
    click.echo(f"{folder / name}.key: its private key, for {name} alone")
    return 0
