"""A Modbus line that can be read and nothing else: pymodbus behind a door without a handle on the other side.

Only function codes 3 (read holding registers) and 4 (read input registers) leave this file.
"""

import contextlib
import errno
import logging
import os
import socket
import termios
import threading
import time
from pathlib import Path
from typing import Final

import serial
from pymodbus import ModbusException
from pymodbus.client import ModbusSerialClient, ModbusTcpClient
from pymodbus.exceptions import ConnectionException
from pymodbus.framer import FramerType

from otolith_drivers.modbus.options import LineOptions, Table
from otolith_drivers.modbus.protocol import Broken, Refused, Silent

FUNCTION_CODES: Final[dict[Table, int]] = {"holding": 3, "input": 4}
HUSH_STEP, MOST_HUSH = 0.02, 5  # s; timeouts
SILENT_LOG = logging.getLogger("pymodbus")


class Line:
    """One host or serial port. For one thread, but for :meth:`abort`."""

    def __init__(self, options: LineOptions) -> None:
        SILENT_LOG.setLevel(logging.CRITICAL)  # it would write the last packets to the log with every error
        self._options = options
        self._aborted = threading.Event()
        self._client = _client(options, self._aborted)

    def connect(self) -> None:
        """Open the line.

        Raises:
            Broken: it cannot be opened.
        """
        try:  # by ourselves, as the library only logs why it cannot
            self._client.socket = self._opened()
        except (OSError, ValueError, termios.error) as error:
            raise Broken(_cause(error)) from error

    def close(self) -> None:
        """Close it; may be called twice. What was on its way is lost, which is how a line is drained."""
        with contextlib.suppress(OSError):
            self._client.close()  # type: ignore[no-untyped-call]  # of a library that is typed but for this

    def abort(self) -> None:
        """From another thread: make a reading in progress end."""
        self._aborted.set()
        handle = self._client.socket
        if isinstance(handle, socket.socket):
            with contextlib.suppress(OSError):
                handle.shutdown(socket.SHUT_RDWR)

    def read(self, device: int, table: Table, address: int, count: int) -> list[int]:
        """The registers from ``address`` on, each 0 to 65535.

        Raises:
            Refused: the device answers with an exception.
            Silent: no answer in time, or one to another question; the line is to be opened anew before the next one.
            Broken: the line is gone.
        """
        read = self._client.read_holding_registers if table == "holding" else self._client.read_input_registers
        try:
            reply = read(address, count=count, device_id=device)
        except ConnectionException as error:
            raise Broken("the connection was closed") from error
        except ModbusException as error:
            raise Silent(f"no answer within {self._options.timeout:g} s") from error
        except OSError as error:
            raise Broken(error.strerror or str(error)) from error
        except Exception as error:  # what hostile bytes do to the library's decoder
            raise Silent(f"an answer that cannot be understood ({type(error).__name__})") from error
        if reply.isError():
            raise Refused(int(reply.exception_code))
        if reply.function_code != FUNCTION_CODES[table] or len(reply.registers) != count:
            raise Silent(f"an answer to another question: {len(reply.registers)} registers instead of {count}")
        return list(reply.registers)

    def drain(self) -> None:
        """Close it, so that an answer that comes late is not taken for that to the next question.

        Frames of a serial line have no number by which it could be told: there nothing must first have come for as
        long as a device may take. A line that never is silent is not waited for.
        """
        if self._options.host is None or self._options.framing == "rtu":
            now = time.monotonic()
            silent, longest = now + self._options.timeout, now + MOST_HUSH * self._options.timeout
            while not self._aborted.is_set() and (now := time.monotonic()) < min(silent, longest):
                if self._discard():
                    silent = now + self._options.timeout
                self._aborted.wait(min(HUSH_STEP, max(0.0, silent - now)))
        self.close()

    def _discard(self) -> bool:
        """Throw away what has come and nobody waits for; whether there was any."""
        handle = self._client.socket
        try:
            if isinstance(handle, socket.socket):
                return bool(handle.recv(4096, socket.MSG_DONTWAIT))
            return handle is not None and bool(handle.read(handle.in_waiting))
        except OSError:
            return False

    def _opened(self) -> socket.socket | serial.Serial:
        options = self._options
        if options.host is not None:
            return self._connected(options.host, options.port)
        return serial.Serial(
            options.serial,
            baudrate=options.baudrate,
            parity="N" if _is_pseudo(options.serial) else options.parity,
            stopbits=options.stop_bits,
            timeout=options.timeout,
            write_timeout=options.timeout,
            exclusive=True,
        )

    def _connected(self, host: str, port: int) -> socket.socket:
        """As ``socket.create_connection`` does, but :meth:`abort` ends it."""
        cause = OSError(0, "the name stands for no address")
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
    """Waits by the monotonic clock, as the library's own may be set back by an hour while it waits; ends when told."""

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


class _WithoutEcho:
    """What some adapters hear of themselves is taken out of what comes in.

    A question for one register of those from 768 to 1023 on reads, with its checksum, like an answer.
    """

    def __init__(self) -> None:
        self._sent = b""

    def __call__(self, sending: bool, data: bytes) -> bytes:
        if sending:
            self._sent = data
            return data
        return data.removeprefix(self._sent)


def _is_pseudo(port: str | None) -> bool:
    """Whether it is a pseudo-terminal, which has no parity and, when it is opened again, refuses to be given any."""
    return str(Path(port or "").resolve()).startswith("/dev/pts/")


def _client(options: LineOptions, aborted: threading.Event) -> ModbusTcpClient | ModbusSerialClient:
    if options.host is not None:
        framer = FramerType.SOCKET if options.framing == "tcp" else FramerType.RTU
        return ModbusTcpClient(
            options.host,
            port=options.port,
            framer=framer,
            timeout=options.timeout,
            retries=0,
            trace_packet=_WithoutEcho() if options.framing == "rtu" else None,
        )
    client = _SerialClient(
        options.serial or "",
        baudrate=options.baudrate,
        parity=options.parity,
        stopbits=options.stop_bits,
        timeout=options.timeout,
        retries=0,
        trace_packet=_WithoutEcho(),
    )
    client.aborted = aborted
    return client


def _cause(error: Exception) -> str:
    if isinstance(error, OSError) and error.errno and error.errno > 0:
        return os.strerror(error.errno)
    if isinstance(error, termios.error):  # which is no OSError
        refused = error.args[0] == errno.EINVAL
        return f"the port refuses these settings: {error.args[-1]}" if refused else str(error.args[-1])
    return (isinstance(error, OSError) and error.strerror) or str(error)
