"""Opening a CAN bus: that of the kernel, of an adapter, or a virtual one between processes of this computer.

The driver and the simulated plant share it, so that the same options mean the same bus. It also asks the kernel for
what python-can does not: a larger receive buffer, the number of dropped frames, and whether the bus is up.
"""

import logging
import os
import re
import socket
import stat
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Self, TypeVar

import can
from pydantic import BeforeValidator, Field, field_validator, model_validator

from otolith_drivers.common.sharing import Place
from otolith_drivers.config_files import StrictModel
from otolith_drivers.errors import DeviceError, counted, nearest
from otolith_drivers.units import Quantity

RECEIVE_BUFFER = 8 << 20  # bytes; a second or two of a bus at its limit
DROPS_SHOWN = 60.0  # s after the last dropped frame
MAX_CONSECUTIVE_BAD = 50  # frames that cannot be unpacked; after more the bus is opened anew
DEFAULT_CHANNEL, DEFAULT_GROUP = "vcan0", "239.74.163.2"
GROUP = re.compile(r"239\.\d{1,3}\.\d{1,3}\.\d{1,3}")

# Constants of Linux for which the socket module has no names: asm-generic/socket.h, linux/sock_diag.h, linux/in.h.
SO_RCVBUFFORCE, SO_MEMINFO, IP_MULTICAST_ALL = 33, 55, 49
MEMORY_INFO, DROPS_FIELD = struct.Struct("9I"), 8

Result = TypeVar("Result")

logging.getLogger("can.bus").setLevel(logging.ERROR)  # it warns of a bus that could not be opened: an error here

LISTEN_ONLY: dict[str, dict[str, Any]] = {
    "cantact": {"monitor": True},
    "kvaser": {"driver_mode": False},
    "nixnet": {"listen_only": True},
    "pcan": {"state": can.BusState.PASSIVE},
    "seeedstudio": {"operation_mode": "silent"},
    "slcan": {"listen_only": True},
    "systec": {"state": can.BusState.PASSIVE},
    "vector": {"listen_only": True},
}
"""Arguments of python-can for an interface that shall not acknowledge. For socketcan 'ip link' decides."""
FILTERING = {"socketcan"}  # Interfaces that get filters: elsewhere they save nothing, or hide error frames
OPENED_OFTEN = {"socketcan", "udp_multicast", "virtual"}  # Interfaces of which each opening is independent
STAMPED_BY_KERNEL = {"socketcan", "udp_multicast"}  # Interfaces whose frames have the kernel's times
WAYS_OUT = {
    "socketcan": "'ip -brief link show type can' lists what there is; set driver.channel or bring the interface up",
    "udp_multicast": "it needs a multicast route: 'ip route add 239.0.0.0/8 dev lo' as root makes one. A service"
    " that was installed beside a bus of the kernel waits for that one, until 'otolith install' is repeated",
}


