"""Agents for the environments of `lag_envs`: learners, the optimum, and the results of all agents."""

import time

#: When the command began, after the interpreter's own start [s]; libraries are imported later.
STARTED = time.perf_counter()
