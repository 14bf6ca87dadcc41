"""``otolith schema``: JSON Schema of what is sent over Zenoh, and to other systems."""

import click

from otolith.cli.terminal import echo, echo_json


@click.command()
@click.argument("name", metavar="[NAME]", required=False)
def schema(name: str | None) -> None:
    """Print the JSON Schema of a kind of document.

    NAME is the kind, such as report, event or command: what is sent over
    Zenoh, and to other systems. Without it, prints the kinds, the version of
    each, and where it is.

    \b
    Examples:
      otolith schema
      otolith schema report > report.schema.json
    """
    from otolith.publishing.json_schema import DOCUMENTS, schema_of
    from otolith_drivers.errors import nearest

    if name is None:
        for kind, own in DOCUMENTS.items():
            place = own.topic.under("<site>", "<machine>", "<name>") if own.topic else own.place
            echo(f"{kind:<14} {own.version_of(kind):<24} {place}")
        return
    if name not in DOCUMENTS:
        raise click.BadParameter(
            f"{name!r} is no kind of document: {nearest(name, list(DOCUMENTS))}", param_hint="NAME"
        )
    echo_json(schema_of(name), indent=2)
