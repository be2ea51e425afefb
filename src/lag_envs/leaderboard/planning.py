"""Model-predictive control: planning ahead on the exact model, with numbers from the table."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Annotated, Any

from pydantic import Field

from lag_envs.controllers.beam import beam
from lag_envs.controllers.ilqr import SHARES
from lag_envs.controllers.mpc import planner
from lag_envs.leaderboard import protocol
from lag_envs.leaderboard.architecture import POLICY, Architecture, Array, PolicyTable
from lag_envs.leaderboard.fields import between
from lag_envs.leaderboard.protocol import Refused
from lag_envs.tasks import TASKS

Number = Annotated[float, between(-1e6, 1e6)]
Weight = Annotated[float, between(0.0, 1e6)]
#: Keys that apply only where actions lie in a range, and keys that apply only where they are listed.
RANGED, LISTED = {"iterations", "guesses", "good", "seed"}, {"cell", "energy"}


class MPCTable(PolicyTable):
    """The table ``[policy]`` of a planner."""

    horizon: Annotated[int, between(2, protocol.HORIZON)]
    every: Annotated[int, between(1, protocol.HORIZON)] = 1
    iterations: Annotated[int, between(1, 20)] = 1
    guesses: Annotated[int, between(1, 64)] = 16
    budget: Annotated[int, between(1, protocol.SEARCH_STEPS)] = 20_000
    pause: Annotated[int, between(1, 1_000)] = 10
    good: Weight | None = None
    seed: Annotated[int, between(0, 2**31)] = 0
    cell: Annotated[float, between(1e-3, 10.0)] = 0.2
    energy: Number = 0.0
    weights: dict[str, Weight] = Field(default={})
    rest: dict[str, Number] = Field(default={})


class PlanAhead(Architecture):
    """Model-predictive control: `lag_envs.controllers.mpc.planner` with the table's numbers.

    In the table: `horizon` (steps); `every` (steps between new plans); `iterations` (of iLQR for each);
    `guesses` and `budget` (plans that a search improves, and its limit of model steps); `pause` (steps
    between searches); `good` (a final cost above which another search follows; without it there is only one);
    `seed` (of the guesses); and the tables `weights` and `rest`, by entry of the state: the final cost of the
    squared distance from rest. There are no arrays.

    Where actions are listed, it is `lag_envs.controllers.beam.BeamSearch`, whose width follows from `budget`.
    `cell` (edge of a cell) and `energy` (factor of the energy in the final cost) take the place of
    `iterations`, `guesses`, `good` and `seed`; without `every`, a plan is followed to its end.
    """

    table = MPCTable
    schema = 2
    counts_as = "controller"
    plans = True

    def __init__(self, env_id: str, table: MPCTable) -> None:
        self.task = task = TASKS[env_id]()
        listed = bool(task.formulas.choices)
        for key in sorted((RANGED if listed else LISTED) & table.model_fields_set):
            where = "are listed" if listed else "lie in a range"
            raise Refused(f"{POLICY}: {key} has no meaning where actions {where}; leave it out")
        for key, entries in (("weights", table.weights), ("rest", table.rest)):
            for name in entries:
                if name not in task.scene.state_names:
                    known = ", ".join(task.scene.state_names)
                    raise Refused(
                        f"{POLICY}: {key} must name entries of the state, {known}; got {name!a:.80}"
                    )
        self.arrays = {}
        every = min(table.every, table.horizon)
        if listed:
            self._beam(table)
            steps = table.budget / every if "every" in table.model_fields_set else 0.0
        else:
            steps = table.horizon * (1 + len(SHARES) * table.iterations) / every
        if steps > protocol.MODEL_STEPS:
            raise Refused(
                f"{POLICY}: renewing plans takes {steps:.0f} steps of the model per step of the environment, "
                f"but at most {protocol.MODEL_STEPS} are allowed; shorten the horizon, or plan less often"
            )
        if not listed:
            self.numbers = table.model_dump(exclude={"architecture", *LISTED}, exclude_none=True)

    def _beam(self, table: MPCTable) -> None:
        """Set the numbers of a beam search: its width, and what else the table states."""
        count = math.prod(self.task.formulas.choices)
        # A plan that was found is stepped once more.
        width = (table.budget // table.horizon - 1) // count
        if width < 1:
            raise Refused(
                f"{POLICY}: a search of {table.horizon} steps with {count} actions needs a budget of at "
                f"least {table.horizon * (count + 1)} model steps, got {table.budget}"
            )
        given = table.model_dump(include=table.model_fields_set - {"architecture", "budget"})
        self.numbers = given | {"width": width}

    def agent(self, arrays: Mapping[str, Array]) -> Any:
        """Return a planner that has no plan yet."""
        return (beam if self.task.formulas.choices else planner)(self.task, **self.numbers)
