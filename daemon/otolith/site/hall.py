"""The hall as HTML: cards that are rendered once for all who look, and which of them a filter lets through."""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from otolith.health.limits import Level
from otolith.health.schema import LANGUAGES, Language
from otolith.health.text import texts_in
from otolith.site.cards import SYMBOLS, card_of
from otolith.site.known import MAX_MACHINES, Knowledge, KnownMachine
from otolith.site.words import words_in

SHOWN = (Level.ACT, Level.WATCH, Level.NO_DATA, Level.OK)  # States of machines, the most severe first
MAX_RENDERED = 2 * len(LANGUAGES) * MAX_MACHINES  # cards that are kept
PAGES = Environment(
    loader=PackageLoader("otolith.site", "pages"),
    autoescape=True,
    undefined=StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
)


@dataclass(frozen=True, slots=True)
class Filter:
    """Which machines a person wants to see; empty texts let all through."""

    area: str = ""
    state: str = ""
    name: str = ""

    def lets(self, machine: KnownMachine, state: Level) -> bool:
        """Whether a machine is shown."""
        return (
            self.area in ("", machine.site)
            and self.state in ("", state.name)
            and self.name.casefold() in machine.name.casefold()
        )


@dataclass(frozen=True, slots=True)
class _Rendered:
    basis: tuple[object, ...]  # What it depends on
    html: str


class Hall:
    """Renders cards; the caller holds the lock of the knowledge."""

    def __init__(self, knowledge: Knowledge, zone: str | None) -> None:
        self._knowledge, self._zone = knowledge, zone
        self._rendered: dict[tuple[Language, str, str], _Rendered] = {}
        self._card = PAGES.get_template("card.html")

    def counts(self, now: float) -> dict[Level, int]:
        """Return how many machines are in each state."""
        counts = Counter(machine.state(now) for machine in self._knowledge)
        return {level: counts[level] for level in SHOWN}

    def cards(self, now: float, language: Language, chosen: Filter) -> dict[str, str]:
        """Return the cards that a filter lets through by their ids, the worst first."""
        shown = {}
        for machine in self._knowledge.worst_first(now):
            if chosen.lets(machine, state := machine.state(now)):
                shown[f"m-{machine.site}.{machine.name}"] = self._html(machine, state, now, language)
        return shown

    def page(self, now: float, language: Language, chosen: Filter, query: str, rest: Mapping[str, Any]) -> str:
        """Return the page of the hall."""
        say = texts_in(language).translated
        counts = [(level, SYMBOLS[level], say(level), count) for level, count in self.counts(now).items()]
        cards = self.cards(now, language, chosen)
        return PAGES.get_template("hall.html").render(
            counts=counts, total=len(self._knowledge), areas=sorted({machine.site for machine in self._knowledge}),
            chosen=chosen, cards=Markup("").join(map(Markup, cards.values())), query=query, here="hall", **rest,
        )  # fmt: skip  # the cards are escaped already

    def _html(self, machine: KnownMachine, state: Level, now: float, language: Language) -> str:
        silence = int((now - machine.heard) // 60.0) if state is Level.NO_DATA else 0
        key = (language, machine.site, machine.name)
        basis = (machine.revision, state, silence, machine.has_rival(now))
        known = self._rendered.get(key)
        if known is None or known.basis != basis:
            if len(self._rendered) >= MAX_RENDERED:  # machines are forgotten, too
                self._rendered.clear()
            card = card_of(machine, now, language, self._zone)
            health = machine.report.health if machine.report else None
            since = health.since if health else 0.0
            order = f"{9 - state.rank} {since:015.1f} {machine.site} {machine.name}"
            html = self._card.render(card=card, order=order, language=language, words=words_in(language))
            known = self._rendered[key] = _Rendered(basis, html)
        return known.html
