"""Programs of environments with hidden parameters, imperfect sensors or actuators.

docs/usage.md explains the keywords; `lag_envs.tasks.imperfections` checks them. Drawn parameters are rows of
a batch, like parameters that differ within any batch (`drawn`). Noise, pushes, slew and delays of whole
control steps change the command before a step and what is shown after it, in loops of their own (`whole`);
with a lag the step between is that of `lagged`.

With other delays the command in force may change within a step, and the state that a late sensor shows may
lie inside it: the step is divided at these times, and nowhere else (`divided`).

Draws come from the same generator as starts and kicks, with a key for each purpose, derived from that of the
episode.
"""
