"""Turn models of Stable-Baselines3 into a submission, and prove that both act alike.

A model's file runs code when it is loaded. Export only your own models. Networks that
``python -m agents.ppo`` left are arrays, which are read without running anything and used as they are.
"""

from __future__ import annotations

import argparse
import json
import os
import pickle
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lag_envs.errors import UserError, hint, one_line
from lag_envs.leaderboard import protocol
from lag_envs.leaderboard.architecture import POLICY, Architecture
from lag_envs.leaderboard.fields import accepted
from lag_envs.leaderboard.networks import MLP
from lag_envs.leaderboard.policies import architecture
from lag_envs.leaderboard.sb3_models import ModelPolicy
from lag_envs.leaderboard.submission import Refused, Submission, write
from lag_envs.tasks import TASKS
from lag_envs.tasks.base import Task

#: Algorithms: where the class is, and the module that a model's file names for its policy.
ALGORITHMS = {
    "ppo": ("stable_baselines3", "PPO", "stable_baselines3.common.policies"),
    "a2c": ("stable_baselines3", "A2C", "stable_baselines3.common.policies"),
    "sac": ("stable_baselines3", "SAC", "stable_baselines3.sac.policies"),
    "td3": ("stable_baselines3", "TD3", "stable_baselines3.td3.policies"),
    "dqn": ("stable_baselines3", "DQN", "stable_baselines3.dqn.policies"),
    "tqc": ("sb3_contrib", "TQC", "sb3_contrib.tqc.policies"),
}
#: Names of PyTorch's activations here.
ACTIVATIONS = {
    "Tanh": "tanh", "ReLU": "relu", "ELU": "elu", "LeakyReLU": "leaky_relu", "SiLU": "silu",
    "Sigmoid": "sigmoid",
}  # fmt: skip
#: Largest difference of the actions of model and export.
DIFFERENCE = 1e-5
MODEL, NORMALISATION, RESULT = "model.zip", "vecnormalize.pkl", "result.json"
#: Lies there until the training is finished.
CHECKPOINT = "checkpoint.pkl"


class ExportError(UserError):
    """A model that cannot be exported; the text says why."""


@dataclass
class Source:
    """A model's files, what is known of its training, and how many observations it sees at once."""

    model: Path
    normalise: Path | None = None
    result: Mapping[str, Any] | None = None
    frames: int = 1


# --- reading ------------------------------------------------------------------------------------------------


def find(paths: Sequence[Path], normalise: Sequence[Path] = ()) -> list[Source]:
    """Return the models at paths: files, folders of a training run, or folders of such folders.

    Parameters
    ----------
    paths : sequence of Path
        An SB3 ``.zip``; a folder with ``model.zip``, and ``vecnormalize.pkl`` and ``result.json`` where there
        are any; or a folder that contains such folders.
    normalise : sequence of Path
        For each of the paths, if all are files, the pickled ``VecNormalize``.
    """
    if normalise and (len(normalise) != len(paths) or any(p.is_dir() for p in paths)):
        raise ExportError(
            f"{len(normalise)} normalisations for {len(paths)} paths: give one file for each path"
        )
    found: list[Source] = []
    for i, path in enumerate(paths):
        if path.is_file():
            found.append(Source(path, normalise[i] if normalise else None))
            continue
        if not path.exists():
            raise ExportError(f"there is no {path}")
        folders = [path] if (path / MODEL).exists() else sorted(f.parent for f in path.glob(f"*/{MODEL}"))
        if not folders:
            raise ExportError(f"{path} is neither a model nor a folder with {MODEL} in it or one level below")
        if unfinished := sorted({f.parent for f in path.glob(f"*/{CHECKPOINT}")} - set(folders)):
            raise ExportError(
                f"{', '.join(map(str, unfinished))}: not finished; resume the training, or name the finished "
                "runs one by one"
            )
        for folder in folders:
            file, norm = folder / RESULT, folder / NORMALISATION
            result = _json(file) if file.exists() else None
            frames = (result or {}).get("hyperparameters", {}).get("frame_stack") or 1
            found.append(Source(folder / MODEL, norm if norm.exists() else None, result, frames))
    return found


