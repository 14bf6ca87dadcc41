"""A machine file, recordings of a simulated motor and a plan, and what a daemon would have learned of the motor."""

import shutil
from dataclasses import replace
from functools import cache
from itertools import islice
from pathlib import Path

from otolith import Twin
from otolith.adaptation.state import AdaptationState
from otolith.machine import load_machine
from otolith.storage.state_store import store_of
from otolith_drivers.plant.faults import PlantSample
from otolith_drivers.plant.scenario import load_scenario, simulate
from tests.conftest import EXAMPLES, SIGNALS

WINDOW = 200  # records
LEARNED, COMPARED = 3, 2  # windows
PLAN = "t,V_a [V],T_load [mN*m]\n0,12,20\n1,24,20\n2.5,24,60\n"


def write_files(folder: Path) -> Path:
    """Write them into ``folder``, and return the machine file."""
    for name in ("dc-motor.toml", "dc-motor.dbc"):
        shutil.copy(EXAMPLES / name, folder / name.replace("dc-motor.toml", "my-machine.toml"))
    ticks = _ticks()
    _write(folder / "monday.csv", ticks[: LEARNED * WINDOW])
    _write(folder / "tuesday.csv", ticks[LEARNED * WINDOW :])
    (folder / "plan.csv").write_text(PLAN, encoding="utf-8")
    return folder / "my-machine.toml"


def save_learned(machine: Path) -> None:
    """Save what a daemon would have learned from the first recording; the resistance has been falling for a day."""
    store_of(load_machine(machine, with_driver=False)).save(learned(machine))


@cache
def _ticks() -> list[PlantSample]:
    scenario = load_scenario(EXAMPLES / "scenarios" / "demo.toml")
    return list(islice(simulate(scenario), (LEARNED + COMPARED) * WINDOW + 50))


def _write(path: Path, ticks: list[PlantSample]) -> None:
    cells = ([f"{tick.time:.3f}", *(repr(float(tick.measured[name])) for name in SIGNALS.values())] for tick in ticks)
    path.write_text("\n".join(map(",".join, [["t", *SIGNALS], *cells])) + "\n", encoding="utf-8")


def learned(machine: Path) -> AdaptationState:
    """What the first recording beside ``machine`` shows; computed once, as it is the same in each folder."""
    if not _known:
        state = Twin.load(machine).adapted(machine.with_name("monday.csv")).learned
        falling = tuple((1800.0 * index - 86_400.0, 6.5 - 0.002 * index, 1e-6) for index in range(48))
        _known.append(replace(state, health=replace(state.health, histories={"R_a": falling})))
    return _known[0]


_known: list[AdaptationState] = []
