"""A plan followed by time-varying feedback, as numbers."""

from __future__ import annotations

from collections.abc import Mapping

from lag_envs.controllers.tracking import Tracking
from lag_envs.leaderboard.architecture import (
    POLICY,
    Architecture,
    Array,
    PageData,
    PolicyTable,
    feedback_data,
)
from lag_envs.leaderboard.protocol import Refused
from lag_envs.tasks import TASKS


class PlanArchitecture(Architecture):
    """Action = planned action - gain · (state - planned state), with a gain for each step.

    After the plan, action = -hold · (state - rest). States are read from the observation; differences of an
    angle that is observed by its cosine and sine are taken the shorter way around. When acting more often,
    planned states are interpolated.

    Arrays: ``states`` (T + 1, n_state), ``actions`` (T,), ``gains`` (T, n_state), ``rest`` (n_state,),
    ``hold`` (n_state,), states in SI units. If an action has m numbers, ``actions`` is (T, m), ``gains`` (T,
    m, n_state), and ``hold`` (m, n_state).
    """

    schema = 2

    def __init__(self, env_id: str, table: PolicyTable) -> None:
        self.task = task = TASKS[env_id]()
        if task.formulas.choices or task.formulas.targets > 1:
            raise Refused(f"{POLICY}: plans are for actions in a range, and one target at most")
        self.arrays = Tracking.shapes(task)

    def agent(self, arrays: Mapping[str, Array]) -> Tracking:
        """Return the agent that follows the plan."""
        return Tracking(self.task, **arrays)

    def page_data(self, arrays: Mapping[str, Array]) -> PageData | None:
        """Return the plan as feedback."""
        return feedback_data(self.agent(arrays), self.task)
