"""Agents for the environments of `lag_envs`: learners, the optimum, and the results of all agents."""

import signal
import sys
import time

#: When the command began [s]: after the interpreter's own start and before libraries are imported.
STARTED = time.perf_counter()

if sys.argv[:1] == ["-m"] and sys.orig_argv[sys.orig_argv.index("-m") + 1].startswith("agents."):
    # While a command imports libraries, Ctrl-C ends it without a traceback; see `agents.run.reports_errors`.
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
