"""A service that listens, on a small model."""

import pytest

from pipelines.learn.model_file import write_model
from pipelines.serve.hub import Limits
from terrain.control.slip_table import load_slip_table

from .strangers import running


@pytest.fixture(scope="session")
def model_folder(mower_model, tmp_path_factory):
    folder = tmp_path_factory.mktemp("model")
    write_model(folder, mower_model)
    return folder


@pytest.fixture(scope="session")
def service(model_folder):
    """A service that many tests use; each has sessions of its own name."""
    with running(model=str(model_folder)) as found:
        yield found


@pytest.fixture(scope="session")
def driving(model_folder):
    """A service without a model, which gives commands to robots of any channels."""
    limits = Limits()._replace(hello_s=1.0, too_slow_s=0.6)
    with running(limits, model=str(model_folder)) as found:
        found.hub.swap(None, "", load_slip_table())
        yield found
