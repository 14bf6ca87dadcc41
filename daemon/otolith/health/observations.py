"""What the report of a window shows about each condition of the machine, before any persistence."""

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace

from otolith.discovery.alternatives import WindowDecision
from otolith.discovery.decision import Approval
from otolith.discovery.sequential_test import MAX_OPEN_WINDOWS
from otolith.estimation.evidence import CHANCE_DEVIATE
from otolith.estimation.information import QUANTILE
from otolith.health.diagnosis import COMMAND, FindingFeatures, MonitoringPlan, matching, severity
from otolith.health.limits import MACHINE, Coldness, Level, Limit, MonitoredQuantity, coldness_after, probability_beyond
from otolith.health.prognosis import MIN_TREND_SPAN, SeenTrend, next_crossing
from otolith.health.schema import (
    ComponentDocument,
    ComponentStatus,
    FindingDocument,
    FindingKind,
    ParameterDocument,
    ReportDocument,
    Status,
)
from otolith.health.text import Texts, duration_text, forecast_text, interval_text, value_text
from otolith_drivers.units import equation_text, quantity_text

PERSISTENT_WINDOWS = 3  # windows in a row that must agree on another level
PERSISTENT_SECONDS = 2.0  # s for which they must, where windows are shorter than two thirds of a second
INTERMITTENT_WINDOWS = 12  # among which as many windows with a fault of a sensor are one that comes and goes
RELEASE_WINDOWS = 30  # the same, to clear what shows only while the machine moves
MIN_RETURNS = 4  # changes among as many windows, of which each was gone before the next: one that comes and goes
LOST_AFTER = 3600.0  # s for which a parameter was not determined
MAIN_SHARE = 0.5  # of a deviation: what one sudden change must make up, so that the parameter counts as stepped
MIN_COLDNESS = 1.0  # K: what is colder by less is not said
DETERMINED = frozenset({Status.ESTIMATED, Status.AMBIGUOUS})
BUS, SENSORS = "bus", "sensors"  # parts that every machine has
DAEMON, OUTPUT = "daemon", "output/"  # part to which an output belongs that does not work, and begin of its key
CLOCK = "clock"  # of the computer: it has events, and no state
PARTS = {
    FindingKind.SENSOR: SENSORS,
    FindingKind.NOISE: SENSORS,
    FindingKind.TIMING: BUS,
    FindingKind.POLLED: BUS,
}
"""Of the findings that are about no part of the twin."""
FROM_START = "from the start"  # Manner of what was so before the signals agreed with the machine file for long
COLDER = "colder"  # Manner of what a lower temperature explains
BY_THE_TWIN = frozenset({FindingKind.UNEXPLAINED, FindingKind.RETURNS, FindingKind.COMPONENT, FindingKind.CLASS})
"""What only the comparison with the twin shows."""
NOTHING = FindingFeatures(FindingKind.OPEN)


def least_windows(length: float) -> int:
    """Return how many windows of ``length`` (s) make :data:`PERSISTENT_SECONDS`."""
    return math.ceil(PERSISTENT_SECONDS / length - 1e-9) if length > 0.0 else 1


@dataclass(frozen=True, slots=True)
class Persistence:
    """How many windows in a row must agree."""

    rise: int = PERSISTENT_WINDOWS  # On a higher level
    fall: int = PERSISTENT_WINDOWS  # On a lower one
    within: int = 0  # Windows among which those on a higher level need not follow each other, if more than ``rise``

    def of_windows(self, length: float) -> "Persistence":
        """Return how many windows of ``length`` (s) must agree: short ones for :data:`PERSISTENT_SECONDS` as well."""
        least = least_windows(length)
        ratio = max(least / PERSISTENT_WINDOWS, 1.0)
        rise, fall = (max(own, least) if own >= PERSISTENT_WINDOWS else own for own in (self.rise, self.fall))
        return Persistence(rise, fall, math.ceil(ratio * self.within))


UNDECIDED = Persistence(MAX_OPEN_WINDOWS, RELEASE_WINDOWS)  # Of what an open test states; it shows only with excitation
INTERMITTENT = Persistence(within=INTERMITTENT_WINDOWS)  # Of a sensor: a loose contact is no fault in most windows
PERSISTENCE = {FindingKind.CLASS: UNDECIDED, FindingKind.MOVED: UNDECIDED, FindingKind.SENSOR: INTERMITTENT}


