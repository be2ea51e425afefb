"""Gymnasium's environments and their counterparts here: one policy in both, and energy against time.

``python -m tools.docs.energy`` prints the returns of a task's reference controller in both, and draws
``docs/images/energy-ID.png``. The picture shows the energy minus the control's work since the start, under
random actions. These three systems have no friction, so the difference must stay constant.
"""

from __future__ import annotations

import sys
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from lag_envs.controllers import make_controller
from lag_envs.options import module_parser
from lag_envs.report.episodes import endless_actions
from lag_envs.report.gymnasium_peers import PEERS, record_peer
from lag_envs.scenes.base import Scene
from lag_envs.scenes.derivation import layout_of
from lag_envs.tasks import TASKS

ROOT = Path(__file__).parents[2]
Array = NDArray[np.float64]


def with_peer() -> dict[str, str]:
    """Return Gymnasium's ids by our own."""
    return {env_id: TASKS[env_id].peer for env_id in TASKS if TASKS[env_id].peer}


def returns(env_id: str, agent: Any, episodes: int) -> Array:
    """Return an agent's returns in episodes with the seeds 0, 1, ..., each in a new environment."""
    envs = [gym.make(env_id) for _ in range(episodes)]
    seen = np.array([env.reset(seed=seed)[0] for seed, env in enumerate(envs)])
    total, going, memory = np.zeros(episodes), np.ones(episodes, np.bool_), None
    start = going.copy()
    while going.any():
        actions, memory = agent.predict(seen, memory, start)
        start[:] = False
        for i in np.flatnonzero(going):
            seen[i], reward, terminated, truncated, _ = envs[i].step(actions[i])
            total[i] += float(reward)
            going[i] = not (terminated or truncated)
    return total


def energy_minus_work(scene: Scene, states: Array, controls: Array) -> Array:
    """Return the energy minus the control's work [J] along states (n + 1, n_state) with held controls.

    The control is a constant force or torque on coordinates, independent of the state, so its work in a step
    is that force times the change of the coordinates.
    """
    layout = layout_of(scene)
    places = [layout.state.index(e) for e in layout.state if e.kind == "place"]
    zero, one = (np.array([float(u) for u in _forces(scene, u).values()]) for u in (0.0, 1.0))
    turned = np.diff(states[:, places], axis=0)
    angles = [layout.state[i].unit == "rad" for i in places]
    turned[:, angles] -= 2.0 * np.pi * np.rint(turned[:, angles] / (2.0 * np.pi))  # Gymnasium wraps some
    work = np.sum((zero + controls[:, None] * (one - zero)) * turned, axis=1)
    return scene.energy(states)["total"] - np.concatenate([[0.0], np.cumsum(work)])


def _forces(scene: Any, control: float) -> dict[str, float]:
    """Return the generalised forces of a control, by coordinate."""
    from lag_envs.mechanics.recording import Values

    rest = Values("coordinate", dict.fromkeys(scene.coordinates, 0.0))
    controls = dict.fromkeys((name for mode in scene.modes.values() for name in mode), 0.0)
    controls |= dict.fromkeys(scene.control_names, control)
    given = scene.applied(rest, rest, Values("control", controls), np)
    return {name: given.get(name, 0.0) for name in scene.coordinates}


def paths(env_id: str) -> dict[str, tuple[Array, Array]]:
    """Return times [s] and balances [J] under the same random actions in both, over an episode's length.

    Both start from the same state in mid-motion, and continue past the end of an episode.
    """
    task = TASKS[env_id]()
    peer, original = PEERS[task.peer], gym.make(task.peer, disable_env_checker=True).unwrapped
    original.reset(seed=0)
    start = np.array(task.examples.start["state"], np.float64)
    original.state = start[np.argsort(peer.order)]  # type: ignore[attr-defined]
    actions = endless_actions(original, 0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that the episode is over
        own = record_peer(original, peer, actions, int(task.limit), to_the_end=False)
    exact, controls = task.scene.simulate(start, own.controls, task.dt), np.array(own.controls)
    times = task.dt * np.arange(len(exact))
    found = {task.peer: own.states[:, list(peer.order)], env_id: exact}
    return {name: (times, energy_minus_work(task.scene, y, controls)) for name, y in found.items()}


def energy_figure(env_id: str) -> Any:
    """Return the figure of an environment."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.0, 2.6), layout="constrained")
    axes = figure.subplots()
    styles = ({"color": "#D55E00", "lw": 1.0}, {"color": "#0072B2", "lw": 1.8})
    for (name, (times, energy)), style in zip(paths(env_id).items(), styles, strict=True):
        axes.plot(times, energy, label=name, **style)
    axes.set_xlabel("time [s]", fontsize=8)
    axes.set_ylabel("energy less work [J]", fontsize=8)
    axes.tick_params(labelsize=8)
    axes.grid(color="0.9")
    axes.legend(fontsize=8, frameon=False)
    return figure


def main(arguments: Sequence[str] | None = None) -> int:
    """Print returns, draw pictures."""
    module_parser("tools.docs.energy", __doc__, "examples:\n  python -m tools.docs.energy").parse_args(
        arguments
    )
    from agents.figures import save

    for env_id, peer_id in with_peer().items():
        agent = make_controller(env_id, TASKS[env_id].reference)
        for name in (peer_id, env_id):
            found = returns(name, agent, 100)
            error = found.std(ddof=1) / np.sqrt(len(found))
            print(f"{name:20} {TASKS[env_id].reference:24} {found.mean():10.2f} ± {error:.2f}")
        for name, (_, energy) in paths(env_id).items():
            low, high = energy.min(), energy.max()
            print(f"{name:20} energy less work: {energy[0]:.3f} J at first, {low:.3f} to {high:.3f} J")
        save(energy_figure(env_id), ROOT / "docs" / "images" / f"energy-{env_id}.png")
    return 0


if __name__ == "__main__":
    sys.exit(main())
