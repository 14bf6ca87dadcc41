"""``otolith schema``: JSON Schema of what daemons publish over Zenoh."""

import click

from otolith.cli.terminal import echo, echo_json


@click.command()
@click.argument("name", metavar="[NAME]", required=False)
def schema(name: str | None) -> None:
    """Print the JSON Schema of what daemons publish over Zenoh.

    NAME is the kind of a document: report, event, parameter, health or start.
    Without it, prints the kinds, the version of each, and its key.

    \b
    Examples:
      otolith schema
      otolith schema report > report.schema.json
    """
    from otolith.publishing.json_schema import DOCUMENTS, schema_of
    from otolith_drivers.errors import nearest

    if name is None:
        for kind, own in DOCUMENTS.items():
            place = own.topic.under("<site>", "<machine>", "<name>") if own.topic else "a part of the report"
            echo(f"{kind:<10} {own.version_of(kind):<20} {place}")
        return
    if name not in DOCUMENTS:
        raise click.BadParameter(
            f"{name!r} is no kind of document: {nearest(name, list(DOCUMENTS))}", param_hint="NAME"
        )
    echo_json(schema_of(name), indent=2)
