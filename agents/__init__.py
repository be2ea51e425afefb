"""Agents for the environments of `lag_envs`: learners, the optimum, and what all agents reach."""

import time

#: When the command began, but for the interpreter's own start [s]; libraries are imported later.
STARTED = time.perf_counter()
