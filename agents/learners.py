"""Learners of Stable-Baselines3: hyperparameters, environments, interruptible training, policies.

Our own learners, each in its own file, are called from here too, so that commands treat all learners alike.
"""

from __future__ import annotations

import inspect
import io
import json
import math
import pickle
import platform
import time
from collections.abc import Callable, Iterable, Mapping
from copy import deepcopy
from importlib import import_module
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any, ClassVar, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import ConfigDict, Field, PositiveInt, TypeAdapter

import lag_envs.hyperparams
from agents.run import (
    CHECKPOINT,
    FIRST_FRESH_SEED,
    FIRST_TEST_SEED,
    MODEL,
    NORMALISATION,
    RESULT,
    Run,
    UserError,
    fresh_seeds,
    known_name,
    read_result,
)
from lag_envs import __version__
from lag_envs.errors import hint
from lag_envs.evaluation.rollout import play
from lag_envs.host import machine
from lag_envs.hyperparams import DISCRETISE
from lag_envs.leaderboard import export, protocol
from lag_envs.leaderboard.fields import Strict, checked
from lag_envs.leaderboard.sb3_models import ModelPolicy
from lag_envs.scores import known_returns, score
from lag_envs.store import write_file
from lag_envs.tasks.base import Task
from lag_envs.tasks.registration import make_task


class Entry(NamedTuple):
    """A learner.

    Attributes
    ----------
    module, label : str
        Where it is found, and its name in tables; for a learner of Stable-Baselines3, that of its class.
    needs : str
        The kind of actions that it needs; any kind if empty.
    keeps_best : bool
        Whether its policies get better and worse: the one that did best in a test is kept, not the last one.
    """

    module: str
    label: str
    needs: str = ""
    keeps_best: bool = False


CONTINUOUS, DISCRETE = "continuous actions", "one discrete action"
#: Learners of Stable-Baselines3. DQN splits a continuous control into bins, see `make_envs`.
ALGORITHMS = {
    "ppo": Entry(*export.ALGORITHMS["ppo"][:2]),
    "sac": Entry(*export.ALGORITHMS["sac"][:2], CONTINUOUS, keeps_best=True),
    "td3": Entry(*export.ALGORITHMS["td3"][:2], CONTINUOUS, keeps_best=True),
    "dqn": Entry(*export.ALGORITHMS["dqn"][:2], DISCRETE, keeps_best=True),
    "tqc": Entry(*export.ALGORITHMS["tqc"][:2], CONTINUOUS, keeps_best=True),
}
#: Learners of our own, in the modules that train them.
OWN = {
    "fast_ppo": Entry("agents.ppo", "fast PPO"),
    "shac": Entry("agents.shac", "SHAC", CONTINUOUS),
    "cloning": Entry("agents.cloning", "cloning", CONTINUOUS),
}
LEARNERS = ALGORITHMS | OWN
#: Episodes of each test during training, and of the evaluation at the end.
TEST_EPISODES, EPISODES = 20, 100
#: Tests of one run; each gives a point of the learning curve and a checkpoint.
TESTS = 16
TIME_LIMIT = "gymnasium.wrappers.TimeLimit"
SCALE = "lag_envs.sb3.ScaledReward"
#: Upper limits of the numbers of environments, steps between updates, and frames: more would hardly fit into
#: memory.
Count = Annotated[int, Field(ge=1, le=100_000)]
#: Frames, and width and number of hidden layers of our own policies: what the leaderboard, and so
#: `lag-envs watch`, accepts.
Frames = Annotated[int, Field(ge=1, le=protocol.FRAMES)]
Width, LAYERS = Annotated[int, Field(gt=0, le=protocol.WIDTH)], protocol.LAYERS
#: The argument of each wrapper that is known, and its type.
WRAPPERS: Mapping[str, tuple[str, Any]] = {
    TIME_LIMIT: ("max_episode_steps", PositiveInt),
    DISCRETISE: ("bins", Annotated[int, Field(ge=2, le=1000)]),
    SCALE: ("factor", float),
}
#: The Zoo's hyperparameters that are not arguments of a learner's class, with their types if they are
#: numbers.
ZOO: Mapping[str, Any] = dict.fromkeys(
    ("n_timesteps", "normalize", "env_wrapper", "vec_env_wrapper", "noise_type")
) | {"n_envs": Count, "noise_std": float, "frame_stack": Count}
#: Arguments of a learner's class, and of `VecNormalize`, that are not hyperparameters.
GIVEN = ("env", "seed", "device", "tensorboard_log", "action_noise", "_init_setup_model")
GIVEN_TO_NORMALISE = ("venv", "gamma")
#: A training has diverged if one of the weights is larger than this.
LARGEST_WEIGHT = 1e6
#: Libraries whose versions are stored in a result.
PACKAGES = ("gymnasium", "numpy", "numba", "torch", "stable-baselines3", "sb3-contrib")


