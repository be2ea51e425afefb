"""The core stands alone: its dependencies, and the modules that importing it loads."""

import json
import os
import re
import subprocess
import sys
import venv
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
OPTIONAL = ["matplotlib", "mpmath", "pygame", "scipy", "sympy", "torch"]

STEP = """
import gymnasium as gym
import lag_envs

env = gym.make("PivotedBar-v0")
env.reset(seed=1)
for _ in range(3):
    observation, *_ = env.step(env.action_space.sample())
assert env.observation_space.contains(observation)

vec = gym.make_vec("PivotedBar-v0", num_envs=3)
vec.reset(seed=1)
observations, *_ = vec.step(vec.action_space.sample())
assert vec.observation_space.contains(observations)
"""
LOADED = f"""
import json, sys
print(json.dumps([name for name in {OPTIONAL} if name in sys.modules]))
"""
INSTALLED = f"""
import importlib.util, json
print(json.dumps([name for name in {OPTIONAL} if importlib.util.find_spec(name)]))
"""
#: The example by its module's name: native vectors equal freshly started workers.
OWN = """
import json
import gymnasium as gym
import numpy as np

if __name__ == "__main__":
    id = "ball_on_beam:BallOnBeam-v0"
    native = gym.make_vec(id, num_envs=2)
    workers = gym.make_vec(
        id, num_envs=2, vectorization_mode="async", vector_kwargs={"context": "spawn"}
    )
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (20, 2, 1)).astype(np.float32)
    seen = []
    for envs in (native, workers):
        observations = [envs.reset(seed=3)[0]]
        for action in actions:
            observations.append(envs.step(action)[0])
        seen.append(np.array(observations))
    workers.close()
    single = gym.make(id)
    start, _ = single.reset(seed=3)
    print(json.dumps([bool(np.array_equal(*seen)), bool(np.array_equal(start, seen[0][0, 0]))]))
"""


def run(*command, cwd):
    """Run a command outside the repository and return what it printed."""
    done = subprocess.run([*map(str, command)], cwd=cwd, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, f"{command[0]} failed ({done.returncode}):\n{done.stdout}\n{done.stderr}"
    return done.stdout


# Numba looks for SciPy when it is imported, so a step may load it, but importing the package may not.
@pytest.mark.parametrize(
    ("script", "allowed"), [("import lag_envs", set()), (STEP, {"scipy"})], ids=["import", "step"]
)
def test_optional_packages_are_not_loaded(script, allowed, tmp_path):
    loaded = json.loads(run(sys.executable, "-W", "error", "-c", script + LOADED, cwd=tmp_path))
    assert set(loaded) <= allowed


@pytest.mark.slow
def test_core_alone_can_be_installed_and_stepped(tmp_path):
    home = tmp_path / "venv"
    venv.create(home)  # without pip, which takes seconds to install: the outer one installs into it
    python = home / ("Scripts" if sys.platform == "win32" else "bin") / "python"
    pip = [sys.executable, "-m", "pip", "--python", python, "--disable-pip-version-check"]
    try:
        run(*pip, "install", "--quiet", "-c", ROOT / "constraints.txt", ROOT, cwd=tmp_path)
    except AssertionError as failure:
        needs = "a package index, or to be told where wheels of the core's dependencies and of hatchling are"
        pytest.fail(f"pip could not install the core into a fresh environment; it needs {needs}.\n{failure}")

    # -I keeps the surrounding environment's PYTHONPATH out.
    assert json.loads(run(python, "-I", "-W", "error", "-c", STEP + INSTALLED, cwd=tmp_path)) == []
    assert "bench" in run(python.with_name("lag-envs"), "--help", cwd=tmp_path)
    # A file of one's own makes an environment, also in spawned worker processes.
    example = (ROOT / "examples" / "ball_on_beam.py").read_text(encoding="utf-8")
    (tmp_path / "ball_on_beam.py").write_text(example, encoding="utf-8")
    (tmp_path / "use_it.py").write_text(OWN, encoding="utf-8")
    assert json.loads(run(python, "use_it.py", cwd=tmp_path)) == [True, True]
    # Parts for other libraries are in the wheel, and state their requirements.
    assert "lag_envs.sb3.ScaledReward" in run(
        python.with_name("lag-envs"), "hyperparams", "ppo", cwd=tmp_path
    )
    for module, extra in (("lag_envs.sb3", "agents"), ("lag_envs.zoo", "zoo")):
        with pytest.raises(AssertionError, match=rf'pip install "lag-envs\[{extra}\]"'):
            run(python, "-I", "-m", module, "enjoy", cwd=tmp_path)


def test_one_distribution_brings_pygame():
    """Gymnasium asks for pygame-ce; pygame beside it would overwrite half of its files."""
    assert packages_distributions()["pygame"] == ["pygame-ce"]


@pytest.mark.slow
def test_no_skips_fails_what_is_skipped(tmp_path):
    """The basis of `make test-slow`: nothing is skipped silently."""
    (tmp_path / "test_it.py").write_text(
        "import pytest\n\ndef test_a(): pytest.skip('a')\n\n"
        "@pytest.mark.skipif(True, reason='b')\ndef test_b(): pass\n\ndef test_c(): pass\n"
    )
    (tmp_path / "test_other.py").write_text("import pytest\n\npytest.importorskip('no_such_module')\n")

    def outcome(*options):
        command = [sys.executable, "-m", "pytest", "-q", "-p", "conftest", "-c", os.devnull, *options]
        path = {"PYTHONPATH": os.pathsep.join([str(ROOT), str(ROOT / "tests")])}
        done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, env=os.environ | path)
        return done.stdout

    assert "1 passed, 3 skipped" in outcome()
    assert "1 failed, 1 passed, 2 errors" in outcome("--no-skips", "--continue-on-collection-errors")


@pytest.mark.slow
@pytest.mark.parametrize(
    "version", re.findall(r":: Python :: (3\.\d+)", (ROOT / "pyproject.toml").read_text()), ids=str
)
def test_every_dependency_has_wheels(version, tmp_path):
    """For each Python that we name; rliable is pure Python and has no wheel for any."""
    pins = [p for p in (ROOT / "constraints.txt").read_text().split() if "==" in p and "rliable" not in p]
    options = ["--only-binary=:all:", "--no-deps", "--target", tmp_path, "--python-version", version]
    run(sys.executable, "-m", "pip", "install", "--dry-run", "--quiet", *options, *pins, cwd=tmp_path)
