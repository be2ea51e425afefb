"""A board's page data, with made-up scores and real episodes, for tests and for looking at the page.

``python -m tests.board_pages FOLDER`` writes its page.
"""

import math
import sys
from functools import cache
from pathlib import Path

import gymnasium as gym
import numpy as np

import lag_envs  # noqa: F401
from lag_envs.scores import known_returns
from lag_envs.tasks import TASKS, cylinder_in_cylinder, incline, pivoted_bar

#: Names and texts that a page must show as they are.
HOSTILE = (
    "</script><script>window.hacked = 1</script>",
    "<img src=x onerror='window.hacked = 1'>",
    '" onmouseover="window.hacked = 1" x=\'',
    "{{ 7 * 7 }}{% raw %}${window.hacked = 1}`",
    "<!--<script>\u2028\u2029\u202eevil\u0000",
    "javascript:window.hacked=1",
    "Ω" * 300,
    "constructor",
)
AGENTS = (
    ("Value iteration, 81 nodes", "optimal", 1.0), ("iLQR", "controller", 0.996), ("PPO", "learned", 0.981),
    ("TQC", "learned", 0.978), ("SAC", "learned", 0.952), ("Energy pumping + LQR", "controller", 0.913),
    ("TD3", "learned", 0.86), ("A2C", "learned", 0.61), ("DQN, 11 bins", "learned", 0.47),
    ("PD", "controller", 0.12),
)  # fmt: skip


COMBINED = {
    "name": "PPO",
    "authors": ["A. Author"],
    "kind": "learned",
    "score": 0.7,
    "interval": [0.65, 0.75],
    "boards": 2,
    "of": 3,
    "there": 0.9,
    "profile": [[0.5, 2 / 3], [0.9, 1 / 3], [0.99, 0.0]],
}


@cache
def replay(env_id, seed):
    """Return an episode of a slowly varying random policy, in the form of the page's data."""
    env = gym.make(env_id)
    env.reset(seed=seed)
    rng, action, done = np.random.default_rng(seed), 0.0, False
    found = {
        "seed": seed % 5,
        "label": ["median", "best", "worst"][seed % 10],
        "dt": env.unwrapped.task.dt,
        "t0": 0.0,
        "target": env.unwrapped.target,
    }
    found |= {"states": [env.unwrapped.state.round(5).tolist()], "actions": [], "rewards": []}
    while not done:
        action = float(np.clip(0.9 * action + 0.35 * rng.normal(), -1.0, 1.0))
        _, reward, terminated, truncated, _ = env.step(np.array([action], np.float32))
        done = terminated or truncated
        found["states"].append(env.unwrapped.state.round(5).tolist())
        found["actions"].append(round(action, 5))
        found["rewards"].append(round(float(reward), 5))
    env.close()
    total = sum(found["rewards"])
    known = known_returns(env_id)
    return found | {"return": total, "score": (total - known.random) / (known.best - known.random)}


def row(env_id, i, name, kind, score):
    rng = np.random.default_rng(i)
    known, spread = known_returns(env_id), 0.002 + 0.05 * (1.0 - score)
    learned = kind == "learned"
    steps = np.linspace(0, 400_000, 41)
    rise = 60_000 * (1.3 - score)
    taus = np.linspace(-0.2, 1.1, 66)
    return {
        "id": f"{env_id}-{i:08x}", "rank": [1, 1, 3, 3, 5, 6, 7, 8, 9, 10][i % 10],
        "name": name, "kind": kind, "authors": ["Ada Example", "B. Example"],
        "code": "https://example.org/code", "license": "MIT",
        "score": score, "interval": [score - 2 * spread, min(score + spread, 1.004)],
        "return": known.random + score * (known.best - known.random), "gap": max(0.0, 1.0 - score + 0.003),
        "success": {"rate": min(1.0, score), "low": max(0.0, score - 0.02), "high": min(1.0, score + 0.01)},
        "settle": 1.2 + 4 * (1 - score) if score > 0.3 else None, "effort": 0.08 + 0.3 * rng.random(),
        "env_steps": 400_000 * (1 + i % 3) if learned else None,
        "seconds": 95.0 * (i + 1) if learned else None,
        "robustness": {"mass +20 %": score - 0.03, "damping -20 %": score - 0.01} if i % 4 else {},
        "hardware": "2 cores", "above": [0.7, 0.4, 0.9] if i else None,
        "often": score - 0.01 if i % 3 else None, "state": "verified",
        "description": "Two layers of 64, tanh." if learned else None,
        "profile": [[round(t, 3), round(1 / (1 + math.exp(40 * (t - score))), 4)] for t in taus.tolist()],
        "curves": [
            {"seed": seed, "steps": steps.tolist(),
             "scores": (score * (1 - np.exp(-steps / rise)) + 0.02 * rng.normal(size=41)).round(4).tolist()}
            for seed in range(3)
        ] if learned else [],
        "replays": [replay(env_id, 10 * (i % 3) + j) for j in range(2)],
    }  # fmt: skip


def value():
    """Return an energy as the value function of a pendulum."""
    theta, speed = np.linspace(-math.pi, math.pi, 41), np.linspace(-12, 12, 41)
    energy = 0.5 * speed[None, :] ** 2 - 36 * (1 + np.cos(theta[:, None])) * 0.5
    axes = [
        {"label": "theta", "low": -math.pi, "high": math.pi, "n": 41},
        {"label": "theta_dot", "low": -12.0, "high": 12.0, "n": 41},
    ]
    return {"axes": axes, "values": (-np.abs(energy)).round(2).tolist()}


def data(env_ids=("PivotedBar-v0", incline.Brake.id, cylinder_in_cylinder.Tilt.id), agents=AGENTS):
    """Return data like that of `board_data`, for environments of all three scenes."""
    boards = [
        {
            "id": env_id,
            "known": (known := known_returns(env_id)) and known._asdict(),
            "value": value() if issubclass(TASKS[env_id], pivoted_bar.SwingUp) else None,
            "rows": [row(env_id, i, *agent) for i, agent in enumerate(agents)],
            "other": [
                {
                    "id": "x-1",
                    "name": "Quick hack",
                    "state": "rejected",
                    "reason": "policy_0: NaN in layer 1",
                },
                {"id": "x-2", "name": "SAC, long run", "state": "pending", "reason": None},
            ],
        }
        for env_id in env_ids
    ]
    return {"protocol": 1, "made": "2026-11-21", "environments": boards, "combined": [COMBINED]}


def hostile():
    """Return a page's data in which every text is hostile."""
    found = data(("PivotedBar-v0",), [(n, "learned", 0.9 - 0.1 * i) for i, n in enumerate(HOSTILE)])
    for board in found["environments"]:
        for row, text in zip(board["rows"], HOSTILE, strict=True):
            row |= dict.fromkeys(("description", "license", "hardware", "code", "id"), text) | {
                "authors": [text]
            }
            row["robustness"] = {text: 0.5}
            row["replays"][0] = row["replays"][0] | {"label": text}
        board["rows"][0]["kind"] = HOSTILE[2]
        board["other"] = [{"id": t, "name": t, "state": "rejected", "reason": t} for t in HOSTILE]
    return found


def clean(text):
    return text.replace("\0", "\ufffd")


if __name__ == "__main__":
    from lag_envs.leaderboard.site.build import write_page

    write_page(data(), Path(sys.argv[1]))
