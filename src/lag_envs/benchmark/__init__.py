"""Speed compared with other environments, and the time to a first step; the command ``lag-envs bench``.

All contestants are measured in one process on one core, in turn, round after round. They are compared within
each round, so that a slow phase of the machine affects all of them. A sample is a loop over actions made
beforehand; it includes everything that a step does: dynamics, observation, reward, endings, kicks, and the
resets that follow. If batches are stepped by several threads, the process has a core for each thread.

`process` starts a `measurement`. Contestants are prepared by `environments`, `peers`, `energies` and `peak`,
and sampled in `rounds`. The results go through `results` and `targets` to `console` and `docs`.
"""
