"""The hall as HTML: cards that are rendered once for all who look, and which of them a filter lets through."""

import json
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined

from otolith.health.limits import Level
from otolith.health.schema import LANGUAGES, Language
from otolith.health.text import texts_in
from otolith.site.cards import SYMBOLS, card_of
from otolith.site.known import MAX_MACHINES, Knowledge, KnownMachine, place_of
from otolith.site.words import words_in

SHOWN = (Level.ACT, Level.WATCH, Level.NO_DATA, Level.OK)  # States of machines, the most severe first
PLACE = "<!-- cards -->"  # In hall.html; no text from outside has it, as all are escaped
MAX_RENDERED = 2 * len(LANGUAGES) * MAX_MACHINES  # cards that are kept
PAGES = Environment(
    loader=PackageLoader("otolith.site", "pages"),
    autoescape=True,
    undefined=StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
)


@dataclass(frozen=True, slots=True)
class Rendered:
    """The card of a machine, in bytes that all who look share."""

    area: str
    name: str
    state: Level
    html: bytes
    event: bytes  # The same for who sees it live

    @property
    def id(self) -> str:
        """The id of its element."""
        return f"m-{self.area}.{self.name}"


@dataclass(frozen=True, slots=True)
class Filter:
    """Which machines a person wants to see; empty texts let all through."""

    area: str = ""
    state: str = ""
    name: str = ""

    def lets(self, card: Rendered) -> bool:
        """Whether a machine is shown."""
        return (
            self.area in ("", card.area)
            and self.state in ("", card.state.name)
            and self.name.casefold() in card.name.casefold()
        )


@dataclass(frozen=True, slots=True)
class Shown:
    """The hall at a moment, in one language."""

    language: Language
    cards: tuple[Rendered, ...]  # The worst first
    counts: Mapping[Level, int]  # How many machines are in each state
    refused: Mapping[str, int]  # Documents, by reason

    def page(self, chosen: Filter, query: str, rest: Mapping[str, Any]) -> list[bytes]:
        """Return the page of the hall in pieces."""
        say = texts_in(self.language).translated
        counts = [(level, SYMBOLS[level], say(level), count) for level, count in self.counts.items()]
        cards = [card.html for card in self.cards if chosen.lets(card)]
        page = PAGES.get_template("hall.html").render(
            counts=counts, total=len(self.cards), areas=sorted({card.area for card in self.cards}), chosen=chosen,
            cards=len(cards), query=query, here="hall", language=self.language,
            refused=self.refused, **rest,
        )  # fmt: skip
        before, _, after = page.partition(PLACE)
        return [before.encode(errors="replace"), *cards, after.encode(errors="replace")]

    def numbers(self) -> bytes:
        """Return the numbers at the top, for who sees them live."""
        return _event("counts", {level.name: count for level, count in self.counts.items()} | {"all": len(self.cards)})


class Hall:
    """Renders cards; the caller holds the lock of the knowledge."""

    def __init__(self, knowledge: Knowledge, zone: str | None) -> None:
        self._knowledge, self._zone = knowledge, zone
        self._rendered: dict[tuple[Language, str, str], tuple[object, Rendered]] = {}  # With what they depend on
        self._card = PAGES.get_template("card.html")

    def shown(self, now: float, language: Language) -> Shown:
        """Return the hall as it is."""
        cards = tuple(self._of(machine, now, language) for machine in self._knowledge.worst_first(now))
        counts = Counter(card.state for card in cards)
        refused = {reason.value: count for reason, count in self._knowledge.refused.items()}
        return Shown(language, cards, {level: counts[level] for level in SHOWN}, refused)

    def _of(self, machine: KnownMachine, now: float, language: Language) -> Rendered:
        state = machine.state(now)
        silence = int((now - machine.heard) // 60.0) if state is Level.NO_DATA else 0
        key, basis = (language, machine.site, machine.name), (machine.revision, state, silence, machine.has_rival(now))
        known = self._rendered.get(key)
        if known is None or known[0] != basis:
            if len(self._rendered) >= MAX_RENDERED:  # machines are forgotten, too
                self._rendered.clear()
            known = self._rendered[key] = basis, self._render(machine, state, now, language)
        return known[1]

    def _render(self, machine: KnownMachine, state: Level, now: float, language: Language) -> Rendered:
        card = card_of(machine, now, language, self._zone)
        rank, since, site, name = place_of(machine, state)
        order = f"{rank} {since:015.1f} {site} {name}"
        html = self._card.render(card=card, order=order, language=language, words=words_in(language))
        event = _event("card", {"id": card.id, "html": html})
        return Rendered(machine.site, machine.name, state, html.encode(errors="replace"), event)


def removal(card: Rendered) -> bytes:
    """Return that a card is not shown any more, for who sees it live."""
    return _event("card", {"id": card.id, "html": None})


def _event(name: str, content: Mapping[str, Any]) -> bytes:
    return f"event: {name}\ndata: {json.dumps(content)}\n\n".encode()
