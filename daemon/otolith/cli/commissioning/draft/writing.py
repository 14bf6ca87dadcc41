"""The text of a first machine file."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from otolith.cli.commissioning.draft.offers import Offer
from otolith.machine_file import MAX_WINDOW_RECORDS, MIN_WINDOW_RECORDS, whole_length
from otolith.twin.definition import Definition, Parameter, Role
from otolith_drivers.grammars.toml_lines import toml_comment, toml_key, toml_value
from otolith_drivers.units import factor

RECORDS = 200  # of a proposed window
MIN_LENGTH, MAX_LENGTH = 0.5, 600.0  # s
WINDOWS = 3  # of a recording at least
CLOSE_PERIOD = 0.005  # by which a measured interval differs from a round one at most; see thresholds-cli.md
USUAL_PERIOD = 0.01  # s, where the source shows none


@dataclass(frozen=True, slots=True)
class ReadSignal:
    """A signal of the twin that a source has."""

    offer: Offer
    unit: str
    remark: str  # Why it was chosen, and what was assumed
    keys: Mapping[str, Any]  # Beyond those of the offer: a scale


@dataclass(frozen=True, slots=True)
class MachineDraft:
    """All that a first machine file says."""

    name: str
    site: str | None
    driver: Sequence[str]  # Lines of the table [driver]
    twin: Definition
    signals: Mapping[str, ReadSignal]
    assumed: Mapping[str, str]  # constant, slow or friction, of inputs that no sensor measures
    noise: Mapping[str, str]  # As written in the file
    period: float  # s
    why: str  # What the sample period is
    length: float  # s


def meaning_of(twin: Definition, name: str) -> str:
    """Return what a signal of the twin means."""
    return {**{row.name: row.meaning for row in twin.inputs}, **{row.name: row.meaning for row in twin.outputs}}[name]


def proposed_period(offers: Sequence[Offer]) -> float:
    """Return the interval of the fastest of the ``offers`` in s, with three digits and within what a file may have.

    It is a measured one: devices send at a round one, of two digits, if that is so close.
    """
    measured = min((offer.interval for offer in offers if offer.interval), default=USUAL_PERIOD)
    fastest = min(max(measured, 1e-4), 10.0)
    usual = float(f"{fastest:.2g}")
    return usual if abs(usual / fastest - 1.0) <= CLOSE_PERIOD else float(f"{fastest:.3g}")


def period_reason(offers: Sequence[Offer], known: str) -> str:
    """Return why the sample period is as proposed: ``known`` if an interval of the ``offers`` shows it."""
    if any(offer.interval for offer in offers):
        return known
    return "assumed, as too few changes show how often the signals are renewed: let the machine move"


def proposed_length(period: float, duration: float) -> float:
    """Return the length of a window in s for records every ``period`` s, of a recording that takes ``duration`` s.

    A ``duration`` of zero is of a machine that goes on.
    """
    wanted = min(max(RECORDS * period, MIN_LENGTH), MAX_LENGTH)
    if duration:
        wanted = min(wanted, duration / WINDOWS)
    records = round(min(max(wanted / period, MIN_WINDOW_RECORDS), MAX_WINDOW_RECORDS))
    return whole_length(records * period, period)


def proposed_noise(signals: Mapping[str, ReadSignal], twin: Definition) -> dict[str, str]:
    """Return the noise of the outputs that their values show, in their units, as a machine file has it."""
    levels = {}
    for output in twin.outputs:
        read = signals.get(output.name)
        if read is None or (noise := read.offer.noise) is None:
            continue
        level = abs(factor(read.unit, output.unit)[0] * float(read.keys.get("scale", 1.0))) * noise
        if math.isfinite(level) and level > 0.0:
            levels[output.name] = f"{level:.2g} {output.unit}"
    return levels


def machine_file_text(draft: MachineDraft) -> str:
    """Return the machine file; each text from outside is a value or a comment of TOML."""
    return "\n".join([*_head(draft), *_signals(draft), *_twin(draft), *_noise(draft), *_window(draft)]) + "\n"


def _head(draft: MachineDraft) -> Iterator[str]:
    yield "## Machine file by 'otolith init'. '##' is prose, '#' what the daemon uses while nothing else is written."
    yield "## Every value has its unit, any of the quantity. docs/reference/machine-file.md explains all keys."
    yield ""
    yield "[machine]"
    yield f"name = {toml_value(draft.name)}"
    yield f"site = {toml_value(draft.site)}" if draft.site else '# site = "site"'
    yield '# timezone = "Europe/Berlin"  # of the plant: people read times in it; UTC for dates that name none'
    yield ""
    yield "## Source of the signals. The driver only listens or reads."
    yield from draft.driver
    yield ""


def _signals(draft: MachineDraft) -> Iterator[str]:
    yield "## Where each input and output of the twin is read, and in which unit."
    yield "[signals]"
    twin = draft.twin
    for name in dict.fromkeys(twin.signals):
        if name in draft.assumed:
            remark = toml_comment(f"{meaning_of(twin, name)}: no sensor")
            yield f"{toml_key(name)} = {toml_value({'unknown': draft.assumed[name]})}  {remark}"
        elif name in draft.signals:
            read = draft.signals[name]
            keys = toml_value({**read.offer.keys, **read.keys, "unit": read.unit})
            yield f"{toml_key(name)} = {keys}  {toml_comment(f'{meaning_of(twin, name)}: {read.remark}')}"
    if draft.assumed:
        yield '## unknown = "constant": one value in each window; "slow": it changes within a window; "friction": the'
        yield "## load is friction. 'otolith check' says what can therefore not be estimated."
    yield ""


def _twin(draft: MachineDraft) -> Iterator[str]:
    yield f"#{toml_comment(f'{draft.twin.title}. {draft.twin.validity}')}"
    yield "[twin]"
    yield f"name = {toml_value(draft.twin.name)}"
    yield ""
    yield "## A line with '#' has the value of the twin's example. 'otolith commission --write' replaces it by that"
    yield "## of your machine, from a healthy record. Or write that of a data sheet: estimates are as right as these."
    yield "[parameters]"
    for parameter in draft.twin.parameters:
        if parameter.role is not Role.SETTING:
            yield f"# {_parameter(parameter)}  {toml_comment(parameter.meaning)}"
    yield ""


def _parameter(parameter: Parameter) -> str:
    name, unit = toml_key(parameter.name), parameter.unit
    if parameter.role is not Role.ESTIMATED:
        return f'{name} = "{parameter.nominal:.6g} {unit}"'
    bounds = f'low = "{parameter.low:.6g} {unit}", high = "{parameter.high:.6g} {unit}"'
    return f'{name} = {{ value = "{parameter.nominal:.6g} {unit}", estimate = true, {bounds} }}'


def _noise(draft: MachineDraft) -> Iterator[str]:
    yield "## Standard deviation of the sensors, at first from the fastest changes of the values that came;"
    yield "## 'otolith commission --write' finds better ones in a healthy record."
    yield "[noise]"
    for name, level in draft.noise.items():
        yield f"{toml_key(name)} = {toml_value(level)}"
    for output in draft.twin.outputs:
        if output.name not in draft.noise:
            yield f'# {toml_key(output.name)} = "{output.noise:.6g} {output.unit}"  # of the twin: the values show none'
    yield ""


def _window(draft: MachineDraft) -> Iterator[str]:
    yield "## One estimate for each window; a record in each sample period:"
    yield f"#{toml_comment(draft.why)}"
    yield "[window]"
    yield f'length = "{draft.length:.9g} s"'
    yield f'sample_period = "{1e3 * draft.period:.6g} ms"'
