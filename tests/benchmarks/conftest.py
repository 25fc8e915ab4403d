"""Benchmarks count as slow tests: without ``--benchmark-enable`` the test command of README leaves them out."""

from pathlib import Path

import pytest

HERE = Path(__file__).parent


def pytest_ignore_collect(collection_path, config):
    """Do not even import them, or what they are compared with, where slow tests are left out."""
    left_out = config.getoption("markexpr") == "not slow" and not config.getoption("benchmark_enable")
    return True if left_out and collection_path != HERE else None


def pytest_collection_modifyitems(config, items):
    """Mark them, unless they are asked for."""
    if config.getoption("benchmark_enable"):
        return
    for item in items:
        if HERE in item.path.parents:
            item.add_marker(pytest.mark.slow)
