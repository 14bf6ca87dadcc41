"""Router, daemon and site go and come in any order, and the site shows the machine again; nobody is told to."""

import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from itertools import permutations
from pathlib import Path

import pytest

from otolith.health.limits import Level
from otolith.machine_file import ZenohTable
from otolith.publishing.publisher import Published, Publisher
from otolith.publishing.zenoh_config import Access
from tests.publishing.test_catch_up import ROUTER
from tests.sites.machines import own_endpoint, report_of
from tests.sites.serving import Served, router, serving
from tests.storage.histories import SITE
from tests.variants import often
from tests.waiting import wait_for

PARTS = ("router", "daemon", "site")
MACHINE = "press-1"


class Plant:
    """What of a plant runs at present."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.endpoint, self.number = folder, own_endpoint(), 0
        self.stacks: dict[str, ExitStack] = {}
        self.publisher: Publisher | None = None
        self.served: Served | None = None

    def start(self, part: str) -> None:
        """Start a part."""
        stack = self.stacks[part] = ExitStack()
        if part == "router":
            stack.enter_context(router(ROUTER, self.endpoint))
        elif part == "daemon":
            access = Access(ZenohTable(listen=(), connect=(self.endpoint,)))
            self.publisher = Publisher([Published(SITE, MACHINE, None)], [], access)
            stack.callback(self.publisher.close)
        else:
            self.served = stack.enter_context(serving(self.folder, self.endpoint))

    def stop(self, part: str) -> None:
        """End a part."""
        self.stacks.pop(part).close()

    def shows(self, state: Level) -> bool:
        """Let the daemon report, and return whether the site shows its state."""
        assert self.publisher is not None
        assert self.served is not None
        self.number += 1
        self.publisher.publish(report_of(MACHINE, self.number, time.time(), state=state))
        return f'id="count-{state.name}">1<' in self.served.ask("/").text


@pytest.fixture
def plant(tmp_path: Path) -> Iterator[Plant]:
    made = Plant(tmp_path)
    yield made
    for part in tuple(made.stacks):
        made.stop(part)


def shown(plant: Plant, state: Level) -> Callable[[], bool]:
    return lambda: plant.shows(state)


@pytest.mark.parametrize("order", often([("site", "daemon", "router")], permutations(PARTS)), ids="-".join)
def test_parts_that_start_in_any_order_find_each_other(plant: Plant, order: tuple[str, ...]) -> None:
    for part in order:
        plant.start(part)
    wait_for(shown(plant, Level.ACT))


@pytest.mark.parametrize("part", often(["router"], PARTS))
def test_a_part_that_goes_and_comes_is_found_again(plant: Plant, part: str) -> None:
    for each in PARTS:
        plant.start(each)
    wait_for(shown(plant, Level.WATCH))
    plant.stop(part)
    plant.start(part)
    wait_for(shown(plant, Level.ACT))