def learner_label(algo: str) -> str:
    """Return a learner's name in tables; any other agent has its own name."""
    return LEARNERS[algo].label if algo in LEARNERS else algo


def learner(algo: str) -> type:
    """Return a learner's class."""
    entry = ALGORITHMS[known_name("algorithm", algo, ALGORITHMS)]
    return getattr(import_module(entry.module), entry.label)


def zoo_hyperparameters(algo: str, env_id: str, file: Path | None = None) -> dict[str, Any]:
    """Return the RL Zoo's hyperparameters for an algorithm and environment.

    Parameters
    ----------
    algo, env_id : str
        Name of the algorithm and id of the environment.
    file : Path, optional
        A YAML file in the Zoo's form in place of the task's own.

    Raises
    ------
    UserError
        For an unknown algorithm, also in the task's own hyperparameters, or a file without a readable entry
        for the environment.
    """
    known_name("algorithm", algo, LEARNERS)
    if file is None:
        try:
            return lag_envs.hyperparams.hyperparameters(algo, make_task(env_id))
        except ValueError as error:
            raise UserError(str(error)) from error
    import yaml

    try:
        entries = yaml.safe_load(file.read_text())
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise UserError(f"{file} cannot be read: {error}") from error
    form = f"`lag-envs hyperparams {algo}` prints the form"
    if not isinstance(entries, dict):
        raise UserError(f"{file} must map ids to hyperparameters, got a {type(entries).__name__}; {form}")
    if env_id not in entries:
        raise UserError(f"{file} has no entry for {env_id}, only for {', '.join(map(str, entries))}; {form}")
    entry = entries[env_id]
    if not isinstance(entry, dict):
        raise UserError(f"{file}: the entry for {env_id} must map names to values, got {entry!r:.60}; {form}")
    try:
        check_hyperparameters(algo, entry)
    except UserError as error:
        raise UserError(f"{file}, entry {env_id}: {error}") from error
    return entry


def check_hyperparameters(algo: str, hyperparameters: Mapping[str, Any]) -> None:
    """Raise a UserError for a missing or unknown hyperparameter, or one of the wrong type."""
    if algo in OWN:
        import_module(OWN[algo].module).Settings.of(hyperparameters)
        return
    from stable_baselines3.common.vec_env import VecNormalize

    if "env_kwargs" in hyperparameters:
        raise UserError(
            "env_kwargs would change the environment of training, but not that of tests and results; "
            "register the task with these parameters, under an id of its own"
        )
    check_arguments(algo, hyperparameters, types_of(learner(algo), GIVEN) | ZOO | {"policy": str})
    if isinstance(which := hyperparameters.get("normalize", False), dict):
        check_arguments("normalize", which, types_of(VecNormalize, GIVEN_TO_NORMALISE))
    else:
        check_type("normalize", which, bool)
    asked_wrappers(hyperparameters)
    for name in ("n_timesteps", "policy"):
        if name not in hyperparameters:
            raise UserError(f"{name} is missing; `lag-envs hyperparams {algo}` prints complete entries")


def types_of(function: Any, given: Iterable[str]) -> dict[str, Any]:
    """Return the types of a function's arguments, by name, leaving out the named ones."""
    arguments = inspect.signature(function).parameters
    return {name: a.annotation for name, a in arguments.items() if name not in given}


def check_arguments(owner: str, values: Mapping[str, Any], known: Mapping[str, Any]) -> None:
    """Raise a UserError for an unknown argument, or for one of the wrong type if its type is a simple one."""
    for name, value in values.items():
        if name not in known:
            raise UserError(f"{owner} has no hyperparameter {name!r}; {hint(str(name), known)}")
        if known[name] in (bool, int, float, str, Count):
            check_type(name, value, known[name])


