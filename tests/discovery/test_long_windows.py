"""Windows of many records: filter and hypotheses are compared on all of them."""

from dataclasses import replace

import numpy as np

from otolith.discovery.screening import screen_window
from otolith.discovery.sequential_test import continue_test, open_test
from otolith.estimation.evidence import DECISIVE
from otolith.estimation.window_fit import estimate_window
from tests.discovery.test_experiment_design import CURRENT, PERIOD, SPEED, STEADY, steady, window


def test_the_filter_of_long_windows_is_compared_on_the_records_of_the_hypotheses() -> None:
    """Windows in which nothing happens are no evidence against it, however many records they have."""
    records, state = 6000, steady(3)[0]
    test, posterior = None, state.posterior
    for index in range(3):
        inputs = np.tile(STEADY, (records, 1))
        inputs[:, 0] += np.repeat(np.random.default_rng(index).uniform(-2.0, 2.0, records // 50), 50)
        healthy = replace(window(3, inputs, np.array([CURRENT, SPEED])), start=6.0 + records * PERIOD * index)
        predicted = posterior.predict(healthy)
        estimated = estimate_window(predicted, healthy)
        screening = screen_window(predicted, estimated, determined=True)
        if test is None:
            test = open_test(predicted, replace(screening, gain=1.0))
        else:
            test = continue_test(test, predicted, screening).with_filter(estimated.fit)
            assert not test.filter_evidence.is_against
            assert abs(test.filter_evidence.deviance) < DECISIVE
        posterior = predicted.update(predicted.innovation(estimated.evidence), estimated.advance)
