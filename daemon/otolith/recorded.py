"""Opening recorded data for a machine: a table, a log of its bus or one of our recordings."""

from pathlib import Path

from otolith.errors import ConfigurationError
from otolith.named_driver import NamedDriver, named_driver
from otolith.plan import Plan
from otolith_drivers.base import Setup, Signal
from otolith_drivers.logs.readers import format_of, holds_frames
from otolith_drivers.logs.rows import Reader
from otolith_drivers.toml_files import read


def open_recorded(plan: Plan, data: Path) -> Reader:
    """The signals of the twin of ``plan`` in ``data``.

    A log of a bus is decoded by what the machine file says of it; a table and a recording need no more than the names
    of the signals, but columns are looked for where a machine file with ``type = "replay"`` says that they are.

    Raises:
        ConfigurationError: no such file, not the signals that are needed, or nothing that tells what is in the frames.
    """
    kind = plan.file.driver.get("type")
    if kind == "replay":
        return _as_replayed(named_driver(plan.file, plan.twin, read(plan.path)), plan, data)
    if not holds_frames(data):
        return _by_name(plan, data)
    if kind != "can":
        needed = '[driver] with type = "can" and [signals] must say what is in its frames'
        raise ConfigurationError(f"{data}: a log of a CAN bus, and in {plan.path} {needed}")
    driver = named_driver(plan.file, plan.twin, read(plan.path))
    with driver.faults_placed():
        return format_of(data).open_log(data, driver.setup, driver.options)


def _by_name(plan: Plan, data: Path) -> Reader:
    format_ = format_of(data)
    signals = tuple(Signal(name, plan.twin.unit_of(name), format_.Source()) for name in plan.twin.signals)
    return format_.open_log(data, Setup(signals, plan.path.parent, plan.file.window.sample_period), None)


def _as_replayed(driver: NamedDriver, plan: Plan, data: Path) -> Reader:
    from otolith_drivers.replayer import opener  # noqa: PLC0415 - only for a machine file that names it

    if format_of(data) is not format_of(driver.options.file) and not holds_frames(data):
        return _by_name(plan, data)
    with driver.faults_placed():
        return opener(data, driver.options, driver.setup)()