def check_type(name: str, value: Any, kind: Any) -> None:
    """Raise a UserError for a value of the wrong type."""
    try:
        checked(TypeAdapter(kind, config=ConfigDict(strict=True, allow_inf_nan=False)), value)
    except ValueError as error:
        raise UserError(f"{name}: {error}") from error


def asked_wrappers(hyperparameters: Mapping[str, Any]) -> dict[str, Any]:
    """Return the argument of each requested wrapper, or raise a UserError."""
    asked: dict[str, Any] = {}
    for key in ("env_wrapper", "vec_env_wrapper"):
        wrappers = hyperparameters.get(key) or []
        check_type(key, wrappers, list)
        for wrapper in wrappers:
            name, arguments = next(iter(wrapper.items())) if isinstance(wrapper, dict) else (wrapper, {})
            if name not in WRAPPERS:
                raise UserError(f"wrapper {name} is not known here; {', '.join(WRAPPERS)} are")
            argument, kind = WRAPPERS[name]
            if not isinstance(arguments, dict) or list(arguments) != [argument]:
                raise UserError(f"wrapper {name} needs its argument, as in {name}: {{{argument}: ...}}")
            check_type(f"wrapper {name}: {argument}", arguments[argument], kind)
            asked[name] = arguments[argument]
    return asked


def suits(algo: str, task: Task) -> bool:
    """Return whether a learner supports a task's kind of actions: discrete or continuous."""
    choices = task.formulas.choices
    return {CONTINUOUS: not choices, DISCRETE: len(choices) == 1}.get(LEARNERS[algo].needs, True)


def check_suits(algo: str, env_id: str) -> None:
    """Raise a UserError for a learner that does not support an environment's kind of actions."""
    task = make_task(env_id)
    if not suits(algo, task):
        fit, needs = ", ".join(name for name in LEARNERS if suits(name, task)), LEARNERS[algo].needs
        has = "discrete ones"
        if needs == DISCRETE:
            has = "several" if task.formulas.actions > 1 else "a continuous one"
        raise UserError(f"{algo} needs {needs}; {env_id} has {has}; available: {fit}")


def check_trainable(algo: str, env_id: str) -> None:
    """Raise a UserError for a learner that cannot be used with an environment."""
    single = trainable(env_id).formulas.actions == 1
    if not (LEARNERS[algo].needs == DISCRETE and single):  # a continuous control is split into bins
        check_suits(algo, env_id)


class LearnerSettings(Strict):
    """Settings of a learner of our own.

    Attributes
    ----------
    learner : str
        Its name.
    """

    learner: ClassVar[str]

    @classmethod
    def of(cls, hyperparameters: Mapping[str, Any]) -> Self:
        """Return settings by name, or raise a UserError that names the wrong one."""
        for name in hyperparameters:
            if name not in cls.model_fields:
                meant = hint(str(name), cls.model_fields)
                raise UserError(f"settings of {cls.learner}: {name} is an unknown key; {meant}")
        try:
            return checked(cls, dict(hyperparameters))
        except ValueError as error:
            raise UserError(f"settings of {cls.learner}: {error}") from error


def trainable(env_id: str) -> Task:
    """Return the task of an environment in which learning is possible, or raise a UserError."""
    task = make_task(env_id)
    if task.limit == math.inf:
        raise UserError(f"the episodes of {env_id} have no end; give it a duration to train")
    if not task.formulas.actions:
        raise UserError(f"{env_id} has no control: there is nothing to learn")
    return task


# --- environments and learner -------------------------------------------------------------------------------


