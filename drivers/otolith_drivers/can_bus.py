"""Opening a CAN bus: the kernel's where there is one, else a virtual one between processes of this computer.

Shared by the receiver and by the simulated plant, so that both mean the same bus by the same words.
"""

import socket
from pathlib import Path
from typing import Annotated, Any

import can
from pydantic import BeforeValidator, Field

from otolith_drivers.errors import DeviceError
from otolith_drivers.quantities import Quantity
from otolith_drivers.toml_files import Closed


class BusOptions(Closed):
    """Which CAN bus."""

    interface: str = "auto"
    """``auto``, or one of python-can: ``socketcan``, ``udp_multicast``, ``pcan``, ``kvaser``, ``slcan`` ..."""
    channel: str = "vcan0"
    """The kernel's network interface, or the channel as the interface of python-can names it."""
    bitrate: Annotated[float, BeforeValidator(Quantity("bit/s", 1e3, 1e6))] | None = None
    """Only for interfaces that set it themselves; the kernel's is set with ``ip link``."""
    multicast_group: Annotated[str, Field(pattern=r"^239\.\d{1,3}\.\d{1,3}\.\d{1,3}$")] = "239.74.163.2"
    multicast_port: Annotated[int, Field(ge=1024, le=65535)] = 43113

    def resolved(self) -> str:
        """The interface, with ``auto`` decided for this computer."""
        if self.interface != "auto":
            return self.interface
        return "socketcan" if kernel_has(self.channel) else "udp_multicast"

    def title(self) -> str:
        """The bus in a few words."""
        if self.resolved() == "udp_multicast":
            return f"udp_multicast {self.multicast_group}:{self.multicast_port} (this computer only)"
        return f"{self.resolved()} {self.channel}"


def kernel_has(channel: str) -> bool:
    """Whether the kernel speaks CAN and has a network interface of this name."""
    if not hasattr(socket, "AF_CAN") or not (Path("/sys/class/net") / Path(channel).name).exists():
        return False
    try:
        socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
    except OSError:
        return False
    return True


def open_bus(options: BusOptions, filters: list[can.typechecking.CanFilter] | None = None) -> can.BusABC:
    """The bus, open.

    Raises:
        DeviceError: it is not there, or refuses.
    """
    interface = options.resolved()
    arguments: dict[str, Any] = {"interface": interface, "channel": options.channel}
    if interface == "udp_multicast":
        # A hop limit of 0 keeps every frame on this computer; the library's own default reaches the network.
        arguments |= {"channel": options.multicast_group, "port": options.multicast_port, "hop_limit": 0, "fd": False}
    elif options.bitrate is not None:
        arguments["bitrate"] = int(options.bitrate)
    try:
        return can.Bus(**arguments, can_filters=filters)
    except (can.CanError, OSError, ImportError, ValueError, TypeError, AttributeError, NotImplementedError) as error:
        raise DeviceError(
            f"CAN bus {options.title()} cannot be opened: {_cause(error)}; {_way_out(interface)}"
        ) from error


def _cause(error: BaseException) -> str:
    inner = error.__cause__ or error
    return (getattr(inner, "strerror", None) or str(inner) or type(inner).__name__).strip()


WAYS_OUT = {
    "socketcan": "'ip -brief link show type can' lists what there is; set driver.channel or bring the interface up",
    "udp_multicast": "it needs a multicast route: 'ip route add 239.0.0.0/8 dev lo' as root makes one",
}


def _way_out(interface: str) -> str:
    return WAYS_OUT.get(interface, f"interfaces known here: {', '.join(sorted(can.VALID_INTERFACES))}")
