"""A site with many machines, at rest and attacked: pages, scrapes, memory, and what the daemon notices of it.

    python -m benchmarks.site --machines 200 --seconds 15

One process publishes recorded reports of a motor under many names in windows of 2 s, as a hall does, and keeps the
history of the first ten. Another is ``otolith site``, a third one attacks it, and this one scrapes it. Of the daemon it
measures by how much later than due a report is published, and in a browser how long after its report a fault shows. All
figures are of one run.
"""

import asyncio
import http.client
import json
import multiprocessing
import subprocess
import sys
import tempfile
import time
from collections.abc import Awaitable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from multiprocessing.connection import Connection
from pathlib import Path

import click
import numpy as np
import psutil
from rich.table import Table

from benchmarks.browser import Browser, browser, program
from benchmarks.command_line import print_pages
from benchmarks.hall import pss
from benchmarks.pictures import simulated
from otolith.health.limits import Level
from otolith.publishing.publisher import Published, Publisher
from otolith.storage.history import SUFFIX
from otolith.storage.history_writer import Bounds, HistoryWriter

WINDOW = 2.0  # s
KEPT = 10  # machines with a history
CHANGED = 0  # the machine that becomes faulty, and healthy again
CHANGES = 6  # of it that are awaited in a browser
MAX_SHOWN = 20.0  # s until a browser must show one
SETTLING = 8.0  # s until all machines are shown
PAUSE = 0.2  # s between two scrapes at an address
PATHS = {
    "pages": ["/", "/compare", "/?name=press", "/?language=de"],
    "metrics": ["/metrics"],
    "past": [
        f"/machine/hall/press-{number}?time={span}" for number in range(KEPT) for span in ("1h", "8h", "24h", "7d")
    ],
}
CLIENTS = {"pages": 100, "metrics": 50, "past": 50}


def publish(folder: Path, endpoint: str, machines: int, end: Connection) -> None:
    """Publish until the other end wants neither the figures since the last time nor a changed state of a machine."""
    documents = [row.document for row in simulated("healthy", 12)]
    writers = [
        HistoryWriter(folder / f"hall.press-{number}{SUFFIX}", Bounds(50_000_000, 3650, 24)) for number in range(KEPT)
    ]
    numbers = [writer.open(time.time())[0] for writer in writers]
    for writer in writers:
        writer.start()
    published = [
        Published("hall", f"press-{number}", writers[number] if number < KEPT else None) for number in range(machines)
    ]
    publisher, late, count, state = Publisher(published, [endpoint]), list[float](), 0, Level.OK

    def say(number: int) -> None:
        now, report = time.time(), documents[count // machines % len(documents)]
        window = report.window.model_copy(update={"start": now - WINDOW, "end": now})
        own = {"site": "hall", "machine": f"press-{number}", "window": window, "sequence": count + 1, "previous": None}
        if number == CHANGED and report.health is not None:
            own["health"] = report.health.model_copy(update={"state": state})
        report = report.model_copy(update=own)
        if number < KEPT:
            report = numbers[number].number(report)
            writers[number].add(report)
        publisher.publish(report)

    begun = time.monotonic()
    while True:
        due = begun + count * WINDOW / machines
        time.sleep(max(0.0, due - time.monotonic()))
        say(count % machines)
        late.append(time.monotonic() - due)
        count += 1
        if not end.poll():
            continue
        wish = end.recv()
        if wish == "figures":
            end.send(late)
            late = []
        elif wish == "change":
            state = Level.ACT if state is Level.OK else Level.OK
            say(CHANGED)
            end.send((state.name, time.monotonic()))
        else:
            break
    publisher.close()
    for writer in writers:
        writer.stop(5.0)


async def _ask(port: int, paths: Sequence[str]) -> None:
    """Ask again as soon as an answer is there, in one connection."""
    for index in range(1 << 30):
        try:
            reader, writer = await asyncio.open_connection("127.0.0.1", port)
            writer.write(
                f"GET {paths[index % len(paths)]} HTTP/1.1\r\nhost: localhost\r\nconnection: close\r\n\r\n".encode()
            )
            while await reader.read(1 << 18):
                pass
            writer.close()
        except OSError:
            await asyncio.sleep(0.1)


async def _take_nothing(port: int, path: str) -> None:
    """Ask and read nothing, until it is cut; then again."""
    while True:
        try:
            _, writer = await asyncio.open_connection("127.0.0.1", port, limit=1)
            writer.write(f"GET {path} HTTP/1.1\r\nhost: localhost\r\n\r\n".encode() * 5)
            await asyncio.sleep(15.0)
            writer.transport.abort()
        except OSError:
            await asyncio.sleep(0.1)


def attack(port: int, name: str) -> None:
    """Attack until this process is ended."""

    async def run() -> None:
        tasks: list[Awaitable[None]] = [_ask(port, PATHS[name]) for _ in range(CLIENTS.get(name, 0))]
        if name == "slow readers":
            tasks = [
                _take_nothing(port, path) for path in ("/live", *("/", "/metrics", "/compare") * 20) for _ in range(5)
            ]
        if name == "1000 connections":
            tasks = [_take_nothing(port, "/") for _ in range(1000)]
        await asyncio.gather(*tasks)

    asyncio.run(run())


def scrape(port: int) -> float:
    """Return how long one scrape takes as Prometheus does it, ms."""
    begun = time.perf_counter()
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=60.0)
    connection.request("GET", "/metrics", headers={"accept-encoding": "gzip"})
    connection.getresponse().read()
    connection.close()
    return 1e3 * (time.perf_counter() - begun)


