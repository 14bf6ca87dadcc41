"""``otolith site``: one page for all machines, and what is known of them for other systems."""

import importlib.util
import os
import signal
from pathlib import Path

import click

from otolith.cli.common import FILE, INTERRUPTED, log_to_stderr
from otolith.cli.terminal import echo

EXTRA = ("starlette", "uvicorn")


@click.command()
@click.argument("file", type=FILE, required=False, metavar="[SITE.TOML]")
@click.option("-v", "--verbose", is_flag=True, help="Log more.")
def site(file: Path | None, verbose: bool) -> int:
    """Serve one page for all machines, in the foreground.

    It reads what daemons publish over Zenoh, and nothing else: no bus and no
    state directory. Without SITE.TOML it shows the daemons of this computer on
    http://127.0.0.1:8420/. It runs until SIGTERM or Ctrl-C.

    \b
    Examples:
      otolith site
      otolith site site.toml
    """
    from otolith_drivers.errors import ConfigurationError, ServiceError, installation_of

    if lacking := [name for name in EXTRA if importlib.util.find_spec(name) is None]:
        raise ServiceError(f"{', '.join(lacking)} is missing: {installation_of('site')}")
    from otolith.site.access.users import access_of
    from otolith.site.collector import Collector
    from otolith.site.outlets.base import OutletSetup, OutletStatus
    from otolith.site.outlets.table import runners_of
    from otolith.site.server import run_site
    from otolith.site.settings import SiteFile, load_site

    log_to_stderr(verbose=verbose)
    folder = Path() if file is None else file.parent.absolute()
    try:
        settings, source = (SiteFile(), None) if file is None else load_site(file)
        access = access_of(settings, folder)
        collector = Collector(settings.connection(folder), settings.machines)
        statuses = list[OutletStatus]()
        own = settings.title, settings.language, settings.timezone
        setup = OutletSetup(folder, *own, known=collector, statuses=statuses)
        outlets = runners_of(settings.outlets, setup, collector, source)
        statuses += (outlet.status for outlet in outlets)
    except ConfigurationError as error:
        error.exit_code = os.EX_CONFIG  # as 'otolith run', so that systemd does not start it again
        raise

    def ready(address: str) -> None:
        echo(f"{address}; Ctrl-C ends it", err=True)

    ended_by = run_site(collector, settings, outlets, ready, access)
    return INTERRUPTED if ended_by == signal.SIGINT else 0
