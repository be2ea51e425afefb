"""The closed list of a submission's architectures: data in, actions out, with Stable-Baselines3's `predict`.

=============  ===================================================================================
architecture   what it is
=============  ===================================================================================
``mlp``        a network of fully connected layers, which may see the last few observations
``gru``        a network with a memory: a gated recurrent unit
``linear``     action = gain · observation + offset, clipped
``plan``       states, actions and a gain for each step, and feedback to hold the end
``table``      actions over a grid, or values over a grid that are looked up one step ahead
``mpc``        plans ahead on the exact model: horizon, terminal weights, budget of model steps
``controller`` one of `lag_envs.controllers`, with numbers
=============  ===================================================================================

An architecture is made from the table ``[policy]`` of ``submission.toml``. It states which arrays it needs
and makes a policy from them.
"""

from __future__ import annotations

import inspect
import re
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any

import numpy as np
from pydantic import Field, create_model

from lag_envs.leaderboard.architecture import (
    POLICY,
    Architecture,
    Array,
    PageData,
    PolicyTable,
    feedback_data,
)
from lag_envs.leaderboard.fields import Strict, accepted, between, shown_ascii
from lag_envs.leaderboard.grids import GridArchitecture
from lag_envs.leaderboard.networks import GRU, MLP, Linear
from lag_envs.leaderboard.planning import PlanAhead
from lag_envs.leaderboard.protocol import Refused
from lag_envs.leaderboard.tracking import PlanArchitecture
from lag_envs.tasks import TASKS, resolve


@dataclass(frozen=True)
class SubmittedPolicy:
    """An architecture with its arrays.

    Parameters
    ----------
    architecture : Architecture
        The architecture.
    arrays : mapping of str to ndarray of float64
        Its arrays.
    """

    architecture: Architecture
    arrays: Mapping[str, Array]

    def agent(self) -> Any:
        """Return a fresh agent, with the `predict` of Stable-Baselines3.

        Raises
        ------
        Refused
            If the arrays' values do not fit.
        """
        return self.architecture.agent(self.arrays)


def architecture(env_id: str, table: Mapping[str, Any]) -> Architecture:
    """Return the architecture that the table ``[policy]`` describes."""
    name = table.get("architecture")
    if not isinstance(name, str) or name not in ARCHITECTURES:
        known = ", ".join(sorted(ARCHITECTURES))
        raise Refused(f"{POLICY}: architecture must be one of {known}, got {shown_ascii(name)}")
    kind = ARCHITECTURES[name]
    return kind(env_id, accepted(kind.table, dict(table), POLICY))


#: Numbers of controllers that make planning slower.
PLANS = ("opening", "periods")


class ControllerTable(PolicyTable):
    """The table of a built-in controller."""

    name: str
    numbers: dict[str, Any] = Field(default={})


class ControllerPolicy(Architecture):
    """A controller of `lag_envs.controllers`, made for the undisturbed environment.

    In the table: `name`, one of the task's controllers, and optionally the table ``numbers`` of its numeric
    keyword arguments. There are no arrays.
    """

    table = ControllerTable
    counts_as = "controller"

    def __init__(self, env_id: str, table: ControllerTable) -> None:
        from lag_envs.controllers import build, controllers

        self.task = TASKS[env_id]()
        known = controllers(self.task)
        if table.name not in known:
            raise Refused(f"{POLICY}: name must be one of {', '.join(known)}, got {shown_ascii(table.name)}")
        found = known[table.name]
        self.build, self.plans = partial(build, self.task, table.name), found.plans
        self.module = found.place.partition(":")[0]
        own: dict[str, Any] = {
            name: (Annotated[float, between(-1e6, 10.0 if name in PLANS else 1e6)], 0.0)
            for name, parameter in inspect.signature(resolve(found.place)).parameters.items()
            if parameter.kind is parameter.KEYWORD_ONLY
            and name not in found.numbers
            and re.fullmatch(r"float( \| None)?", str(parameter.annotation))
        }
        numbers = accepted(create_model("Numbers", __base__=Strict, **own), table.numbers, "[policy.numbers]")
        self.numbers = numbers.model_dump(exclude_unset=True)
        self.arrays = {}

    def agent(self, arrays: Mapping[str, Array]) -> Any:
        """Return a new controller."""
        try:
            with np.errstate(all="ignore"), warnings.catch_warnings():
                warnings.simplefilter("ignore")
                return self.build(**self.numbers)
        except Exception as error:  # nonsensical numbers may raise anything
            reason = shown_ascii(f"{type(error).__name__}: {error}")
            raise Refused(f"the controller cannot be made with these numbers: {reason}") from error

    def page_data(self, arrays: Mapping[str, Array]) -> PageData | None:
        """Return the controller as feedback; None if it is not pure feedback, or plans."""
        return None if self.plans else feedback_data(self.agent(arrays), self.task)


ARCHITECTURES: dict[str, type[Architecture]] = {
    "mlp": MLP,
    "gru": GRU,
    "linear": Linear,
    "plan": PlanArchitecture,
    "mpc": PlanAhead,
    "table": GridArchitecture,
    "controller": ControllerPolicy,
}