def make_envs(run: Run, normalise: Any = None) -> Any:
    """Return the native vector environment with the wrappers that the hyperparameters name.

    Parameters
    ----------
    run : Run
        The run.
    normalise : VecNormalize, optional
        A saved normalisation, without its environments, to continue with in place of a new one.
    """
    from stable_baselines3.common.vec_env import VecFrameStack, VecMonitor, VecNormalize

    from lag_envs.sb3 import DiscreteActions, ScaledReward, make_vec_env

    hyper = run.hyperparameters
    options: dict[str, Any] = {}
    task, asked = trainable(run.env), asked_wrappers(hyper)
    steps = task.limit
    bins, factor = asked.get(DISCRETISE), asked.get(SCALE)
    if TIME_LIMIT in asked:
        options["max_episode_steps"], steps = asked[TIME_LIMIT], min(steps, asked[TIME_LIMIT])
    if bins and (task.formulas.choices or task.formulas.actions > 1):
        raise UserError(
            f"{run.algo} needs a single control with discrete actions, which {run.env} does not have; try ppo"
        )
    envs = make_vec_env(run.env, int(hyper.get("n_envs", 1)), stagger=int(steps), **options)
    envs = VecMonitor(envs if bins is None else DiscreteActions(envs, bins))
    envs = envs if factor is None else ScaledReward(envs, factor)
    if normalise is not None:
        normalise.set_venv(envs)
        envs = normalise
    elif which := hyper.get("normalize"):
        which = which if isinstance(which, dict) else {}
        envs = VecNormalize(envs, gamma=float(hyper.get("gamma", 0.99)), **which)
    frames = hyper.get("frame_stack")
    if frames and getattr(envs, "norm_obs", False):
        raise UserError("frame_stack does not go with normalised observations: set norm_obs to false")
    return VecFrameStack(envs, frames) if frames else envs


def make_model(run: Run, envs: Any) -> Any:
    """Return a new learner."""
    import torch
    from stable_baselines3.common.noise import NormalActionNoise
    from stable_baselines3.common.utils import LinearSchedule

    # The networks are too small for several threads: a second one costs more than it gains.
    torch.set_num_threads(1)
    # A copy, because learners change the dict that they are given.
    arguments = deepcopy({k: v for k, v in run.hyperparameters.items() if k not in ZOO})
    for name in ("learning_rate", "clip_range"):
        if isinstance(arguments.get(name), str):  # "lin_3e-4" falls to zero in the course of the training
            try:
                arguments[name] = LinearSchedule(float(arguments[name].removeprefix("lin_")), 0.0, 1.0)
            except ValueError:
                raise UserError(f"{name} must be a number or lin_NUMBER, got {arguments[name]!r}") from None
    if "." in arguments.get("policy", ""):
        module, _, name = arguments["policy"].rpartition(".")
        try:
            arguments["policy"] = getattr(import_module(module), name)
        except (ImportError, AttributeError, ValueError) as error:
            raise UserError(f"policy must be one of {run.algo}'s names or a class: {error}") from error
    noise = run.hyperparameters.get("noise_type")
    if noise not in (None, "normal"):
        raise UserError(
            f"noise_type must be normal, got {noise!r}: other noise has a memory, which resuming would lose"
        )
    if noise:
        sigma = np.full(envs.action_space.shape, float(run.hyperparameters["noise_std"]))
        arguments["action_noise"] = NormalActionNoise(np.zeros_like(sigma), sigma)
    try:
        return learner(run.algo)(
            env=envs, seed=run.seed, device="cpu", tensorboard_log=str(run.path("tensorboard")), **arguments
        )
    except (TypeError, ValueError, AssertionError) as error:
        raise UserError(f"{run.algo} does not take the hyperparameters of {run.env}: {error}") from error


# --- checkpoints --------------------------------------------------------------------------------------------


def freeze(model: Any) -> dict[str, Any]:
    """Return the files in which Stable-Baselines3 saves a training: learner, normalisation, replay buffer."""
    file = io.BytesIO()
    model.save(file)
    return {
        "model": file.getvalue(),
        "normalisation": pickle.dumps(model.get_vec_normalize_env()),
        "buffer": pickle.dumps(getattr(model, "replay_buffer", None)),
    }


def thaw(run: Run, content: Mapping[str, Any]) -> Any:
    """Return the learner of a checkpoint, in new environments."""
    import torch

    torch.set_num_threads(1)
    try:
        normalise, buffer = pickle.loads(content["normalisation"]), pickle.loads(content["buffer"])
        envs = make_envs(run, normalise)
        log = str(run.path("tensorboard"))
        model = learner(run.algo).load(
            io.BytesIO(content["model"]), env=envs, device="cpu", tensorboard_log=log, **export.LOADING
        )
    except Exception as error:  # a damaged file can raise anything
        reason = f"{type(error).__name__}: {error}"
        raise UserError(f"{run.path(CHECKPOINT)} cannot be read ({reason}); --new starts over") from error
    if buffer is not None:
        model.replay_buffer = buffer
    model.set_random_seed(run.seed + run.trained)
    return model


# --- training -----------------------------------------------------------------------------------------------


