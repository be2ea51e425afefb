"""RLlib's PPO with each way to step many environments: in turn, in processes, and natively as a vector."""

import ray
from ray.rllib.algorithms.ppo import PPOConfig


def main():
    """Make two updates in each mode."""
    ray.init(num_cpus=2, include_dashboard=False)
    for mode in ("sync", "async", "vector_entry_point"):
        config = (
            PPOConfig()
            .environment("lag_envs:PivotedBar-v0", env_config={"damping": 0.01})
            .env_runners(num_env_runners=1, num_envs_per_env_runner=4, gym_env_vectorize_mode=mode)
            .training(train_batch_size_per_learner=2000, minibatch_size=500, num_epochs=2)
        )
        algo = config.build_algo()
        for _ in range(2):
            found = algo.train()["env_runners"]
        assert found["episode_len_mean"] == 500.0, found["episode_len_mean"]
        steps, mean = found["num_env_steps_sampled_lifetime"], found["episode_return_mean"]
        print(f"{mode}: {steps:g} steps, return {mean:.3g}", flush=True)
        algo.stop()


if __name__ == "__main__":
    main()
