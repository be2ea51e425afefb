"""Train PPO on an environment, compare it with a controller, and leave model, learning curve and video.

``python -m agents.demo --help`` tells more.
"""

from __future__ import annotations

import argparse
import difflib
import json
import os
import platform
import shlex
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from agents.evaluate import KNOWN_RETURNS, evaluate, evaluate_batch, score
from lag_envs import TASKS, __version__
from lag_envs.tasks import load_task

DEFAULT_FOLDER = Path("runs/demo")
EPISODES = 20
#: Seed of the first episode that agents are compared on. Training never comes near it.
FIRST_FRESH_SEED = 1_000_000_000
#: Seed of the first episode that the policy is tested on while it is trained, for the learning curve.
FIRST_TEST_SEED = 2_000_000_000

#: Steps to train for, and seconds of an episode in training; None for the task's own. Half as long an episode
#: shows twice as often how the bar is swung up; the evaluation has it held for all of the time.
RECIPES = {"PivotedBar-v0": (500_000, 5.0), "PivotedBarFree-v0": (500_000, 5.0)}
DEFAULT_RECIPE = (400_000, None)

ENVS = 64
#: Returns of some hundred are more than the value network learns quickly.
REWARD_FACTOR = 0.1
FILES = """what is left in the output folder:
  model.zip            the policy: stable_baselines3.PPO.load reads it
  learning_curve.png   returns while training, beside the controller and the random policy
  episode.mp4          one fresh episode of the trained policy
  results.json         returns, scores, seeds, times and versions
  run.json             the settings and the learning curve's numbers; needed to resume
  tensorboard/         for `tensorboard --logdir FOLDER`

Ctrl-C or SIGTERM ends the training early and saves what was learned; go on with --resume.

examples:
  python -m agents.demo                                  train on PivotedBar-v0, in about a minute
  python -m agents.demo --resume                         go on, or evaluate again
  python -m agents.demo --new --seed 7                   anew, with other random numbers
  python -m agents.demo --env InclineTilt-v0 --output runs/incline"""


