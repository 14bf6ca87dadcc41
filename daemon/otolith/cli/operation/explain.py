"""``otolith explain``: what a condition of an event means, what to do, whether to stop, and when it clears."""

import contextlib
import shutil
import textwrap
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import click

from otolith.cli.common import AS_JSON
from otolith.cli.machines import is_file, own_histories, reader_of
from otolith.cli.terminal import echo, echo_json
from otolith_drivers.errors import ConfigurationError, OtolithError, nearest

if TYPE_CHECKING:
    from otolith.health.diagnosis import Rule
    from otolith.health.schema import Language
    from otolith.storage.history import HistoryReader

LANGUAGES = ("en", "de")  # those of otolith.health.schema, which is slow to import
MAX_WIDTH = 100  # characters of a line; engineering choice


@click.command()
@click.argument("conditions", nargs=-1, metavar="[CONDITION]...")
@click.option("--machine", metavar="FILE|MACHINE", help="With the rules and in the language of this machine.")
@click.option(
    "--language",
    type=click.Choice(LANGUAGES),
    show_default=False,
    help="[default: of the machine, or en]",
)
@click.option("--markdown", "as_markdown", is_flag=True, help="Print all of them as one page of Markdown.")
@AS_JSON
def explain(
    conditions: tuple[str, ...], machine: str | None, language: "Language | None", as_markdown: bool, as_json: bool
) -> None:
    """Explain what a CONDITION of an event means.

    It prints what must be seen, what to do, whether to stop the machine, what
    else it may be, and when it clears. Events have the name of their condition
    at the end. Without a name all of them are listed. No network is needed.

    \b
    Examples:
      otolith explain
      otolith explain unbalance
      otolith explain winding-hot winding-contact --language de
      otolith explain worn-seal --machine press-3
    """
    from otolith.health.conditions import condition_page, markdown, pages_of
    from otolith.health.text import texts_in
    from otolith.machine import load_rules

    if conditions and as_markdown:
        raise click.UsageError("--markdown prints all conditions: give no CONDITION with it")
    reader = None if machine is None else reader_of(machine)
    language = language or _language(machine, reader)
    joined = " ".join(conditions)
    own = _own_rules(reader, (*conditions, joined))
    rules, texts = (*own, *load_rules(language)), texts_in(language)
    known = list(dict.fromkeys(rule.id for rule in rules))
    conditions = (joined,) if joined in known else conditions  # the name of a rule may have spaces
    for name in conditions:
        if not pages_of([name], rules, texts):
            raise ConfigurationError(f"no condition {name!r}: {nearest(name, known)}")
    pages = pages_of(conditions or known, rules, texts)
    if as_markdown:
        echo(*markdown([condition_page(rule, rules, texts) for rule in rules], texts).splitlines())
    elif as_json:
        echo_json({"conditions": [{"id": page.id, "condition": page.condition, **page.texts} for page in pages]})
    elif not conditions:
        width = max(map(len, known))
        echo(*(f"{page.id:{width}}  {page.condition}" for page in pages))
    else:
        width = min(shutil.get_terminal_size((80, 24)).columns, MAX_WIDTH)
        for number, page in enumerate(pages):
            echo(*([""] if number else []), f"{page.id}: {page.condition}")
            for key, text in page.texts.items():
                heading = texts.conditions[key]
                line = f"{heading}{'' if heading.endswith('?') else ':'} {text}"
                echo(*textwrap.wrap(line, width, initial_indent="  ", subsequent_indent="    "))


def _language(machine: str | None, reader: "HistoryReader | None") -> "Language":
    """Return the language of a machine; without one that which all machines here share, or English.

    A machine file says it, also before its first report.
    """
    if machine is not None and is_file(machine) and machine.endswith(".toml"):
        from otolith.machine import load_machine

        return load_machine(Path(machine), with_driver=False).file.machine.language
    languages = {language for each in (own_histories() if reader is None else [reader]) for language in _reported(each)}
    return languages.pop() if len(languages) == 1 else "en"


def _reported(reader: "HistoryReader") -> "Iterator[Language]":
    """Yield the language of the last report of a history, if there is one that can be read."""
    with contextlib.suppress(OtolithError):
        language = reader.language_and_zone()[0] if reader.path.is_file() else None
        if language is not None:
            yield language


def _own_rules(reader: "HistoryReader | None", names: tuple[str, ...]) -> "tuple[Rule, ...]":
    """Return the rules of a machine file; without a machine those of all here that have one of the names."""
    if reader is not None:
        return reader.own_rules() if reader.path.is_file() else ()
    rules: list[Rule] = []
    for each in own_histories():
        try:
            rules += [rule for rule in each.own_rules() if rule.id in names]
        except OtolithError as error:  # a history that cannot be read is no reason to explain nothing
            echo(str(error), err=True)
    return tuple(rules)