@dataclass(frozen=True, slots=True)
class Observation:
    """What a window shows about one condition."""

    key: str
    part: str
    level: Level | None  # None if the window does not show it
    features: FindingFeatures = NOTHING
    text: str = ""
    advice: str = ""  # Beside that of the rules
    setting: str = ""  # See EventDocument.setting
    since: float | None = None  # Service time, s; None for the first window that shows it
    numbers: Mapping[str, float | str] | None = None  # For the evidence of the event
    persistence: Persistence = Persistence()
    formulas: str = ""  # See EventDocument.formulas

    @property
    def limit(self) -> float | None:
        """Value of the limit that decides the level; None without one."""
        limit = (self.numbers or {}).get("limit")
        return limit if isinstance(limit, float) else None


@dataclass(frozen=True, slots=True)
class Past:
    """What earlier windows showed of the parameters."""

    steps: Mapping[str, float]  # Last sudden change of each
    spans: Mapping[str, float]  # Length of the history of each, s
    trends: Mapping[str, SeenTrend]  # See HealthState.trends
    undetermined: Mapping[str, float]  # Time for which the machine has moved since each was determined, s
    held: Mapping[str, float | None]  # Value of the limit that decided the level of each condition, by its key
    doubtful: tuple[int, ...] = ()  # See HealthState.doubtful
    known_since: float | None = None  # See HealthState.known_since
    coldness: Mapping[str, Coldness] = field(default_factory=dict)  # See HealthState.coldness


def observe(plan: MonitoringPlan, report: ReportDocument, before: Mapping[str, Level], past: Past) -> list[Observation]:
    """Return the observations of a window after the levels ``before``."""
    data = Level.NO_DATA if report.decision is WindowDecision.BAD else Level.OK
    held = (parameter.reason for parameter in report.parameters.values() if parameter.reason)
    reasons = "; ".join(report.window.quality.reasons) or next(held, "")  # where values, not times, are unusable
    no_data = Observation("data", BUS, data, FindingFeatures(FindingKind.NO_DATA), reasons)
    observations = [*_of_sources(report, before), no_data]  # of one state, the first is more specific
    observations += _of_outputs(report, before, plan.texts.translated)
    if report.decision is WindowDecision.REFUSED:
        features = FindingFeatures(FindingKind.UNEXPLAINED, report.twin)
        text = plan.texts.translated(report.decision)
        unexplained = Observation("unexplained", MACHINE, Level.WATCH, features, text)
        observations.append(replace(unexplained, persistence=Persistence(fall=RELEASE_WINDOWS)))
    observations.append(_of_returns(plan, report, before, past.doubtful))
    for name, parameter in report.parameters.items():
        own = _of_parameter(plan, report, name, before, past)
        observations += [own, *_of_coldness(plan, report, name, past), _of_trend(plan, report, name, own.level, past)]
        observations.append(_of_lost(plan, report, name, parameter, past.undetermined.get(name, 0.0)))
    observations += _without_temperature(plan, report)
    components = (_of_component(plan, report.twin, component, before, past) for component in report.components)
    observations += sorted(components, key=lambda item: item.level.rank if item.level else 0)  # the last one counts
    for finding in report.findings:
        if finding.kind not in (FindingKind.OPEN, FindingKind.COMPONENT):
            observed = _of_finding(plan, report.twin, finding, before, past)
            if finding.kind is FindingKind.CLASS:
                words = plan.texts("class_in_words", count=max(len(report.explanations), 2))
                observed = replace(observed, text=words, formulas=observed.text)
            observations.append(observed)
    return [_of_example(plan, item, report.window.start, past) for item in observations]


def _of_example(plan: MonitoringPlan, observed: Observation, start: float, past: Past) -> Observation:
    """Return an observation as a hint if the twin computes with values of an example, and so did from the start.

    What does not fit is then the machine file to complete, and nothing has happened to the machine.
    """
    # An example of zero says that the twin's term is absent, as a record that does not show it does.
    examples = [name for name, quantity in plan.known.items() if quantity.is_example and quantity.nominal]
    begin = start if observed.since is None else observed.since
    is_from_start = past.known_since is None or begin < past.known_since
    is_warning = observed.level in (Level.WATCH, Level.ACT) and observed.features.finding in BY_THE_TWIN
    if not examples or not is_from_start or not is_warning:
        return observed
    return replace(observed, level=Level.HINT, setting=plan.texts("example_values", names=", ".join(examples)))