def train_rest(run: Run, *, show: Callable[[Run], None], tested: Callable[[Run], None]) -> None:
    """Train the rest of a run, and write its result.

    Parameters
    ----------
    run : Run
        The run; it continues from its checkpoint, if there is one.
    show : callable
        Called often during training, with the run as argument.
    tested : callable
        Called after each test of the policy, when its checkpoint has been written.
    """
    if run.algo in OWN:
        _train_own(run, show, tested)
        return
    from stable_baselines3.common.callbacks import BaseCallback
    from stable_baselines3.common.logger import Logger

    content = run.load_checkpoint()
    check_hyperparameters(run.algo, run.hyperparameters)
    model = make_model(run, make_envs(run)) if content is None else thaw(run, content)
    best = content and content["best"]
    model.get_env().reset()  # compiles
    # The episodes of every seed are different throughout, and so are those of a resumed run.
    model.get_env().seed((1_000_000 * run.seed + run.trained) % FIRST_FRESH_SEED)
    every = run.steps / TESTS

    class Watch(BaseCallback):
        """Test and save at intervals."""

        last = run.trained

        def _on_step(self) -> bool:
            run.trained = self.num_timesteps
            if not np.isfinite(self.locals["rewards"]).all():
                check_weights(run, self.model.policy.parameters())
                check_rewards(run.env, self.locals["rewards"])
            run.stop_clock()
            show(run)
            run.start_clock()
            return True

        def _on_rollout_start(self) -> None:
            # At this point the learner has already been updated from the last roll-out.
            if not run.curve or self.num_timesteps - self.last >= every:
                self.keep()

        def keep(self) -> None:
            """Test the current policy and save everything; this does not count as training."""
            nonlocal best
            run.stop_clock()
            check_weights(run, self.model.policy.parameters())
            content = freeze(self.model)
            normalise = self.model.get_vec_normalize_env()
            mean = tested_return(run.env, policy_of(run.settings, self.model, normalise))
            run.trained = self.last = self.num_timesteps
            run.curve.append((run.trained, round(run.seconds, 3), mean))
            if (
                best is None
                or not ALGORITHMS[run.algo].keeps_best
                or mean >= max(test[2] for test in run.curve)
            ):
                best = {**content, "buffer": None, "trained": run.trained}
            run.save_checkpoint({**content, "best": best})
            self.logger.record("test/mean_return", mean)
            tested(run)
            run.start_clock()

    watch = Watch()
    if model.tensorboard_log is None:  # otherwise each training leaves an empty folder among temporary files
        model.set_logger(Logger(None, []))
    if run.trained < run.steps:
        run.start_clock()
        left = run.steps - run.trained  # the learner adds its earlier steps
        try:
            model.learn(left, watch, tb_log_name=run.algo, reset_num_timesteps=False, log_interval=10)
        except Exception as error:
            check_weights(run, model.policy.parameters(), error)
            raise
        watch.keep()
    finish_training(run, best)


def tested_return(env_id: str, policy: Any) -> float:
    """Return a policy's mean return in the episodes of a test during training."""
    returns = play(env_id, policy, range(FIRST_TEST_SEED, FIRST_TEST_SEED + TEST_EPISODES))
    check_rewards(env_id, returns)
    return float(returns.mean())


def check_rewards(env_id: str, rewards: NDArray[Any]) -> None:
    """Raise a UserError for a reward that is not finite; otherwise the learner would seem to diverge."""
    wrong = rewards[~np.isfinite(rewards)]
    if wrong.size:
        raise UserError(f"the reward of {env_id} is {wrong[0]}; it must be a finite number in every state")


def check_weights(run: Run, weights: Iterable[Any], error: Exception | None = None) -> None:
    """Raise a UserError, from the given error, if a tensor of weights shows that a training diverged."""
    if not all((w.detach().abs() < LARGEST_WEIGHT).all() for w in weights):
        raise UserError(
            f"the training diverged (seed {run.seed}, after {run.trained:,} steps): lower learning_rate"
        ) from error


