"""The registry of drivers."""

import pytest

from otolith_drivers import registry
from otolith_drivers.errors import ConfigurationError


def test_unknown_driver_is_refused_with_the_nearest_name() -> None:
    with pytest.raises(ConfigurationError, match="did you mean 'can'"):
        registry.find("cam")
