"""A robot with a truth that its description does not know, and runs of it on tiles."""

import pytest
from studies.intervals import HIDDEN, NOMINAL, drive_hidden


@pytest.fixture(scope="session")
def nominal():
    return NOMINAL


@pytest.fixture(scope="session")
def hidden():
    return HIDDEN


@pytest.fixture(scope="session")
def drive():
    return drive_hidden


@pytest.fixture(scope="session")
def truth():
    """Return the hidden truth of a parameter: ``truth("steering.zero_1_rad")``."""
    return lambda parameter: getattr(getattr(HIDDEN, parameter.split(".")[0]), parameter.split(".")[-1])
