"""Agents for the environments of `lag_envs`: learners, the optimum, and the results of all agents."""

import time

#: When the command began [s]: after the interpreter's own start and before libraries are imported.
STARTED = time.perf_counter()
