"""An OPC UA server in a process of its own: asyncua's, with variables that a function of time renews."""

import argparse
import asyncio
import atexit
import json
import math
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from datetime import UTC, datetime, timedelta
from functools import cache
from pathlib import Path
from typing import Any

from asyncua import Server, ua
from asyncua.crypto.permission_rules import User, UserRole
from asyncua.crypto.truststore import TrustStore
from asyncua.crypto.validator import CertificateValidator, CertificateValidatorOptions

from tests.conftest import free_port

PERIOD = 0.01  # s
MOTOR = "urn:motor"  # URI of the namespace of the variables


class OneUser:
    """Accepts the user ``otolith`` with the password ``secret``."""

    def get_user(
        self, iserver: Any, username: Any = None, password: Any = None, certificate: Any = None
    ) -> User | None:
        good = (username, password) == ("otolith", "secret")
        return User(role=UserRole.User, name="otolith") if good else None


async def serve(options: argparse.Namespace) -> None:
    """Serve for ever. The variable ``still`` is not renewed; the source of ``ahead`` has a clock an hour ahead.

    The variable ``--late`` is not there at first; each SIGUSR1 adds or removes it.
    """
    server = Server(user_manager=OneUser() if options.user else None)
    await server.init()
    server.set_endpoint(f"opc.tcp://127.0.0.1:{options.port}/motor")
    server.set_security_policy([ua.SecurityPolicyType.NoSecurity])
    if options.certificate:
        await server.load_certificate(options.certificate)
        await server.load_private_key(options.key)
        server.set_security_policy([ua.SecurityPolicyType.Basic256Sha256_SignAndEncrypt])
        trusted = TrustStore([Path(options.trusted)], [])
        await trusted.load()
        server.set_certificate_validator(
            CertificateValidator(
                CertificateValidatorOptions.TRUSTED_VALIDATION | CertificateValidatorOptions.PEER_CLIENT, trusted
            )
        )
    for uri in options.namespaces.split(","):  # those beside the motor's have variables of the same names, always 0
        space = await server.register_namespace(uri)
        for name in json.loads(options.values) if uri != MOTOR else ():
            await server.nodes.objects.add_variable(ua.NodeId(name, space), ua.QualifiedName(name, space), 0.0)
    is_there = MOTOR in options.namespaces
    space = await server.get_namespace_index(MOTOR) if is_there else 0
    values: dict[str, Any] = json.loads(options.values) if is_there else {}
    nodes = {}
    for name, (value, unit) in values.items():
        node = nodes[name] = await server.nodes.objects.add_variable(ua.NodeId(name, space), name, float(value))
        if unit:
            details = ua.EUInformation(DisplayName=ua.LocalizedText(unit))
            await node.add_property(ua.NodeId(f"{name}.Unit", space), ua.QualifiedName("EngineeringUnits", 0), details)
    if options.late:
        await _let_appear(server, nodes, options.late)
    async with server:
        sys.stdout.write("up\n")
        sys.stdout.flush()
        while True:
            now = datetime.fromtimestamp(PERIOD * math.floor(time.time() / PERIOD), UTC)
            for name, (value, _) in values.items():
                status = ua.StatusCode(ua.StatusCodes.BadSensorFailure if math.isnan(value) else ua.StatusCodes.Good)
                stamp = now + timedelta(hours=name == "ahead")
                new = ua.DataValue(ua.Variant(float(value)), status, SourceTimestamp=stamp, ServerTimestamp=now)
                if name != "still" and name in nodes:
                    await server.write_attribute_value(nodes[name].nodeid, new)
            await asyncio.sleep(PERIOD - time.time() % PERIOD)


async def _let_appear(server: Server, nodes: dict[str, Any], name: str) -> None:
    """Remove the variable ``name``, and add or remove it at each SIGUSR1."""
    node, loop, tasks = nodes.pop(name), asyncio.get_running_loop(), set[asyncio.Task[None]]()
    await server.delete_nodes([node])

    async def toggle() -> None:
        if name not in nodes:
            nodes[name] = await server.nodes.objects.add_variable(node.nodeid, name, 0.0)
            return
        del nodes[name]
        # Part 4 demands this status of a node that is removed; the library's server does not send it by itself.
        gone = ua.DataValue(ua.Variant(0.0), ua.StatusCode(ua.StatusCodes.BadNodeIdUnknown))
        await server.write_attribute_value(node.nodeid, gone)
        await server.delete_nodes([node])

    loop.add_signal_handler(signal.SIGUSR1, lambda: tasks.add(loop.create_task(toggle())))


@contextmanager
def opcua_server(port: int, values: dict[str, tuple[float, str]], *arguments: str) -> "Iterator[subprocess.Popen[str]]":
    """The process of a server with the variables ``nsu=urn:motor;s=NAME``: value and unit by name."""
    command = [sys.executable, "-m", "tests.drivers.opcua_server", "--port", str(port), "--values", json.dumps(values)]
    with subprocess.Popen([*command, *arguments], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        try:
            assert process.stdout.readline() == "up\n"
            yield process
        finally:
            process.kill()


@cache
def server_of_this_process() -> int:
    """The port of a server that ends with this process."""
    return lasting_server(i=(2.0, "A"), omega=(10.0, ""), still=(3.0, "A"), ahead=(4.0, "A"), bad=(math.nan, "A"))


def lasting_server(**values: tuple[float, str]) -> int:
    """The port of a new server that ends with this process."""
    port, stack = free_port(socket.SOCK_STREAM), ExitStack()
    stack.enter_context(opcua_server(port, values))
    atexit.register(stack.close)
    return port


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--port", type=int)
    parser.add_argument("--values")
    parser.add_argument("--namespaces", default=MOTOR)
    parser.add_argument("--user", action="store_true")
    parser.add_argument("--late")
    for name in ("--certificate", "--key", "--trusted"):
        parser.add_argument(name)
    asyncio.run(serve(parser.parse_args()))
