"""TorchRL's `GymEnv`, `GymWrapper`, `ParallelEnv` and collectors, with `check_env_specs`."""

import gymnasium as gym
from torchrl.collectors import Collector, MultiSyncCollector
from torchrl.envs import GymEnv, GymWrapper, ParallelEnv, check_env_specs

import lag_envs


def bar():
    """Return one environment."""
    return GymEnv("lag_envs:PivotedBar-v0")


def check(what, env, steps=60, **options):
    """Check the specs, roll out, and print the number of steps."""
    check_env_specs(env)
    path = env.rollout(steps, **options)
    print(what, tuple(path.shape), flush=True)
    env.close()
    return path


def main():
    """Check them all."""
    for env_id in lag_envs.TASKS:
        check(env_id, GymEnv(f"lag_envs:{env_id}"))
        for mode in ("SameStep", "Disabled"):  # TorchRL refuses NextStep
            envs = gym.make_vec(env_id, num_envs=4, autoreset_mode=mode, duration=1.0)
            path = check(f"{env_id} x 4, {mode}", GymWrapper(envs), 120, break_when_any_done=False)
            assert path["next", "done"].sum() >= 8
    # Keywords that TorchRL tries, and drops if the environment does not take them.
    check("frame_skip", GymEnv("lag_envs:PivotedBar-v0", frame_skip=3))
    check("from_pixels", GymEnv("lag_envs:PivotedBar-v0", from_pixels=True, pixels_only=False), 5)
    check("num_envs", GymEnv("lag_envs:PivotedBar-v0", num_envs=2))
    check("ParallelEnv", ParallelEnv(2, bar))
    for collector in (
        Collector(bar, None, frames_per_batch=200, total_frames=1000),
        MultiSyncCollector([bar, bar], None, frames_per_batch=200, total_frames=1000),
    ):
        frames = sum(batch.numel() for batch in collector)
        assert frames == 1000, frames
        print(type(collector).__name__, frames, flush=True)
        collector.shutdown()


if __name__ == "__main__":
    main()
