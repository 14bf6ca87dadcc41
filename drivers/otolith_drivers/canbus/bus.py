"""Opening a CAN bus: the kernel's where there is one, else a virtual one between processes of this computer.

Shared by the receiver and by the simulated plant, so that both mean the same bus by the same words.

What python-can does not ask of the kernel: room for frames, how many were thrown away, and whether the bus is up.
"""

import contextlib
import os
import re
import socket
import stat
import struct
from pathlib import Path
from typing import Annotated, Any, Self

import can
from pydantic import BeforeValidator, Field, model_validator

from otolith_drivers.config_files import StrictModel
from otolith_drivers.errors import DeviceError
from otolith_drivers.units import Quantity

SO_RCVBUFFORCE, SO_MEMINFO = 33, 55  # of <asm-generic/socket.h>; the socket module has no names for them
MEMORY_INFO = struct.Struct("9I")  # of <linux/sock_diag.h>
DROPS = 8  # its last
BUFFER = 8 << 20  # bytes; a second or two of a bus at its limit
RECENT = 60.0  # s for which dropped frames are told


def enlarge_buffer(bus: can.BusABC) -> None:
    """Let the kernel keep frames for as long as this computer may be busy; above its limit where that is permitted."""
    descriptor = _descriptor(bus)
    if descriptor is None:
        return
    with contextlib.suppress(OSError), socket.socket(fileno=os.dup(descriptor)) as handle:
        try:
            handle.setsockopt(socket.SOL_SOCKET, SO_RCVBUFFORCE, BUFFER)
        except PermissionError:
            handle.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, BUFFER)


def frames_dropped(bus: can.BusABC) -> int | None:
    """Frames that the kernel had no room for since the bus was opened; None where it does not say."""
    descriptor = _descriptor(bus)
    if descriptor is None:
        return None
    try:
        with socket.socket(fileno=os.dup(descriptor)) as handle:
            if handle.type == socket.SOCK_STREAM:  # what is dropped there is sent again
                return None
            told = handle.getsockopt(socket.SOL_SOCKET, SO_MEMINFO, MEMORY_INFO.size)
    except OSError:
        return None
    if len(told) < MEMORY_INFO.size:
        return None
    drops: int = MEMORY_INFO.unpack_from(told)[DROPS]
    return drops


def refusal(bus: can.BusABC) -> str | None:
    """What the kernel has against a bus that was just opened: it opens one that is down, too, and then refuses to read.

    The error is taken off the bus by asking, so that it is to be shut.
    """
    descriptor = _descriptor(bus)
    if descriptor is None:
        return None
    try:
        with socket.socket(fileno=os.dup(descriptor)) as handle:
            code = handle.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR)
    except OSError:
        return None
    return os.strerror(code) if code else None


def _descriptor(bus: can.BusABC) -> int | None:
    """Of the socket under ``bus``; other interfaces have none, or that of a serial line."""
    try:
        found = bus.fileno()
        is_socket = isinstance(found, int) and found >= 0 and stat.S_ISSOCK(os.fstat(found).st_mode)
    except (NotImplementedError, OSError):
        return None
    return found if is_socket else None


class Drops:
    """Frames that this computer did not read in time, over all the buses that were opened."""

    def __init__(self) -> None:
        self.total = 0
        self._of_this_bus = 0
        self._at = 0.0

    def begin(self) -> None:
        """Another socket counts from zero."""
        self._of_this_bus = 0

    def note(self, count: int | None, now: float) -> None:
        """What the kernel says of this bus."""
        if count is not None and count > self._of_this_bus:
            self.total += count - self._of_this_bus
            self._of_this_bus, self._at = count, now

    def warnings(self, now: float) -> list[str]:
        """A line for a while after it happened."""
        if not self.total or now - self._at > RECENT:
            return []
        return [f"this computer was too busy to read {self.total} frames, the last {now - self._at:.1f} s ago"]


IP_MULTICAST_ALL = 49  # of <linux/in.h>; the socket module has no name for it
DEFAULT_CHANNEL, DEFAULT_GROUP = "vcan0", "239.74.163.2"
MOST_BAD_IN_A_ROW = 50  # frames that cannot be unpacked; more are no accident
GROUP = re.compile(r"239\.\d{1,3}\.\d{1,3}\.\d{1,3}")


