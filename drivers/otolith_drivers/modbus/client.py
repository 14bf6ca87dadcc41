"""A read-only Modbus client over pymodbus: only function codes 1 to 4, which read bits and registers.

How a request can fail is here as well: an exception of the device, no reply, or a lost connection.
"""

import contextlib
import errno
import logging
import math
import socket
import termios
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import serial
from pymodbus import ModbusException
from pymodbus.client import ModbusSerialClient, ModbusTcpClient
from pymodbus.exceptions import ConnectionException
from pymodbus.framer import FramerType

from otolith_drivers.common.reconnection import cause_of
from otolith_drivers.modbus.frames import FrameFilter, SerialFilter, TcpFilter
from otolith_drivers.modbus.options import BIT_TABLES, LineOptions, Table

# Modbus Application Protocol V1.1b3, section 7.
EXCEPTIONS = {
    1: "illegal function",
    2: "illegal data address",
    3: "illegal data value",
    4: "server device failure",
    5: "acknowledge, it takes longer",
    6: "server device busy",
    8: "memory parity error",
    10: "gateway path unavailable",
    11: "gateway target device failed to respond",
}
ILLEGAL_FUNCTION = 1  # Exception of a device that does not serve the function, such as reading a table that it lacks
ILLEGAL_ADDRESS = 2  # Exception for registers that the device does not have
PERMANENT_CODES = (ILLEGAL_FUNCTION, ILLEGAL_ADDRESS, 3)  # Exceptions that a repeated request will meet again
BUSY_CODES = (5, 6)  # Exceptions that ask to repeat the request later
GATEWAY_CODES = (10, 11)  # Exceptions by which a gateway reports that the device does not answer

FUNCTION_CODES: Final[dict[Table, int]] = {"coil": 1, "discrete": 2, "holding": 3, "input": 4}
DRAIN_STEP = 0.02  # s between looks for late bytes; engineering choice: at most 1 % of a core
READS: Final = {1: "read_coils", 2: "read_discrete_inputs", 3: "read_holding_registers", 4: "read_input_registers"}
MAX_DRAIN = 5  # timeouts, after which a line that never falls silent is reopened all the same; engineering choice


class ExceptionReplyError(Exception):
    """The device answers with an exception: it does not have the registers, returns fewer at once, or is busy."""

    def __init__(self, code: int) -> None:
        super().__init__(f"exception {code}, {EXCEPTIONS.get(code, 'unknown')}")
        self.code = code

    @property
    def meaning(self) -> str:
        """The exception's name in the standard."""
        return EXCEPTIONS.get(self.code, str(self))


class NoReplyError(Exception):
    """No valid answer arrives in time, as from a device that is off or late; the connection itself stands."""


class ConnectionLostError(Exception):
    """The connection fails: it is refused or closed, the host unreachable, or the serial adapter unplugged."""


