from functools import cache

import pytest

from pipelines.data.datasets import load_runs


@pytest.fixture(scope="session")
def measured_runs(measured):
    """Return a function that gives the runs of a folder of measured logs, each read once."""

    @cache
    def read(folder, robot=None):
        return load_runs(measured(folder), robot=robot)

    return read
