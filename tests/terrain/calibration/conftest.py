"""A robot with a truth that its description does not know, and runs of it on tiles."""

import pytest
from studies.intervals import HIDDEN, NOMINAL, drive_hidden


@pytest.fixture(scope="session")
def nominal():
    """The description that a calibration starts from."""
    return NOMINAL


@pytest.fixture(scope="session")
def hidden():
    """The robot that was driven."""
    return HIDDEN


@pytest.fixture(scope="session")
def drive():
    """Return a maker of runs of the hidden robot: ``drive(scenario, seed, ...)``."""
    return drive_hidden


@pytest.fixture(scope="session")
def truth():
    """Return a function that tells the hidden truth of a parameter."""

    def of(parameter):
        section, _, name = parameter.partition(".")
        return getattr(getattr(HIDDEN, section), name)

    return of
