"""What ``otolith init`` proposes and asks, from a source to the file: units, twin, signals, window."""

import re
import shlex
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from otolith.cli.commissioning.draft.answers import Answers
from otolith.cli.commissioning.draft.assignment import TwinProposal, propose, rank
from otolith.cli.commissioning.draft.displays import with_displays
from otolith.cli.commissioning.draft.offers import Offer, OfferedSource
from otolith.cli.commissioning.draft.questions import Questions
from otolith.cli.commissioning.draft.words import usual_unit
from otolith.cli.commissioning.draft.writing import (
    MachineDraft,
    ReadSignal,
    machine_file_text,
    meaning_of,
    period_reason,
    proposed_length,
    proposed_noise,
    proposed_period,
)
from otolith.cli.commissioning.machine_lines import write_machine_file
from otolith.cli.commissioning.probe_view import fitted_tables, stdout_console
from otolith.cli.terminal import echo
from otolith.machine import find_twin, library_twins
from otolith.runtime.preview import duration_text
from otolith.twin.definition import Definition
from otolith.twin.unmeasured import Assumption
from otolith_drivers.config_files import check_name
from otolith_drivers.errors import ConfigurationError, nearest
from otolith_drivers.outside_text import CONTROL
from otolith_drivers.units import Quantity, factor, is_unit

ASSUMPTIONS = [kind.value for kind in Assumption if kind is not Assumption.PROPORTIONAL]  # which needs an expression
MAX_SHOWN = 40  # rows of the table of offers


def write_draft(file: Path, source: OfferedSource, answers: Answers, questions: Questions) -> None:
    """Show what ``source`` offers, choose, ask, and write ``file``.

    Raises:
        ConfigurationError: no twin fits, or an answer is none.
    """
    writable = [offer for offer in source.offers if not CONTROL.search(offer.name)]
    answers = with_displays(answers, writable, [find_twin(name) for name in library_twins()])
    offers = with_units(writable, answers.units)
    _show(source, offers)
    if hidden := [offer.name for offer in source.offers if offer not in writable]:
        echo(f"! no machine file can name {', '.join(hidden)}: rename what has control characters", "")
    proposal = _twin(offers, source, answers, questions)
    signals, assumed = _signals(proposal, offers, answers, questions, source.doubt)
    chosen = [read.offer for read in signals.values()]
    proposed, why = f"{1e3 * proposed_period(chosen):.6g} ms", period_reason(chosen, source.period)
    if answers.sample_period is None:
        echo(f"sample period {proposed}: {why}; --sample-period states another")
    period = questions.text("Sample period", answers.sample_period or proposed, _seconds).removesuffix(" s")
    length = proposed_length(float(period), source.duration)
    window = questions.text("Length of a window", answers.window or f"{length:.9g} s", _seconds).removesuffix(" s")
    name = answers.name or re.sub(r"[^A-Za-z0-9_-]+", "-", file.stem).strip("-_")[:64] or "machine"
    draft = MachineDraft(
        name=questions.text("Name of the machine", name, check_name),
        site=answers.site,
        driver=source.driver,
        twin=proposal.twin,
        signals=signals,
        assumed=assumed,
        noise=proposed_noise(signals, proposal.twin) | dict(answers.noises),
        period=float(period),
        why=why if _seconds(proposed) == f"{period} s" else "as told",
        length=float(window),
    )
    write_machine_file(file, machine_file_text(draft))
    echo("", f"written: {file}")


def next_lines(file: Path, source: OfferedSource, *, is_commissioned: bool) -> Iterator[str]:
    """Yield what to do with a first machine file, whose values are those of the twin's example until commissioning."""
    name, log = shlex.quote(str(file)), shlex.quote(source.check)
    if not source.check:
        yield "[parameters] has the values of the twin's example; what the daemon records shows those of your machine:"
        yield f"next: otolith check {name}"
        yield f"then: otolith run {name}, and after some minutes: otolith commission {name} --last 5m --write"
        return
    page = shlex.quote(f"{file.stem}.html")
    if is_commissioned:
        yield f"next: otolith replay {name} {log} --report {page}"
        return
    yield "[parameters] has the values of the twin's example; a log of the healthy machine shows its own:"
    yield f"next: otolith commission {name} {log} --write"
    yield f"then: otolith replay {name} {log} --report {page}"


def with_units(offers: Sequence[Offer], units: Mapping[str, str]) -> list[Offer]:
    """Return the offers with units by their names; raise ConfigurationError for another name or no unit."""
    known = {offer.name: offer for offer in offers}
    for name, unit in units.items():
        _offer_named(name, known)
        if not is_unit(unit):
            raise ConfigurationError(f"--unit {name}={unit}: {unit!r} is no unit: write it like V, 1/min or N*m")
    return [replace(offer, unit=units.get(offer.name, offer.unit)) for offer in offers]


def _offer_named(name: str, known: Mapping[str, Offer]) -> Offer:
    if name not in known:
        raise ConfigurationError(f"the source has no signal {name!r}: {nearest(name, list(known))}")
    return known[name]


def _show(source: OfferedSource, offers: Sequence[Offer]) -> None:
    echo(source.title)
    rows = []
    for offer in offers[:MAX_SHOWN]:
        ends = [f"{end:.4g}" for end in (offer.values.min(), offer.values.max())] if len(offer.values) else ["", ""]
        every = "" if offer.interval is None else duration_text(offer.interval)
        moves = "?" if source.doubt else "yes" if offer.moves else "·no"
        rows.append({"signal": offer.name, "unit": offer.unit or "?", "least": ends[0], "most": ends[1],
                     "every": every, "moves": moves})  # fmt: skip
    console = stdout_console()
    for table in fitted_tables(("signal",), rows, console.width):
        console.print(table)
    if len(offers) > MAX_SHOWN:
        echo(f"and {len(offers) - MAX_SHOWN} more")
    echo(*(f"! {remark}" for remark in source.remarks), "")


