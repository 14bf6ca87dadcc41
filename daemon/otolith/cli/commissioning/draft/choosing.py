"""What ``otolith init`` proposes and asks, from a source to the file: units, twin, signals, window."""

import contextlib
import math
import re
import shlex
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from otolith.cli.commissioning.draft.answers import Answers
from otolith.cli.commissioning.draft.assignment import TwinProposal, percentages, propose, rank
from otolith.cli.commissioning.draft.displays import displayed, with_displays
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
AMPLITUDES = "amplitude"  # In the validity of a twin whose currents and voltages are no effective values
MAX_SHOWN = 40  # rows of the table of offers


def check_answers(answers: Answers) -> None:
    """Check what options have answered as far as no source is needed.

    Raises:
        ConfigurationError: a name, unit, number or quantity is none, or no twin can have it.
    """
    twins = [find_twin(name) for name in ([answers.twin] if answers.twin else library_twins())]
    fitting = _twins_with(answers, twins)
    _check_unknown(answers, fitting)
    _check_numbers(answers, fitting)
    if answers.displays:
        displayed(answers, twins)
    for signal, source in answers.signals.items():
        units = [twin.unit_of(signal) for twin in fitting]
        unit = answers.units.get(source, units[0])
        _checked(f"--signal {signal}={source} --unit {source}", unit, [_fitting(target) for target in units])
    for option, text, check in (
        ("--sample-period", answers.sample_period, _seconds),
        ("--window", answers.window, _seconds),
        ("--name", answers.name, check_name),
        ("--site", answers.site, check_name),
    ):
        if text is not None:
            _checked(option, text, [check])


def _check_unknown(answers: Answers, fitting: Sequence[Definition]) -> None:
    """Raise ConfigurationError for an input without a sensor that no twin has, or an assumption that there is not."""
    inputs = dict.fromkeys(row.name for twin in fitting for row in twin.inputs)
    for name, kind in answers.unknown.items():
        if name not in inputs:
            raise ConfigurationError(f"--unknown {name}={kind}: no input of the twin: {nearest(name, list(inputs))}")
        if kind not in ASSUMPTIONS:
            raise ConfigurationError(f"--unknown {name}={kind}: {nearest(kind, ASSUMPTIONS)}")


def _check_numbers(answers: Answers, fitting: Sequence[Definition]) -> None:
    """Raise ConfigurationError for a unit, scale or noise level that is none."""
    for name, unit in answers.units.items():
        if not is_unit(unit):
            raise ConfigurationError(f"--unit {name}={unit}: {unit!r} is no unit: write it like V, 1/min or N*m")
    for name in answers.scales:
        _scale(name, answers)
    for name, level in answers.noises.items():
        units = [twin.unit_of(name) for twin in fitting if name in twin.signals]
        _checked(f"--noise {name}", level, [Quantity(unit, low=0.0, difference=True) for unit in units])


def _twins_with(answers: Answers, twins: Sequence[Definition]) -> list[Definition]:
    """Return the twins with all signals that are told; raise ConfigurationError if there is none."""
    named = dict.fromkeys(answers.signals, "--signal") | dict.fromkeys(answers.unknown, "--unknown")
    named |= dict.fromkeys(answers.noises, "--noise")
    fitting = [twin for twin in twins if named.keys() <= set(twin.signals)]
    if fitting:
        return fitting
    known = dict.fromkeys(name for twin in twins for name in twin.signals)
    for name, option in named.items():
        if name not in known:
            who = f"twin {twins[0].name}" if len(twins) == 1 else "no twin"
            has = "has no" if len(twins) == 1 else "has a"
            raise ConfigurationError(f"{option} {name}: {who} {has} signal {name!r}: {nearest(name, list(known))}")
    remedy = "'otolith twin list' shows the twins, 'otolith twin show NAME' the signals of one"
    raise ConfigurationError(f"{', '.join(f'{option} {name}' for name, option in named.items())}: no twin has all "
                             f"of these signals: {remedy}")  # fmt: skip


def _checked(option: str, text: str, checks: Sequence[Callable[[str], object]]) -> None:
    """Raise ConfigurationError, which names ``option``, if none of ``checks`` takes ``text``."""
    faults = []
    for check in checks:
        try:
            check(text)
        except ValueError as error:
            faults.append(error)
        else:
            return
    raise ConfigurationError(f"{option}={text}: {faults[0]}") from faults[0]


def write_draft(file: Path, source: OfferedSource, answers: Answers, questions: Questions) -> None:
    """Show what ``source`` offers, choose, ask, and write ``file``; the answers are checked.

    Raises:
        ConfigurationError: no twin fits, or the source has no signal that an answer names.
    """
    writable = [offer for offer in source.offers if not CONTROL.search(offer.name)]
    answers = with_displays(answers, writable, [find_twin(name) for name in library_twins()], source.still)
    for named in (*answers.signals.values(), *answers.units, *answers.scales):
        _check_offered(named, source, writable)
    offers = [replace(offer, unit=answers.units.get(offer.name, offer.unit)) for offer in writable]
    _show(source, offers)
    if hidden := [offer.name for offer in source.offers if offer not in writable]:
        echo(f"! no machine file can name {', '.join(hidden)}: rename what has control characters", "")
    proposal = _twin(offers, f"{source.title} {answers.name or file.stem}", answers, questions)
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


