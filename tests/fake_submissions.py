"""Submissions that are quick to load and to verify, in place of real ones."""

import hashlib
import json
from pathlib import Path
from types import SimpleNamespace

from lag_envs.leaderboard import alike, protocol, submission, verify
from lag_envs.leaderboard.submission import About, Refused, Submission
from lag_envs.scores import known_returns

ENV = "PivotedBar-v0"
EPISODES = 20


def write(folder, name="PPO", *, env=ENV, authors=("A. Author",), kind="learned", score=0.5, **other):
    """Write a fake submission whose policies get about this score; another text gives other bytes.

    Two with the same text for `acts` act alike.
    """
    folder = Path(folder)
    folder.mkdir(parents=True)
    told = {"env": env, "name": name, "authors": authors, "kind": kind, "score": score, **other}
    (folder / "submission.toml").write_text(json.dumps(told))
    (folder / "policy_0.safetensors").write_bytes(b"numbers")
    return folder


def read_files(folder):
    try:
        return {path.name: path.read_bytes() for path in sorted(Path(folder).iterdir())}
    except OSError as error:
        raise Refused("submission.toml: cannot be read") from error


def digest_of(files):
    return hashlib.sha256(b"".join(name.encode() + content for name, content in files.items())).hexdigest()


def about(files):
    try:
        told = json.loads(files["submission.toml"])
    except (KeyError, ValueError) as error:
        raise Refused("submission.toml: cannot be read") from error
    if "refuse" in told:
        raise Refused(told["refuse"])
    curves = [{"seed": 0, "steps": [0, 1000], "returns": [0.0, 100.0]}]
    return About(
        env=told["env"], name=told["name"], authors=tuple(told["authors"]), license="MIT", kind=told["kind"],
        seeds=tuple(range(5 if told["kind"] == "learned" else 1)),
        architecture=SimpleNamespace(plans=False, module=""),
        digest=digest_of(files),
        code="https://example.org/code",
        training={"env_steps": 1000, "seconds": 2.0, "hardware": "a laptop", "curves": curves},
    )  # fmt: skip


def load(folder):
    told = about(read_files(folder))
    architecture = SimpleNamespace(page_data=lambda arrays: None)
    policies = tuple((seed, SimpleNamespace(architecture=architecture, arrays={})) for seed in told.seeds)
    return Submission(**vars(told), policies=policies, folder=Path(folder))


def told(found):
    return json.loads((found.folder / "submission.toml").read_text())


def played(found, nonce, seed, episodes):
    """Return the verified data of the policy of a seed."""
    known = known_returns(found.env)
    bits = hashlib.sha256((found.digest + nonce).encode()).digest()
    scores = [told(found)["score"] + 0.01 * (bits[(i + seed) % 32] / 255 - 0.5) for i in range(episodes)]
    returns = [known.random + s * (known.best - known.random) for s in scores]
    some = {
        "seed": seed, "returns": returns, "success": [True] * episodes, "settle": [1.5] * episodes,
        "effort": [0.1] * episodes, "trajectory": bits.hex(),
    }  # fmt: skip
    if reference := protocol.reference(found.env):
        some["reference"] = [reference.mean + (-1) ** i for i in range(episodes)]
    return some


def recompute(found, nonce, episodes=EPISODES, progress=None):
    if "fail" in told(found):
        raise MemoryError(told(found)["fail"])
    if "reject" in told(found):
        raise Refused(told(found)["reject"])
    if progress is not None:
        progress(50, 100)
    policies = [played(found, nonce, seed, episodes) for seed in found.seeds]
    mean = [sum(p["returns"]) / episodes for p in policies]
    return {
        "env": found.env, "digest": found.digest, "nonce": nonce, "episodes": episodes,
        "policies": policies, "robustness": {"mass +20 %": mean}, "often": mean, "seconds": 0.1,
        "machine": {}, "versions": {}, "build": "0" * 64,
    }  # fmt: skip


def replay(found, result, policy, chosen):
    everything = played(found, result["nonce"], found.seeds[policy], result["episodes"])
    some = {k: [v[i] for i in chosen] if isinstance(v, list) else v for k, v in everything.items()}
    first = protocol.first_seed(result["digest"], result["nonce"], policy)
    return some, [
        {
            "seed": policy, "reset_seed": first + i, "return": everything["returns"][i], "dt": 0.02,
            "states": [[0.0, 0.0, 0.1, 0.0]] * 3, "actions": [0.0, 1.0], "rewards": [0.5, 0.5],
            "target": None,
        }
        for i in chosen
    ]  # fmt: skip


class Likeness(alike.Likeness):
    def __call__(self, newer, older, error):
        same = told(newer).get("acts", newer.digest) == told(older).get("acts", older.digest)
        return alike.Distance(1e-5, 1e-3) if same else alike.FAR


def install(put=setattr):
    """Replace the real functions; `put` is monkeypatch's setattr in a test."""
    put(protocol, "EPISODES", EPISODES)
    for name in ("read_files", "digest_of", "about", "load"):
        put(submission, name, globals()[name])
    put(verify, "verify", recompute)
    put(verify, "record_again", replay)
    put(alike, "Likeness", Likeness)
    put(alike, "check_twins", lambda found, nonce: None)