def _json(file: Path) -> Mapping[str, Any]:
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
        if not isinstance(content, dict):
            raise ValueError("it does not hold an object")
    except (OSError, ValueError) as error:
        raise ExportError(f"{file} cannot be read: {error}") from error
    return content


def algorithm_of(source: Source) -> str:
    """Return the algorithm of a model, from the notes of its training or from its policy."""
    if (noted := (source.result or {}).get("algo")) in ALGORITHMS:
        return noted
    file = source.model
    try:
        with zipfile.ZipFile(file) as archive:
            data = json.loads(archive.read("data"))
        module = data["policy_class"]["__module__"]
    except (OSError, ValueError, KeyError, TypeError, zipfile.BadZipFile) as error:
        raise ExportError(
            f"{file} is neither a network of ours nor a model of Stable-Baselines3: {error}"
        ) from error
    names = [name for name, (*_, known) in ALGORITHMS.items() if known == module]
    if not names:
        raise ExportError(
            f"{file} has a policy of {module}, which is not known; name a similar algorithm with --algo: "
            + ", ".join(ALGORITHMS)
        )
    return "a2c" if "a2c" in names and "n_epochs" not in data else names[0]


def _name(source: Source, algo: str | None) -> str:
    """Return the name of a model's learner."""
    if arrays_of(source.model) is None:
        return ALGORITHMS[algo or algorithm_of(source)][1]
    words = (source.result or {}).get("algo", "ppo").split("_")
    return " ".join(word.upper() if word in ("ppo", "shac") else word for word in words)


#: Keyword for the `load` of Stable-Baselines3's learners: each chooses the buffer by the model's `n_steps`.
#: The stored choice would pass for the caller's, with a warning that `n_steps` is ignored.
LOADING: Mapping[str, Any] = {"custom_objects": {"replay_buffer_class": None}}


def load_model(source: Source, algo: str) -> tuple[Any, Any]:
    """Return model and normalisation, or None for the latter."""
    from importlib import import_module

    module, name, _ = ALGORITHMS[algo]
    try:
        file = source.model
        model = getattr(import_module(module), name).load(file, device="cpu", **LOADING)
        if source.normalise is None:
            return model, None
        file = source.normalise
        normalise = pickle.loads(file.read_bytes())
        return model, normalise if normalise.norm_obs else None
    except ImportError:
        raise
    except Exception as error:  # a file of another kind may raise anything
        raise ExportError(f"{file} cannot be read for {name}: {one_line(error)}") from error