def measure(port: int, process: psutil.Process, plant: Connection, seconds: float) -> dict[str, float]:
    """Return the figures of so many seconds."""
    plant.send("figures")
    plant.recv()
    spent, begun, scrapes, beside = sum(process.cpu_times()[:2]), time.monotonic(), list[float](), list[float]()
    while time.monotonic() - begun < seconds:
        scrapes.append(scrape(port + 1))
        time.sleep(PAUSE / 2.0)
        beside.append(scrape(port))
        time.sleep(PAUSE / 2.0)
    cores = (sum(process.cpu_times()[:2]) - spent) / (time.monotonic() - begun)
    plant.send("figures")
    late = 1e3 * np.array(plant.recv())
    return {"scrape_median_ms": float(np.median(scrapes)), "scrape_max_ms": max(scrapes),
            "beside_pages_median_ms": float(np.median(beside)), "beside_pages_max_ms": max(beside),
            "site_mb": pss(process), "site_cores": cores, "late_median_ms": float(np.median(late)),
            "late_99_ms": float(np.quantile(late, 0.99)), "late_max_ms": float(late.max())}  # fmt: skip


def shown(tab: Browser, plant: Connection) -> list[float]:
    """Return how long after its report each change of a machine shows in a browser that is open, s."""
    found, card = list[float](), f"document.getElementById('m-hall.press-{CHANGED}').className"
    for index in range(CHANGES):
        time.sleep(0.17 * index)  # at another moment between two looks of the site
        plant.send("change")
        state, begun = plant.recv()
        while state not in str(tab.value(card)).split() and time.monotonic() - begun < MAX_SHOWN:
            time.sleep(0.01)
        found.append(time.monotonic() - begun)
    return found


@contextmanager
def served(folder: Path, endpoint: str, port: int) -> Iterator[psutil.Process]:
    """A site."""
    file = folder / "site.toml"
    file.write_text(
        f'[http]\nlisten = "127.0.0.1:{port}"\n[zenoh]\nconnect = ["{endpoint}"]\n'
        f'[outlets.prometheus]\nlisten = "127.0.0.1:{port + 1}"\n',
        encoding="utf-8",
    )
    with subprocess.Popen([sys.executable, "-m", "otolith", "site", str(file)]) as process:  # noqa: S603 - our own
        try:
            yield psutil.Process(process.pid)
        finally:
            process.terminate()


def hall_page(tab: Browser, port: int) -> dict[str, float]:
    """Return how long the hall takes to load in a browser, and its size; it stays open."""
    tab.open(f"http://127.0.0.1:{port}/", 1280, 720)
    load = tab.value("performance.timing.loadEventStart - performance.timing.navigationStart")
    size = tab.value("performance.getEntriesByType('navigation')[0].transferSize")
    return {"load_s": load / 1e3, "size_kb": size / 1e3}


def run(machines: int, seconds: float, port: int) -> dict[str, dict[str, float]]:
    """Return the figures by attack; the first row is at rest."""
    context, found = multiprocessing.get_context("spawn"), dict[str, dict[str, float]]()
    with tempfile.TemporaryDirectory(prefix="otolith-site-") as name, ExitStack() as stack:
        folder, (own, theirs) = Path(name), context.Pipe()
        endpoint = f"unixsock-stream/{folder}/reports.sock"
        plant = context.Process(target=publish, args=(folder, endpoint, machines, theirs), daemon=True)
        plant.start()
        stack.callback(plant.kill)
        process = stack.enter_context(served(folder, endpoint, port))
        own.send("figures")
        own.recv()
        time.sleep(SETTLING)
        path = program()
        tab = None if path is None else stack.enter_context(browser(path))
        page = {} if tab is None else hall_page(tab, port)

        def figures() -> dict[str, float]:
            times = [] if tab is None else shown(tab, own)
            rest = measure(port, process, own, seconds)
            return rest | ({"shown_median_s": float(np.median(times)), "shown_max_s": max(times)} if times else {})

        found["at rest"] = figures() | page
        for each in ("pages", "metrics", "past", "slow readers", "1000 connections"):
            attacker = context.Process(target=attack, args=(port, each), daemon=True)
            attacker.start()
            time.sleep(3.0)
            found[each] = figures()
            attacker.kill()
            attacker.join()
    return found


@click.command()
@click.option("--machines", default=200, show_default=True, type=click.IntRange(KEPT))
@click.option("--seconds", default=15.0, show_default=True, help="Measured at rest and in each attack.")
@click.option("--port", default=18420, show_default=True)
@click.option("--json", "as_json", is_flag=True, help="Print a JSON document.")
def main(machines: int, seconds: float, port: int, *, as_json: bool) -> None:
    """Measure a site."""
    found = run(machines, seconds, port)
    if as_json:
        print(json.dumps(found, indent=2))
        return
    table = Table(
        "attack", "scrape 50 / 100 %, ms", "at the pages", "MB", "cores", "report late by 50 / 99 / 100 %, ms",
        "fault shows after 50 / 100 %, s",
    )  # fmt: skip
    for name, row in found.items():
        late = f"{row['late_median_ms']:.1f} / {row['late_99_ms']:.1f} / {row['late_max_ms']:.1f}"
        scrapes = f"{row['scrape_median_ms']:.0f} / {row['scrape_max_ms']:.0f}"
        beside = f"{row['beside_pages_median_ms']:.0f} / {row['beside_pages_max_ms']:.0f}"
        seen = f"{row['shown_median_s']:.1f} / {row['shown_max_s']:.1f}" if "shown_max_s" in row else "no browser"
        table.add_row(name, scrapes, beside, f"{row['site_mb']:.0f}", f"{row['site_cores']:.2f}", late, seen)
    rest = found["at rest"]
    print_pages(
        table, f"hall page: {rest.get('load_s', float('nan')):.2f} s, {rest.get('size_kb', float('nan')):.0f} kB"
    )


if __name__ == "__main__":
    main()
