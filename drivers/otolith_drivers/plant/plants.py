"""The table of simulated machines: one row each."""

from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

from otolith_drivers.errors import ConfigurationError, nearest
from otolith_drivers.plant.scenario import Scenario
from otolith_drivers.plant.tick import Tick
from otolith_drivers.toml_files import expect, parse, read, validate

# Each module has SCENARIO, the model of its scenario files, SIGNALS, the unit of each signal that it measures, and
# simulate(scenario), its ticks without end.
PLANTS = {
    "dc_motor": "otolith_drivers.plant.dc_motor",
    "hydraulic_actuator": "otolith_drivers.plant.hydraulic_actuator",
}


def load_scenario(path: Path) -> Scenario:
    """The scenario in ``path``, its DBC made relative to the file.

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
    return scenario.model_copy(update={"dbc": path.parent / scenario.dbc})


def simulate(scenario: Scenario) -> Iterator[Tick]:
    """The machine of ``scenario``, one tick per sample period, without end; the same for the same seed."""
    ticks: Iterator[Tick] = _module(scenario.plant).simulate(scenario)
    return ticks


def signals(scenario: Scenario) -> dict[str, str]:
    """What the machine of ``scenario`` measures, and the unit of each."""
    found: dict[str, str] = _module(scenario.plant).SIGNALS
    return found


def _module(name: str) -> Any:
    return import_module(PLANTS[name])