def arrays_of(file: Path) -> tuple[dict[str, Any], dict[str, NDArray[Any]]] | None:
    """Return a network's table ``[policy]`` and its arrays, where a file holds arrays and no model."""
    try:
        with np.load(file, allow_pickle=False) as found:
            choices = found["choices"].tolist()
            arrays = {name: found[name] for name in found if name.startswith(("weight_", "bias_"))}
            frames = int(found.get("frames", 1))
    except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile):
        return None
    layers = range(len(arrays) // 2)
    if not layers or any(np.ndim(arrays.get(f"bias_{k}", 0.0)) != 1 for k in layers):
        raise ExportError(f"{file} is damaged: it should hold weight_0, bias_0, weight_1, bias_1 and so on")
    hidden = [len(arrays[f"bias_{k}"]) for k in layers[:-1]]
    table: dict[str, Any] = {"architecture": "mlp", "hidden": hidden, "activation": "tanh"}
    table |= {"frames": frames} if frames > 1 else {}
    return table | ({} if choices else {"squash": "clip"}), arrays


def _only_for_models(option: str, source: Source) -> ExportError:
    return ExportError(
        f"--{option} is for models of Stable-Baselines3; {source.model} holds a network, leave it out"
    )


# --- converting ---------------------------------------------------------------------------------------------


def convert(
    model: Any, task: Task, normalise: Any = None, frames: int = 1
) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
    """Return a model's policy as the table ``[policy]`` and its arrays.

    Parameters
    ----------
    model : BaseAlgorithm
        A model of Stable-Baselines3, which acts by the mode of its distribution.
    task : Task
        The task.
    normalise : VecNormalize, optional
        Its normalisation of observations.
    frames : int
        The number of observations that it sees at once, as with `VecFrameStack`.

    Raises
    ------
    ExportError
        For a policy that is not a network of fully connected layers, or that has other spaces.
    """
    from gymnasium import spaces

    policy, space, listed = model.policy, model.action_space, bool(task.formulas.choices)
    table: dict[str, Any] = {"architecture": "mlp"}
    own, shape = len(task.observation), model.observation_space.shape
    if shape != (frames * own,):
        raise ExportError(
            f"the model takes {'x'.join(map(str, shape or '?'))} numbers; {task.id} has {own} per observation"
            f"{f', {frames * own} in {frames} frames' if frames > 1 else ''}. Is --env right? If the model "
            "stacks observations, give --frames"
        )
    if frames > 1:
        table["frames"] = frames
    discrete = isinstance(space, spaces.Discrete | spaces.MultiDiscrete if listed else spaces.Discrete)
    numbers = isinstance(space, spaces.Box) and len(space.shape) == 1
    if not discrete and not (numbers and len({*-space.low, *space.high}) == 1):
        raise ExportError(f"the action space must be numbers in [-1, 1], or Discrete, got {space}")
    if hasattr(policy, "mlp_extractor"):  # PPO, A2C
        owner, parts = policy, [policy.mlp_extractor.policy_net, policy.action_net]
        squash = "tanh" if policy.squash_output else "clip"
    elif hasattr(policy, "q_net"):
        owner, parts, squash = policy.q_net, [policy.q_net.q_net], "clip"
    else:
        owner, squash = policy.actor, "tanh"
        parts = [getattr(owner, "latent_pi", []), owner.mu]
    extractor = type(owner.features_extractor if hasattr(owner, "features_extractor") else None).__name__
    if extractor != "FlattenExtractor":
        raise ExportError(f"observations must go to the network as they are, not through a {extractor}")
    layers = [layer for part in parts for layer in _flat(part)]
    if type(layers[-1]).__name__ == "Hardtanh":  # the limit of the mean under gSDE, in SAC and TQC
        last = layers.pop()
        if last.max_val != -last.min_val:
            raise ExportError(f"the last layer's clipping must be symmetric, got {last}")
        table["mean_limit"] = float(last.max_val)
    if type(layers[-1]).__name__ == "Tanh":  # TD3's
        layers.pop()
    linear, activations = layers[::2], layers[1::2]
    names = {type(a).__name__ for a in activations}
    if any(type(a).__name__ != "Linear" for a in linear) or len(linear) != len(activations) + 1:
        raise ExportError(f"the network must alternate linear layers and activations, got {layers}")
    if len(names) > 1 or not names <= set(ACTIVATIONS):
        raise ExportError(
            f"all activations must be one of {', '.join(ACTIVATIONS)}, got {', '.join(sorted(names))}"
        )
    for a in activations:
        if getattr(a, "alpha", 1.0) != 1.0 or getattr(a, "negative_slope", 0.01) != 0.01:
            raise ExportError(f"{a} has a parameter other than PyTorch's default")
    arrays = {}
    for k, layer in enumerate(linear):
        arrays[f"weight_{k}"] = layer.weight.detach().numpy().copy()
        arrays[f"bias_{k}"] = np.zeros(layer.out_features, np.float32)
        if layer.bias is not None:
            arrays[f"bias_{k}"] = layer.bias.detach().numpy().copy()
    table["hidden"] = [layer.out_features for layer in linear[:-1]]
    if names:
        table["activation"] = ACTIVATIONS[names.pop()]
    if not listed:
        table |= {"bins": int(space.n)} if discrete else {"squash": squash}
    if normalise is not None:
        if normalise.obs_rms.mean.shape != shape:
            raise ExportError("observations must be stacked before they are normalised, not after")
        table["normalise"] = {"epsilon": float(normalise.epsilon), "clip": float(normalise.clip_obs)}
        arrays["obs_mean"] = np.array(normalise.obs_rms.mean, np.float64)
        arrays["obs_var"] = np.array(normalise.obs_rms.var, np.float64)
    return table, arrays


def _flat(module: Any) -> list[Any]:
    """Return the layers of nested sequences, without those that do nothing."""
    parts = list(module.children()) if hasattr(module, "children") else list(module)
    if parts:
        return [layer for part in parts for layer in _flat(part)]
    return [] if type(module).__name__ in ("Identity", "Flatten", "Sequential", "list") else [module]


def difference(policy: ModelPolicy, agent: Any, env_id: str) -> tuple[float, int]:
    """Return the largest difference of a model's actions and an agent's, and the number of observations.

    Half of the observations come from episodes, in most of which the model acts, and in some of which actions
    are random. The others are random numbers in the same range; beyond it, float32 rounds too much.

    Where the model chooses between actions and two are worth the same within float32's rounding, either is
    right.
    """
    import gymnasium as gym

    task = TASKS[env_id]()
    rng, seen, choices = np.random.default_rng(0), [], task.formulas.choices
    memory, over = None, np.zeros(64, np.bool_)
    envs = gym.make_vec(env_id, 64, autoreset_mode="SameStep")
    observation, _ = envs.reset(seed=0)
    for _ in range(int(task.limit)):
        action, memory = policy.predict(observation, memory, over)
        seen.append(observation if memory is None else memory)
        if choices:
            action[48:] = rng.integers(0, choices, (16, len(choices))).reshape(16, *action.shape[1:])
        else:
            largest = task.formulas.largest
            action[48:] = rng.uniform(-largest, largest, (16, *action.shape[1:]))
        observation, _, terminated, truncated, _ = envs.step(action)
        over = terminated | truncated
    envs.close()
    path = rng.permutation(np.concatenate(seen))[:8192]
    far = np.abs(path).max(axis=0)
    both = np.concatenate([path, rng.uniform(-far, far, path.shape).astype(path.dtype)])
    frames = both.reshape(len(both), policy.frames, -1)
    before = None if policy.frames == 1 else np.roll(frames, 1, axis=1).astype(np.float64)
    worth = agent.layers.outputs(agent.layers.normalised(both.astype(np.float64)))
    model_action, action = policy.actions(both)[0], agent.predict(frames[:, -1], before)[0]
    if choices:
        lists = np.split(worth, np.cumsum(choices)[:-1], axis=1)
        chosen = zip(lists, model_action.reshape(len(both), -1).T, strict=True)
        return float(not all(_as_good(*each).all() for each in chosen)), len(both)
    off = np.abs(model_action.astype(np.float64) - action).max(axis=1)
    if policy.centres is not None:
        off[_as_good(worth, np.abs(policy.centres - model_action).argmin(axis=1))] = 0.0
    return float(off.max()), len(both)


def _as_good(worth: NDArray, chosen: NDArray) -> NDArray[np.bool_]:
    """Return in which rows the chosen action is worth as much as the best, within float32's rounding."""
    lost = worth.max(axis=1) - worth[np.arange(len(worth)), chosen]
    return lost <= 1e-5 * np.maximum(1.0, np.abs(worth).max(axis=1))


@dataclass
class Exported:
    """A model in the form of a submission.

    Attributes
    ----------
    table, arrays : mapping
        The table ``[policy]`` and its arrays.
    agent : object
        The agent, as on the board.
    policy : ModelPolicy or None
        The model it was made from; None for a file that holds arrays.
    """

    table: dict[str, Any]
    arrays: dict[str, NDArray[Any]]
    agent: Any
    policy: ModelPolicy | None = None


def exported(source: Source, env: str, algo: str | None = None) -> Exported:
    """Return a model of an environment in the form of a submission; raise ExportError if that fails."""
    policy = None
    if (ready := arrays_of(source.model)) is not None:
        if algo:
            raise _only_for_models("algo", source)
        table, arrays = ready
    else:
        task, (model, normalise) = TASKS[env](), load_model(source, algo or algorithm_of(source))
        table, arrays = convert(model, task, normalise, source.frames)
        policy = ModelPolicy(model, task, normalise, source.frames)
    try:
        agent = _agent(architecture(env, table), env, arrays)
    except Refused as error:
        raise ExportError(f"{source.model}: {error}") from error
    return Exported(table, arrays, agent, policy)


def own_agent(
    source: Source, env: str, task: Task, table: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]]
) -> Any:
    """Return the agent of `arrays_of`, for any task; raise ExportError if it does not fit."""
    try:
        return _agent(MLP(env, accepted(MLP.table, dict(table), POLICY), task), env, arrays)
    except Refused as error:
        raise ExportError(f"{source.model}: {error}") from error


