"""MuJoCo and Pinocchio as rivals: both build their models from the same table of links."""

from __future__ import annotations

import ctypes
import shutil
import subprocess
from collections.abc import Callable, Sequence
from functools import cache
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from lag_envs.report import reference
from lag_envs.report.equations import Problems
from lag_envs.report.linkages import THIN, Link, System
from lag_envs.report.motions import SceneProblems
from lag_envs.report.oracle import oracle_of
from lag_envs.report.peers import LibraryRival
from lag_envs.report.timing import Sample

Array = NDArray[np.float64]


class Engine(LibraryRival):
    """A rival with its own model, made of a system's links; it takes one state after the other."""

    fixed, batched = True, False


def _given(problems: Problems) -> tuple[System, Array, Array, Array]:
    """Return the system, joints' places and velocities, and controls."""
    assert isinstance(problems, SceneProblems) and problems.system is not None
    system = problems.system
    q, v = map(system.turned, np.split(problems.y, 2))
    return system, q, v, problems.controls[:, 0]


def _ends(problems: Problems, system: System, joints: Array, span: float) -> Array:
    """Return the states for joints' places and velocities after a time, one row each."""
    return problems.states(np.concatenate([system.back(half) for half in np.split(joints.T, 2)]), span)


# --- MuJoCo ---


def xml(system: System, gravity: Sequence[float], integrator: str = "RK4", step: float = 0.02) -> str:
    """Return MuJoCo's model of a system, contacts and constraints switched off."""

    def text(values: Sequence[float]) -> str:
        return " ".join(repr(float(x)) for x in values)

    body = ""
    for i, link in reversed(list(enumerate(system.links))):
        body = (
            f'<body pos="{text(link.place)}"><joint name="j{i}" type="{link.kind}" axis="{text(link.axis)}"/>'
            f'<inertial pos="{text(link.centre)}" mass="{link.mass!r}" diaginertia="{text(link.inertia)}"/>'
            f"{body}</body>"
        )
    motors = "".join(f'<motor joint="j{i}"/>' for i in range(len(system.links)))
    return (
        f'<mujoco><option gravity="{text(gravity)}" integrator="{integrator}" timestep="{step!r}">'
        '<flag contact="disable" constraint="disable"/></option>'
        f"<worldbody>{body}</worldbody><actuator>{motors}</actuator></mujoco>"
    )


class MuJoCoLinks(Engine):
    """MuJoCo's dynamics in its compiled rollouts, all states in one call."""

    family = "mujoco"
    settings: ClassVar = {
        "Euler": (1, 8, 64, 512),
        "implicitfast": (1, 8, 64, 512),
        "RK4": (1, 2, 4, 8, 16, 32, 64, 128, 256),
    }

    def build(self, problems: Problems, dt: float, steps: int, together: bool, changes: int = 1) -> Sample:
        """Make a model for each field; one is enough if the control is a force."""
        import mujoco
        from mujoco.rollout import rollout

        system, q, v, controls = _given(problems)
        n = self.substeps(steps)
        fields = system.fields(controls)
        if not system.field:
            fields = fields[:1]
        models = [
            mujoco.MjModel.from_xml_string(xml(system, field, self.method, dt * steps / n))
            for field in fields
        ]
        data = mujoco.MjData(models[0])
        count = len(controls)
        start = np.concatenate([np.zeros((count, 1)), q.T, v.T], axis=1)
        held = np.repeat(system.forces(controls)[:, None], n, axis=1)
        path = np.empty((count, n, start.shape[1]))
        given = models if len(models) == count else models * count
        return Sample(
            lambda: rollout(given, data, start, held, state=path, skip_checks=False),
            count * steps,
            ends=lambda: _ends(problems, system, path[:, -1, 1:], dt * steps),
        )


def mujoco_motion(system: System, q: Array, v: Array, control: float) -> tuple[Array, Array]:
    """Return MuJoCo's mass matrix and accelerations for given joint positions and velocities."""
    import mujoco

    model = mujoco.MjModel.from_xml_string(xml(system, system.fields(np.array([control]))[0]))
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:], data.ctrl[:] = q, v, system.forces(np.array([control]))[0]
    mujoco.mj_forward(model, data)
    mass = np.zeros((model.nv, model.nv))
    for column, unit in zip(mass, np.eye(model.nv), strict=True):
        mujoco.mj_mulM(model, data, column, unit)
    return mass, data.qacc.copy()


# --- Pinocchio ---


class PinocchioLinks(Engine):
    """Pinocchio's articulated-body algorithm in a compiled loop of RK4 steps.

    Pinocchio's wheel includes its headers, so `pinocchio.cpp` is compiled once per report, if a compiler
    exists.
    """

    family = "pinocchio"
    settings: ClassVar = {"ABA, RK4": (1, 2, 4, 8, 16, 32, 64, 128, 256)}

    def build(self, problems: Problems, dt: float, steps: int, together: bool, changes: int = 1) -> Sample:
        """Make the model."""
        system, q, v, controls = _given(problems)
        library, model = pinocchio(), pinocchio_model(tuple(system.links))
        n, count = self.substeps(steps), len(controls)
        start = np.ascontiguousarray(np.concatenate([q, v]).T)
        found = np.empty_like(start)
        forces, fields = system.forces(controls), np.ascontiguousarray(system.fields(controls))
        h = ctypes.c_double(dt * steps / n)
        arrays = [_pointer(x) for x in (start, forces, fields, found)]
        return Sample(
            lambda: library.run(model, count, n, h, *arrays),
            count * steps,
            ends=lambda: _ends(problems, system, found, dt * steps),
        )


