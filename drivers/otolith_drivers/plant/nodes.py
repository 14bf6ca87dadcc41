"""The table of ways to reach a simulated machine as a device of its own: one lazy row each."""

import json
import math
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Protocol

from otolith_drivers.errors import ServiceError
from otolith_drivers.plant.bus_faults import CAN, MODBUS_RTU, MODBUS_TCP
from otolith_drivers.plant.pace import refuse_unfit
from otolith_drivers.plant.scenario import Scenario
from otolith_drivers.plant.summary import Summary
from otolith_drivers.plant.truth import TruthFile

# Each class is built from a scenario and is a Node.
NODES = {
    CAN: ("otolith_drivers.plant.can_node", "CanNode"),
    MODBUS_TCP: ("otolith_drivers.plant.modbus_node", "TcpNode"),
    MODBUS_RTU: ("otolith_drivers.plant.modbus_node", "RtuNode"),
}


class Node(Protocol):
    """A simulated machine on its bus: built, run once, closed once."""

    def title(self) -> str:
        """Where it can be heard or asked, and what for."""

    def run(self, truth: TruthFile | None, stopped: Callable[[], bool], duration: float = math.inf) -> Summary:
        """Be the machine until ``stopped`` or for ``duration`` s.

        Raises:
            DeviceError: the bus went away.
        """

    def close(self) -> None:
        """Leave the bus."""

    def say(self, done: Summary) -> str:
        """What it has done, in a line."""


def open_node(transport: str, scenario: Scenario) -> Node:
    """The machine of ``scenario`` on ``transport``, a key of ``NODES``.

    Raises:
        ConfigurationError: the scenario does not fit the transport.
        DeviceError: the bus cannot be opened, or another node already uses it.
    """
    refuse_unfit(scenario, transport)
    module, name = NODES[transport]
    node: Node = getattr(import_module(module), name)(scenario)
    return node


def write_summary(path: Path, scenario: Scenario, transport: str, done: Summary) -> None:
    """As a file of JSON.

    Raises:
        ServiceError: it cannot be written.
    """
    document = {"plant": scenario.plant, "transport": transport, "seed": scenario.seed} | done.document()
    try:
        path.write_text(json.dumps(document, indent=2) + "\n", encoding="utf-8")
    except OSError as error:
        raise ServiceError(f"{path}: cannot be written: {error.strerror}") from error