def _agent(made: Architecture, env: str, arrays: Mapping[str, NDArray[Any]]) -> Any:
    shapes = {key: value.shape for key, value in arrays.items()}
    if shapes != made.arrays:
        raise Refused(f"arrays of {shapes} do not fit {env}, which asks for {made.arrays}")
    for key, array in arrays.items():
        if not np.isfinite(array).all():
            raise Refused(f"{key} has entries that are not finite")
    return made.agent({k: v.astype(np.float64) for k, v in arrays.items()})


# --- exporting ----------------------------------------------------------------------------------------------


def export(
    sources: Sequence[Source],
    folder: Path,
    *,
    authors: Sequence[str],
    license: str,
    env: str | None = None,
    name: str | None = None,
    algo: str | None = None,
    code: str = "",
    description: str = "",
    env_steps: int | None = None,
    seconds: float | None = None,
    hardware: str | None = None,
) -> tuple[Submission, float, int]:
    """Write models, one for each training seed, as a submission.

    Parameters
    ----------
    sources : sequence of Source
        The models.
    folder : Path
        The folder to write, which must not exist.
    authors, license, name, code, description
        See `Submission`; by default, the name is that of the algorithm.
    env, env_steps, seconds, hardware
        If not given, these are taken from the runs' ``result.json``; without such a file, the steps are
        taken from the model and the hardware from this machine. Seconds are those of one training.
    algo : str, optional
        One of `ALGORITHMS`; detected if not given.

    Returns
    -------
    submission : Submission
        What was written.
    difference : float
        The largest difference of the actions of a model and its export, `DIFFERENCE` at most.
    observations : int
        The number of observations for which each model was compared.

    Raises
    ------
    ExportError
        For models that cannot be exported, or that do not act as their export does.
    """
    known = [s.result for s in sources if s.result]
    name = name or _name(sources[0], algo)
    env = env or _environment(sources)
    if env not in protocol.boards():
        raise ExportError(f"there is no environment {env!r}; {hint(env, protocol.boards())}")
    if os.path.lexists(folder):
        raise ExportError(f"{folder} already exists; remove it, or choose another place")
    if seconds is None:
        for source in sources:
            if "wall_seconds" not in (source.result or {}):
                raise ExportError(f"{source.model}: the training's time is not known; give --seconds")
    tables, arrays, curves, steps, took, off, count = [], {}, [], [], [], 0.0, 0
    for number, source in enumerate(sources):
        made = exported(source, env, algo)
        table, content, model = made.table, made.arrays, made.policy and made.policy.model
        one, count = (0.0, 0) if made.policy is None else difference(made.policy, made.agent, env)
        if not one <= DIFFERENCE:
            raise ExportError(
                f"{source.model}: model and export differ by {one:.1e} in an action, more than {DIFFERENCE:g}"
            )
        result = source.result or {}
        if model is None and env_steps is None and "trained" not in result:
            raise ExportError(f"{source.model}: it is not known how long it was trained; give --env-steps")
        seed = result.get("seed", getattr(model, "seed", None))
        seed = number if seed is None or int(seed) in arrays else int(seed)
        if seed in arrays:
            raise ExportError(f"{source.model}: another model has seed {seed} too")
        tables.append(table)
        arrays[seed] = content
        off = max(off, one)
        steps.append(int(result.get("trained", getattr(model, "num_timesteps", 0))))
        took.append(result.get("wall_seconds", 0.0))
        curves += _curve(seed, result.get("curve", []))
    for table in tables:
        if table != tables[0]:
            raise ExportError(f"the models' networks differ: {table} and {tables[0]}")
    training = {
        "env_steps": max(steps) if env_steps is None else env_steps,
        "seconds": round(float(np.mean(took)), 2) if seconds is None else seconds,
        "hardware": hardware or (known and known[0].get("machine")) or _hardware(),
        "curves": curves,
    }
    try:
        submission = write(
            folder, env=env, name=name, authors=list(authors), license=license,
            policy=tables[0], arrays=arrays, training=training, code=code, description=description,
        )  # fmt: skip
    except (Refused, OSError) as error:
        raise ExportError(str(error)) from error
    return submission, off, count


