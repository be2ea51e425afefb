"""Check the tasks of the real double pendulum against its project's own simulator.

``python -m tools.double_pendulum CHECKOUT`` needs a checkout of
github.com/dfki-ric-underactuated-lab/double_pendulum, and SciPy, SymPy and PyYAML. The command compares
parameters and accelerations. It also runs the project's own LQR, with friction compensation, from near
upright in the project's simulator, which takes a Runge-Kutta step in each control interval, and in lag_envs.
The check fails if the results differ by more than that integrator's error.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from lag_envs.controllers import make_controller
from lag_envs.mechanics.recording import parameter_values
from lag_envs.options import module_parser
from lag_envs.tasks import Task
from lag_envs.tasks.acrobot import AcrobotReal, PendubotReal

MODEL = Path("data/system_identification/identified_parameters/design_C.1/model_1.0/model_parameters.yml")
ROBOTS: tuple[type[Task], ...] = (AcrobotReal, PendubotReal)
#: The order of lag_envs's state entries in the project's state (angles, rates).
ORDER = [0, 2, 1, 3]
START = [np.pi + 0.05, -0.03, 0.0, 0.0]
#: Torque limit of the idle motor [N m], and the identified friction.
IDLE = 0.5
FRICTION = {"damping": 0.001, "damping_2": 0.001, "dry_friction": 0.16, "dry_friction_2": 0.12}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the check; return 0 if everything agrees."""
    parser = module_parser(
        "tools.double_pendulum", __doc__, "examples:\n  python -m tools.double_pendulum ../double_pendulum"
    )
    parser.add_argument("checkout", type=Path, help="folder with the project's checkout")
    args = parser.parse_args(arguments)
    if not (args.checkout / MODEL).is_file():
        parser.error(f"{args.checkout} has no {MODEL}; give a checkout of the project")
    sys.path.insert(0, str(args.checkout / "src" / "python"))
    good = [check(robot, args.checkout) for robot in ROBOTS]
    return 0 if all(good) else 1


def check(robot: type[Task], checkout: Path) -> bool:
    """Compare one task with the project's plant, simulator and LQR, and print and check the results."""
    from double_pendulum.analysis.leaderboard import get_swingup_time  # type: ignore[import-not-found]
    from double_pendulum.model.model_parameters import model_parameters  # type: ignore[import-not-found]
    from double_pendulum.model.plant import DoublePendulumPlant  # type: ignore[import-not-found]
    from double_pendulum.simulation.simulation import Simulator  # type: ignore[import-not-found]

    env: Any = gym.make(robot.id).unwrapped
    # Both motors and all friction are used: the project compensates the idle joint's friction by the idle
    # motor, while lag_envs leaves this friction out.
    names = parameter_values(env.scene)
    whole = type(env.scene)(control="both", **(names | FRICTION))
    (joint,) = (whole.control_names.index(name) for name in robot.action)
    model = model_parameters(filepath=str(checkout / MODEL))
    limits = [IDLE, IDLE]
    limits[joint] = float(env.task.limit_control)
    model.set_torque_limit(limits)
    plant = DoublePendulumPlant(model_pars=model)

    worst = accelerations(whole, plant)
    print(f"{robot.id}: accelerations at 10,000 random states agree to {worst:.1e} of the largest")

    simulator = Simulator(plant=plant)
    times, states, torques = simulator.simulate(
        t0=0.0, x0=START, tf=env.task.duration, dt=env.task.dt, controller=published(model, joint)
    )
    path = np.array(states)[:, ORDER]
    # Each of the project's steps is repeated from its start.
    alone = [whole.simulate(y, [u], env.task.dt)[1] for y, u in zip(path[:-1], torques, strict=True)]
    local = float(np.median(np.abs(np.array(alone) - path[1:]).max(axis=1)))
    print(f"  the project's torques on lag_envs, step by step: {local:.1e} apart in the median")

    own_path, their_time = [np.array(START)[ORDER]], swing(get_swingup_time, times, path, model)
    observation, _ = env.reset(seed=0, options={"state": own_path[0]})
    agent, memory, over, total = make_controller(robot.id, "LQR"), None, False, 0.0
    while not over:
        action, memory = agent.predict(observation, memory)
        observation, reward, terminated, truncated, _ = env.step(action)
        total, over = total + float(reward), terminated or truncated
        own_path.append(env.state)
    end = np.array(own_path)
    our_time = swing(get_swingup_time, np.arange(len(end)) * env.task.dt, end, model)
    apart = np.abs(end - path[: len(end)]).max()
    print(f"  the LQR on both: {apart:.1e} apart at most")
    print(f"  up after {their_time:.3f} s there, {our_time:.3f} s here")
    print(
        f"  return here {total:.2f}; |off upright| at the end {np.abs(end[-1] - [np.pi, 0, 0, 0]).max():.1e}"
    )
    return bool(worst < 1e-9 and local < 1e-6 and abs(our_time - their_time) < 0.01)


def accelerations(scene: Any, plant: Any) -> float:
    """Return the largest difference of accelerations at random states, relative to the largest of them."""
    rng = np.random.default_rng(0)
    states = rng.uniform(-1.0, 1.0, (10_000, 4)) * [np.pi, 20.0, np.pi, 20.0]
    torques = rng.uniform(-6.0, 6.0, (len(states), 2))
    found = scene.acceleration(states, torques)
    own = np.stack([found["theta_1"], found["theta_2"]], axis=-1)
    project = np.array([plant.forward_dynamics(y[ORDER], u) for y, u in zip(states, torques, strict=True)])
    return float(np.abs(own - project).max() / np.abs(project).max())


def published(model: Any, joint: int) -> Any:
    """Return the project's LQR as on its leaderboard, with friction compensated as on its machine."""
    from double_pendulum.controller.lqr.lqr_controller import LQRController  # type: ignore[import-not-found]
    from double_pendulum.model.model_parameters import model_parameters  # type: ignore[import-not-found]

    ideal = model_parameters()
    ideal.set_mass(model.m)
    ideal.set_length(model.l)
    ideal.set_com(model.r)
    ideal.set_inertia(model.I)
    ideal.set_gravity(model.g)
    ideal.set_damping([0.0, 0.0])
    ideal.set_cfric([0.0, 0.0])
    ideal.set_motor_inertia(0.0)
    ideal.set_torque_limit([0.0 if i != joint else most for i, most in enumerate(model.tl)])
    weights, effort = {
        1: ((0.97, 0.93, 0.39, 0.26), 0.11),
        0: ((0.00125, 0.65, 0.000688, 0.000936), 25.0),
    }[joint]
    controller = LQRController(model_pars=ideal)
    controller.set_goal([np.pi, 0.0, 0.0, 0.0])
    controller.set_cost_matrices(Q=np.diag(weights), R=effort * np.eye(2))
    controller.set_parameters(failure_value=0.0, cost_to_go_cut=15.0)
    controller.set_friction_compensation(damping=model.b, coulomb_fric=model.cf)
    controller.init()
    return controller


def swing(measure: Any, times: Any, path: Any, parameters: Any) -> float:
    """Return the project's swing-up time [s] for a path in our order of entries."""
    return float(measure(T=np.array(times), X=path[:, ORDER], mpar=parameters, method="height", height=0.9))


if __name__ == "__main__":
    sys.exit(main())