class BusOptions(StrictModel):
    """Which CAN bus."""

    interface: str = "auto"  # auto, or one of python-can: socketcan, udp_multicast, pcan, slcan and so on
    channel: str | None = None  # Network interface of the kernel, or channel as python-can names it; by default vcan0
    bitrate: Annotated[float, BeforeValidator(Quantity("bit/s", 1e3, 1e6))] | None = None
    """Only for interfaces that set it themselves; that of the kernel is set with ``ip link``."""
    fd: bool = False  # Whether frames of CAN FD are received as well
    data_bitrate: Annotated[float, BeforeValidator(Quantity("bit/s", 1e3, 2e7))] | None = None
    """Bit rate of the data of FD frames; see ``bitrate``."""
    listen_only: bool = True  # Whether the adapter does not even acknowledge, if it can; false if no other node would
    port: Annotated[int, Field(ge=1024, le=65535)] = 43113  # Of udp_multicast: two buses differ in port or group

    @field_validator("interface")
    @classmethod
    def _is_known(cls, interface: str) -> str:
        known = ["auto", *can.VALID_INTERFACES]
        if interface not in known:
            raise ValueError(f"{interface!r} is no interface of python-can: {nearest(interface, known)}")
        return interface

    @model_validator(mode="after")
    def _channel_fits(self) -> Self:
        if self.interface == "udp_multicast" and self.channel is not None and not GROUP.fullmatch(self.channel):
            raise ValueError(f"channel {self.channel!r}: udp_multicast takes a group like {DEFAULT_GROUP!r}")
        if self.data_bitrate is not None and not self.fd:
            raise ValueError("data_bitrate is that of CAN FD: set fd = true")
        return self

    def resolved(self) -> tuple[str, str]:
        """Interface and channel, with ``auto`` decided for this computer.

        Only a virtual channel that does not exist is replaced by another bus.
        """
        if self.interface == "udp_multicast":
            return self.interface, self.channel or DEFAULT_GROUP
        channel = self.channel or DEFAULT_CHANNEL
        if self.interface != "auto":
            return self.interface, channel
        if channel.startswith("vcan") and not kernel_has(channel):
            return "udp_multicast", DEFAULT_GROUP
        return "socketcan", channel

    @property
    def stamped_by_kernel(self) -> bool:
        """Whether a frame has its time even if it is read late."""
        return self.resolved()[0] in STAMPED_BY_KERNEL

    def place(self) -> Place:
        """What identifies the bus on this computer, however it is spelled; with ``fd`` if both kinds can be open."""
        interface, channel = self.resolved()
        if interface in OPENED_OFTEN:
            return "can", interface, channel, self.port if interface == "udp_multicast" else None, self.fd
        name = channel.partition("@")[0]  # slcan takes the rate of its serial line behind it
        return "can", interface, str(Path(name).resolve()) if name.startswith("/") else name

    def agreed(self) -> dict[str, object]:
        """Options in which all must agree who share the bus, as its adapter can be opened only once."""
        if self.resolved()[0] in OPENED_OFTEN:
            return {}
        rate = self.resolved()[1].partition("@")[2] or "as usual"
        names = ("bitrate", "fd", "data_bitrate", "listen_only")
        return {"serial rate": rate, **{name: getattr(self, name) for name in names}}

    def title(self) -> str:
        """The bus in a few words."""
        interface, channel = self.resolved()
        port = f":{self.port} (this computer only)" if interface == "udp_multicast" else ""
        return f"{interface} {channel}{port}"


def kernel_has(channel: str) -> bool:
    """Whether the kernel supports CAN and has a network interface of this name."""
    if not hasattr(socket, "AF_CAN") or not (Path("/sys/class/net") / Path(channel).name).exists():
        return False
    try:
        socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
    except OSError:
        return False
    return True


def open_bus(
    options: BusOptions, filters: list[can.typechecking.CanFilter] | None = None, *, listen_only: bool = False
) -> can.BusABC:
    """The bus, open; with ``listen_only`` it does not acknowledge if it can; raise DeviceError if it is missing."""
    interface, channel = options.resolved()
    arguments: dict[str, Any] = {"interface": interface, "channel": channel}
    if interface == "udp_multicast":
        # A hop limit of 0 keeps every frame on this computer; the library's own default reaches the network.
        arguments |= {"port": options.port, "hop_limit": 0, "fd": options.fd}
    else:
        rates = {"bitrate": options.bitrate, "data_bitrate": options.data_bitrate}
        arguments |= {key: int(rate) for key, rate in rates.items() if rate is not None}
        arguments |= {"fd": True} if options.fd else {}
        arguments |= LISTEN_ONLY.get(interface, {}) if listen_only and options.listen_only else {}
    try:
        bus = can.Bus(**arguments, can_filters=filters if interface in FILTERING else None)
        if interface == "udp_multicast":
            _receive_only_this_group(bus)
    except (can.CanError, OSError, ImportError, ValueError, TypeError, AttributeError, NotImplementedError) as error:
        inner = error.__cause__ or error
        cause = (getattr(inner, "strerror", None) or str(inner) or type(inner).__name__).strip()
        way_out = WAYS_OUT.get(interface, "set driver.interface and driver.channel as python-can's documentation says")
        raise DeviceError(f"CAN bus {options.title()} cannot be opened: {cause}; {way_out}") from error
    return bus


