"""The options by which every reader reaches daemons."""

import functools
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import click

from otolith.cli.common import FILE


def endpoints(_: click.Context, option: click.Parameter, written: tuple[str, ...]) -> tuple[str, ...]:
    """Return what ``--connect`` or ``--listen`` gives; raise BadParameter for a text that is no endpoint."""
    for endpoint in written:
        is_local = option.name == "listen" and endpoint == "local"
        if not (is_local or re.fullmatch(r"[a-z-]+/\S+", endpoint)):
            raise click.BadParameter(f"{endpoint!r} is no endpoint: write it like tcp/127.0.0.1:7447")
    return written


def reader_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add the options of a reader; the command receives ``connect`` and ``credentials``."""

    @functools.wraps(command)
    def wrapped(
        ca: Path | None, certificate: Path | None, key: Path | None, login: Path | None, **options: Any
    ) -> object:
        from otolith.publishing.zenoh_config import Credentials

        return command(credentials=Credentials(ca, certificate, key, login), **options)

    for option in (
        click.option("--login", type=FILE, envvar="OTOLITH_LOGIN", help="File with a line name:password."),
        click.option("--key", type=FILE, envvar="OTOLITH_KEY", help="Private key of the certificate."),
        click.option("--certificate", type=FILE, envvar="OTOLITH_CERTIFICATE", help="Own certificate."),
        click.option("--ca", type=FILE, envvar="OTOLITH_CA", help="Certificate of the site's CA, for tls/ endpoints."),
        click.option("--connect", multiple=True, callback=endpoints, metavar="ENDPOINT", envvar="OTOLITH_CONNECT",
                     help="Where daemons publish; may be repeated.  [default: their sockets on this computer]"),
    ):  # fmt: skip
        wrapped = option(wrapped)
    return wrapped
