"""How tables and their figures are set."""

from rich.table import Table
from rich.text import Text


def table(title: str, *columns: str) -> Table:
    """An empty one; all columns but the first two are figures."""
    made = Table(title=title, title_justify="left", caption_justify="left")
    for number, column in enumerate(columns):
        made.add_column(column, justify="right" if number > 1 else "left", no_wrap=True)
    return made


def percent(share: float | None) -> str:
    """Three digits."""
    return "" if share is None else f"{100.0 * share:.3g}"


def verdict_text(*, met: bool) -> Text:
    """Whether a target is met."""
    return Text("met", style="green") if met else Text("not met", style="red")
