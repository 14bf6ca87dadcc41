"""Tables and styled lines of a terminal, in which no text from outside is an instruction to it."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

from rich.console import Console, ConsoleOptions, RenderableType, RenderResult
from rich.measure import Measurement
from rich.segment import Segment
from rich.text import Text

from otolith_drivers.outside_text import CONTROL, visible

SHOWN = 4000  # characters of a text; rich takes time by the square of its length


class Terminal(Console):
    """A console without markup, on which each text is one line: a line break in it is escaped like any control."""

    def __init__(self, **options: Any) -> None:
        """``options`` are those of rich's console."""
        super().__init__(markup=False, emoji=False, **{"highlight": False, **options})

    def render_str(self, text: str, **options: Any) -> Text:
        """Return a text as rich's console does: all texts that are printed come through here."""
        return super().render_str(visible(text, SHOWN), **options)

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterable[Segment]:
        """Return the segments of what is printed: all that has a style comes through here, also cells of tables."""
        return super().render(_escaped(renderable), options)


def _escaped(renderable: RenderableType) -> RenderableType:
    if not isinstance(renderable, Text) or not (len(renderable) > SHOWN or CONTROL.search(renderable.plain)):
        return renderable
    same = {name: getattr(renderable, name) for name in ("style", "justify", "overflow", "no_wrap", "end")}
    return Text(visible(renderable.plain, SHOWN), **same)


@dataclass(frozen=True, slots=True)
class Localised:
    """What is printed in a language whose numbers have another decimal sign; tables stay as wide as they were."""

    shown: RenderableType
    decimals: Callable[[str], str]

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """Return the segments with the decimal sign of the language."""
        for segment in console.render(self.shown, options):
            yield Segment(self.decimals(segment.text), segment.style, segment.control)

    def __rich_measure__(self, console: Console, options: ConsoleOptions) -> Measurement:
        """Return the width of what is printed."""
        return Measurement.get(console, options, self.shown)
