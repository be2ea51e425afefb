"""Test every wrapper of Gymnasium, single and vector, around each environment; its checkers; its `play`.

``python gymnasium_wrappers.py single|vector|checkers|play``. A wrapper that is not listed here causes an
error, so that no wrapper of a new release is missed.
"""

import sys
import warnings
from tempfile import mkdtemp

import gymnasium as gym
import gymnasium.wrappers as single
import gymnasium.wrappers.vector as vector
import jax.numpy as jnp
import numpy as np
import torch
from gymnasium import spaces
from gymnasium.utils.env_checker import check_env
from gymnasium.utils.env_match import check_environments_match
from gymnasium.utils.performance import benchmark_render, benchmark_step, benchmark_vector_step
from gymnasium.vector import AutoresetMode

import lag_envs

STEPS = 60
#: Wrappers for a single kind of environment.
ELSEWHERE = {"AtariPreprocessing": "for Atari games only"}


def pixels(env):
    """Return an environment whose observations are pictures."""
    return single.AddRenderObservation(env, render_only=True)


def image(envs):
    """Return a vector environment whose observations are turned into pictures, as some wrappers require."""
    one = spaces.Box(0, 255, (16, 16, 3), np.uint8)
    many = spaces.Box(0, 255, (envs.num_envs, 16, 16, 3), np.uint8)
    show = lambda o: np.broadcast_to(np.uint8(127 * np.tanh(o[:, :1]) + 128)[:, None, None], many.shape)  # noqa: E731
    return vector.TransformObservation(envs, show, many, one)


def as_dict(envs):
    """Return a vector environment whose observations are dicts, as some wrappers require."""
    one = spaces.Dict({"a": envs.single_observation_space, "b": envs.single_observation_space})
    many = spaces.Dict({"a": envs.observation_space, "b": envs.observation_space})
    return vector.TransformObservation(envs, lambda o: {"a": o, "b": -o}, many, one)


