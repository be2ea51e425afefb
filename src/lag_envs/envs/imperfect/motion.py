"""How the state moves in a piece of a control step, from ``y`` to ``z`` in a time ``h``.

The controls are held at their commands ``u`` (`Held`), or go towards them from where they are (`Lagged`).
Both print the mean of the controls in force over the step, ``mean_u``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from lag_envs.envs.imperfect.rows import Rows


class Held:
    """Prints the motion under controls that are held.

    Parameters
    ----------
    stepper : object
        The scene's.
    y, z, u : sequence of str
        State before and after, and controls.
    x : str or float
        Order of the general series, or what bounds the closed form: in proportion to the time.
    """

    #: Constants that are used.
    constants: Sequence[str] = ()

    def __init__(self, stepper: Any, y: Sequence[str], z: Sequence[str], u: Sequence[str], x: Any) -> None:
        general = not hasattr(stepper, "fast")
        arguments = [*(["room"] if general else []), *y, *u, "h", "limit", *stepper.constants]
        limit = str(x) if general or x == 0.0 else f"{x} * (h / k_dt)"
        #: The lines of the move; behind it; and, behind a command, those of the mean, which within a piece is
        #: the control.
        self.move = [f"limit = {limit}", f"{', '.join(z)}, status = advance({', '.join(arguments)})"]
        self.behind: list[str] = []
        self.mean = [f"mean_{name} += (h / k_dt) * {name}" for name in u]
        #: The controls at the end of a piece.
        self.reached = u

    def begin(self, rows: Rows) -> list[str]:
        """Return the lines before a step: none, for controls begin at their commands."""
        return []


class Lagged:
    """Prints the motion under controls whose actuators lag.

    Parameters
    ----------
    code : object
        That of the scene with lag.
    lift_end : sequence of str
        The lines that add cosine and sine of the angle to ``z``.
    n_state : int
        Entries of the state without them.
    y, z, u : sequence of str
        State before and after, and commands.
    constants : mapping
        Name, or zero, of each constant.
    """

    mean: Sequence[str] = ()

    def __init__(
        self,
        code: Any,
        lift_end: Sequence[str],
        n_state: int,
        y: Sequence[str],
        z: Sequence[str],
        u: Sequence[str],
        constants: Mapping[str, Any],
    ) -> None:
        n = range(len(u))
        self.reached = [f"reached{i}" for i in n]
        decays = [str(constants[f"decay{i}"]) for i in n]
        lagged = ["k_lagged_order", *(name.replace("k_", "k_lagged_", 1) for name in code.constants)]
        self.constants = [*decays, *lagged]
        arguments = ["room", *y[:n_state], *self.reached, *u, *decays, "h", *lagged]
        found = [*z[:n_state], *(f"end{i}" for i in n), *(f"within{i}" for i in n), "status"]
        self.move = [f"{', '.join(found)} = advance({', '.join(arguments)})"]
        self.behind = [
            *lift_end,
            *(f"reached{i} = end{i}" for i in n),
            *(f"mean_{name} += (h / k_dt) * within{i}" for i, name in zip(n, u, strict=True)),
        ]
        self._u = u

    def begin(self, rows: Rows) -> list[str]:
        """Return the lines before a step: controls begin where they were."""
        return [f"{reached} = {rows.at(u)}" for reached, u in zip(self.reached, self._u, strict=True)]
