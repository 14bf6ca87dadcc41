"""Pictures of a site with 40 machines: reports of the simulated situations, under names of a plant."""

from collections.abc import Iterator
from importlib.resources import files
from itertools import product
from pathlib import Path

from benchmarks.browser import Browser
from benchmarks.pictures import reduced, simulated
from otolith.health.times import moment_text
from otolith.publishing.zenoh_session import REPORT
from otolith.site.app import FIRST_PEERS
from otolith.site.compare import peers, poor_data, week
from otolith.site.daemons import certificates, versions
from otolith.site.hall import PAGES, Filter, Hall
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


def pages() -> dict[str, str]:
    """Return the hall and the comparison, with their style in them, for a browser without a server."""
    known, now = knowledge()
    frame = {"title": "Works 2", "words": words_in("en"), "time": moment_text(now, ZONE), "dropped": 0}
    hall = b"".join(Hall(known, ZONE).shown(now, "en").page(Filter(), "", frame)).decode()
    rows = {"peers": peers(known, now, "en"), "poor": poor_data(known, now, "en", ZONE),
            "versions": versions(known, "en"), "certificates": certificates(known, now, "en", ZONE, None)}  # fmt: skip
    comparison = PAGES.get_template("compare.html").render(
        rows, events=week(known, now, "en", ZONE), first=FIRST_PEERS, here="compare", language="en", refused={}, **frame
    )
    style = files("otolith.site").joinpath("pages", "site.css").read_text(encoding="utf-8")
    parts = {'<link rel="stylesheet" href="/site.css">': f"<style>{style}</style>",
             '<script src="/site.js" defer></script>': ""}  # fmt: skip
    found = {"site": hall, "site-compare": comparison}
    for key, part in product(found, parts):
        found[key] = found[key].replace(part, parts[part])
    return found


def pictures(tab: Browser, folder: Path) -> Iterator[tuple[str, bytes]]:
    """Yield name and content of the pictures; ``folder`` takes the pages."""
    for name, html in pages().items():
        file = folder / f"{name}.html"
        file.write_text(html, encoding="utf-8")
        for width, size in SIZES.items():
            tab.open(file, *size, is_phone=width == "390")
            yield f"{name}-{width}", reduced(tab.picture(), size)
