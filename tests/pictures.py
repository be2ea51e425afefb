"""Pictures of environments for tests."""

import math
from itertools import pairwise

import gymnasium as gym
import numpy as np

import lag_envs
from lag_envs.scenes.shapes import Frame
from lag_envs.tasks import incline

IDS = list(lag_envs.TASKS)


TASKS = {env_id: kind() for env_id, kind in lag_envs.TASKS.items()}
TASKS |= {"quasi-static": incline.Tilt(control="tilt")}


def picture(env_id, state=None, action=0.5, **options):
    env = gym.make(env_id, render_mode="rgb_array", **options)
    env.reset(seed=1, options=None if state is None else {"state": state})
    env.step(np.array([action], dtype=np.float32))
    frame = env.render()
    env.close()
    return frame


def moment(task, share=0.5, **changes):
    state = [c + h for c, h in zip(task.centre, task.half_widths, strict=True)]
    return Frame(state, share * task.limit_control, share, task.target_range and 0.1)._replace(**changes)


def length(points):
    return sum(math.dist(a, b) for a, b in pairwise(points))


def shown(env_id, steps=5, **look):
    env = gym.make(env_id, render_mode="rgb_array", **look)
    env.reset(seed=1)
    for _ in range(steps):
        env.step(np.full(env.action_space.shape, 0.5).astype(env.action_space.dtype))
        frame = env.render()
    env.close()
    return frame