class UserError(Exception):
    """A mistake of the user's; its text is shown, without a traceback."""


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    p = argparse.ArgumentParser(
        prog="python -m agents.demo",
        description="Train PPO on an environment and evaluate it over 20 fresh episodes beside others.",
        epilog=FILES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    p.add_argument("--env", metavar="ID", help="environment to train on (default PivotedBar-v0)")
    p.add_argument("--seed", type=int, help="seed of training (default 0)")
    p.add_argument("--steps", type=int, help="environment steps to train for, in all")
    p.add_argument(
        "--output", type=Path, default=DEFAULT_FOLDER, metavar="FOLDER", help="default %(default)s"
    )
    again = p.add_mutually_exclusive_group()
    again.add_argument("--resume", action="store_true", help="go on with the run in the output folder")
    again.add_argument(
        "--new", action="store_true", help="start anew, overwriting the run in the output folder"
    )
    p.add_argument("--no-video", action="store_true", help="make no video")
    return p


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return 0, 2 for a mistake of the user's, 128 + signal when interrupted."""
    args = parser().parse_args(arguments)
    with Stop() as stop:
        try:
            return work(open_run(args), stop, video=not args.no_video)
        except UserError as error:
            print(f"agents.demo: error: {error}", file=sys.stderr)
            return 2
        except KeyboardInterrupt:
            print("\nInterrupted.", file=sys.stderr)
            return 128 + stop.signal


class Stop:
    """Ctrl-C and SIGTERM: the first one during training asks it to end, any other one interrupts at once."""

    def __init__(self) -> None:
        self.signal = 0
        self.gently = False

    def __enter__(self) -> Stop:
        """Listen to the signals."""
        self._before = {
            number: signal.signal(number, self._handle) for number in (signal.SIGINT, signal.SIGTERM)
        }
        return self

    def __exit__(self, *_: object) -> None:
        """Leave the signals to whom they went before."""
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _handle(self, number: int, frame: Any) -> None:
        again, self.signal = self.signal, number
        if again or not self.gently:
            raise KeyboardInterrupt


# --- the run in its folder ----------------------------------------------------------------------------------


class Run:
    """A run's folder, settings and progress.

    Parameters
    ----------
    folder : Path
        Where everything of the run lies.
    env, seed, steps : str, int, int
        The settings.
    """

    def __init__(self, folder: Path, env: str, seed: int, steps: int) -> None:
        self.folder, self.env, self.seed, self.steps = folder, env, seed, steps
        self.trained = 0
        self.seconds = 0.0
        #: Steps so far, seconds so far, mean return of the policy then.
        self.curve: list[tuple[int, float, float]] = []
        self.evaluated = False

    @property
    def model_file(self) -> Path:
        """Where the model is kept."""
        return self.folder / "model.zip"

    def save(self, model: Any = None) -> None:
        """Write the run, and the model if there is one; files are replaced whole, never half written."""
        self.folder.mkdir(parents=True, exist_ok=True)
        if model is not None:
            part = self.folder / "model.part.zip"
            model.save(part)
            os.replace(part, self.model_file)
        part = self.folder / "run.part.json"
        part.write_text(json.dumps({k: v for k, v in vars(self).items() if k != "folder"}) + "\n")
        os.replace(part, self.folder / "run.json")

    @classmethod
    def load(cls, folder: Path) -> Run:
        """Read a run; raises UserError if its files cannot be read."""
        file = folder / "run.json"
        try:
            content = json.loads(file.read_text())
            run = cls(folder, content["env"], content["seed"], content["steps"])
            if set(content) != set(vars(run)) - {"folder"} or run.env not in TASKS:
                raise ValueError("it was not written by this version")
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise UserError(f"{file} cannot be read ({error}); --new starts anew") from error
        vars(run).update(content)
        return run

    def command(self, *more: str) -> str:
        """Return a command that takes this run up again."""
        python = Path(sys.executable)
        if python.is_relative_to(Path.cwd()):
            python = python.relative_to(Path.cwd())
        output = [] if self.folder == DEFAULT_FOLDER else ["--output", str(self.folder)]
        return shlex.join([str(python), "-m", "agents.demo", *more, *output])


def open_run(args: argparse.Namespace) -> Run:
    """Return the run that the arguments ask for, or raise a UserError."""
    if args.env is not None and args.env not in TASKS:
        names = {name.lower(): name for name in TASKS}
        close = [names[c] for c in difflib.get_close_matches(args.env.lower(), names, n=3, cutoff=0.5)]
        hint = f"did you mean {' or '.join(close)}?" if close else f"there are {', '.join(TASKS)}"
        raise UserError(f"there is no environment {args.env!r}; {hint}")
    if args.seed is not None and not 0 <= args.seed < 2**31:
        raise UserError(f"--seed must lie between 0 and 2147483647, got {args.seed}")
    if args.steps is not None and args.steps < 1:
        raise UserError(f"--steps must be at least 1, got {args.steps}")
    if args.output.exists() and not args.output.is_dir():
        raise UserError(f"--output must be a folder, {args.output} is not")
    if (args.output / "run.json").exists() and not args.new:
        old = Run.load(args.output)
        if not args.resume:
            resuming = "evaluates it again" if old.evaluated else "goes on with it"
            raise UserError(
                f"{args.output} holds a run on {old.env}, {_progress(old)}.\n"
                f"  {old.command('--resume')}    {resuming}\n"
                f"  {old.command('--new')}    overwrites it"
            )
        for name in ("env", "seed"):
            if getattr(args, name) not in (None, getattr(old, name)):
                raise UserError(
                    f"the run in {args.output} has {name} {getattr(old, name)}; another one needs --new"
                )
        old.steps = args.steps or old.steps
        return old
    if args.resume:
        raise UserError(f"there is no run in {args.output} to resume")
    if args.output.exists() and any(args.output.iterdir()) and not args.new:
        raise UserError(
            f"{args.output} holds files but no run; choose another --output, or use it with --new"
        )
    for name in ("model.zip", "learning_curve.png", "episode.mp4", "results.json", "run.json"):
        (args.output / name).unlink(missing_ok=True)
    shutil.rmtree(args.output / "tensorboard", ignore_errors=True)
    env = args.env or "PivotedBar-v0"
    return Run(args.output, env, args.seed or 0, args.steps or RECIPES.get(env, DEFAULT_RECIPE)[0])


def _progress(run: Run) -> str:
    state = "evaluated" if run.evaluated else "finished" if run.trained >= run.steps else "unfinished"
    return f"seed {run.seed}: {run.trained:,} of {run.steps:,} steps trained, {state}"


def work(run: Run, stop: Stop, video: bool) -> int:
    """Train as far as the run has not been trained, then evaluate."""
    print(f"{run.env}, {_progress(run)}; results go to {run.folder}/", flush=True)
    print("Loading PyTorch and compiling the environment (kept for the next time) ...", flush=True)
    with gym.make(run.env) as env:
        env.reset(seed=0)
        env.step(env.action_space.sample())
    model = make_model(run)
    if run.trained < run.steps:
        train(model, run, stop)
        if stop.signal:
            print(f"\nStopped after {run.trained:,} of {run.steps:,} steps. What was learned is saved;")
            print(f"  {run.command('--resume')}    goes on with it")
            return 128 + stop.signal
    report(model, run, video)
    return 0


# --- training -----------------------------------------------------------------------------------------------


def make_model(run: Run) -> Any:
    """Return the learner with its environments: a new one, or the one that was saved."""
    import torch
    from stable_baselines3 import PPO
    from stable_baselines3.common.utils import LinearSchedule
    from stable_baselines3.common.vec_env import VecMonitor

    from agents.sb3_vec_env import ScaledReward, make_sb3_vec_env

    # The networks are too small to share out: a second thread costs more than it brings.
    torch.set_num_threads(1)
    place, fixed = TASKS[run.env]
    duration = RECIPES.get(run.env, DEFAULT_RECIPE)[1]
    task = load_task(place)(duration=duration, **fixed)
    envs = make_sb3_vec_env(run.env, ENVS, spread=int(task.limit), duration=task.duration)
    envs = ScaledReward(VecMonitor(envs), REWARD_FACTOR)
    log = str(run.folder / "tensorboard")
    if run.trained:
        try:
            model = PPO.load(run.model_file, env=envs, device="cpu", tensorboard_log=log)
        except Exception as error:  # whatever a damaged file leads to
            reason = f"{type(error).__name__}: {error}"
            raise UserError(f"{run.model_file} cannot be read ({reason}); --new starts anew") from error
        run.trained = model.num_timesteps
    else:
        # Exploration by noise that depends on the state (gSDE) and is kept for some steps: it moves the bar
        # where noise drawn anew at each step averages out.
        model = PPO(
            "MlpPolicy",
            envs,
            n_steps=64,
            batch_size=1024,
            n_epochs=10,
            gamma=0.995,
            gae_lambda=0.9,
            learning_rate=LinearSchedule(3e-3, 0.0, 1.0),
            ent_coef=1e-3,
            max_grad_norm=1.0,
            use_sde=True,
            sde_sample_freq=4,
            policy_kwargs={
                "net_arch": {"pi": [32, 32], "vf": [128, 128]},
                "log_std_init": 0.0,
                "optimizer_kwargs": {"eps": 1e-5, "fused": True},
            },
            seed=run.seed,
            device="cpu",
            tensorboard_log=log,
        )
    envs.reset()  # compiles
    # A resumed run goes on with episodes that it has not seen.
    envs.seed((1000 * run.seed + run.trained) % FIRST_FRESH_SEED)
    return model


def train(model: Any, run: Run, stop: Stop) -> None:
    """Train up to the run's number of steps or until asked to stop; test and save now and then."""
    from stable_baselines3.common.callbacks import BaseCallback
    from tqdm import tqdm

    # On a terminal a bar shows the progress, in a log a line now and then does.
    bar = tqdm(
        total=run.steps, initial=run.trained, unit=" steps", unit_scale=True, disable=None, dynamic_ncols=True
    )
    started, before = time.perf_counter(), run.seconds

    class Watch(BaseCallback):
        """Show the progress, test and save now and then, and end the training when asked to."""

        def _on_training_start(self) -> None:
            if not run.curve:
                self.keep()

        def _on_step(self) -> bool:
            bar.update(self.num_timesteps - bar.n)
            return not stop.signal

        def _on_rollout_start(self) -> None:
            # Here the roll-out before has been learnt from.
            if self.num_timesteps - run.trained >= run.steps / 16:
                self.keep()

        def keep(self) -> None:
            """Test the policy as it is, and save all."""
            mean = evaluate_batch(run.env, self.model, FIRST_TEST_SEED, EPISODES).mean()
            run.trained = self.num_timesteps
            run.seconds = before + time.perf_counter() - started
            run.curve.append((run.trained, round(run.seconds, 3), float(mean)))
            run.save(self.model)
            self.logger.record("test/mean_return", mean)
            bar.set_postfix_str(f"return {mean:.1f}", refresh=False)
            if bar.disable:
                print(f"{run.trained:>9,} steps, {run.seconds:3.0f} s, return {mean:.1f}", flush=True)

    watch = Watch()
    run.evaluated = False
    run.save()
    stop.gently = True
    try:
        # The learner adds what it has done before to the number of steps it is given.
        model.learn(run.steps - run.trained, watch, tb_log_name="PPO", reset_num_timesteps=False)
        watch.keep()
    finally:
        stop.gently = False
        bar.close()


# --- evaluation ---------------------------------------------------------------------------------------------


def report(model: Any, run: Run, video: bool) -> None:
    """Evaluate the model and what it is compared with; write results, picture and video, print a table."""
    from agents.controllers import EnergyShapingLQR, Random, do_nothing

    seeds = range(FIRST_FRESH_SEED, FIRST_FRESH_SEED + EPISODES)
    started = time.perf_counter()
    with gym.make(run.env) as env:
        agents = {"PPO": model, "random": Random(run.seed), "do nothing": do_nothing(env)}
        if run.env == "PivotedBar-v0":
            agents["energy shaping + LQR"] = EnergyShapingLQR(env.unwrapped.task)
        returns = {name: evaluate(env, agent, seeds) for name, agent in agents.items()}
    seconds = time.perf_counter() - started
    draw_curve(run, returns)
    if video:
        record(model, run, seeds[0])
    packages = ["gymnasium", "numpy", "numba", "torch", "stable-baselines3"]
    results = {
        "env": run.env,
        "seed": run.seed,
        "steps": run.trained,
        "training_seconds": round(run.seconds, 2),
        "evaluation_seconds": round(seconds, 2),
        "evaluation_seeds": list(seeds),
        "known_returns": dict(zip(("random", "best"), KNOWN_RETURNS.get(run.env, ()), strict=False)),
        "agents": {
            name: {"score": score(run.env, r.mean()), "mean_return": r.mean(), "returns": r.tolist()}
            for name, r in returns.items()
        },
        "versions": {"python": platform.python_version(), "lag-envs": __version__}
        | {name: version(name) for name in packages},
        "machine": f"{platform.machine()}, {os.cpu_count()} cores",
    }
    (run.folder / "results.json").write_text(json.dumps(results, indent=1) + "\n")
    run.evaluated = True
    run.save()

    print(f"\nReturns over {EPISODES} fresh episodes of {run.env}")
    print(f"{'':22}{'mean':>9}{'lowest':>9}{'highest':>9}{'score':>8}")
    for name, r in sorted(returns.items(), key=lambda item: -item[1].mean()):
        s = score(run.env, r.mean())
        last = "" if s is None else f"{s:8.3f}"
        print(f"{name:22}{r.mean():9.2f}{r.min():9.2f}{r.max():9.2f}{last}")
    if run.env in KNOWN_RETURNS:
        low, high = KNOWN_RETURNS[run.env]
        print(f"The score is 0 for the random policy ({low:g}) and 1 for the best return known ({high:g}).")
    print(f"\n{run.trained:,} steps in {run.seconds:.1f} s of training, {seconds:.1f} s of evaluation.")
    print(f"In {run.folder}: " + ", ".join(sorted(p.name for p in run.folder.iterdir())))


def draw_curve(run: Run, returns: dict[str, np.ndarray]) -> None:
    """Draw the returns over the steps of training, beside the other agents' means."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8.0, 4.5), layout="constrained")
    axes = figure.add_subplot()
    if run.curve:
        steps, _, means = zip(*run.curve, strict=True)
        axes.plot(steps, means, color="tab:blue", label="PPO while training")
    axes.plot(run.trained, returns["PPO"].mean(), "o", color="tab:blue", clip_on=False, label="PPO, trained")
    if "energy shaping + LQR" in returns:
        mean = returns["energy shaping + LQR"].mean()
        axes.axhline(mean, color="tab:green", label=f"energy shaping + LQR ({mean:.1f})")
    if run.env in KNOWN_RETURNS:
        best = KNOWN_RETURNS[run.env][1]
        axes.axhline(best, color="black", linestyle="--", linewidth=1.0, label=f"best known ({best:g})")
    mean = returns["random"].mean()
    axes.axhline(mean, color="tab:grey", linestyle=":", label=f"random ({mean:.1f})")
    axes.set(xlabel="environment steps", ylabel="return of an episode", xlim=(0, run.trained), title=run.env)
    axes.xaxis.set_major_formatter("{x:,.0f}")
    pace = run.seconds / max(run.trained, 1)
    time_axis = axes.secondary_xaxis("top", functions=(lambda x: x * pace, lambda x: x / max(pace, 1e-12)))
    time_axis.set_xlabel("seconds of training")
    axes.grid(alpha=0.3)
    axes.legend(loc="best")
    figure.savefig(run.folder / "learning_curve.png", dpi=120)


def record(model: Any, run: Run, seed: int) -> None:
    """Record one episode as a video."""
    from gymnasium.wrappers import RecordVideo

    with tempfile.TemporaryDirectory() as folder:
        env = gym.make(run.env, render_mode="rgb_array")
        with RecordVideo(
            env, f"{folder}/video", episode_trigger=lambda n: n == 0, disable_logger=True
        ) as env:
            evaluate(env, model, [seed])
        (video,) = Path(folder, "video").glob("*.mp4")
        shutil.move(video, run.folder / "episode.mp4")


if __name__ == "__main__":
    sys.exit(main())
