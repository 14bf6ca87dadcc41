"""``otolith probe opcua``: the variables of a server, and lines for the machine file."""

import asyncio
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from otolith.cli.common import AS_JSON, FILE, progress_line

if TYPE_CHECKING:
    from otolith_drivers.opcua.connection import OpcuaOptions, Variable

NOTHING_THERE = 1  # exit code
SHOWN_VALUE = 40  # characters of a value


@click.command()
@click.argument("endpoint", metavar="ENDPOINT")
@click.option("--security", type=click.Choice(["none", "Basic256Sha256", "Aes128Sha256RsaOaep", "Aes256Sha256RsaPss"]),
              default="none")  # fmt: skip
@click.option("--mode", type=click.Choice(["sign", "sign and encrypt"]), default="sign and encrypt")
@click.option("--certificate", type=FILE, help="Of this client; the server must trust it.")
@click.option("--key", type=FILE, help="The private key of the certificate.")
@click.option("--server-certificate", type=FILE, help="The only one that is accepted from the server.")
@click.option("--user", help="With --password-file.")
@click.option("--password-file", type=FILE, help="A file whose first line is the password.")
@click.option("--timeout", type=click.FloatRange(0.1, 60.0), default=4.0, metavar="SECONDS", help="For each answer.")
@click.option("--most", type=click.IntRange(1, 10_000), default=500, help="Variables that are shown.")
@AS_JSON
def opcua(endpoint: str, timeout: float, most: int, as_json: bool, **keys: Any) -> int:
    """List the variables of an OPC UA server with value, type and unit.

    The lines can be copied into [signals]. Nothing is written to the server.

    \b
    Examples:
      otolith probe opcua opc.tcp://192.168.0.10:4840
      otolith probe opcua opc.tcp://plc:4840 --user otolith --password-file pw
    """
    from otolith.cli.commissioning.probe_view import stdout_console
    from otolith_drivers.config_files import validated
    from otolith_drivers.registry import find

    find("opcua")  # names the extra that is missing
    from otolith_drivers.opcua.connection import OpcuaOptions

    given = {name: value for name, value in keys.items() if value is not None}
    options = validated({"endpoint": endpoint, "timeout": f"{timeout} s"} | given, OpcuaOptions, ())
    with progress_line(f"reading {endpoint}"):
        variables = asyncio.run(_browse(options, most))
    if as_json:
        click.echo(json.dumps({"variables": [_document(one) for one in variables]}, ensure_ascii=False))
    else:
        console = stdout_console()
        for variable in variables:
            console.print(_line(variable), markup=False, soft_wrap=True)
        console.print(f"{len(variables)} variables" if variables else "no variables beside those of OPC UA itself")
    return 0 if variables else NOTHING_THERE


async def _browse(options: "OpcuaOptions", most: int) -> "list[Variable]":
    """Return the variables of the server; raise DeviceError if it cannot be read."""
    from otolith_drivers.errors import DeviceError
    from otolith_drivers.opcua.connection import OpcUaCredentials, browse, connected, reason

    credentials = OpcUaCredentials.load(options, Path())
    try:
        async with connected(options, credentials) as client:
            return await browse(client, most)
    except Exception as error:  # the library raises anything that a server makes it raise
        raise DeviceError(f"OPC UA {options.endpoint}: {reason(error, options.timeout)}") from error


def _document(variable: "Variable") -> dict[str, Any]:
    value = variable.value if isinstance(variable.value, bool | int | float | str) else None
    rest = {"type": variable.type, "unit": variable.unit, "status": variable.status}
    return {"node": variable.node, "path": variable.path, "value": value} | rest


def _line(variable: "Variable") -> str:
    """Return a line for [signals], with the rest as a comment."""
    name = "".join(sign if sign.isalnum() else "_" for sign in variable.path.rpartition("/")[2]) or "signal"
    value = str(variable.value)
    short = value if len(value) <= SHOWN_VALUE else f"{value[:SHOWN_VALUE]}..."
    unit = variable.unit or "unit?"
    status = "" if variable.status == "Good" else f", status {variable.status}"
    node = json.dumps(variable.node, ensure_ascii=False)
    return f"{name} = {{ node = {node} }}  # {variable.path}: {short} {unit}, {variable.type}{status}"
