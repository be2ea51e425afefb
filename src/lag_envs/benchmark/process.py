"""The separate process in which the measurement runs, on its own cores."""

from __future__ import annotations

import json
import os
import sys
import tempfile
import warnings
from dataclasses import asdict

from lag_envs.benchmark.measurement import BenchmarkSettings, bench
from lag_envs.errors import run_shown
from lag_envs.host import ONE_THREAD
from lag_envs.own_files import see_current_folder
from lag_envs.workers import obey_parent, run_stoppable


def in_own_process(settings: BenchmarkSettings) -> int:
    """Run `bench` in a separate process, on as many cores as it has threads; return its exit status."""
    command = [sys.executable, "-P", "-m", "lag_envs.benchmark.process", json.dumps(asdict(settings))]
    # Its temporary files are removed even if it is killed.
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        return run_stoppable(command, os.environ | ONE_THREAD | {"TMPDIR": folder})


def main() -> int:
    """Measure with the settings from the command line."""
    obey_parent()
    warnings.simplefilter("ignore")  # from the peers
    see_current_folder()
    settings = BenchmarkSettings(**json.loads(sys.argv[1]))
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[-settings.threads :])
    return 0 if bench(settings)["complete"] else 130


if __name__ == "__main__":
    sys.exit(run_shown("lag-envs", main))