def set_filters(bus: can.BusABC, options: BusOptions, filters: list[can.typechecking.CanFilter]) -> None:
    """Let the kernel pass on other frames than before, if it filters."""
    if options.resolved()[0] in FILTERING:
        bus.set_filters(filters)


def _receive_only_this_group(bus: can.BusABC) -> None:
    """Without this, Linux delivers the frames of every group that any program here has joined on the same port."""
    with socket.socket(fileno=os.dup(bus.fileno())) as handle:
        handle.setsockopt(socket.IPPROTO_IP, IP_MULTICAST_ALL, 0)


def is_gone(error: Exception) -> bool:
    """Whether ``error``, raised on receiving, means that the bus has failed, and not only that a frame is bad."""
    return isinstance(error, OSError) or isinstance(error.__cause__, OSError)


def _ask_kernel(bus: can.BusABC, ask: Callable[[socket.socket], Result | None]) -> Result | None:
    """What ``ask`` returns for the socket below ``bus``; None if there is no socket, or if the kernel refuses.

    Interfaces other than the kernel's use a serial line or a library of the vendor.
    """
    try:
        descriptor = bus.fileno()
        if not isinstance(descriptor, int) or descriptor < 0 or not stat.S_ISSOCK(os.fstat(descriptor).st_mode):
            return None
        with socket.socket(fileno=os.dup(descriptor)) as handle:
            return ask(handle)
    except (NotImplementedError, OSError):
        return None


def enlarge_buffer(bus: can.BusABC) -> None:
    """Let the kernel keep the frames that come while this computer is busy; above its limit if that is permitted."""

    def enlarge(handle: socket.socket) -> None:
        try:
            handle.setsockopt(socket.SOL_SOCKET, SO_RCVBUFFORCE, RECEIVE_BUFFER)
        except PermissionError:
            handle.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER)

    _ask_kernel(bus, enlarge)


def frames_dropped(bus: can.BusABC) -> int | None:
    """Frames that the kernel had no room for since the bus was opened; None if that is not known."""

    def drops(handle: socket.socket) -> int | None:
        if handle.type == socket.SOCK_STREAM:  # what is dropped there is sent again
            return None
        memory = handle.getsockopt(socket.SOL_SOCKET, SO_MEMINFO, MEMORY_INFO.size)
        return MEMORY_INFO.unpack_from(memory)[DROPS_FIELD] if len(memory) >= MEMORY_INFO.size else None

    return _ask_kernel(bus, drops)


def bus_error(bus: can.BusABC) -> str | None:
    """Why a bus that was just opened cannot be read; None if it can.

    The kernel opens an interface that is down, and refuses to read from it. Asking clears the error.
    """
    code = _ask_kernel(bus, lambda handle: handle.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR))
    return os.strerror(code) if code else None


class DropCounter:
    """Counts the frames that this computer did not read in time, over every bus that was opened."""

    def __init__(self) -> None:
        self.total = 0
        self._of_this_bus = 0
        self._time = 0.0

    def restart(self) -> None:
        """The bus was opened anew: its socket counts from zero."""
        self._of_this_bus = 0

    def note(self, count: int | None, now: float) -> None:
        """Take the number of :func:`frames_dropped` at ``now`` (s)."""
        if count is not None and count > self._of_this_bus:
            self.total += count - self._of_this_bus
            self._of_this_bus, self._time = count, now

    def warnings(self, now: float) -> list[str]:
        """One line as long as a drop is recent at ``now`` (s)."""
        if not self.total or now - self._time > DROPS_SHOWN:
            return []
        frames = counted(self.total, "frame")
        return [f"this computer was too busy to read {frames}, the last {now - self._time:.1f} s ago"]
