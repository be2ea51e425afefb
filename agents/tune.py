"""Find the few numbers of the controllers that are not derived, on seeds that no evaluation uses.

``python -m agents.tune ENV`` prints what it found for each controller of the environment; those
that are the controllers' defaults were found in this way.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from typing import Any

from scipy.optimize import differential_evolution

from agents.evaluate import evaluate_batch
from lag_envs.controllers import check_id
from lag_envs.controllers.basic import Constant
from lag_envs.controllers.cylinder_in_cylinder import BrakingLine, EnergyPump, TiltLQR
from lag_envs.controllers.incline import SwitchingLine, TiltCascade
from lag_envs.controllers.pd import PD
from lag_envs.controllers.pivoted_bar import BalanceLQR, EnergyShapingLQR
from lag_envs.errors import hint
from lag_envs.tasks import TASKS, load_task

#: Evaluation has seeds from 1,000,000,000 on, learning curves from 2,000,000,000 on.
FIRST_TUNING_SEED = 3_000_000_000

_BRAKE = {"action": (-1.0, 1.0)}

#: What can be tuned, by environment and controller: how it is made, and between which values each number is
#: looked for.
TUNABLE: dict[str, dict[str, tuple[Callable[..., Any], dict[str, tuple[float, float]]]]] = {
    "PivotedBar-v0": {
        "energy shaping + LQR": (
            EnergyShapingLQR,
            {
                "catch": (0.5, 6.0),
                "lose": (6.0, 60.0),
                "pump": (0.3, 6.0),
                "centring": (0.5, 10.0),
            },
        )
    },
    "PivotedBarFree-v0": {
        "energy shaping + LQR": (
            EnergyShapingLQR,
            {"catch": (0.1, 10.0), "lose": (6.0, 60.0), "pump": (0.1, 6.0)},
        )
    },
    "PivotedBarBalance-v0": {
        "LQR": (BalanceLQR, {"effort": (1e-3, 0.1), "slide": (0.05, 2.0), "turn": (0.05, 2.0)})
    },
    "InclineTilt-v0": {
        "PD": (PD, {"frequency": (1.0, 5.0), "lag": (0.05, 0.3)}),
        "cascade": (TiltCascade, {"braking": (0.3, 1.2), "effort": (0.0, 1.0)}),
    },
    "InclineBrake-v0": {
        "best constant": (lambda task, action: Constant(action), _BRAKE),
        "switching line": (SwitchingLine, {"speed": (0.45, 0.52)}),
    },
    "CylinderInCylinderTilt-v0": {
        "PD": (PD, {"frequency": (2.0, 30.0), "lag": (0.05, 0.6)}),
        "LQR": (TiltLQR, {"effort": (0.0, 0.5)}),
    },
    "CylinderInCylinderPump-v0": {"energy pump": (EnergyPump, {"pump": (5.0, 60.0), "centring": (0.0, 3.0)})},
    "CylinderInCylinderDamping-v0": {
        "best constant": (lambda task, action: Constant(action), _BRAKE),
        "switching line": (BrakingLine, {"steepness": (0.6, 1.2), "sharpness": (1.0, 30.0)}),
    },
}


def tune(env_id: str, name: str, episodes: int, generations: int) -> tuple[dict[str, float], float]:
    """Return the numbers that differential evolution finds best, and the mean return with them."""
    maker, ranges = TUNABLE[env_id][name]
    place, fixed = TASKS[env_id]
    task = load_task(place)(**fixed)

    def loss(values: Sequence[float]) -> float:
        agent = maker(task, **dict(zip(ranges, values, strict=True)))
        return -float(evaluate_batch(env_id, agent, FIRST_TUNING_SEED, episodes).mean())

    found = differential_evolution(
        loss, list(ranges.values()), maxiter=generations, popsize=12, seed=0, polish=False
    )
    return {n: float(f"{v:.3g}") for n, v in zip(ranges, found.x, strict=True)}, -float(found.fun)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return 0, or 2 for an environment that does not exist."""
    p = argparse.ArgumentParser(prog="python -m agents.tune", description=__doc__)
    p.add_argument("env", metavar="ENV", help="id of an environment")
    p.add_argument("--only", metavar="NAME", help="tune this controller only")
    p.add_argument("--episodes", type=int, default=2000, help="episodes per trial (default %(default)s)")
    p.add_argument("--generations", type=int, default=15, help="default %(default)s")
    args = p.parse_args(arguments)
    try:
        check_id(args.env)
    except ValueError as error:
        print(f"agents.tune: error: {error}", file=sys.stderr)
        return 2
    if args.only not in (None, *TUNABLE[args.env]):
        there = hint(args.only, TUNABLE[args.env])
        print(f"agents.tune: error: nothing of {args.only!r} can be tuned; {there}", file=sys.stderr)
        return 2
    for name in ("episodes", "generations"):
        if getattr(args, name) < 1:
            print(
                f"agents.tune: error: --{name} must be at least 1, got {getattr(args, name)}", file=sys.stderr
            )
            return 2
    for name in TUNABLE[args.env]:
        if args.only in (None, name):
            numbers, mean = tune(args.env, name, args.episodes, args.generations)
            print(f"{args.env}, {name}: {numbers}, return {mean:.3f}", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
