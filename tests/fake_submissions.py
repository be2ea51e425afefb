"""Submissions that are quick to load and to verify, in place of real ones."""

import hashlib
import json
from pathlib import Path

from lag_envs.leaderboard import submission, verify
from lag_envs.leaderboard.protocol import PROTOCOL
from lag_envs.leaderboard.submission import Refused, Submission
from lag_envs.scores import KNOWN_RETURNS

ENV = "PivotedBar-v0"


def write(folder, name="PPO", *, env=ENV, authors=("A. Author",), kind="learned", score=0.5, **other):
    """Write a fake submission whose policies get about this score; other text makes other bytes."""
    folder = Path(folder)
    folder.mkdir(parents=True)
    told = {"env": env, "name": name, "authors": authors, "kind": kind, "score": score, **other}
    (folder / "submission.toml").write_text(json.dumps(told))
    (folder / "policy_0.safetensors").write_bytes(b"numbers")
    return folder


def load(folder):
    folder = Path(folder)
    try:
        files = sorted(folder.iterdir())
        told = json.loads((folder / "submission.toml").read_text())
    except (OSError, ValueError) as error:
        raise Refused("submission.toml: cannot be read") from error
    if "refuse" in told:
        raise Refused(told["refuse"])
    digest = hashlib.sha256(b"".join(path.name.encode() + path.read_bytes() for path in files)).hexdigest()
    curves = [{"seed": 0, "steps": [0, 1000], "returns": [0.0, 100.0]}]
    return Submission(
        env=told["env"], name=told["name"], authors=tuple(told["authors"]), license="MIT", kind=told["kind"],
        policies=((0, None),), digest=digest, folder=folder, code="https://example.org/code",
        training={"env_steps": 1000, "seconds": 2.0, "hardware": "a laptop", "curves": curves},
    )  # fmt: skip


def recompute(found, nonce, episodes=20, progress=None):
    told = json.loads((found.folder / "submission.toml").read_text())
    if "fail" in told:
        raise MemoryError(told["fail"])
    if "reject" in told:
        raise Refused(told["reject"])
    if progress is not None:
        progress(50, 100)
    known = KNOWN_RETURNS[found.env]
    bits = hashlib.sha256((found.digest + nonce).encode()).digest()
    seeds = range(5) if found.kind == "learned" else range(1)
    policies = []
    for seed in seeds:
        scores = [told["score"] + 0.01 * (bits[(i + seed) % 32] / 255 - 0.5) for i in range(episodes)]
        policies.append(
            {
                "seed": seed,
                "returns": [known.random + s * (known.best - known.random) for s in scores],
                "success": [True] * episodes, "settle": [1.5] * episodes, "effort": [0.1] * episodes,
                "trajectory": bits.hex(),
            }
        )  # fmt: skip
    mean = [sum(p["returns"]) / episodes for p in policies]
    return {
        "protocol": PROTOCOL, "env": found.env, "digest": found.digest, "nonce": nonce, "episodes": episodes,
        "policies": policies, "robustness": {"mass +20 %": mean}, "often": mean, "seconds": 0.1,
        "machine": {}, "versions": {},
    }  # fmt: skip


def episode(found, policy, seed):
    return {
        "seed": policy, "reset_seed": seed, "return": 100.0, "dt": 0.02, "states": [[0.0, 0.0, 0.1, 0.0]] * 3,
        "actions": [0.0, 1.0], "rewards": [0.5, 0.5], "target": None,
    }  # fmt: skip


def install(put=setattr):
    """Take the place of the real ones; `put` is monkeypatch's setattr in a test."""
    put(submission, "load", load)
    put(verify, "verify", recompute)
    put(verify, "episode", episode)
