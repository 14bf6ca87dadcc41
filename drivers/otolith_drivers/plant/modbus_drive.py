"""What a simulated machine answers as a Modbus device: its registers at the latest tick, and nothing that writes.

pymodbus speaks: frames, checksums, limits of requests. Here is what the device makes of a request that is one.
"""

from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from typing import Any

from pymodbus import FramerType
from pymodbus.constants import ExcCodes
from pymodbus.pdu import ExceptionResponse, ModbusPDU
from pymodbus.server import ModbusTcpServer
from pymodbus.server.requesthandler import ServerRequestHandler
from pymodbus.simulator import DataType, SimData, SimDevice

from otolith_drivers.plant.bus_faults import Effect
from otolith_drivers.plant.pace import Turn
from otolith_drivers.plant.registers import ModbusOptions, RegisterMap
from otolith_drivers.plant.summary import Summary

READS = frozenset({3, 4})  # holding and input registers: the functions that are answered
UNREADABLE = 0  # stands for the function of a request that cannot be decoded


@dataclass(frozen=True, slots=True)
class _State:
    """What the device is between two ticks; put in place of the one before as a whole."""

    registers: list[int]
    effect: Effect


class Drive:
    """The device. Its ticks come from one thread and its requests from another, the only one that counts requests."""

    def __init__(self, options: ModbusOptions, registers: RegisterMap, *, alone: bool) -> None:
        """``alone``: who asks for another device hears that there is none; else it is for others on the line to say."""
        self._options, self._map, self._alone = options, registers, alone
        self._state = _State([0] * registers.size, Effect())
        self._done = Summary({})

    def begin(self, done: Summary) -> None:
        """Count in ``done`` from now on."""
        self._done = done

    def live(self, turn: Turn) -> None:
        """Take over a tick, all registers at once."""
        order = turn.effect.order or self._options.order
        registers = self._map.encode(turn.tick.measured, turn.index, order)
        self._state = _State(registers, turn.effect)

    def device(self) -> SimDevice:
        """For pymodbus, which asks :meth:`answer` before it looks here."""

        async def refresh(
            _function: int, _start: int, _address: int, _count: int, registers: list[int], values: object
        ) -> ExcCodes | None:
            if values is not None:
                return ExcCodes.ILLEGAL_FUNCTION
            registers[: self._map.size] = self._state.registers
            return None

        data = SimData(0, values=[0] * self._map.size, datatype=DataType.REGISTERS, readonly=True)
        return SimDevice(id=self._options.device, simdata=[data], action=refresh)

    async def answer(self, request: ModbusPDU, context: Any) -> ModbusPDU | None:
        """To ``request``, or None for silence; ``context`` is pymodbus' own."""
        function = request.function_code
        if not (state := self._heard(request.dev_id, function)):
            return None
        if request.dev_id != self._options.device:
            return ExceptionResponse(function, ExcCodes.GATEWAY_NO_RESPONSE)
        if function not in READS:
            self._done.refused[function] += 1
            return ExceptionResponse(function, ExcCodes.ILLEGAL_FUNCTION)
        for number, refusal in state.effect.refusals:
            if refusal.concerns(request.address, request.count):
                self._done.faults[number].refused += 1
                return ExceptionResponse(function, refusal.code)
        return await request.datastore_update(context, request.dev_id)

    def refuses_unreadable(self, device: int) -> bool:
        """Whether to say that a request cannot be decoded."""
        if not self._heard(device, UNREADABLE):
            return False
        self._done.refused[UNREADABLE] += 1
        return True

    def answered(self) -> None:
        """Another answer is on its way."""
        self._done.answers += 1

    def _heard(self, device: int, function: int) -> _State | None:
        """The state that answers a request; None if it stays unanswered. Either is counted."""
        state = self._state
        if device != self._options.device and not self._alone:
            return None
        self._done.functions[function] += 1
        if state.effect.withheld is not None:
            self._done.faults[state.effect.withheld].withheld += 1
            return None
        return state


class Conversation(ServerRequestHandler):
    """With one client, or with all on a line."""

    server: "Server"

    def __init__(self, server: "Server") -> None:
        """For one who has come."""
        super().__init__(server, None, None, None)  # type: ignore[no-untyped-call] # pymodbus does not say

    async def handle_request(self) -> None:
        """Answer what has come, or be silent."""
        request = self.last_pdu
        if request is None or (response := await self.server.drive.answer(request, self.server.context)) is None:
            return
        response.transaction_id, response.dev_id = request.transaction_id, request.dev_id
        self._say(response)

    def server_send(self, pdu: ModbusPDU, addr: tuple[Any, ...] | None) -> None:
        """What pymodbus itself answers: to a request that it cannot decode."""
        if self.server.drive.refuses_unreadable(pdu.dev_id):
            self._say(pdu)

    def disturb(self, data: bytes) -> None:
        """Put bytes on the line that are no answer."""
        if self.transport is not None:
            self.send(data)

    def _say(self, response: ModbusPDU) -> None:
        if self.transport is None:  # the client has gone meanwhile
            return
        self.server.drive.answered()
        self.pdu_send(response)


class Server(ModbusTcpServer):
    """A server of pymodbus that answers what ``drive`` does, on whatever ``attach`` makes."""

    def __init__(self, drive: Drive, framer: FramerType) -> None:
        """To be made where its event loop runs."""
        super().__init__(drive.device(), framer=framer)
        self.drive = drive

    async def begin(self, attach: Callable[[], Awaitable[Any]]) -> None:
        """Serve what ``attach`` makes: a listening server, or a transport and its protocol."""
        self.call_create = attach  # type: ignore[assignment]  # declared as what its own constructor gives
        await self.serve_forever(background=True)

    def callback_new_connection(self) -> Conversation:
        """For a client that has come."""
        return Conversation(self)

    def disturb(self, data: bytes) -> None:
        """Put bytes on all lines that are no answer."""
        for conversation in self.active_connections.values():
            if isinstance(conversation, Conversation):
                conversation.disturb(data)
