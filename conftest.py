"""Options of the test command, and fixtures for the tests and the doctests of src and docs."""

import gc
import signal
import sys

import gymnasium as gym
import pytest
from browsers import browser, browsing  # noqa: F401 (fixtures)

import lag_envs  # noqa: F401 (registers its environments before any test)

# Numba makes many objects and hardly any cycles: searching for these takes a tenth of its time.
gc.freeze()
gc.set_threshold(100_000, 50, 50)

# A shell that starts the tests in the background makes them, and their children, ignore Ctrl-C.
signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(autouse=True)
def registered_before():
    """Leave Gymnasium's registry as it was, and forget the example, so that its next import registers it."""
    before = dict(gym.registry)
    yield
    gym.registry.clear()
    gym.registry.update(before)
    sys.modules.pop("ball_on_beam", None)


def pytest_addoption(parser):
    parser.addoption("--no-skips", action="store_true", help="count a test that is skipped as failed")


def _fail(report, config):
    """Turn a skip into a failure, if requested; except for GPUs, which few machines have."""
    allowed = hasattr(report, "wasxfail") or "gpu" in getattr(report, "keywords", ())
    if report.skipped and config.getoption("--no-skips") and not allowed:
        report.outcome = "failed"
        report.longrepr = f"{report.nodeid} must not be skipped here: {report.longrepr[-1]}"
    return report


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item):
    return _fail((yield), item.config)


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report(collector):
    return _fail((yield), collector.config)
