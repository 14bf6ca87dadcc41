"""``otolith drivers``: which drivers there are, whether they can be used here, and their keys."""

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import click

from otolith.cli.common import AS_JSON
from otolith.cli.terminal import echo, echo_json

if TYPE_CHECKING:
    from otolith_drivers.config_files import StrictModel


@click.command()
@click.argument("kind", metavar="[TYPE]", required=False)
@AS_JSON
def drivers(kind: str | None, as_json: bool) -> None:
    """List the drivers, or show the keys of one.

    A driver that lacks its libraries is listed with the command that installs them. Packages of other authors may add
    drivers.

    \b
    Examples:
      otolith drivers
      otolith drivers modbus
    """
    from otolith_drivers.base import find_driver, known_drivers
    from otolith_drivers.errors import ConfigurationError

    kinds = known_drivers() if kind is None else [kind]
    found: dict[str, dict[str, Any]] = {}
    for name in kinds:
        try:
            module = find_driver(name)
        except ConfigurationError as error:
            if kind is not None:
                raise
            found[name] = {"usable": False, "reason": str(error)}
        else:
            keys = {"driver": _keys(module.Options), "signals": _keys(module.Source)}
            found[name] = {"usable": True} | keys
    if as_json:
        echo_json(found)
    else:
        echo(*(_lines(found) if kind is None else _details(kind, found[kind])))


def _keys(model: "type[StrictModel]") -> dict[str, str | None]:
    """Return the keys of a table with what stands for one that is not written; None for one that must be written."""
    from otolith.cli.commissioning.values import written_value

    keys: dict[str, str | None] = {}
    for name, field in model.model_fields.items():
        default = None if field.is_required() else field.get_default(call_default_factory=True)
        keys[field.alias or name] = (
            None if field.is_required() else "" if default is None else written_value(field, default)
        )
    return keys


def _lines(found: dict[str, dict[str, Any]]) -> Iterator[str]:
    width = max(map(len, found)) + 2
    for name, row in found.items():
        yield name.ljust(width) + (f"keys: {', '.join(row['driver']) or 'none'}" if row["usable"] else row["reason"])
    yield ""
    yield "'otolith drivers TYPE' shows defaults, and the keys of each signal"


def _details(kind: str, row: dict[str, Any]) -> Iterator[str]:
    for table, title in (("driver", "[driver]"), ("signals", "each signal in [signals]")):
        yield f"{title}:"
        if table == "driver":
            yield f'  type = "{kind}"'
        for name, default in row[table].items():
            if default is None:
                yield f"  {name}  (must be written)"
            else:
                yield f"  {name} = {default}" if default else f"  {name}  (optional)"
