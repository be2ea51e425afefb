"""The process that measures, on its own cores."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import warnings
from dataclasses import asdict
from typing import Any

from lag_envs.benchmark.measurement import BenchmarkSettings, bench
from lag_envs.host import ONE_THREAD


def in_own_process(settings: BenchmarkSettings) -> int:
    """Run `bench` in a separate process, on as many cores as it has threads; return its exit status."""
    command = [sys.executable, "-P", "-m", "lag_envs.benchmark.process", json.dumps(asdict(settings))]
    child = subprocess.Popen(command, env=os.environ | ONE_THREAD)

    def pass_on(*_: Any) -> None:
        if os.name == "posix":  # on Windows, the terminal signals the child itself
            child.send_signal(signal.SIGINT)

    before = {number: signal.signal(number, pass_on) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        return child.wait()
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _break_off(*_: Any) -> None:
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: None)  # the results still have to be written
    raise KeyboardInterrupt


def main() -> int:
    """Measure with the settings from the command line."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, _break_off)
    warnings.simplefilter("ignore")  # from the peers
    settings = BenchmarkSettings(**json.loads(sys.argv[1]))
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[-settings.threads :])
    report = bench(settings)
    return 0 if report["complete"] else 130


if __name__ == "__main__":
    sys.exit(main())