def _environment(sources: Sequence[Source]) -> Any:
    """Return the environment that is noted about the trainings."""
    values = {source.result["env"] for source in sources if source.result and "env" in source.result}
    if not values:
        raise ExportError("the environment is not known; give --env")
    if len(values) > 1:
        raise ExportError(f"the models have more than one environment: {', '.join(map(str, sorted(values)))}")
    return values.pop()


def _curve(seed: int, points: Sequence[Sequence[float]]) -> list[dict[str, Any]]:
    """Return the learning curve from (steps, seconds, mean return), each number of steps once."""
    last = {int(p[0]): float(p[-1]) for p in points}
    kept = sorted(last.items())
    kept = kept[:: -(-len(kept) // protocol.CURVE)] if kept else []
    if not kept:
        return []
    return [{"seed": seed, "steps": [s for s, _ in kept], "returns": [float(f"{r:.6g}") for _, r in kept]}]


def _hardware() -> str:
    from lag_envs.host import machine

    about = machine()
    return f"{about['processor']}, {about['cores']} cores"


# --- the command --------------------------------------------------------------------------------------------


def declare_export(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of ``export``."""
    add = parser.add_argument
    add(
        "models", metavar="MODEL", nargs="+", type=Path,
        help=f"an SB3 .zip; or a folder with {MODEL}, {NORMALISATION}, {RESULT}; or a folder of those",
    )  # fmt: skip
    add("--author", metavar="NAME", action="append", required=True, help="an author; repeatable")
    add("--license", metavar="SPDX", required=True, help="licence of the policies, such as MIT or CC-BY-4.0")
    add("--output", metavar="FOLDER", type=Path, help="new folder to write (default: ENV-NAME)")
    add("--env", metavar="ID", help=f"the environment (default: what {RESULT} says)")
    add("--name", help="name on the board (default: the algorithm)")
    add(
        "--normalise", metavar="PKL", nargs="+", type=Path, default=[],
        help="pickled VecNormalize, one for each MODEL that is a file of Stable-Baselines3",
    )  # fmt: skip
    add(
        "--frames", metavar="N", type=int,
        help="observations that models of Stable-Baselines3 see at once, as with VecFrameStack "
        "(default: as recorded, else 1)",
    )  # fmt: skip
    add("--algo", choices=list(ALGORITHMS), help="algorithm of the models (default: detected)")
    add("--code", metavar="URL", default="", help="https address of the training code")
    add("--description", metavar="TEXT", default="", help="a line about the agent")
    add("--env-steps", metavar="N", type=int, help="steps of one training (default: as recorded)")
    add("--seconds", metavar="S", type=float, help="wall time of one training (default: as recorded)")
    add("--hardware", metavar="TEXT", help="training hardware (default: as recorded, else this machine)")


def run_export(args: argparse.Namespace) -> int:
    """Turn models into a submission."""
    try:
        import torch

        torch.set_num_threads(1)  # the networks are too small to divide the work
        sources = find(args.models, args.normalise)
        for option in ("algo", "frames", "normalise"):
            if getattr(args, option):
                for source in sources:
                    if arrays_of(source.model) is not None:
                        raise _only_for_models(option, source)
        if args.frames is not None:
            sources = [replace(source, frames=args.frames) for source in sources]
        known = args.env or _environment(sources)
        name = args.name or _name(sources[0], args.algo)
        submission, off, count = export(
            sources, args.output or Path(f"{known}-{name}".replace(" ", "-").replace("/", "-")),
            env=args.env, name=name, authors=args.author, license=args.license, algo=args.algo,
            code=args.code, description=args.description, env_steps=args.env_steps, seconds=args.seconds,
            hardware=args.hardware,
        )  # fmt: skip
    except ImportError as error:
        raise UserError(f'{error.name} is missing: pip install "lag-envs[agents,leaderboard]"') from error
    alike = f"largest difference of an action from the models': {off:.1e}, over {count} observations of each"
    print(
        f"{submission.folder}: {submission.env}, {submission.name}, {len(submission.policies)} policies\n"
        f"{alike if count else 'their numbers are used as they are'}\n"
        f"digest {submission.digest}"
    )
    return 0
