"""Programs of environments with hidden parameters, imperfect sensors or actuators.

What the keywords mean is told in docs/usage.md; `lag_envs.tasks.imperfections` checks them. Parameters that
are drawn are rows of a batch, as those that differ in any batch are (`drawn`). With everything else
(`program`) a control step is taken by one function on the rows of one environment. The single environment
calls it on its own rows, a batch on those of each environment in turn, so both have the same bits. Within the
step the command in force may change, and what a late sensor shows may lie in its midst: it is divided there,
and nowhere else.

Draws come from the same generator as starts and kicks, with a key of their own for each purpose, which
follows from the episode's.
"""
