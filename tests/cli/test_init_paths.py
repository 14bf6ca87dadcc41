"""Names with a path, as topics, fields and nodes have them: what they mean, and the unit at their end."""

import shlex
from pathlib import Path

import numpy as np
import pytest

from otolith.cli.commissioning.draft.assignment import percentages, rank
from otolith.cli.commissioning.draft.offers import Offer, unit_in
from otolith.cli.commissioning.draft.words import meanings
from otolith.estimation.minimisers import FitResult, gauss_newton
from otolith.machine import find_twin, library_twins
from otolith.runtime.preview import duration_text
from otolith_drivers.errors import ConfigurationError
from tests.cli.commands import otolith, tables
from tests.messages import assert_each_says, assert_says, raises_saying


@pytest.mark.parametrize(
    ("name", "unit"),
    [
        ("plain/drive7/rpm", "rpm"),
        ("values.rpm", "rpm"),
        ("plain/drive7/current_A", "A"),
        ("plain/drive7/A", None),  # a phase
        ("metrics.m", None),
        ("rpm", None),
        ("hall/drive/trip", None),
    ],
)
def test_a_path_may_end_with_a_unit(name: str, unit: str | None) -> None:
    assert unit_in(name) == unit


@pytest.mark.parametrize(
    ("name", "meaning"),
    [
        ("factory/hall1/telemetry metrics.u_dc", "voltage"),
        ("metrics.i_dc", "current"),
        ("plain/line7/n", "speed"),
        ("U_A", "voltage"),
    ],
)
def test_the_symbol_of_a_path_is_that_of_its_last_name(name: str, meaning: str) -> None:
    assert meaning in meanings(name)
    assert meaning not in meanings(f"{name}/temperature")


@pytest.mark.parametrize(("seconds", "text"), [(0.9996, "0.9996 s"), (0.9985, "998 ms"), (1.001, "1.001 s")])
def test_a_period_of_about_a_second_has_no_power_of_ten(seconds: float, text: str) -> None:
    assert duration_text(seconds) == text


class Diverging:
    """Residuals that are finite at the start only."""

    low, high = np.array([-10.0]), np.array([10.0])

    def linearise(self, guess: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return huge residuals away from zero."""
        far = 1e200 if guess[0] else 1.0
        return np.array([far, far]), np.array([[-1.0], [-1.0]])


@pytest.mark.filterwarnings("error")
def test_a_fit_that_diverges_warns_of_nothing() -> None:
    found = gauss_newton(Diverging(), np.zeros(1), 5)
    assert isinstance(found, FitResult)
    assert found.guess[0] == 0.0


HEADING = "time [s];Drehzahl [rpm];Drehmoment [%];Ausgangsfrequenz [Hz];Motorstrom [A]\n"
ROWS = ((at / 10.0, 1000 + 50 * (at // 20 % 3), 50 + at // 20 % 5, 33 + at // 20 % 3, 7 + at % 5) for at in range(200))
PERCENT = HEADING + "".join(";".join(map(str, row)).replace(".", ",") + "\n" for row in ROWS)


def test_a_percentage_of_a_fan_is_asked_for_its_rated_value_and_then_used(tmp_path: Path) -> None:
    """The name of the file says what the machine is; the error has the options that are missing."""
    file, data = tmp_path / "exhaust-fan.toml", tmp_path / "log.csv"
    data.write_text(PERCENT, encoding="utf-8")
    with pytest.raises(ConfigurationError) as caught:
        otolith("init", file, "--csv", data)
    message = str(caught.value)
    assert_says(message, "twin fan", "T_m", "Drehmoment is in %", "rated value")
    options = shlex.split(message.partition("Drehmoment is in %: ")[2].partition(",")[0].replace("FACTOR", "0.48"))
    otolith("init", file, "--csv", data, *options)
    assert tables(file)["signals"]["T_m"] == {"column": "Drehmoment", "scale": 0.48, "unit": "N*m"}
    with raises_saying(ConfigurationError, "T_m from Drehmoment", "--scale", "rated value"):
        otolith("init", file, "--csv", data, "--force", "--twin", "fan", "--signal", "T_m=Drehmoment")


def test_currents_in_percent_are_those_of_an_induction_motor() -> None:
    """Also its flux is named; a fan, which would lack one signal only, has no output frequency and voltage."""
    names = {"speed": "rpm", "torque current": "%", "magnetising current": "%", "output frequency": "Hz",
             "output voltage": "V", "DC link": "V"}  # fmt: skip
    offers = [Offer(name, unit, {}, np.linspace(20.0, 45.0, 30)) for name, unit in names.items()]
    first = rank([find_twin(name) for name in library_twins()], offers)[0]
    assert first.twin.name == "induction_motor"
    found = {signal: offer.name for signal, offer in percentages(first, offers).items()}
    assert (found["i_d"], found["i_q"]) == ("magnetising current", "torque current")


def test_what_is_an_amplitude_is_said_unless_its_scale_was_told(tmp_path: Path) -> None:
    """Converters show effective values, of a voltage those between two phases: 18 % or 41 % beside the amplitude."""
    file, data = tmp_path / "motor.toml", tmp_path / "log.csv"
    rows = ((0.02 * at, 900 + at % 50, 3.0 + at % 3, 4.0, 30 + at % 4, 300 + at % 20) for at in range(300))
    heading = "time [s],speed [rpm],torque current [A],magnetising current [A],output frequency [Hz],output voltage [V]"
    data.write_text("\n".join([heading, *(",".join(map(str, row)) for row in rows), ""]), encoding="utf-8")
    said = otolith("init", file, "--csv", data, "--scale", "output voltage=0.8165").stdout
    remarks = [line for line in said.splitlines() if "amplitude; " in line]
    assert_each_says(remarks, ("magnetising current=1.41421",), ("torque current=1.41421",))