def _pointer(array: Array) -> Any:
    return array.ctypes.data_as(ctypes.c_void_p)


@cache
def pinocchio() -> Any:
    """Return the compiled loop.

    Raises
    ------
    ModuleNotFoundError
        If Pinocchio, its headers, or a compiler is missing.
    """
    include = _headers()
    compiler = shutil.which("c++") or shutil.which("g++") or shutil.which("clang++")
    if compiler is None:
        raise ModuleNotFoundError("a C++ compiler is missing", name="a C++ compiler")
    source = Path(__file__).with_name("pinocchio.cpp")
    assert reference.store is not None
    made = reference.store / "pinocchio.so"
    if not made.exists():
        part = made.with_suffix(".part")
        options = ["-O3", "-march=native", "-std=c++17", "-DNDEBUG", "-w", "-shared", "-fPIC"]
        options += ["-DBOOST_MPL_LIMIT_LIST_SIZE=30", "-DBOOST_MPL_CFG_NO_PREPROCESSED_HEADERS"]
        folders = [f"-I{include}", f"-I{include / 'eigen3'}"]
        subprocess.run(
            [compiler, *options, *folders, "-o", str(part), str(source)], check=True, capture_output=True
        )
        part.replace(made)
    library = ctypes.CDLL(str(made))
    library.make.restype = ctypes.c_void_p
    pointer = ctypes.c_void_p
    library.motion.argtypes = [pointer] * 7
    library.run.argtypes = [pointer, ctypes.c_int, ctypes.c_int, ctypes.c_double, *[pointer] * 4]
    return library


def _headers() -> Path:
    """Return the folders of Pinocchio's and Eigen's headers in their wheels."""
    for package, header in (
        ("libpinocchio", "pinocchio/algorithm/aba.hpp"),
        ("cmeel-eigen", "eigen3/Eigen/Core"),
    ):
        try:
            found = Path(str(distribution(package).locate_file("cmeel.prefix/include")))
        except PackageNotFoundError as error:
            raise ModuleNotFoundError(f"{package} is missing", name=package) from error
        if not (found / header).exists():
            raise ModuleNotFoundError(f"{package} has no headers", name=f"{header} of {package}")
    return found


@cache
def pinocchio_model(links: tuple[Link, ...]) -> Any:
    """Return Pinocchio's model of links."""
    numbers = [
        [float(link.kind == "hinge"), *link.axis, *link.place, link.mass, *link.centre,
         *(0.0 if x == THIN else x for x in link.inertia)]
        for link in links
    ]  # fmt: skip
    table = np.array(numbers)
    return pinocchio().make(len(links), _pointer(table))


def pinocchio_motion(system: System, q: Array, v: Array, control: float) -> tuple[Array, Array]:
    """Return Pinocchio's mass matrix and accelerations for given joint positions and velocities."""
    n, controls = len(q), np.array([control])
    acceleration, mass = np.empty(n), np.empty((n, n))
    given = [np.ascontiguousarray(x) for x in (q, v, system.forces(controls)[0], system.fields(controls)[0])]
    pinocchio().motion(pinocchio_model(tuple(system.links)), *map(_pointer, [*given, acceleration, mass]))
    return mass, acceleration


#: Engines with their own models: their dynamics at a point, by family.
MOTIONS: dict[str, Callable[[System, Array, Array, float], tuple[Array, Array]]] = {
    "mujoco": mujoco_motion, "pinocchio": pinocchio_motion,
}  # fmt: skip
ENGINES: dict[str, type[Engine]] = {engine.family: engine for engine in (MuJoCoLinks, PinocchioLinks)}


def differences(system: System, family: str) -> tuple[float, float]:
    """Return the difference of an engine's mass matrices and accelerations from SymPy's at random states.

    Both differences are relative to the largest value.
    """
    states, controls = system.draw(50, seed=1)
    problems = SceneProblems(system.scene, states, controls, system)
    _, q, v, _ = _given(problems)
    turn = system.turned(np.eye(len(q)))
    oracle, found = oracle_of(system.scene), []
    for j in range(len(states)):
        mass, acceleration = oracle.at(states[j].tolist(), controls[j].tolist())
        other, joints = MOTIONS[family](system, q[:, j], v[:, j], float(controls[j, 0]))
        found.append((turn.T @ other @ turn, mass, system.back(joints), acceleration))
    m, mass, a, acceleration = (np.array(part) for part in zip(*found, strict=True))
    far = [float(np.abs(x - y).max() / np.abs(y).max()) for x, y in ((m, mass), (a, acceleration))]
    return far[0], far[1]