def _of_sources(report: ReportDocument, before: Mapping[str, Level]) -> Iterator[Observation]:
    """Yield the absent sources, and those that were absent; a window may be good without one of several."""
    absent = {f"source/{name}": text for name, text in (report.window.absent or {}).items()}
    level = Level.NO_DATA if report.decision is WindowDecision.BAD else Level.WATCH
    for key in sorted(absent.keys() | {key for key in before if key.startswith("source/")}):
        features = FindingFeatures(FindingKind.NO_SOURCE, subject=key.partition("/")[2])
        yield Observation(key, BUS, level if key in absent else Level.OK, features, absent.get(key, ""))


def _of_outputs(
    report: ReportDocument, before: Mapping[str, Level], say: Callable[[str], str]
) -> Iterator[Observation]:
    """Yield the outputs that do not work, and those that did not; the machine itself may be well."""
    outages = {
        f"{OUTPUT}{name}": f"{say(name)}: {say(reason)}" for name, reason in (report.window.outages or {}).items()
    }
    for key in sorted(outages.keys() | {key for key in before if key.startswith(OUTPUT)}):
        features = FindingFeatures(FindingKind.NO_OUTPUT, subject=key.removeprefix(OUTPUT))
        yield Observation(key, DAEMON, Level.WATCH if key in outages else Level.OK, features, outages.get(key, ""))


def _of_returns(
    plan: MonitoringPlan, report: ReportDocument, before: Mapping[str, Level], doubtful: tuple[int, ...]
) -> Observation:
    """Return whether something changes again and again, but never for long enough to be an event of its own."""
    key, once, features = "returns", Persistence(rise=1, fall=1), FindingFeatures(FindingKind.RETURNS, report.twin)
    least = least_windows(report.window.end - report.window.start)  # what is gone for less is one change
    begins = [now for before, now in zip((-least - 1, *doubtful), doubtful, strict=False) if now - before > least]
    is_shown = len(begins) >= MIN_RETURNS and doubtful[-1] == report.window.index
    of_machine = [level for name, level in before.items() if name != key and not name.startswith(OUTPUT)]
    if not is_shown or any(level not in (Level.OK, Level.HINT) for level in of_machine):
        return Observation(key, MACHINE, None if doubtful else Level.OK, features, persistence=once)
    seconds = (report.window.end - report.window.start) * (doubtful[-1] - begins[0] + 1)
    causes = next((item.text for item in report.findings if item.kind is not FindingKind.COMPONENT), "")
    text = plan.texts("returns", count=len(begins), duration=duration_text(seconds))
    since, formulas = report.window.end - seconds, plan.texts("causes_at_last", causes=causes) if causes else ""
    shown = Observation(key, MACHINE, Level.WATCH, features, text, since=since, persistence=once)
    return replace(shown, formulas=formulas)


def _of_finding(
    plan: MonitoringPlan, twin: str, finding: FindingDocument, before: Mapping[str, Level], past: Past
) -> Observation:
    """Return the observation of a finding; a parameter that has moved within the limits of the twin is none."""
    is_from_start = finding.of_file or past.known_since is None or finding.since < past.known_since
    features = FindingFeatures(finding.kind, twin, finding.subject, manner=FROM_START if is_from_start else "")
    if finding.kind is FindingKind.TIMING and finding.error is not None:
        features = replace(features, side="below" if finding.error < 0.0 else "above")
    if finding.kind is FindingKind.SENSOR and finding.subject in plan.commands:
        features = replace(features, input=COMMAND)
    part = PARTS.get(finding.kind, MACHINE)
    level = severity(plan.rules, features)
    # A signal that is wrong by a share moves the parameters that are estimated from it by about that share. That of an
    # offset varies with the signal: what once was at ACT stays there.
    # What a rule of the machine file says holds as it is.
    is_sensor = finding.kind is FindingKind.SENSOR and not any(rule.is_own for rule in matching(plan.rules, features))
    is_small = is_sensor and finding.error is not None and abs(finding.error) < plan.act_distance
    if level is Level.ACT and is_small and before.get(finding.id) is not Level.ACT:
        level = Level.WATCH
    meaning, numbers = plan.signals.get(finding.subject, ""), None
    text = f"{plan.texts.translated(meaning)}: {finding.text}" if meaning else finding.text
    if (value := finding.value) is not None:
        quantity = plan.known.get(finding.subject, MonitoredQuantity())
        part = quantity.part
        passed, limit = quantity.level(value.value, value.sd, *_held(finding.id, before, past))
        # The value of an example is that of the file to complete, and none of the machine.
        of_example = Level.HINT if is_from_start and quantity.is_example else level
        level = passed if quantity.limits else of_example
        deviation = value.value - quantity.nominal
        features = replace(features, side="below" if deviation < 0.0 else "above", manner="step")
        numbers = _numbers(value.value, value.sd, value.unit, limit)
        change = f" ({deviation / quantity.nominal:+.1%})" if quantity.nominal else ""
        what = {"what": plan.texts.translated(quantity.meaning), "name": finding.subject, "change": change}
        interval = interval_text(value.value, value.sd, value.unit)
        text = plan.texts("moved", **what, value=interval, stated=quantity_text(quantity.nominal, value.unit))
    persistence = PERSISTENCE.get(finding.kind, Persistence())
    shown = Observation(finding.id, part, level, features, text, finding.advice, finding.setting, finding.since)
    return replace(shown, numbers=numbers, persistence=persistence)


