"""The native vector environments as Stable-Baselines3's `VecEnv` (extra ``agents``).

Learners then step all environments in one compiled call:

>>> from stable_baselines3 import PPO
>>> envs = make_vec_env("PivotedBar-v0", 64)
>>> model = PPO("MlpPolicy", envs)

``lag-envs hyperparams ppo`` prints the hyperparameters that the agents were trained with, in the RL Zoo's
form.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
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


def make_vec_env(env_id: str, num_envs: int, *, stagger: int = 0, **options: Any) -> VecEnv:
    """Return a native vector environment for Stable-Baselines3.

    Parameters
    ----------
    env_id : str
        Id of an environment.
    num_envs : int
        Number of environments.
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
    return VecEnv(gym.make_vec(env_id, num_envs, autoreset_mode="SameStep", **options), stagger=stagger)


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
    ValueError
        For an environment with another autoreset mode.
    """

    def __init__(self, env: VectorEnv, *, stagger: int = 0) -> None:
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
        observations, infos = self.env.reset(seed=seeds, options=self._stacked_options())
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
                last = {"TimeLimit.truncated": bool(truncated[i] and not terminated[i])}
                each[i] = _row(final, i) | last | {"terminal_observation": infos["final_obs"][i]}
        return observations, rewards.astype(np.float32), done, each

    def close(self) -> None:
        """Close the environment."""
        self.env.close()

    def get_images(self) -> Sequence[NDArray[np.uint8] | None]:
        """Return a picture of each environment, if made with ``render_mode="rgb_array"``."""
        frames: Any = self.env.render() if self.render_mode is not None else None
        return [None] * self.num_envs if frames is None else list(frames)

    # --- attributes of the environments ---------------------------------------------------------------------

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Return an attribute of the environments; one row for each if the batch has an array."""
        single = {"action_space": "single_action_space", "observation_space": "single_observation_space"}
        return self._share(getattr(self.env, single.get(attr_name, attr_name)), indices)

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Set an attribute of all environments: a batch has only one of each."""
        self._all(indices, "set")
        setattr(self.env.unwrapped, attr_name, value)

    def env_method(
        self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any
    ) -> list[Any]:
        """Call a method of the batch, for all environments; return the result for each."""
        self._all(indices, "call")
        return self._share(getattr(self.env, method_name)(*method_args, **method_kwargs), None)

    def env_is_wrapped(self, wrapper_class: type[gym.Wrapper], indices: Any = None) -> list[bool]:
        """Return False for each: single environments in a batch cannot be wrapped."""
        return [False for _ in self._get_indices(indices)]

    # --- internal -------------------------------------------------------------------------------------------

    def _stacked_options(self) -> dict[str, Any] | None:
        """Return the options of the environments as arrays of the batch."""
        names = {name for options in self._options for name in options}
        if any(names != set(options) for options in self._options):
            raise ValueError("either all environments are given the same reset options, or none")
        return {name: np.array([o[name] for o in self._options]) for name in names} or None

    def _split(self, infos: dict[str, Any]) -> list[dict[str, Any]]:
        """Return an info for each environment."""
        reported = {k: v for k, v in infos.items() if k.lstrip("_") not in ("final_obs", "final_info")}
        if not reported:
            return [{} for _ in range(self.num_envs)]
        return [_row(reported, i) for i in range(self.num_envs)]

    def _share(self, value: Any, indices: Any) -> list[Any]:
        each = isinstance(value, np.ndarray | list | tuple) and len(value) == self.num_envs
        return [value[i] if each else value for i in self._get_indices(indices)]

    def _all(self, indices: Any, verb: str) -> None:
        chosen: Iterable[int] = self._get_indices(indices)
        if sorted(chosen) != list(range(self.num_envs)):
            raise NotImplementedError(
                f"a batch can only {verb} for all of its environments, got indices {indices!r}"
            )


def _row(infos: dict[str, Any], i: int) -> dict[str, Any]:
    """Return the part of a vector environment's infos for environment i: where the mask "_name" is set."""
    return {k: v[i] for k, v in infos.items() if not k.startswith("_") and infos[f"_{k}"][i]}


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