BOX = spaces.Box(-2.0, 2.0, (1,), np.float32)
#: How each wrapper is applied to a single environment `e`.
SINGLE = {
    "DelayObservation": lambda e: single.DelayObservation(e, 2),
    "DtypeObservation": lambda e: single.DtypeObservation(e, np.float64),
    "DiscretizeObservation": lambda e: single.DiscretizeObservation(e, 10),
    "FilterObservation": lambda e: single.FilterObservation(single.AddRenderObservation(e, False), ["state"]),
    "FlattenObservation": single.FlattenObservation,
    "FrameStackObservation": lambda e: single.FrameStackObservation(e, 3),
    "GrayscaleObservation": lambda e: single.GrayscaleObservation(pixels(e)),
    "TransformObservation": lambda e: single.TransformObservation(e, lambda o: -o, e.observation_space),
    "MaxAndSkipObservation": lambda e: single.MaxAndSkipObservation(e, 2),
    "NormalizeObservation": single.NormalizeObservation,
    "AddRenderObservation": lambda e: single.AddRenderObservation(e, render_only=False),
    "ResizeObservation": lambda e: single.ResizeObservation(pixels(e), (48, 64)),
    "ReshapeObservation": lambda e: single.ReshapeObservation(e, (1, *e.observation_space.shape)),
    "RescaleObservation": lambda e: single.RescaleObservation(e, np.float32(-1.0), np.float32(1.0)),
    "TimeAwareObservation": single.TimeAwareObservation,
    "ClipAction": single.ClipAction,
    "DiscretizeAction": lambda e: single.DiscretizeAction(e, 9),
    "TransformAction": lambda e: single.TransformAction(e, lambda a: 0.5 * a, BOX),
    "RescaleAction": lambda e: single.RescaleAction(e, np.float32(-2.0), np.float32(2.0)),
    "StickyAction": lambda e: single.StickyAction(e, 0.3),
    "RepeatAction": lambda e: single.RepeatAction(e, 2),
    "ClipReward": lambda e: single.ClipReward(e, -0.1, 0.1),
    "TransformReward": lambda e: single.TransformReward(e, lambda r: 0.1 * r),
    "NormalizeReward": single.NormalizeReward,
    "TimeLimit": lambda e: single.TimeLimit(e, 20),
    "Autoreset": single.Autoreset,
    "PassiveEnvChecker": single.PassiveEnvChecker,
    "OrderEnforcing": single.OrderEnforcing,
    "RecordEpisodeStatistics": single.RecordEpisodeStatistics,
    "AddWhiteNoise": lambda e: single.AddRenderObservation(single.AddWhiteNoise(e, 0.1), True),
    "ObstructView": lambda e: single.AddRenderObservation(single.ObstructView(e, 0.1, 8), True),
    "RenderCollection": single.RenderCollection,
    "RecordVideo": lambda e: single.RecordVideo(e, mkdtemp() + "/videos", disable_logger=True),
    "HumanRendering": single.HumanRendering,
    "ArrayConversion": lambda e: single.ArrayConversion(e, np, torch),
    "NumpyToTorch": single.NumpyToTorch,
    "JaxToNumpy": lambda e: single.JaxToNumpy(single.ArrayConversion(e, np, jnp)),
    "JaxToTorch": lambda e: single.JaxToTorch(single.ArrayConversion(e, np, jnp)),
}
#: How each wrapper is applied to a vector environment.
VECTOR = {
    "VectorizeTransformObservation": lambda e: vector.VectorizeTransformObservation(
        e, single.ReshapeObservation, shape=(1, *e.single_observation_space.shape)
    ),
    "VectorizeTransformAction": lambda e: vector.VectorizeTransformAction(
        e, single.RescaleAction, min_action=np.float32(-2.0), max_action=np.float32(2.0)
    ),
    "VectorizeTransformReward": lambda e: vector.VectorizeTransformReward(
        e, single.ClipReward, min_reward=-0.1, max_reward=0.1
    ),
    "DictInfoToList": vector.DictInfoToList,
    "TransformObservation": lambda e: vector.TransformObservation(e, lambda o: -o),
    "FilterObservation": lambda e: vector.FilterObservation(as_dict(e), ["a"]),
    "FlattenObservation": lambda e: vector.FlattenObservation(as_dict(e)),
    "GrayscaleObservation": lambda e: vector.GrayscaleObservation(image(e)),
    "ResizeObservation": lambda e: vector.ResizeObservation(image(e), (8, 8)),
    "ReshapeObservation": lambda e: vector.ReshapeObservation(e, (1, *e.single_observation_space.shape)),
    "RescaleObservation": lambda e: vector.RescaleObservation(e, np.float32(-1.0), np.float32(1.0)),
    "DtypeObservation": lambda e: vector.DtypeObservation(e, np.float64),
    "NormalizeObservation": vector.NormalizeObservation,
    "TransformAction": lambda e: vector.TransformAction(e, lambda a: 0.5 * a, single_action_space=BOX),
    "ClipAction": vector.ClipAction,
    "RescaleAction": lambda e: vector.RescaleAction(e, np.float32(-2.0), np.float32(2.0)),
    "TransformReward": lambda e: vector.TransformReward(e, lambda r: 0.1 * r),
    "ClipReward": lambda e: vector.ClipReward(e, -0.1, 0.1),
    "NormalizeReward": vector.NormalizeReward,
    "RecordEpisodeStatistics": vector.RecordEpisodeStatistics,
    "RecordVideo": lambda e: vector.RecordVideo(e, mkdtemp() + "/videos", disable_logger=True),
    "HumanRendering": vector.HumanRendering,
    "ArrayConversion": lambda e: vector.ArrayConversion(e, np, torch),
    "NumpyToTorch": vector.NumpyToTorch,
    "JaxToNumpy": lambda e: vector.JaxToNumpy(vector.ArrayConversion(e, np, jnp)),
    "JaxToTorch": lambda e: vector.JaxToTorch(vector.ArrayConversion(e, np, jnp)),
}
#: Wrappers that take or return something other than NumPy arrays although their spaces do not say so.
OTHER_ARRAYS = ("ArrayConversion", "NumpyToTorch", "JaxToTorch")


def listed(module, recipes):
    """Return the names of a module's wrappers; exit with an error if they differ from our list."""
    names = [n for n in module.__all__ if isinstance(getattr(module, n), type) and n not in ELSEWHERE]
    unknown, gone = sorted(set(names) - set(recipes)), sorted(set(recipes) - set(names))
    if unknown or gone:
        sys.exit(f"wrappers that are not listed here: {unknown}; that Gymnasium lacks: {gone}")
    return names


