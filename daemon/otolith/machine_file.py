"""The machine file: typed, bounded, closed, every value with its unit."""

import re
from pathlib import Path
from typing import Annotated, Any

from pydantic import AfterValidator, BeforeValidator, Field

from otolith_drivers.config_files import StrictModel
from otolith_drivers.units import Quantity

PROTOCOLS = ("tcp", "tls", "udp", "quic", "ws", "unixsock-stream")


def _name(written: str) -> str:
    if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_\-]{0,63}", written):
        raise ValueError(
            f"{written!r} is no name: letters, digits, '-' and '_', at most 64, as it becomes part of keys"
        )
    return written


def _endpoint(written: str) -> str:
    if not re.fullmatch(rf"({'|'.join(PROTOCOLS)})/\S+", written):
        raise ValueError(f'{written!r} is no endpoint: write it like "tcp/127.0.0.1:7447" ({", ".join(PROTOCOLS)})')
    if not written.startswith("unixsock-stream/") and not re.search(r":\d{1,5}$", written):
        raise ValueError(f'{written!r} lacks its port: write it like "tcp/127.0.0.1:7447"')
    return written


def _value_alone(written: object) -> object:
    """``"6.5 ohm"`` is short for ``{ value = "6.5 ohm" }``."""
    return written if isinstance(written, dict) else {"value": written}


Name = Annotated[str, AfterValidator(_name)]
Endpoint = Annotated[str, AfterValidator(_endpoint)]
Written = str | float | None
"""A quantity that is understood once its unit is known; a number without a unit is refused then."""


class MachineTable(StrictModel):
    """Who the machine is; both names become part of the Zenoh keys and of file names."""

    name: Name
    site: Name = "site"


class TwinTable(StrictModel):
    """Which twin: one of the library by its name, or a file of one's own."""

    name: str | None = None
    file: Path | None = None
    """Relative to the machine file."""


class ParameterTable(StrictModel):
    """A parameter that is not simply known."""

    value: Written = None
    """Known, or for an estimated one where the search starts; without it the twin's nominal value."""
    estimate: bool | None = None
    """Without it: a parameter with a value is known, and one without is what the twin says of its role."""
    low: Written = None
    high: Written = None


class WindowTable(StrictModel):
    """How samples become windows, and what a window may lack and still be estimated from."""

    length: Annotated[float, BeforeValidator(Quantity("s", 0.1, 600.0))] = 2.0
    shortest: Annotated[float, BeforeValidator(Quantity("s", 0.1, 600.0))] | None = None
    longest: Annotated[float, BeforeValidator(Quantity("s", 0.1, 600.0))] | None = None
    """With either of these the length follows what drift and noise ask for, from ``length`` on."""
    sample_period: Annotated[float, BeforeValidator(Quantity("s", 1e-4, 10.0))] = 0.01
    missing_limit: Annotated[float, BeforeValidator(Quantity("1", 0.0, 1.0))] = 0.01
    gap_limit: Annotated[float, BeforeValidator(Quantity("s", 0.0, 60.0))] = 0.05
    jitter_limit: Annotated[float, BeforeValidator(Quantity("s", 0.0, 10.0))] = 0.005


class EstimationTable(StrictModel):
    """What is asked of estimates."""

    open_loop: bool = False
    """The paper's cost: nothing corrects the twin within a window; noise other than the sensors' is left out."""
    determined_within: Annotated[float, BeforeValidator(Quantity("1", 1e-6, 1.0))] = 0.1
    """A parameter counts as determined when the half of its 95 % interval is at most this share of its value."""


class DiscoveryTable(StrictModel):
    """What is looked for when the twin does not explain the machine; everything unless restricted."""

    enabled: bool = True
    families: tuple[str, ...] | None = None
    sites: tuple[str, ...] | None = None
    inputs: tuple[str, ...] | None = None
    """``t``, ``angle(omega)``, or names of signals and states."""


class SwarmTable(StrictModel):
    """The particle swarm; the default values are Table 2 of the paper."""

    size: Annotated[int, Field(ge=3, le=1000)] = 15
    generations: Annotated[int, Field(ge=1, le=100_000)] = 1000
    inertia: Annotated[float, Field(gt=0.0, lt=1.0)] = 0.9
    cognitive: Annotated[float, Field(ge=0.0, le=4.0)] = 2.0
    social: Annotated[float, Field(ge=0.0, le=4.0)] = 2.0
    seed: Annotated[int, Field(ge=0, lt=2**31)] = 1


class ZenohTable(StrictModel):
    """Where reports go; loopback only unless told otherwise."""

    listen: tuple[Endpoint, ...] = ("tcp/127.0.0.1:7447",)
    connect: tuple[Endpoint, ...] = ()


class RecordingTable(StrictModel):
    """Rerun recordings."""

    enabled: bool = True
    folder: Path | None = None
    """Relative to the machine file; without it the state directory of the daemon."""


class MachineFile(StrictModel):
    """The whole file."""

    machine: MachineTable
    driver: Annotated[dict[str, Any], Field(default_factory=dict)]
    """With ``signals`` what the daemon needs; a replay does without."""
    signals: Annotated[dict[str, dict[str, Any]], Field(default_factory=dict)]
    twin: TwinTable
    parameters: Annotated[
        dict[str, Annotated[ParameterTable, BeforeValidator(_value_alone)]], Field(default_factory=dict)
    ]
    noise: Annotated[dict[str, Written], Field(default_factory=dict)]
    """Of sensors: standard deviation of outputs and of measured inputs."""
    process_noise: Annotated[dict[str, Written], Field(default_factory=dict)]
    """Of the machine itself: how far a state strays, in its unit per square root of a second."""
    window: WindowTable = WindowTable()
    estimation: EstimationTable = EstimationTable()
    discovery: DiscoveryTable = DiscoveryTable()
    swarm: SwarmTable = SwarmTable()
    zenoh: ZenohTable = ZenohTable()
    recording: RecordingTable = RecordingTable()
