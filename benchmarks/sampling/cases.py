"""The scenarios: ways to record the motor."""

from dataclasses import replace

from benchmarks.sampling.schedules import Schedule, Timing

DENSE, STALE = Timing(0.01), Timing(renewed_every=5)
SLOWS = (0.01, 0.02, 0.05, 0.1)  # s
SHARES = (0.3, 0.5, 0.8)  # missing
JITTERS = (0.1, 0.3, 0.5)  # of the period


def _cases() -> dict[str, Schedule]:
    cases = {
        "uniform rows": Schedule(rows=DENSE),
        "uniform rows, noisy load": Schedule(rows=DENSE, load="walk", load_noise=True),
        "uniform rows, commands on change": Schedule(rows=DENSE, commands_on_change=True),
    }
    for period in SLOWS:
        text = f"every {1e3 * period:.0f} ms"
        cases[f"omega {text}"] = Schedule(omega=Timing(period))
        cases[f"i {text}"] = Schedule(i=Timing(period))
        cases[f"both {text}, commands on change"] = both(Timing(period))
    for share in SHARES:
        timing, text = Timing(missing=share), f"{100.0 * share:.0f} % missing"
        rows = Schedule(rows=timing, load="walk", load_noise=True)
        cases[f"samples {text}"] = Schedule(i=timing, omega=timing)
        cases[f"rows {text}"] = replace(rows, voltage="steps")
        cases[f"rows {text}, commands on change"] = replace(rows, commands_on_change=True)
    for share in JITTERS:
        timing = Timing(jitter=share)
        cases[f"jitter {100.0 * share:.0f} %"] = Schedule(i=timing, omega=timing)
    cases |= {
        "20 ms, 80 % missing, jitter 50 %": both(Timing(0.02, missing=0.8, jitter=0.5)),
        "100 ms, 80 % missing": both(Timing(0.1, missing=0.8)),
        "omega 50 ms, 50 % missing, jitter 50 %": Schedule(omega=Timing(0.05, missing=0.5, jitter=0.5)),
        "rows every 10.7 ms": Schedule(rows=Timing(0.0107)),
        "rows every 10.7 ms, jitter 30 %": Schedule(rows=Timing(0.0107, jitter=0.3), load="walk", load_noise=True),
        "steps on change": Schedule(voltage="steps", commands_on_change=True),
        "sine held for 10 ms": Schedule(voltage="sine"),
        "inputs every 50 ms": Schedule(load_period=0.05, voltage="steps"),
        "load every 50 ms, commands on change": Schedule(load_period=0.05, commands_on_change=True),
        "polled every 21 ms": polled(Timing(0.021)),
        "polled every 21 ms, 30 % missing": polled(Timing(0.021, missing=0.3)),
        "each row twice": Schedule(rows=DENSE, copies=2),
        "renewed every fifth row": Schedule(rows=DENSE, i=STALE, omega=STALE),
    }
    return cases


def both(timing: Timing) -> Schedule:
    """Return the schedule with both outputs at such times, and commands logged on change."""
    return Schedule(i=timing, omega=timing, commands_on_change=True)


def polled(timing: Timing) -> Schedule:
    """Return the schedule of a device that is asked for all its values at such times.

    Its changes come at all shares of the interval if that does not divide the time between them.
    """
    return Schedule(i=timing, omega=timing, load_period=timing.period, voltage="steps", polled=True)


CASES = _cases()
