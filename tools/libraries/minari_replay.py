"""Minari: record as its README does, load the data set, recover its environment, replay bit for bit."""

import gymnasium as gym
import minari
from minari import DataCollector

import lag_envs

for env_id, options in [
    *((i, {}) for i in lag_envs.TASKS),
    ("PivotedBar-v0", {"dt": 0.005, "duration": 1.0}),
]:
    env = DataCollector(gym.make(env_id, **options))
    env.action_space.seed(1)
    for _ in range(3):
        env.reset()  # with a 64-bit seed that Minari draws and stores
        done = False
        while not done:
            action = env.action_space.sample()
            observation, reward, terminated, truncated, info = env.step(action)
            done = terminated or truncated
    name = f"lag/{env_id.lower()[:-3]}{len(options)}-v0"
    env.create_dataset(name)
    steps = env.spec.max_episode_steps
    env.close()

    dataset = minari.load_dataset(name)
    assert dataset.spec.env_spec.max_episode_steps == steps
    again = dataset.recover_environment()
    assert again.spec.max_episode_steps == steps
    count = 0
    for episode in dataset.iterate_episodes():
        (kept,) = dataset.storage.get_episode_metadata([episode.id])
        observation, _ = again.reset(seed=int(kept["seed"]))
        replayed = [observation]
        for t, action in enumerate(episode.actions):
            observation, reward, terminated, truncated, _ = again.step(action)
            replayed.append(observation)
            assert reward == episode.rewards[t]
            assert (terminated, truncated) == (episode.terminations[t], episode.truncations[t])
        assert b"".join(o.tobytes() for o in replayed) == episode.observations.tobytes()
        count += len(episode)
    print(f"{env_id} {options or ''}: {count} steps replayed bit for bit", flush=True)
    minari.delete_dataset(name)