def _train_own(run: Run, show: Callable[[Run], None], tested: Callable[[Run], None]) -> None:
    """Train with a learner of our own.

    Tests during the training show its progress. They neither stop it nor select the policy that is kept.
    """
    content = run.load_checkpoint()
    module = import_module(OWN[run.algo].module)
    learner = module.Learner(run.env, module.Settings.of(run.hyperparameters), run.seed, run.steps)
    if content is not None:
        try:
            learner.restore(content["learner"])
        except Exception as error:  # anything: another environment, another version of the learner
            raise UserError(
                f"{run.path(CHECKPOINT)} cannot be resumed ({error}); --new starts over"
            ) from error
    every = run.steps / TESTS

    def test() -> None:
        mean = tested_return(run.env, learner.policy)
        run.curve.append((run.trained, round(run.seconds, 3), mean))
        run.save_checkpoint({"learner": learner.state()})
        tested(run)

    if not run.curve:
        test()
    while learner.trained < run.steps:
        run.start_clock()
        try:
            learner.iterate()
        except Exception as error:
            check_weights(run, learner.weights(), error)
            raise
        run.stop_clock()
        run.trained = learner.trained
        check_weights(run, learner.weights())
        show(run)
        if run.trained - run.curve[-1][0] >= every or run.trained >= run.steps:
            test()
    learner.policy.save(run.path(MODEL))
    evaluate_finished(run, learner.policy, run.trained)


def finish_training(run: Run, best: Mapping[str, Any]) -> None:
    """Write the policy, and evaluate it."""
    write_file(run.path(MODEL), best["model"])
    normalise = pickle.loads(best["normalisation"])
    if normalise is not None and normalise.norm_obs:
        write_file(run.path(NORMALISATION), best["normalisation"])
    model = learner(run.algo).load(io.BytesIO(best["model"]), device="cpu", **export.LOADING)
    evaluate_finished(run, policy_of(run.settings, model, normalise), best["trained"])


def evaluate_finished(run: Run, policy: Any, kept: int) -> None:
    """Evaluate the policy of a finished training on fresh episodes, and write the result."""
    started = time.perf_counter()
    returns = play(run.env, policy, fresh_seeds(EPISODES))
    check_rewards(run.env, returns)
    known, place = known_returns(run.env), machine()
    result = {
        **run.settings,
        "trained": run.trained,
        "policy_of_step": kept,
        "wall_seconds": round(run.seconds, 2),
        "processor_seconds": round(run.processor_seconds, 2),
        "evaluation_seconds": round(time.perf_counter() - started, 2),
        "mean_return": float(returns.mean()),
        "score": score(run.env, float(returns.mean())),
        "known_returns": {"random": known.random, "best": known.best} if known else None,
        "curve": run.curve,
        "evaluation": {"first_seed": FIRST_FRESH_SEED, "episodes": EPISODES, "returns": returns.tolist()},
        "versions": {"python": platform.python_version(), "lag-envs": __version__}
        | {name: version(name) for name in PACKAGES},
        "machine": f"{place['processor']}, {place['cores']} cores",
    }
    write_file(run.path(RESULT), json.dumps(result, indent=1) + "\n")
    run.path(CHECKPOINT).unlink(missing_ok=True)


# --- policies -----------------------------------------------------------------------------------------------


def policy_of(settings: Mapping[str, Any], model: Any, normalise: Any) -> ModelPolicy:
    """Return a model of Stable-Baselines3 as a policy, by its run's settings."""
    frames = settings["hyperparameters"].get("frame_stack") or 1
    return ModelPolicy(model, make_task(settings["env"]), normalise, frames)


def load_policy(folder: str | Path) -> Any:
    """Return the policy of a finished run.

    Parameters
    ----------
    folder : str or Path
        The run's folder, ``FOLDER/ENV/ALGO/seed<K>``.

    Raises
    ------
    UserError
        If the folder holds no finished run, or a damaged one.
    """
    folder = Path(folder)
    if folder.is_file():
        raise UserError(f"{folder} is a file; give the folder in which it lies, {folder.parent}")
    if not (folder / RESULT).exists():
        raise UserError(f"there is no finished run in {folder}: it has no {RESULT}")
    result = read_result(folder / RESULT)
    try:
        if result["algo"] in OWN:
            from agents.policy import Policy  # loads PyTorch

            return Policy.load(folder / MODEL)
        model = learner(result["algo"]).load(folder / MODEL, device="cpu", **export.LOADING)
        file = folder / NORMALISATION
        normalise = pickle.loads(file.read_bytes()) if file.exists() else None
    except Exception as error:  # a damaged file can raise anything
        reason = f"{type(error).__name__}: {error}"
        raise UserError(
            f"the policy in {folder} cannot be read ({reason}); train it again, with --new"
        ) from error
    return policy_of(result, model, normalise)