def _check_offered(name: str, source: OfferedSource, offers: Sequence[Offer]) -> None:
    """Raise ConfigurationError, with the reason, if the source does not offer a signal ``name``."""
    known = [offer.name for offer in offers]
    if name in known:
        return
    if name in source.still:
        held = f"{name} held {source.still[name]:g} all the time, so that it does not show what it is"
        raise ConfigurationError(f"{held}: let the machine move, or write its line of [signals] by hand")
    raise ConfigurationError(f"the source has no signal {name!r} that changes: {nearest(name, known)}")


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


def _twin(offers: Sequence[Offer], hint: str, answers: Answers, questions: Questions) -> TwinProposal:
    """Return the twin that fits best, or the one that was told; raise ConfigurationError if none fits.

    ``hint`` is a text that may name the kind of machine, as the names of log and machine do.
    """
    known = {offer.name: offer for offer in offers}
    given = {signal: known[text] for signal, text in answers.signals.items()}
    twins, told = [find_twin(name) for name in library_twins()], given.keys() | answers.unknown.keys()
    having = [twin for twin in twins if told <= set(twin.signals)] or twins
    ranked = rank(having, offers, hint, given, answers.unknown)
    fitting = [row for row in ranked if row.fits]
    if len(fitting) > 1:
        echo(f"twins that fit: {', '.join(row.twin.name for row in fitting)}")
    name = questions.text("Twin", answers.twin or ranked[0].twin.name, lambda text: find_twin(text).name)
    twin = find_twin(name)
    for signal in [*answers.signals, *answers.unknown]:
        if signal not in twin.signals:
            raise ConfigurationError(f"twin {name} has no signal {signal!r}: {nearest(signal, list(twin.signals))}")
    for signal, offer in given.items():
        _check_unit(twin, signal, offer, offer.unit or twin.unit_of(signal))
    proposal = propose(twin, offers, given, answers.unknown)
    echo(f"twin {name}: {twin.title}")
    if not (proposal.fits or questions.asks):
        lacking = "; ".join(f"{row} ({meaning_of(twin, row)}, {twin.unit_of(row)})" for row in proposal.missing)
        remedy = "--signal SIGNAL=NAME tells which signal it is, --unit NAME=UNIT its unit, --twin another twin; "
        remedy += "docs/describe-your-machine.md has how to write a twin of your own"
        shares = [
            f"{offer.name} is in %: --signal {_pair(row, offer.name)} {_as_percentage(offer, twin.unit_of(row))}"
            for row, offer in percentages(proposal, offers).items()
        ]
        raise ConfigurationError("; ".join([f"twin {name} needs what nothing offers: {lacking}: {remedy}", *shares]))
    return proposal


def _as_percentage(offer: Offer, unit: str) -> str:
    """Return the options for a signal in percent of a rated value."""
    options = f"--unit {_pair(offer.name, unit)} --scale {_pair(offer.name, 'FACTOR')}"
    effective = ", times 1.41421 for an effective value of a three-phase motor" if unit == "A" else ""
    return f"{options}, where FACTOR is a hundredth of the rated value in {unit}{effective}"


def _pair(name: str, value: str) -> str:
    return shlex.quote(f"{name}={value}")


def _signals(
    proposal: TwinProposal, offers: Sequence[Offer], answers: Answers, questions: Questions, doubt: str
) -> tuple[dict[str, ReadSignal], dict[str, str]]:
    """Return the signals that the source has, and the inputs that nothing measures with what is assumed of them."""
    known = {offer.name: offer for offer in offers}
    twin, read, assumed = proposal.twin, dict[str, ReadSignal](), dict[str, str]()
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
        if twin.unit_of(name) in ("A", "V") and AMPLITUDES in twin.validity and text not in answers.scales:
            echo(f"  ! an amplitude; of an effective value: --scale {_pair(text, '1.41421')}, between phases 0.8165")
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
    unit = offer.unit
    if unit is None:
        usual = usual_unit(offer.name)
        is_fitting = usual is not None and target == "rad/s"
        unit = questions.text(f"Unit of {offer.name}", usual if usual and is_fitting else target, _fitting(target))
        if not questions.asks:
            why = f"{why}; the unit is assumed, --unit {offer.name}=UNIT states it".removeprefix("; ")
    _check_unit(twin, name, offer, unit)
    scale = {"scale": _scale(offer.name, answers)} if offer.name in answers.scales else {}
    return ReadSignal(offer, unit, why, scale)


def _check_unit(twin: Definition, name: str, offer: Offer, unit: str) -> None:
    try:
        factor(unit, twin.unit_of(name))
    except ValueError as error:
        remedy = f"; {_as_percentage(offer, twin.unit_of(name))}" if unit == "%" else ""
        raise ConfigurationError(f"{name} from {offer.name}: {error}{remedy}") from error


def _fitting(target: str) -> Callable[[str], str]:
    """Return a check that raises ValueError for a unit that is none of the quantity with the unit ``target``."""

    def check(unit: str) -> str:
        factor(unit, target)
        return unit

    return check


def _scale(name: str, answers: Answers) -> float:
    """Return the scale of a signal of the source; raise ConfigurationError for what is none."""
    text = answers.scales[name]
    with contextlib.suppress(ValueError):
        if math.isfinite(scale := float(text)) and scale != 0.0:
            return scale
    raise ConfigurationError(f"--scale {name}={text}: write a number other than 0, like 0.01")


def _seconds(text: str) -> str:
    return f"{Quantity('s', 1e-4, 600.0)(text):.9g} s"