def _of_parameter(
    plan: MonitoringPlan, report: ReportDocument, name: str, before: Mapping[str, Level], past: Past
) -> Observation:
    """Return the observation of a parameter, whose level is not known unless this window determines it."""
    key, parameter, quantity = f"limit/{name}", report.parameters[name], plan.parameters.get(name, MonitoredQuantity())
    value, sd, unit = parameter.value, parameter.sd, parameter.unit
    is_known = value is not None and sd is not None and parameter.status in DETERMINED
    referred = quantity.referred(value or 0.0, sd or 0.0, report.window.observed or {}) if is_known else None
    if referred is None:
        return Observation(key, quantity.part, None)
    shown, colder = referred, past.coldness.get(name)
    referred = quantity.warmed(*referred, colder.kelvin) if colder else referred
    deviation = referred[0] - quantity.nominal
    level, limit = quantity.level(*referred, *_held(key, before, past))
    if limit is None:
        return Observation(key, quantity.part, level)
    may_be_healthy = max(abs(deviation), limit.excess(referred[0])) <= QUANTILE * referred[1]
    if may_be_healthy and level is before.get(key, Level.OK):
        return Observation(key, quantity.part, None)
    manner = _manner(parameter, deviation, past.steps.get(name, 0.0))
    features = FindingFeatures(FindingKind.LIMIT, report.twin, name, limit.side, manner)
    texts = plan.texts
    against = texts("of_baseline") if quantity.has_baseline else ""
    share = f"{shown[0] / quantity.nominal - 1.0:+.1%}" if quantity.nominal else ""
    expected = forecast_text(parameter, report.window.end, texts.language)
    change = f" ({share}{against}{_at_temperature(quantity, texts)})" if share else ""
    value_shown = interval_text(*shown, unit)
    what = {"what": texts.translated(quantity.meaning), "name": name, "value": value_shown, "change": change}
    warming = _warming(quantity, deviation, texts) or _cooled(colder, texts)
    ahead = {"expected": expected and f", {expected}", "warming": warming}
    text = texts("limit", **what, beside=_beside(limit, referred[0], unit, texts), **ahead)
    return Observation(key, quantity.part, level, features, text, numbers=_numbers(*referred, unit, limit))


def _held(key: str, before: Mapping[str, Level], past: Past) -> tuple[Level, float | None]:
    """Return the level of a condition before the window, and the value of the limit that decided it."""
    return before.get(key, Level.OK), past.held.get(key)


def _beside(limit: Limit, value: float, unit: str, texts: Texts) -> str:
    """Return on which side of a limit a value is."""
    side = texts(limit.side if limit.excess(value) > 0.0 else "still_near")
    return texts("beside", side=side, limit=quantity_text(limit.value, unit))


def coldness_of(plan: MonitoringPlan, before: Mapping[str, Coldness], report: ReportDocument) -> dict[str, Coldness]:
    """Return what a lower temperature explains of each parameter that depends on one that is not measured."""
    coldness = dict(before)
    for name, item in report.parameters.items():
        quantity = plan.parameters.get(name, MonitoredQuantity())
        is_known = item.value is not None and item.sd is not None and item.status in DETERMINED
        if is_known and quantity.temperature_coefficient and quantity.limits and not quantity.temperature:
            value, sd = item.value or 0.0, item.sd or 0.0
            times = report.window.start, report.window.end
            coldness[name] = coldness_after(quantity, before.get(name), value, sd, times)
    return coldness


