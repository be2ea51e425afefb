"""Exact ends of motions, shared by the processes of a report."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from mpmath import mp, mpf
from numpy.typing import NDArray

from lag_envs.report import closed_forms
from lag_envs.report.oracle import Oracle, agreed, control_list, oracle_of
from lag_envs.scenes.base import Scene
from lag_envs.store import write_file

Array = NDArray[np.float64]
#: Folder in which the exact ends are kept; None keeps nothing.
store: Path | None = None
#: An undamped pendulum that moves through more than about this many radians uses elliptic functions.
FAR = 5.0


def once(oracle: Oracle, state: Sequence[Any], controls: Any, dt: Any, digits: int) -> list[mpf]:
    """Return the state after a time dt, from one computation with this many digits."""
    held = control_list(controls)
    if known := closed_forms.pendulum(oracle, tuple(map(float, held))):
        (_, speed), (alpha, beta) = oracle.start(state, held, float), known
        if float(dt) * (abs(speed[oracle.names.free[0]]) + math.hypot(alpha, beta) ** 0.5) > FAR:
            return closed_forms.closed_form_flow(oracle, known, state, held, dt, digits)
    return oracle.once(state, held, dt, digits)


def exact_flow(scene: Scene, state: Sequence[Any], controls: Any, dt: Any, digits: int = 30) -> list[mpf]:
    """Return the state after a time dt with the controls held.

    The state is computed by the oracle, see `Oracle.once`, or by the closed form for undamped pendulums that
    move far. Two computations of an entry agree to 10**-digits times max(1, abs(entry)).
    """
    oracle = oracle_of(scene)
    return agreed(lambda working: once(oracle, state, controls, dt, working), digits)


def remembered(scene: Scene, state: Sequence[float], controls: Any, dt: float) -> list[mpf]:
    """Return the result of `exact_flow` with 30 digits, from `store` if it is stored there."""
    problem = repr((type(scene), scene, *(float(x).hex() for x in (*state, *control_list(controls), dt))))
    file = store and store / f"{hashlib.sha256(problem.encode()).hexdigest()[:24]}.json"
    with mp.workdps(40):
        if file and file.exists():
            return [mpf(text) for text in json.loads(file.read_text(encoding="utf-8"))]
        found = exact_flow(scene, state, controls, dt)
        if file:
            write_file(file, json.dumps([mp.nstr(x, 40) for x in found]))
        return found


def exact_ends(scene: Scene, states: Array, controls: Array, dt: float) -> tuple[Array, Array]:
    """Return the exact ends of control steps in two parts, whose sum has twice the digits of a float.

    Parameters
    ----------
    scene : Scene
        The scene.
    states : ndarray, shape (n, n_state)
        Starts.
    controls : ndarray, shape (n, n_controls)
        Controls.
    dt : float
        Length of the step [s].
    """
    found = [remembered(scene, y, u, dt) for y, u in zip(states.tolist(), controls.tolist(), strict=True)]
    high = np.array(found, dtype=np.float64).reshape(states.shape)
    return high, -np.array(
        [state_differences(y, exact) for y, exact in zip(high, found, strict=True)]
    ).reshape(high.shape)


def state_differences(states: Sequence[float] | Array, exact: Sequence[mpf]) -> list[float]:
    """Return the differences of a float64 state from the exact one."""
    with mp.workdps(40):
        return [float(mpf(float(a)) - b) for a, b in zip(states, exact, strict=True)]
