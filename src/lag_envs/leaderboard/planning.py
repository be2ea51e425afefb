"""Planning ahead on the exact model, as numbers."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

from pydantic import Field

from lag_envs.controllers.ilqr import SHARES
from lag_envs.controllers.mpc import MPC
from lag_envs.controllers.swing_up import away
from lag_envs.leaderboard import protocol
from lag_envs.leaderboard.architecture import POLICY, Architecture, Array, PolicyTable
from lag_envs.leaderboard.fields import between
from lag_envs.leaderboard.protocol import Refused
from lag_envs.tasks import TASKS

Number = Annotated[float, between(-1e6, 1e6)]
Weight = Annotated[float, between(0.0, 1e6)]


class MPCTable(PolicyTable):
    """The table of one that plans ahead."""

    horizon: Annotated[int, between(2, protocol.HORIZON)]
    every: Annotated[int, between(1, protocol.HORIZON)] = 1
    iterations: Annotated[int, between(1, 20)] = 1
    guesses: Annotated[int, between(1, 64)] = 16
    budget: Annotated[int, between(1, protocol.SEARCH_STEPS)] = 20_000
    pause: Annotated[int, between(1, 1_000)] = 10
    good: Weight | None = None
    seed: Annotated[int, between(0, 2**31)] = 0
    weights: dict[str, Weight] = Field(default={})
    rest: dict[str, Number] = Field(default={})


class PlanAhead(Architecture):
    """Model-predictive control: `lag_envs.controllers.mpc.MPC` with these numbers.

    In the table: `horizon` (steps), `every` (steps after which a plan is renewed), `iterations` (of iLQR for
    that), `guesses` and `budget` (plans that a search improves, and the steps of the model that it may take),
    `pause` (steps from one search to the next) and `good` (cost of the end above which there is another
    search; without it there is one), `seed` (of the guesses); and the tables `weights` and `rest`, by entry
    of the state: what the square of the distance from the rest costs at the end. There are no arrays.
    """

    table = MPCTable
    schema = 2
    counts_as = "controller"
    plans = True

    def __init__(self, env_id: str, table: MPCTable) -> None:
        self.task = task = TASKS[env_id]()
        if task.formulas.choices or task.formulas.actions != 1:
            raise Refused(f"{POLICY}: planning ahead is for tasks with one action, in a range")
        for key, entries in (("weights", table.weights), ("rest", table.rest)):
            for name in entries:
                if name not in task.scene.state_names:
                    known = ", ".join(task.scene.state_names)
                    raise Refused(
                        f"{POLICY}: {key} must name entries of the state, {known}; got {name!a:.80}"
                    )
        steps = table.horizon * (1 + len(SHARES) * table.iterations) / min(table.every, table.horizon)
        if steps > protocol.MODEL_STEPS:
            raise Refused(
                f"{POLICY}: renewing plans takes {steps:.0f} steps of the model for one of the environment, "
                f"at most {protocol.MODEL_STEPS} are allowed; plan less far, or less often"
            )
        self.numbers = table.model_dump(exclude={"architecture", "weights", "rest"}, exclude_none=True)
        self.tail = away(task, table.weights, table.rest) if table.weights else None
        self.arrays = {}

    def agent(self, arrays: Mapping[str, Array]) -> Any:
        """Return what plans, with nothing planned yet."""
        return MPC(self.task, self.tail, **self.numbers)