class ReadOnlyClient:
    """A connection to one host or serial port, for one thread; only :meth:`abort` may be called from another."""

    def __init__(self, options: LineOptions) -> None:
        # pymodbus would log the last packets with every error.
        logging.getLogger("pymodbus").setLevel(logging.CRITICAL)
        self._options = options
        self._aborted = threading.Event()
        self._filter: FrameFilter = TcpFilter(options) if options.is_tcp else SerialFilter()
        self._client = _client(options, self._aborted, self._filter)

    def connect(self) -> None:
        """Open the connection; raise ConnectionLostError if it cannot be opened."""
        try:  # not by the library, which only logs the cause of a failure
            self._client.socket = self._open()
        except (OSError, ValueError, termios.error) as error:
            raise ConnectionLostError(_cause(error)) from error

    def close(self) -> None:
        """Close the connection; may be called twice."""
        with contextlib.suppress(OSError):
            self._client.close()  # type: ignore[no-untyped-call]  # of a library that is typed but for this

    def abort(self) -> None:
        """End a read in progress; callable from another thread."""
        self._aborted.set()
        handle = self._client.socket
        if isinstance(handle, socket.socket):
            with contextlib.suppress(OSError):
                handle.shutdown(socket.SHUT_RDWR)

    def read(self, device: int, table: Table, address: int, count: int) -> list[int]:
        """Return ``count`` registers (each 0 to 65535) or bits from ``address`` on.

        Raises:
            ExceptionReplyError: the device answers with an exception.
            NoReplyError: no valid answer in time; the connection must be reopened before the next request.
            ConnectionLostError: the connection failed.
        """
        client = self._client
        read = getattr(client, READS[FUNCTION_CODES[table]])
        if self._options.reply_transaction is not None:  # a second copy of an answer looks like the next answer
            self._discard()
        try:
            reply = read(address, count=count, device_id=device)
        except ConnectionException as error:
            raise ConnectionLostError("the connection was closed") from error
        except ModbusException as error:
            raise NoReplyError(self._filter.fault or f"no answer within {self._options.timeout:g} s") from error
        except OSError as error:
            raise ConnectionLostError(cause_of(error)) from error
        except Exception as error:  # the library's decoder may raise anything for corrupted bytes
            raise NoReplyError(f"an answer that cannot be decoded ({type(error).__name__})") from error
        if reply.isError():
            raise ExceptionReplyError(int(reply.exception_code))
        values = list(map(int, reply.bits)) if table in BIT_TABLES else list(reply.registers)
        size = 8 * math.ceil(count / 8) if table in BIT_TABLES else count  # bits fill whole bytes
        if reply.function_code != FUNCTION_CODES[table] or len(values) != size:
            raise NoReplyError(f"an answer to another request: {len(values)} values instead of {size}")
        return values[:count]

    def drain(self) -> None:
        """Close the connection so that a late answer is not taken for the answer to the next request.

        Serial frames have no transaction number: the line must first have been silent for one timeout.
        """
        if not self._options.is_tcp:
            now = time.monotonic()
            silent_at, latest = now + self._options.timeout, now + MAX_DRAIN * self._options.timeout
            while not self._aborted.is_set() and (now := time.monotonic()) < min(silent_at, latest):
                if self._discard():
                    silent_at = now + self._options.timeout
                self._aborted.wait(min(DRAIN_STEP, max(0.0, silent_at - now)))
        self.close()

    def _discard(self) -> bool:
        """Discard the bytes received so far; return whether there were any."""
        handle = self._client.socket
        try:
            if isinstance(handle, socket.socket):
                return bool(handle.recv(4096, socket.MSG_DONTWAIT))
            return handle is not None and bool(handle.read(handle.in_waiting))
        except OSError:
            return False

    def _open(self) -> socket.socket | serial.Serial:
        options = self._options
        if options.host is not None:
            return self._open_socket(options.host, options.port)
        return serial.Serial(
            options.serial,
            baudrate=options.baudrate,
            parity="N" if _is_pseudo_terminal(options.serial) else options.parity,
            stopbits=options.stop_bits,
            timeout=options.timeout,
            write_timeout=options.timeout,
            exclusive=True,
        )

    def _open_socket(self, host: str, port: int) -> socket.socket:
        """Connect like ``socket.create_connection``, but so that :meth:`abort` ends it."""
        cause = OSError(0, "the name has no address")
        for family, kind, protocol, _, address in socket.getaddrinfo(host, port, type=socket.SOCK_STREAM):
            connection = self._client.socket = socket.socket(family, kind, protocol)
            connection.settimeout(self._options.timeout)
            try:
                if self._aborted.is_set():
                    raise ConnectionAbortedError(errno.ECONNABORTED, "closed")
                connection.connect(address)
                connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            except OSError as error:
                cause = error
                self.close()
            else:
                return connection
        raise cause


class _SerialClient(ModbusSerialClient):
    """Waits by the monotonic clock and ends on abort; the library waits by the wall clock, which may be set back."""

    aborted: threading.Event

    def _wait_for_data(self) -> int:
        end = time.monotonic() + self.comm_params.timeout_connect
        size = 0
        while not self.aborted.is_set() and time.monotonic() <= end:
            available = int(self._in_waiting())  # type: ignore[no-untyped-call]  # of a library typed but for this
            if size and available in (0, size):
                break
            size = available
            time.sleep(self._recv_interval)
        return size


def _is_pseudo_terminal(port: str | None) -> bool:
    """Whether it is a pseudo-terminal, which has no parity and rejects one when it is opened again."""
    return str(Path(port or "").resolve()).startswith("/dev/pts/")


def _client(
    options: LineOptions, aborted: threading.Event, trace: Callable[[bool, bytes], bytes]
) -> ModbusTcpClient | ModbusSerialClient:
    keys: dict[str, Any] = {"timeout": options.timeout, "retries": 0, "trace_packet": trace}
    if options.host is not None:
        framer = FramerType.SOCKET if options.framing == "tcp" else FramerType.RTU
        return ModbusTcpClient(options.host, port=options.port, framer=framer, **keys)
    keys |= {"baudrate": options.baudrate, "parity": options.parity, "stopbits": options.stop_bits}
    client = _SerialClient(options.serial or "", **keys)
    client.aborted = aborted
    return client


def _cause(error: Exception) -> str:
    if isinstance(error, termios.error):  # not an OSError
        rejected = error.args[0] == errno.EINVAL
        return f"the port refuses these settings: {error.args[-1]}" if rejected else str(error.args[-1])
    return cause_of(error)
