"""The table of simulated machines: one row each."""

from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

from otolith_drivers.errors import ConfigurationError, nearest
from otolith_drivers.plant.scenario import Scenario
from otolith_drivers.plant.sensor_faults import distorted
from otolith_drivers.plant.tick import Tick
from otolith_drivers.toml_files import expect, parse, read, validate

# Each module has SCENARIO, the model of its scenario files, and simulate(scenario), its ticks without end.
PLANTS = {
    "dc_motor": "otolith_drivers.plant.dc_motor",
    "hydraulic_actuator": "otolith_drivers.plant.hydraulic_actuator",
}


def load_scenario(path: Path) -> Scenario:
    """The scenario in ``path``, the files that it names made relative to it.

    Raises:
        ConfigurationError: unreadable, an unknown plant, or one line per fault.
    """
    page = read(path)
    data = parse(page)
    expect(page, data, "plant")
    name = data.get("plant")
    if not isinstance(name, str) or name not in PLANTS:
        raise ConfigurationError(f"{page.place(('plant',))}: no plant {name!r}: {nearest(str(name), list(PLANTS))}")
    scenario: Scenario = validate(data, _module(name).SCENARIO, page)
    line = scenario.modbus.line
    modbus = scenario.modbus.model_copy(update={"line": None if line is None else path.parent / line})
    return scenario.model_copy(update={"dbc": path.parent / scenario.dbc, "modbus": modbus})


def simulate(scenario: Scenario) -> Iterator[Tick]:
    """The machine of ``scenario``, one tick per sample period, without end; the same for the same seed.

    What is measured is as its sensors say it, faults included; what happens on the bus is not in it.
    """
    ticks: Iterator[Tick] = _module(scenario.plant).simulate(scenario)
    distortions = scenario.distortions()
    return distorted(ticks, distortions) if distortions else ticks


def _module(name: str) -> Any:
    return import_module(PLANTS[name])