def _of_coldness(plan: MonitoringPlan, report: ReportDocument, name: str, past: Past) -> Iterator[Observation]:
    """Yield that a parameter is beyond a limit only if it is not colder than at its nominal value."""
    quantity, parameter = plan.parameters.get(name, MonitoredQuantity()), report.parameters[name]
    colder, value, sd = past.coldness.get(name), parameter.value, parameter.sd
    if colder is None or value is None or sd is None or parameter.status not in DETERMINED:
        return
    level, limit = quantity.level(value, sd, Level.OK)
    explained, _ = quantity.level(*quantity.warmed(value, sd, colder.kelvin), Level.OK)
    key, texts = f"colder/{name}", plan.texts
    is_main = colder.kelvin >= MAIN_SHARE * quantity.colder_by(value)
    if limit is None or explained is not Level.OK or not is_main:
        yield Observation(key, quantity.part, Level.OK if level is Level.OK else None)
        return
    features = FindingFeatures(FindingKind.LIMIT, report.twin, name, limit.side, COLDER)
    what = {"what": texts.translated(quantity.meaning), "name": name, "value": interval_text(value, sd, parameter.unit)}
    what |= {"kelvin": f"{quantity.colder_by(value):.2g}", "limit": quantity_text(limit.value, parameter.unit)}
    text = texts("colder", **what)
    setting = texts("write_temperature", name=name)
    yield Observation(key, quantity.part, severity(plan.rules, features), features, text, setting=setting)


def _of_trend(plan: MonitoringPlan, report: ReportDocument, name: str, level: Level | None, past: Past) -> Observation:
    """Return whether a parameter at ``level`` is on its way to a limit; what is not seen for a while is left as it was.

    A trend that warming explains is none where no temperature is measured.
    """
    parameter, quantity, now = (
        report.parameters[name],
        plan.parameters.get(name, MonitoredQuantity()),
        report.window.end,
    )
    key, length, seen = f"trend/{name}", past.spans.get(name, 0.0), past.trends.get(name)
    if level is not Level.OK or parameter.forecast is None or parameter.value is None:
        return Observation(key, quantity.part, level and Level.OK)
    if seen is None or length < MIN_TREND_SPAN or seen.is_over(now):
        return Observation(key, quantity.part, Level.OK)
    crossing = next_crossing(parameter.forecast, now)
    referred = quantity.referred(parameter.value, parameter.sd or 0.0, report.window.observed or {})
    if crossing is None or referred is None or not seen.is_lasting(now, length):
        return Observation(key, quantity.part, None)
    is_cooling = 0.0 < quantity.colder_by(crossing.limit) <= quantity.coldest
    if is_cooling or _warming(quantity, crossing.limit - quantity.nominal, plan.texts):
        return Observation(key, quantity.part, Level.OK)
    side = "below" if crossing.limit < quantity.nominal else "above"
    features = FindingFeatures(FindingKind.TREND, report.twin, name, side, "trend")
    expected = forecast_text(parameter, report.window.end, plan.language)
    what = {"what": plan.texts.translated(quantity.meaning), "name": name, "expected": expected}
    what |= {"value": interval_text(*referred, parameter.unit), "at": _at_temperature(quantity, plan.texts)}
    text = plan.texts("trend", **what, limit=quantity_text(crossing.limit, parameter.unit))
    return Observation(key, quantity.part, severity(plan.rules, features), features, text)


def _of_lost(
    plan: MonitoringPlan, report: ReportDocument, name: str, parameter: ParameterDocument, seconds: float
) -> Observation:
    """Return whether a parameter is not determined any more, after ``seconds`` in which the machine has moved."""
    quantity, key = plan.parameters.get(name, MonitoredQuantity()), f"lost/{name}"
    part, texts = quantity.part, plan.texts
    if is_determined(parameter):
        return Observation(key, part, Level.OK)
    if seconds <= LOST_AFTER:
        return Observation(key, part, None)
    value = texts("unknown") if parameter.value is None else value_text(parameter)
    text = texts("lost", what=texts.translated(quantity.meaning), name=name, value=value, reason=parameter.reason)
    features = FindingFeatures(FindingKind.LOST, report.twin, name)
    return Observation(key, part, Level.NO_DATA, features, text, advice=parameter.advice or "")


