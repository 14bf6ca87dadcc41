"""Pictures of a site with 40 machines: reports of the simulated situations, under names of a plant."""

from collections.abc import Iterator
from importlib.resources import files
from pathlib import Path

from benchmarks.browser import Browser
from benchmarks.pictures import reduced, simulated
from otolith.health.times import moment_text
from otolith.publishing.zenoh_session import REPORT
from otolith.site.hall import Filter, Hall
from otolith.site.known import Knowledge
from otolith.site.words import words_in

ZONE = "Europe/Berlin"
SITUATIONS = {"healthy": 12, "degrading": 55, "unbalance": 40, "sensor-fault": 48}
"""Windows of each: shortly after what is announced last."""
FAULTY = {3: "unbalance", 11: "degrading", 24: "sensor-fault"}  # By number; the others are well
SILENT = 17
COUNT = 40
SIZES = {"1280": (1280, 720), "390": (390, 844)}  # pixels: a PC, a phone


def knowledge() -> tuple[Knowledge, float]:
    """Return what a site knows of 40 machines, and the time."""
    reports = {name: [row.document for row in simulated(name, count)] for name, count in SITUATIONS.items()}
    known, now = Knowledge(), max(rows[-1].window.end for rows in reports.values())
    for number in range(1, COUNT + 1):
        rows = reports[FAULTY.get(number, "healthy")]
        for report in rows[:1] if number == SILENT else rows:
            own = report.model_copy(update={"machine": f"press-{number}", "site": f"hall-{1 + number // 21}"})
            heard = report.window.end if number == SILENT else now
            known.take(REPORT.under(own.site, own.machine), own.to_json().encode(), heard)
    return known, now


def page() -> str:
    """Return the page of the hall, with its style in it, for a browser without a server."""
    known, now = knowledge()
    frame = {"title": "Works 2", "words": words_in("en"), "time": moment_text(now, ZONE), "dropped": 0}
    html = b"".join(Hall(known, ZONE).shown(now, "en").page(Filter(), "", frame)).decode()
    style = files("otolith.site").joinpath("pages", "site.css").read_text(encoding="utf-8")
    html = html.replace('<link rel="stylesheet" href="/site.css">', f"<style>{style}</style>")
    return html.replace('<script src="/site.js" defer></script>', "")


def pictures(tab: Browser, folder: Path) -> Iterator[tuple[str, bytes]]:
    """Yield name and content of the pictures; ``folder`` takes the page."""
    file = folder / "hall.html"
    file.write_text(page(), encoding="utf-8")
    for width, size in SIZES.items():
        tab.open(file, *size, is_phone=width == "390")
        yield f"site-{width}", reduced(tab.picture(), size)