def _twin(offers: Sequence[Offer], source: OfferedSource, answers: Answers, questions: Questions) -> TwinProposal:
    """Return the twin that fits best, or the one that was told; raise ConfigurationError if none fits."""
    known = {offer.name: offer for offer in offers}
    given = {signal: _offer_named(text, known) for signal, text in answers.signals.items()}
    twins, told = [find_twin(name) for name in library_twins()], given.keys() | answers.unknown.keys()
    having = [twin for twin in twins if told <= set(twin.signals)] or twins
    ranked = rank(having, offers, source.title, given, answers.unknown)
    fitting = [row for row in ranked if row.fits]
    if len(fitting) > 1:
        echo(f"twins that fit: {', '.join(row.twin.name for row in fitting)}")
    name = questions.text("Twin", answers.twin or ranked[0].twin.name, lambda text: find_twin(text).name)
    twin = find_twin(name)
    for signal in [*answers.signals, *answers.unknown]:
        if signal not in twin.signals:
            raise ConfigurationError(f"twin {name} has no signal {signal!r}: it has {', '.join(twin.signals)}")
    for signal, offer in given.items():
        _check_unit(twin, signal, offer, offer.unit or twin.unit_of(signal))
    proposal = propose(twin, offers, given, answers.unknown)
    echo(f"twin {name}: {twin.title}")
    if not (proposal.fits or questions.asks):
        lacking = "; ".join(f"{row} ({meaning_of(twin, row)}, {twin.unit_of(row)})" for row in proposal.missing)
        remedy = "--signal SIGNAL=NAME tells which signal it is, --unit NAME=UNIT its unit, --twin another twin; "
        remedy += "docs/describe-your-machine.md has how to write a twin of your own"
        raise ConfigurationError(f"twin {name} needs what nothing offers: {lacking}: {remedy}")
    return proposal


def _signals(
    proposal: TwinProposal, offers: Sequence[Offer], answers: Answers, questions: Questions, doubt: str
) -> tuple[dict[str, ReadSignal], dict[str, str]]:
    """Return the signals that the source has, and the inputs that nothing measures with what is assumed of them."""
    known = {offer.name: offer for offer in offers}
    twin, read, assumed = proposal.twin, dict[str, ReadSignal](), dict[str, str]()
    for name in answers.scales:
        _offer_named(name, known)
    for name in dict.fromkeys(twin.signals):
        what = f"{name} [{twin.unit_of(name)}], {meaning_of(twin, name)}"
        pair = proposal.pairs.get(name)
        is_input = any(row.name == name for row in twin.inputs)
        if questions.asks:
            proposed = pair.offer.name if pair else answers.unknown.get(name, "constant" if is_input else "")
            allowed = ASSUMPTIONS if is_input else ()
            hint = f" (or {', '.join(ASSUMPTIONS)} without a sensor)" if is_input else ""
            text = questions.text(f"{what}: which signal{hint}?", proposed, _one_of(known, allowed))
        else:
            text = pair.offer.name if pair else answers.unknown.get(name, "constant")
        if text not in known:
            assumed[name] = text
            echo(f"  {what}: no sensor, taken as {text}")
            continue
        why = pair.why if pair and pair.offer.name == text else "as told"
        why = f"{why}; {doubt}".removeprefix("; ").removesuffix("; ")
        others = proposal.others.get(name, ()) if pair and pair.offer.name == text else ()
        read[name] = _read(twin, name, known[text], why, answers, questions)
        echo(f"  {what}: {text} [{read[name].unit}], {read[name].remark}")
        if others:
            echo(f"  ! {', '.join(others)} would be as likely: --signal {name}=NAME decides")
    return read, assumed


def _one_of(known: Mapping[str, Offer], allowed: Sequence[str]) -> Callable[[str], str]:
    def check(text: str) -> str:
        if text not in known and text not in allowed:
            raise ValueError(f"{text!r} is no signal of the source: {nearest(text, list(known))}")
        return text

    return check


def _read(twin: Definition, name: str, offer: Offer, why: str, answers: Answers, questions: Questions) -> ReadSignal:
    """Return a signal with its unit; raise ConfigurationError if it is of another quantity, or the scale no number."""
    target = twin.unit_of(name)

    def fitting(unit: str) -> str:
        factor(unit, target)
        return unit

    unit = offer.unit
    if unit is None:
        usual = usual_unit(offer.name)
        is_fitting = usual is not None and target == "rad/s"
        unit = questions.text(f"Unit of {offer.name}", usual if usual and is_fitting else target, fitting)
        if not questions.asks:
            why = f"{why}; the unit is assumed, --unit {offer.name}=UNIT states it".removeprefix("; ")
    _check_unit(twin, name, offer, unit)
    scale = {"scale": _number(answers.scales[offer.name])} if offer.name in answers.scales else {}
    return ReadSignal(offer, unit, why, scale)


def _check_unit(twin: Definition, name: str, offer: Offer, unit: str) -> None:
    try:
        factor(unit, twin.unit_of(name))
    except ValueError as error:
        raise ConfigurationError(f"{name} from {offer.name}: {error}") from error


def _number(text: str) -> float:
    """Return the number that a scale is; raise ConfigurationError for another text."""
    try:
        return float(text)
    except ValueError as error:
        raise ConfigurationError(f"--scale {text!r}: no number") from error


def _seconds(text: str) -> str:
    return f"{Quantity('s', 1e-4, 600.0)(text):.9g} s"