def is_determined(parameter: ParameterDocument) -> bool:
    """Whether the interval of a parameter is as narrow as is required."""
    return parameter.value is not None and (parameter.progress >= 1.0 or parameter.status is Status.ESTIMATED)


def _numbers(value: float, sd: float, unit: str, limit: Limit | None) -> dict[str, float | str]:
    beyond = {"limit": limit.value, "probability": probability_beyond(limit, value, sd)} if limit else {}
    return {"value": value, "sd": sd, "unit": unit, **beyond}


def _at_temperature(quantity: MonitoredQuantity, texts: Texts) -> str:
    return texts("at_temperature", temperature=f"{quantity.reference - 273.15:.3g}") if quantity.temperature else ""


def _warming(quantity: MonitoredQuantity, deviation: float, texts: Texts) -> str:
    """Return by how much warmer a parameter without a measured temperature would have to be for its deviation."""
    if quantity.temperature or not quantity.temperature_coefficient or not quantity.nominal:
        return ""
    kelvin = deviation / quantity.nominal / quantity.temperature_coefficient
    return texts("warming", kelvin=f"{kelvin:.3g}") if kelvin > 0.0 else ""


def _cooled(colder: Coldness | None, texts: Texts) -> str:
    """Return how much colder a parameter was taken to be when its limit was judged; empty without any."""
    return texts("cooled", kelvin=f"{colder.kelvin:.2g}") if colder and colder.kelvin >= MIN_COLDNESS else ""


def _without_temperature(plan: MonitoringPlan, report: ReportDocument) -> Iterator[Observation]:
    """Yield for each temperature whether it is measured: without it, limits that depend on it are not judged."""
    for name, quantity in plan.parameters.items():
        if quantity.temperature:
            is_known = quantity.referred(1.0, 0.0, report.window.observed or {}) is not None
            text = plan.texts("no_temperature", signal=quantity.temperature, name=name)
            level, features = Level.OK if is_known else Level.NO_DATA, FindingFeatures(FindingKind.NO_TEMPERATURE)
            yield Observation(f"temperature/{name}", quantity.part, level, features, text)


def _manner(parameter: ParameterDocument, deviation: float, step: float) -> str:
    """Return how a parameter came to its ``deviation`` from the nominal value, if that is significant."""
    trend, sd = parameter.trend_per_hour or 0.0, parameter.trend_sd_per_hour or 0.0
    if step * deviation > 0.0 and abs(step) >= MAIN_SHARE * abs(deviation):
        return "step"
    return "trend" if trend * deviation > 0.0 and abs(trend) > QUANTILE * sd else ""


def _of_component(
    plan: MonitoringPlan, twin: str, component: ComponentDocument, before: Mapping[str, Level], past: Past
) -> Observation:
    """Return the observation of a component; one that is expected, fades or is of the size of noise is no warning.

    Its key does not contain its input: at constant speed, a sine of time may later prove to be one of the angle.
    """
    key, amplitude = f"component/{component.site}/{component.family}", component.values["amplitude"]
    order, source = component.values.get("order"), component.input.partition("(")[0]
    unit = plan.sites.get(component.site, MonitoredQuantity()).unit
    is_of = {"subject": component.site, "unit": unit, "family": component.family, "input": source}
    number, reach = (order.value, QUANTILE * order.sd) if order else (None, 0.0)
    features = FindingFeatures(FindingKind.COMPONENT, twin, **is_of, order=number, order_reach=reach)
    quantity = plan.sites.get(component.site, MonitoredQuantity())
    size, limit, level = abs(amplitude.value), None, Level.OK
    is_expected = component.approval is Approval.APPROVED or component.status is ComponentStatus.FADING
    if quantity.limits and amplitude.unit == quantity.unit and not is_expected:
        level, limit = quantity.level(size, amplitude.sd, *_held(key, before, past))
    elif size > CHANCE_DEVIATE * amplitude.sd and not is_expected:
        level = severity(plan.rules, features)
    interval = interval_text(amplitude.value, amplitude.sd, amplitude.unit)
    beside = f", {_beside(limit, size, amplitude.unit, plan.texts)}" if limit else ""
    text = plan.texts("component", what=component.meaning, value=interval, beside=beside)
    numbers, formula = _numbers(size, amplitude.sd, amplitude.unit, limit), equation_text(component.equation)
    shown = Observation(key, quantity.part, level, features, text, since=component.onset, numbers=numbers)
    return replace(shown, formulas=formula)