def play_episodes(env, tensors):
    """Take steps with an env or vector env, and check the results."""
    observation, _ = env.reset(seed=1)
    env.action_space.seed(1)
    many = hasattr(env, "num_envs")
    for _ in range(STEPS):
        if not tensors:
            assert env.observation_space.contains(observation), observation
        action = env.action_space.sample()
        action = torch.as_tensor(action) if tensors else action
        observation, reward, terminated, truncated, _ = env.step(action)
        assert np.all(np.isfinite(np.asarray(reward))), reward
        over = np.logical_or(np.asarray(terminated), np.asarray(truncated))
        if not many and over:
            observation, _ = env.reset()
        elif many and env.metadata["autoreset_mode"] == AutoresetMode.DISABLED and over.any():
            observation, _ = env.reset(options={"reset_mask": over})
    env.close()


def wrappers(kind):
    """Step every environment inside every wrapper, vector environments in all autoreset modes."""
    module, recipes = (single, SINGLE) if kind == "single" else (vector, VECTOR)
    names = listed(module, recipes)
    known_failures = set()
    for env_id in lag_envs.TASKS:
        for name in names:
            # JAX compiles for a second, so only one environment is used.
            if "Jax" in name and env_id != "PivotedBar-v0":
                continue
            tensors = name in OTHER_ARRAYS
            options = {"render_mode": "rgb_array", "duration": 1.0}
            if kind == "single":
                play_episodes(recipes[name](gym.make(env_id, **options)), tensors)
                continue
            for mode in AutoresetMode:
                try:
                    envs = gym.make_vec(env_id, num_envs=3, autoreset_mode=mode, **options)
                    play_episodes(recipes[name](envs), tensors)
                except Exception as error:
                    if not fails_alike(error, recipes[name], mode, tensors):
                        raise
                    known_failures.add(f"{name}, {mode.value}: {type(error).__name__}, as around Pendulum-v1")
    print(f"{len(names)} wrappers around {len(lag_envs.TASKS)} environments")
    print(
        *sorted(known_failures),
        *(f"{n}: {why}" for n, why in ELSEWHERE.items() if n in module.__all__),
        sep="\n",
    )


def fails_alike(error, wrapper, mode, tensors):
    """Return whether Gymnasium's own Pendulum-v1 fails inside a wrapper in the same way."""
    try:
        envs = gym.make_vec(
            "Pendulum-v1", 3, "sync", vector_kwargs={"autoreset_mode": mode}, render_mode="rgb_array",
            max_episode_steps=STEPS // 2,
        )  # fmt: skip
        play_episodes(wrapper(envs), tensors)
    except type(error) as other:
        return str(other) == str(error)
    return False


def checkers():
    """Check every environment with Gymnasium's checkers, and time it with its benchmarks."""
    for env_id in lag_envs.TASKS:
        check_env(gym.make(env_id, render_mode="rgb_array").unwrapped)
        check_environments_match(gym.make(env_id), gym.make(env_id), num_steps=300, seed=1)
        steps = benchmark_step(gym.make(env_id), target_duration=1, seed=1)
        many = benchmark_vector_step(gym.make_vec(env_id, num_envs=64), target_duration=1, seed=1)
        shown = gym.make(env_id, render_mode="rgb_array")
        shown.reset(seed=1)
        frames = benchmark_render(shown, target_duration=1)
        print(f"{env_id}: checked; {steps:,.0f} and {many:,.0f} steps a second, {frames:,.0f} frames")


def play():
    """Play every environment with the keys it names, in a window that is closed after a second."""
    import pygame
    from gymnasium.utils.play import play

    for env_id in lag_envs.TASKS:
        env = gym.make(env_id, render_mode="rgb_array")
        taken = []

        def press(before, after, action, *rest, taken=taken):
            taken.append(float(action[0]))
            events = {10: (pygame.KEYDOWN, "a"), 20: (pygame.KEYUP, "a"), 30: (pygame.KEYDOWN, "d")}
            if len(taken) in events:
                kind, key = events[len(taken)]
                pygame.event.post(pygame.event.Event(kind, key=ord(key)))
            if len(taken) == 40:
                pygame.event.post(pygame.event.Event(pygame.QUIT))

        play(env, callback=press, seed=1)
        assert {-1.0, 1.0} <= set(taken), taken
        print(f"{env_id}: {len(taken)} steps played")


if __name__ == "__main__":
    # Gymnasium warns about an environment by UserWarning. Other warnings are caused by its wrappers.
    warnings.simplefilter("error", UserWarning)
    warnings.filterwarnings(
        "ignore", ".*will not contain the last frame", UserWarning
    )  # in SameStep, anybody's
    what = sys.argv[1]
    wrappers(what) if what in ("single", "vector") else {"checkers": checkers, "play": play}[what]()
