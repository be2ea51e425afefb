"""Speed beside other environments, and the time to a first step; the command ``lag-envs bench``.

All contestants are measured in one process on one core, in turn, round after round, and compared within each
round, so that a slow spell of the machine falls on all of them. A sample is a loop over actions made
beforehand; it holds all that a step does: dynamics, observation, reward, endings, kicks, and the resets that
follow. Where batches are measured that several threads step, the process has a core for each of them.

`process` starts a `measurement`. Contestants are prepared by `environments`, `peers`, `energies` and `peak`,
and sampled in `rounds`. What comes out goes through `results` and `targets` to `console` and `docs`.
"""
