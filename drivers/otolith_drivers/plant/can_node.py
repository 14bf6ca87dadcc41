"""The simulated machine as a CAN node: cyclic frames of a DBC in real time."""

import math
import time

from cantools.database import Message

from otolith_drivers.canbus import can
from otolith_drivers.canbus.bus import open_bus
from otolith_drivers.canbus.database import load_dbc
from otolith_drivers.errors import ConfigurationError, DeviceError
from otolith_drivers.plant.realtime import Node, NodeSummary, ScheduledSample
from otolith_drivers.plant.scenario import Scenario
from otolith_drivers.units import factor

ALIVE_COUNTER = "AliveCounter"  # end of the name of a signal that counts the frames of its message
# Engineering choice: fifteen sample periods of the shipped scenarios. Guarded by tests/system/test_plant.py.
LISTEN_BEFORE_SEND = 0.15  # s
STANDARD_IDENTIFIERS = 2048
MAX_DATA = 8  # bytes of a classical CAN frame


class CanNode(Node):
    """Sends the frames by python-can."""

    def __init__(self, scenario: Scenario) -> None:
        """Open the bus.

        Raises:
            DeviceError: the bus cannot be opened, or another node already sends these frames.
            ConfigurationError: the DBC has a signal that the machine does not have.
        """
        super().__init__(scenario)
        self._messages = _messages(scenario)
        self._conversions = _conversions(self._messages, scenario)
        self._identifiers = {message.frame_id for message in self._messages}
        self._bus = open_bus(scenario.bus)
        try:
            self._refuse_second_node()
        except DeviceError:
            self.close()
            raise

    def title(self) -> str:
        return f"{self._scenario.plant} on {self._scenario.bus.title()}, frames of {self._scenario.dbc.name}"

    def close(self) -> None:
        self._bus.shutdown()

    def summary_line(self, summary: NodeSummary) -> str:
        withheld = f", {summary.withheld} withheld" if summary.faults else ""
        return (
            f"{summary.frames} frames in {summary.seconds:.1f} s of simulated time, {summary.stalls} stalls{withheld}"
        )

    def publish(self, scheduled: ScheduledSample, summary: NodeSummary) -> None:
        if scheduled.effect.withheld is None:
            for message in self._messages:
                self._send(self._frame(message, scheduled))
            summary.frames += len(self._messages)
        else:
            summary.faults[scheduled.effect.withheld].withheld += len(self._messages)
        for data in scheduled.effect.garbage:
            self._send(self._foreign_frame(data))

    def _frame(self, message: Message, scheduled: ScheduledSample) -> can.Message:
        values: dict[str, float] = {}
        for signal in message.signals:
            if signal.name.endswith(ALIVE_COUNTER):
                values[signal.name] = scheduled.index % 2**signal.length
            else:  # a sensor saturates at the ends of its range
                scale, offset = self._conversions[signal.name]
                low = -math.inf if signal.minimum is None else float(signal.minimum)
                high = math.inf if signal.maximum is None else float(signal.maximum)
                values[signal.name] = min(max(scale * scheduled.sample.measured[signal.name] + offset, low), high)
        data = message.encode(values, padding=True)
        return can.Message(arbitration_id=message.frame_id, data=data, is_extended_id=message.is_extended_frame)

    def _foreign_frame(self, data: bytes) -> can.Message:
        """A frame of another node: the first two bytes give its identifier, the rest is its data."""
        identifier = int.from_bytes(data[:2], "big") % STANDARD_IDENTIFIERS
        while identifier in self._identifiers:
            identifier = (identifier + 1) % STANDARD_IDENTIFIERS
        return can.Message(arbitration_id=identifier, data=data[2 : 2 + MAX_DATA], is_extended_id=False)

    def _send(self, frame: can.Message) -> None:
        try:
            self._bus.send(frame)
        except (can.CanError, OSError) as error:
            raise DeviceError(f"sending on the bus failed: {error}") from error

    def _refuse_second_node(self) -> None:
        """Two nodes with the same arbitration IDs would give a mixture of two machines."""
        end = time.monotonic() + LISTEN_BEFORE_SEND
        while (left := end - time.monotonic()) > 0:
            frame = self._bus.recv(left)
            if frame is not None and frame.arbitration_id in self._identifiers:
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
                raise ConfigurationError(f"{text}, which has {', '.join(sorted(scenario.SIGNALS))}")
    return list(messages)


def _conversions(messages: list[Message], scenario: Scenario) -> dict[str, tuple[float, float]]:
    """Scale and offset of each signal from the unit of the plant to the unit of the DBC."""
    units = scenario.SIGNALS
    return {
        signal.name: factor(units[signal.name], signal.unit or units[signal.name])
        for message in messages
        for signal in message.signals
        if signal.name in units
    }
