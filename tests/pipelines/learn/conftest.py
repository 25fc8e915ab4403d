"""Settings of evaluations for one process, one repeat and no extras unless asked for."""

import pytest

from pipelines.learn.crossval import EvaluationSettings


@pytest.fixture(scope="session")
def settings():
    def make(**options):
        if isinstance(options.get("recipe"), str):
            options["recipe"] = (options["recipe"],)
        return EvaluationSettings(**({"repeats": 1, "extras": False, "n_jobs": 1} | options))

    return make
