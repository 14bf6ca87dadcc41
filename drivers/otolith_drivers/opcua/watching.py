"""How the variables of a server change: what a subscription to them delivers for a while."""

import asyncio
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from asyncua import Client, ua
from asyncua.common.subscription import DataChangeNotif

from otolith_drivers.common.message_times import unix_time
from otolith_drivers.opcua.connection import Variable, namespaces, place

# Values, units, origins and guarding tests: docs/reference/thresholds-opcua.md.
SAMPLING = 0.005  # s; asked of the server, which may grant a longer one
PUBLISHING = 0.1  # s between two messages
MAX_CHANGES = 5000  # of each variable
MIN_CHANGES = 8  # from which the time between two of them is known
PAUSE = 0.05  # s between two looks at the clock


@dataclass(slots=True)
class VariableChanges:
    """The numbers that a variable has had, with their times."""

    times: list[float] = field(default_factory=list)  # Unix s; of the source, else of the server
    values: list[float] = field(default_factory=list)

    @property
    def interval(self) -> float | None:
        """Median time from one to the next, s; None if there are too few."""
        steps = np.diff(self.times)
        steps = steps[steps > 0.0]
        return float(np.median(steps)) if len(steps) >= MIN_CHANGES else None


@dataclass(slots=True)
class _Receiver:
    """Takes the notifications of a subscription."""

    changes: dict[ua.NodeId, VariableChanges]

    def datachange_notification(self, node: Any, value: Any, data: DataChangeNotif) -> None:
        """Keep a number; the library calls this for each change."""
        own, stamped = self.changes[node.nodeid], data.monitored_item.Value
        stamp = stamped.SourceTimestamp or stamped.ServerTimestamp
        if is_number(value) and len(own.values) < MAX_CHANGES:
            own.times.append(time.time() if stamp is None else unix_time(stamp))
            own.values.append(float(value))


def is_number(value: object) -> bool:
    """Whether a value can be that of a signal."""
    return isinstance(value, int | float) and not isinstance(value, bool)


async def watch(
    client: Client, variables: Sequence[Variable], seconds: float, stopped: Callable[[], bool]
) -> list[VariableChanges]:
    """Return how each of ``variables`` changes within ``seconds``; its first number is the present one."""
    spaces = await namespaces(client)
    nodes = [place(variable.node, spaces, "").node for variable in variables]
    changes = {node: VariableChanges() for node in nodes}
    subscription = await client.create_subscription(1e3 * PUBLISHING, _Receiver(changes))
    queue = int(4.0 * PUBLISHING / SAMPLING)
    await subscription.subscribe_data_change(
        [client.get_node(node) for node in nodes], queuesize=queue, sampling_interval=1e3 * SAMPLING
    )
    end = time.monotonic() + seconds
    while time.monotonic() < end and not stopped():
        await asyncio.sleep(PAUSE)
    await subscription.delete()
    return [changes[node] for node in nodes]
