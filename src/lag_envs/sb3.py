"""The native vector environments as Stable-Baselines3's `VecEnv` (extra ``agents``).

Learners then step all environments in one compiled call:

>>> from stable_baselines3 import PPO
>>> envs = make_vec_env("PivotedBar-v0", 64)
>>> model = PPO("MlpPolicy", envs)

``lag-envs hyperparams ppo`` prints the hyperparameters that the agents were trained with, in the RL Zoo's
form.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from numpy.typing import NDArray

try:
    from stable_baselines3.common import vec_env
except ModuleNotFoundError as error:
    raise ModuleNotFoundError(
        f'{error.name} is missing: pip install "lag-envs[agents]"', name=error.name
    ) from error

import lag_envs  # noqa: F401  (registers the environments)
from lag_envs.envs.stagger import stagger
from lag_envs.leaderboard.networks import bin_centres


def make_vec_env(
    env_id: str, num_envs: int, *, seed: int | None = None, stagger: int = 0, **options: Any
) -> VecEnv:
    """Return a native vector environment for Stable-Baselines3.

    Parameters
    ----------
    env_id : str
        Id of an environment.
    num_envs : int
        Number of environments.
    seed : int, optional
        Seed of the first environment's first episode, as for `VecEnv.seed`.
    stagger : int, default 0
        See `VecEnv`.
    **options
        Parameters of the environment.

    Examples
    --------
    >>> env = make_vec_env("PivotedBar-v0", 3, damping=0.0)
    >>> _ = env.seed(1)
    >>> env.reset().shape
    (3, 5)
    """
    if "env_kwargs" in options:
        raise TypeError("write the parameters themselves in place of env_kwargs, as in duration=5.0")
    envs = VecEnv(gym.make_vec(env_id, num_envs, autoreset_mode="SameStep", **options), stagger=stagger)
    if seed is not None:
        envs.seed(seed)
    return envs


class VecEnv(vec_env.VecEnv):
    """A Gymnasium vector environment as Stable-Baselines3's `VecEnv`.

    Its results equal those of `DummyVecEnv` over the single environments, bit for bit, except that the infos
    of environments whose episode continues hold only what the environment reports.

    Parameters
    ----------
    env : VectorEnv
        A vector environment that resets in the same step.
    stagger : int, default 0
        Number of steps over which the starts of the first episodes are spread; see `lag_envs.envs.stagger`.

    Raises
    ------
    TypeError
        For a single environment.
    ValueError
        For an environment with another autoreset mode.
    """

    def __init__(self, env: VectorEnv, *, stagger: int = 0) -> None:
        if not isinstance(env, VectorEnv):
            raise TypeError(f"a vector environment is needed, as from make_vec_env, got {env}")
        mode = env.metadata.get("autoreset_mode")
        if mode != AutoresetMode.SAME_STEP:
            raise ValueError(f'the environment must be made with autoreset_mode="SameStep", got {mode}')
        self.env = env
        self._stagger = stagger
        self._actions: NDArray[np.floating] | None = None
        super().__init__(env.num_envs, env.single_observation_space, env.single_action_space)

    # --- stepping -------------------------------------------------------------------------------------------

    def reset(self) -> NDArray[np.float32]:
        """Begin an episode in every environment, with the seeds and options set before."""
        seeds: Any = self._seeds  # Gymnasium's types allow only one seed
        observations, infos = self.env.reset(seed=seeds, options=_stack(self._options) or None)
        if self._stagger:
            seed = None if self._seeds[0] is None else int(self._seeds[0])
            observations, infos = stagger(self.env, self._stagger, seed)
        self.reset_infos = self._split(infos)
        self._reset_seeds()
        self._reset_options()
        return observations

    def step_async(self, actions: NDArray[np.floating]) -> None:
        """Take the actions for the next step."""
        self._actions = actions

    def step_wait(
        self,
    ) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_], list[dict[str, Any]]]:
        """Step all environments; those whose episode has ended begin the next one."""
        observations, rewards, terminated, truncated, infos = self.env.step(self._actions)
        done = terminated | truncated
        ended = np.flatnonzero(done).tolist()
        # New dicts, because callers may write to them; they cost some 30 ns each.
        each = self._split(infos)
        if ended:
            final = infos.get("final_info", {})
            for i in ended:
                self.reset_infos[i] = each[i]
                last: dict[str, Any] = {"TimeLimit.truncated": bool(truncated[i] and not terminated[i])}
                last["terminal_observation"] = infos["final_obs"][i]
                # Wrappers report the end beside what the next episode's reset reports.
                each[i] = each[i] | _row(final, i, self.num_envs) | last
        return observations, rewards.astype(np.float32), done, each

    def close(self) -> None:
        """Close the environment."""
        self.env.close()

    def get_images(self) -> Sequence[NDArray[np.uint8] | None]:
        """Return a picture of each environment, or with ``show_tiles`` one of them all.

        They are None if the environment was made without ``render_mode="rgb_array"``.
        """
        frames: Any = self.env.render() if self.render_mode is not None else None
        if isinstance(frames, np.ndarray) and frames.ndim == 3:
            return [frames]
        return [None] * self.num_envs if frames is None else list(frames)

    # --- attributes of the environments ---------------------------------------------------------------------

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Return an attribute of the environments; one row for each if the batch has an array."""
        if attr_name == "scene":
            return [task.scene for task in self.get_attr("tasks", indices)]
        single = {"action_space": "single_action_space", "observation_space": "single_observation_space"}
        name = (single | {"task": "tasks"}).get(attr_name, attr_name)
        return self._share(name, getattr(self._owner(name), name), indices)

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Set an attribute of all environments: they share one value in a batch."""
        self._all(indices, "set")
        batch: Any = self.env.unwrapped
        batch.check_settable(attr_name)
        setattr(self._owner(attr_name), attr_name, value)

    def env_method(
        self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any
    ) -> list[Any]:
        """Call a method of the batch, for all environments; return the result for each."""
        self._all(indices, "call")
        result = getattr(self._owner(method_name), method_name)(*method_args, **method_kwargs)
        return self._share(method_name, result, None)

    def env_is_wrapped(self, wrapper_class: type[gym.Wrapper], indices: Any = None) -> list[bool]:
        """Return False for each: single environments in a batch cannot be wrapped."""
        return [False for _ in self._get_indices(indices)]

    # --- internal -------------------------------------------------------------------------------------------

    def _split(self, infos: dict[str, Any]) -> list[dict[str, Any]]:
        """Return an info for each environment."""
        reported = {k: v for k, v in infos.items() if k.lstrip("_") not in ("final_obs", "final_info")}
        if not reported:
            return [{} for _ in range(self.num_envs)]
        return [_row(reported, i, self.num_envs) for i in range(self.num_envs)]

    def _owner(self, name: str) -> VectorEnv:
        """Return the object that has an attribute: vector wrappers do not pass on attributes they lack."""
        return self.env if hasattr(self.env, name) else self.env.unwrapped

    def _share(self, name: str, value: Any, indices: Any) -> list[Any]:
        """Return each environment's part of a value from the batch's attribute or method `name`."""
        chosen: Iterable[int] = self._get_indices(indices)
        if name not in ("tasks", "render"):
            return [_row(value, i, self.num_envs) for i in chosen]
        return [value[i] if isinstance(value, list | tuple) else value for i in chosen]

    def _all(self, indices: Any, verb: str) -> None:
        chosen: Iterable[int] = self._get_indices(indices)
        if sorted(chosen) != list(range(self.num_envs)):
            raise NotImplementedError(
                f"a batch can only {verb} for all of its environments, got indices {indices!r}"
            )


def _row(value: Any, i: int, n: int) -> Any:
    """Return the part of a batch's value for environment i of n.

    Arrays have a row for each environment, also within tuples and mappings; in a mapping, a mask "_name" says
    which environments have an entry. Anything else belongs to each environment as a whole.
    """
    if isinstance(value, np.ndarray) and value.shape[:1] == (n,):
        return value[i]
    if type(value) is tuple:
        return tuple(_row(v, i, n) for v in value)
    if isinstance(value, Mapping):
        masks = {f"_{k}" for k in value} & set(value)
        return {
            k: _row(v, i, n)
            for k, v in value.items()
            if k not in masks and (f"_{k}" not in masks or value[f"_{k}"][i])
        }
    return value


def _stack(values: Sequence[Any]) -> Any:
    """Return reset options of the environments as arrays of the batch, those in mappings by name."""
    if not all(isinstance(v, Mapping) for v in values):
        return np.array(values)
    if any(set(v) != set(values[0]) for v in values):
        raise ValueError("either all environments must be given the same reset options, or none")
    return {name: _stack([v[name] for v in values]) for name in values[0]}


class ScaledReward(vec_env.VecEnvWrapper):
    """Multiply the reward that a learner sees.

    Parameters
    ----------
    venv : stable_baselines3.common.vec_env.VecEnv
        The environments.
    factor : float
        The factor of the rewards.
    """

    def __init__(self, venv: vec_env.VecEnv, factor: float) -> None:
        super().__init__(venv)
        self.factor = np.float32(factor)

    def reset(self) -> Any:
        """Begin an episode in every environment."""
        return self.venv.reset()

    def step_wait(self) -> Any:
        """Step all environments."""
        observations, rewards, done, infos = self.venv.step_wait()
        return observations, rewards * self.factor, done, infos


class DiscreteActions(vec_env.VecEnvWrapper):
    """Discrete actions in place of numbers in [-1, 1], like Gymnasium's ``DiscretizeAction``.

    Parameters
    ----------
    venv : stable_baselines3.common.vec_env.VecEnv
        The environments.
    bins : int
        Number of actions.
    """

    def __init__(self, venv: vec_env.VecEnv, bins: int) -> None:
        super().__init__(venv, action_space=gym.spaces.Discrete(bins))
        self._centres = bin_centres(bins).astype(np.float32)

    def reset(self) -> Any:
        """Begin an episode in every environment."""
        return self.venv.reset()

    def step_async(self, actions: NDArray[np.integer]) -> None:
        """Take the numbers of the actions for the next step."""
        self.venv.step_async(self._centres[actions][:, None])

    def step_wait(self) -> Any:
        """Step all environments."""
        return self.venv.step_wait()
