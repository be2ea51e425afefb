"""How the state moves in a piece of a control step, from ``y`` to ``z`` in a time ``h``.

The controls are held at their commands ``u`` (`Held`), or approach them from their present values (`Lagged`).
Both print the mean of the controls in force over the step, ``mean_u``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from lag_envs.envs.imperfect.rows import RowsWithRings


class Held:
    """Prints the motion under held controls.

    Parameters
    ----------
    stepper : object
        The scene's stepper.
    y, z, u : sequence of str
        State before and after, and controls.
    x : str or float
        Order of the general series, or the bound of the closed form, which is proportional to the time.
    """

    #: Constants that it uses.
    constants: Sequence[str] = ()

    def __init__(self, stepper: Any, y: Sequence[str], z: Sequence[str], u: Sequence[str], x: Any) -> None:
        general = not hasattr(stepper, "fast")
        arguments = [*(["room"] if general else []), *y, *u, "h", "limit", *stepper.constants]
        limit = str(x) if general or x == 0.0 else f"{x} * (h / k_dt)"
        #: The lines of the move; those after it; and, after a command is chosen, the lines of the mean, where
        #: the mean over a piece is the control itself.
        self.move = [f"limit = {limit}", f"{', '.join(z)}, status = advance({', '.join(arguments)})"]
        self.behind: list[str] = []
        self.mean = [f"mean_{name} += (h / k_dt) * {name}" for name in u]
        #: The controls at the end of a piece.
        self.reached = u

    def begin(self, rows: RowsWithRings) -> list[str]:
        """Return the lines before a step: none, since controls begin at their commands."""
        return []


class Lagged:
    """Prints the motion under lagging controls.

    Parameters
    ----------
    code : object
        The code of the scene's step with lag.
    lift_end : sequence of str
        The lines that add cosine and sine of the angle to ``z``.
    n_state : int
        Entries of the state, without cosine and sine.
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

    def begin(self, rows: RowsWithRings) -> list[str]:
        """Return the lines before a step: controls begin at their previous values."""
        return rows.load(self._u, self.reached)
