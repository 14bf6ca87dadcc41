"""Plans at any times become records; readings are mixtures of normal distributions; what persons suppose is checked."""

import numpy as np
import pytest
from scipy.stats import norm

from otolith.acquisition.window import Window
from otolith.simulation.plan import MAX_RECORDS, joined, planned_window
from otolith.simulation.prediction import bands
from otolith.simulation.what_if import with_value, without_component
from otolith_drivers.errors import ConfigurationError
from tests.messages import raises_saying
from tests.simulation.motors import PERIOD, TWIN, posterior


def planned(*times: float) -> Window:
    """Voltage and load rise from row to row."""
    rising = np.arange(len(times), dtype=np.float64)
    return planned_window(TWIN, np.array(times), {"V_a": rising, "T_load": rising}, PERIOD, 5.0)


def test_between_two_rows_are_records_where_commands_are_held_and_loads_are_linear() -> None:
    window = planned(1.0, 1.02, 1.055)
    assert window.start == 5.0
    np.testing.assert_allclose(window.grid.offsets, [0.0, 0.01, 0.02, 0.02875, 0.0375, 0.04625, 0.055])
    np.testing.assert_allclose(window.column("V_a"), [0, 0, 1, 1, 1, 1, 2])
    np.testing.assert_allclose(window.column("T_load"), [0, 0.5, 1, 1.25, 1.5, 1.75, 2])
    assert np.isnan(window.column("omega")).all()


def test_a_plan_at_the_sample_period_has_its_own_records() -> None:
    window = planned(*(0.01 * np.arange(100)).tolist())
    assert window.records == 100
    assert window.grid.period == pytest.approx(PERIOD)


def test_a_plan_that_is_denser_than_the_samples_loses_no_row() -> None:
    assert planned(*(0.001 * np.arange(50)).tolist()).records == 50


def test_a_plan_has_two_rows_and_not_too_many_records() -> None:
    with raises_saying(ValueError, "one row"):
        planned(0.0)
    with raises_saying(ValueError, str(MAX_RECORDS), "0.01 s"):
        planned(0.0, 1e6)


def test_windows_are_joined_up_to_the_first_gap() -> None:
    values = np.zeros((10, len(TWIN.signals)))
    windows = [Window.whole(0, start, PERIOD, TWIN.signals, values) for start in (0.0, 0.1, 0.25)]
    assert joined(windows).records == 20
    assert joined(windows).grid.period == PERIOD


@pytest.mark.parametrize("spread", [0.01, 0.4, 3.0, 50.0, 300.0])
def test_the_ends_of_a_band_are_quantiles_of_the_mixture(spread: float) -> None:
    """Of normal draws, and of the positions of a sine whose phase is not known: two peaks."""
    normal = spread * norm.ppf((np.arange(400) + 0.5) / 400)
    sine = spread * np.sin(2.0 * np.pi * (np.arange(400) + 0.5) / 400)
    draws = np.stack([normal, sine])[:, :, None]
    _, low, high = bands(draws, np.ones(1), np.ones(draws.shape[1], dtype=np.bool_))
    for row in range(2):
        below, above = (norm.cdf(end[row, 0] - draws[row, :, 0]).mean() for end in (low, high))
        assert below == pytest.approx(0.025, abs=0.002)
        assert above == pytest.approx(0.975, abs=0.002)


@pytest.mark.parametrize(("value", "expected"), [(5.2, 5.2), ("5.2", 5.2), ("5200 mohm", 5.2)])
def test_a_value_may_have_a_unit(value: str | float, expected: float) -> None:
    assert with_value(posterior(), "R_a", value).prior().mean[0] == pytest.approx(expected)


def test_a_known_parameter_may_be_set_too() -> None:
    assert dict(with_value(posterior(), "J", "20 kg*cm^2").problem.known)["J"] == pytest.approx(0.002)


@pytest.mark.parametrize(
    ("name", "value", "parts"),
    [
        ("R_b", 5.0, ("R_b", "R_a")),
        ("R_a", "5 V", ("R_a", "5 V", "ohm")),
        ("R_a", "high", ("R_a", "high", "ohm")),
        ("R_a", 50.0, ("R_a", "50", "12 ohm")),
        ("R_a", "nan", ("R_a", "nan", "12 ohm")),
    ],
)
def test_a_value_that_cannot_be_meant_is_refused(name: str, value: str | float, parts: tuple[str, ...]) -> None:
    with raises_saying(ConfigurationError, *parts):
        with_value(posterior(), name, value)


def test_a_component_that_is_not_there_cannot_be_removed() -> None:
    with raises_saying(ConfigurationError, "shaft/periodic", "none"):
        without_component(posterior(), "shaft/periodic")
