"""Programs of environments with hidden parameters, imperfect sensors or actuators.

docs/usage.md explains the keywords; `lag_envs.tasks.imperfections` checks them. Drawn parameters are rows of
a batch, like parameters that differ within any batch (`drawn`). Noise, pushes, slew and delays of whole
control steps change the command before a step and what is shown after it, in loops of their own (`whole`);
with a lag, the step itself is that of `lagged`.

With other delays the command in force may change within a step, and a late sensor may show a state within the
step. The step is then divided at these times, and nowhere else (`divided`).

Draws come from the same generator as starts and kicks, with a key for each purpose, which is derived from the
episode's key.
"""
