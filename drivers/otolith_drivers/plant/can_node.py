"""The simulated machine as a CAN node: cyclic frames by a DBC, in real time, with an alive counter in each message."""

import math
import time
from collections.abc import Callable

import can
from cantools.database import Message

from otolith_drivers.canbus.bus import open_bus
from otolith_drivers.canbus.database import load_dbc
from otolith_drivers.errors import ConfigurationError, DeviceError
from otolith_drivers.plant.realtime import Summary, TruthFile, Turn, in_real_time
from otolith_drivers.plant.scenario import Scenario
from otolith_drivers.units import factor

ALIVE_COUNTER = "AliveCounter"  # signals whose name ends so count the frames of their message
LISTEN_FIRST = 0.15  # s; longer than ten periods of a node that is already there
STANDARD_IDENTIFIERS = 2048
LONGEST_FRAME = 8  # bytes


class CanNode:
    """Implements :class:`otolith_drivers.plant.realtime.Node` over python-can."""

    def __init__(self, scenario: Scenario) -> None:
        """Open the bus.

        Raises:
            DeviceError: the bus cannot be opened, or another node already sends these frames.
            ConfigurationError: the DBC describes signals that the machine does not have.
        """
        self._scenario = scenario
        self._messages = _messages(scenario)
        self._conversions = _conversions(self._messages, scenario)
        self._ours = {message.frame_id for message in self._messages}
        self._bus = open_bus(scenario.bus)
        try:
            self._refuse_twins()
        except DeviceError:
            self.close()
            raise

    def title(self) -> str:
        """See :meth:`otolith_drivers.plant.realtime.Node.title`."""
        return f"{self._scenario.plant} on {self._scenario.bus.title()}, frames of {self._scenario.dbc.name}"

    def run(self, truth: TruthFile | None, stopped: Callable[[], bool], duration: float = math.inf) -> Summary:
        """See :meth:`otolith_drivers.plant.realtime.Node.run`."""
        done = Summary.of(self._scenario.faults)
        for turn in in_real_time(self._scenario, done, stopped, duration):
            if turn.effect.withheld is None:
                for message in self._messages:
                    self._send(self._frame(message, turn))
                done.frames += len(self._messages)
            else:
                done.faults[turn.effect.withheld].withheld += len(self._messages)
            for data in turn.effect.garbage:
                self._send(self._strangers_frame(data))
            if truth is not None:
                truth.note(turn)
        return done

    def close(self) -> None:
        """See :meth:`otolith_drivers.plant.realtime.Node.close`."""
        self._bus.shutdown()

    def say(self, done: Summary) -> str:
        """See :meth:`otolith_drivers.plant.realtime.Node.say`."""
        withheld = f", {done.withheld} withheld" if done.faults else ""
        return f"{done.frames} frames in {done.seconds:.1f} s of simulated time, {done.stalls} stalls{withheld}"

    def _frame(self, message: Message, turn: Turn) -> can.Message:
        values: dict[str, float] = {}
        for signal in message.signals:
            if signal.name.endswith(ALIVE_COUNTER):
                values[signal.name] = turn.index % 2**signal.length
            else:  # a sensor saturates at the ends of its range
                scale, offset = self._conversions[signal.name]
                low = -math.inf if signal.minimum is None else float(signal.minimum)
                high = math.inf if signal.maximum is None else float(signal.maximum)
                values[signal.name] = min(max(scale * turn.tick.measured[signal.name] + offset, low), high)
        data = message.encode(values, padding=True)
        return can.Message(arbitration_id=message.frame_id, data=data, is_extended_id=message.is_extended_frame)

    def _strangers_frame(self, data: bytes) -> can.Message:
        """Two bytes for its identifier, which is none of ours, and the rest as its data."""
        identifier = int.from_bytes(data[:2], "big") % STANDARD_IDENTIFIERS
        while identifier in self._ours:
            identifier = (identifier + 1) % STANDARD_IDENTIFIERS
        return can.Message(arbitration_id=identifier, data=data[2 : 2 + LONGEST_FRAME], is_extended_id=False)

    def _send(self, frame: can.Message) -> None:
        try:
            self._bus.send(frame)
        except (can.CanError, OSError) as error:
            raise DeviceError(f"sending on the bus failed: {error}") from error

    def _refuse_twins(self) -> None:
        """Two nodes with the same arbitration IDs would give the listener a mixture of two machines."""
        end = time.monotonic() + LISTEN_FIRST
        while (left := end - time.monotonic()) > 0:
            frame = self._bus.recv(left)
            if frame is not None and frame.arbitration_id in self._ours:
                raise DeviceError(
                    f"another node already sends frame 0x{frame.arbitration_id:X} on {self._scenario.bus.title()}: "
                    "is a second plant or demo running? Stop it, or give this scenario another bus"
                )


def _messages(scenario: Scenario) -> list[Message]:
    messages = load_dbc(scenario.dbc).messages
    for message in messages:
        for signal in message.signals:
            if signal.name not in scenario.SIGNALS and not signal.name.endswith(ALIVE_COUNTER):
                text = f"{scenario.dbc}: {message.name}.{signal.name} is no signal of plant {scenario.plant!r}"
                raise ConfigurationError(f"{text}; it has {', '.join(sorted(scenario.SIGNALS))}")
    return list(messages)


def _conversions(messages: list[Message], scenario: Scenario) -> dict[str, tuple[float, float]]:
    """Scale and offset of each signal from the plant's unit to that of the DBC."""
    units = scenario.SIGNALS
    return {
        signal.name: factor(units[signal.name], signal.unit or units[signal.name])
        for message in messages
        for signal in message.signals
        if signal.name in units
    }