class BusOptions(StrictModel):
    """Which CAN bus."""

    interface: str = "auto"
    """``auto``, or one of python-can: ``socketcan``, ``udp_multicast``, ``pcan``, ``kvaser``, ``slcan`` ..."""
    channel: str | None = None
    """The kernel's network interface, or the channel as the interface of python-can names it; ``vcan0`` without it."""
    bitrate: Annotated[float, BeforeValidator(Quantity("bit/s", 1e3, 1e6))] | None = None
    """Only for interfaces that set it themselves; the kernel's is set with ``ip link``."""
    fd: bool = False
    """Whether frames of CAN FD are received as well."""
    data_bitrate: Annotated[float, BeforeValidator(Quantity("bit/s", 1e3, 2e7))] | None = None
    """Of the data of FD frames; like ``bitrate``."""
    listen_only: bool = True
    """Not even to acknowledge, where the interface can; ``false`` where nobody else on the bus acknowledges."""
    port: Annotated[int, Field(ge=1024, le=65535)] = 43113
    """Of ``udp_multicast``: two buses on one computer differ in it, or in their group."""

    @model_validator(mode="after")
    def _channel_fits(self) -> Self:
        if self.interface == "udp_multicast" and self.channel is not None and not GROUP.fullmatch(self.channel):
            raise ValueError(f"channel {self.channel!r}: udp_multicast takes a group like {DEFAULT_GROUP!r}")
        if self.data_bitrate is not None and not self.fd:
            raise ValueError("data_bitrate is that of CAN FD: set fd = true")
        return self

    def resolved(self) -> tuple[str, str]:
        """Interface and channel, with ``auto`` decided for this computer.

        Only a virtual channel has a stand-in: a real one that is missing must not turn into a bus where nobody speaks.
        """
        if self.interface == "udp_multicast":
            return self.interface, self.channel or DEFAULT_GROUP
        channel = self.channel or DEFAULT_CHANNEL
        if self.interface != "auto":
            return self.interface, channel
        if channel.startswith("vcan") and not kernel_has(channel):
            return "udp_multicast", DEFAULT_GROUP
        return "socketcan", channel

    def title(self) -> str:
        """The bus in a few words."""
        interface, channel = self.resolved()
        return (
            f"{interface} {channel}:{self.port} (this computer only)"
            if interface == "udp_multicast"
            else f"{interface} {channel}"
        )


def kernel_has(channel: str) -> bool:
    """Whether the kernel speaks CAN and has a network interface of this name."""
    if not hasattr(socket, "AF_CAN") or not (Path("/sys/class/net") / Path(channel).name).exists():
        return False
    try:
        socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
    except OSError:
        return False
    return True


# How an interface of python-can is told not to acknowledge. The kernel's is set up with 'ip link ... listen-only on'.
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
FILTERING = {"socketcan"}
"""Where the kernel looks at filters. Elsewhere they cost as much as they save, or hide error frames."""


def open_bus(
    options: BusOptions, filters: list[can.typechecking.CanFilter] | None = None, *, listen_only: bool = False
) -> can.BusABC:
    """The bus, open; with ``listen_only`` it does not even acknowledge, where the interface can do that.

    Raises:
        DeviceError: it is not there, or refuses.
    """
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
            _hear_only_this_group(bus)
    except (can.CanError, OSError, ImportError, ValueError, TypeError, AttributeError, NotImplementedError) as error:
        raise DeviceError(
            f"CAN bus {options.title()} cannot be opened: {_cause(error)}; {_way_out(interface)}"
        ) from error
    return bus


def is_gone(error: Exception) -> bool:
    """Whether ``error``, raised on receiving, says that the bus has failed, and not only a frame in the unpacking."""
    return isinstance(error, OSError) or isinstance(error.__cause__, OSError)


def _hear_only_this_group(bus: can.BusABC) -> None:
    """Linux hands a socket the frames of every group that anybody on this computer has joined on its port."""
    with socket.socket(fileno=os.dup(bus.fileno())) as handle:
        handle.setsockopt(socket.IPPROTO_IP, IP_MULTICAST_ALL, 0)


def _cause(error: BaseException) -> str:
    inner = error.__cause__ or error
    return (getattr(inner, "strerror", None) or str(inner) or type(inner).__name__).strip()


WAYS_OUT = {
    "socketcan": "'ip -brief link show type can' lists what there is; set driver.channel or bring the interface up",
    "udp_multicast": "it needs a multicast route: 'ip route add 239.0.0.0/8 dev lo' as root makes one",
}


def _way_out(interface: str) -> str:
    return WAYS_OUT.get(interface, f"interfaces known here: {', '.join(sorted(can.VALID_INTERFACES))}")
