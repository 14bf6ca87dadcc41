"""``otolith report``: the history of a machine as one HTML file."""

import sys
import time
from pathlib import Path

import click

from otolith.cli.common import new_file
from otolith.cli.operation.history import age_or_date, interval_since, reader_of, samples_since


@click.command()
@click.argument("machine", metavar="FILE|MACHINE")
@click.option("--since", default="7d", callback=age_or_date, metavar="AGE|DATE", help="Begin here, like 12h, 30d, 8w.")
@click.option("--output", type=click.Path(path_type=Path, dir_okay=False, allow_dash=True), callback=new_file,
              metavar="FILE", help="Write this new file; '-' prints.  [default: MACHINE-TIME.html]")  # fmt: skip
def report(machine: str, since: float, output: Path | None) -> None:
    """Write what was estimated and announced as one HTML page.

    FILE is the machine file, MACHINE the name in it. A daemon may run meanwhile.
    The page needs no other file and no network: it can be mailed and printed.

    \b
    Examples:
      otolith report press-3
      otolith report my-machine.toml --since 30d
      otolith report press-3 --since 2026-01-31 --output press-3.html
      otolith report press-3 --since 1d --output - > /srv/www/press-3.html
    """
    from otolith.publishing.html_report import html_report
    from otolith_drivers.errors import ConfigurationError

    reader, now = reader_of(machine), time.time()
    if since >= now:
        raise click.BadParameter("lies in the future", param_hint="'--since'")
    interval = interval_since(reader, since)
    try:
        page = html_report(reader, samples_since(reader, interval, since, ()), interval, since, now)
    except ValueError as error:
        raise ConfigurationError(f"{reader.path}: cannot be read: {error}") from error
    content = page.encode(errors="backslashreplace")  # a text of a machine may have half a character
    if output == Path("-"):
        sys.stdout.buffer.write(content)
        return
    path = output or Path(f"{reader.machine}-{time.strftime('%FT%H%M%S', time.localtime(now))}.html")
    with path.open("xb") as file:
        try:
            file.write(content)
            file.flush()
        except OSError as error:
            path.unlink()
            error.filename = str(path)
            raise
    click.echo(path)
