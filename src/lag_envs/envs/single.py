"""The single environment: a task behind Gymnasium's interface."""

from __future__ import annotations

import math
from typing import Any, SupportsFloat

import gymnasium as gym
import numpy as np
from gymnasium.error import ResetNeeded
from numpy.typing import NDArray

from lag_envs.envs import snapshots
from lag_envs.envs.actions import Actions, single_number
from lag_envs.envs.imperfect.constants import constants_of
from lag_envs.envs.imperfect.programs import program_of
from lag_envs.envs.interface import (
    FLOAT32,
    RENDER_MODES,
    TaskEnv,
    check_flag,
    check_look,
    check_render_mode,
    check_seed,
    diagnostics,
    observation_space,
    seed_key,
    start_options,
)
from lag_envs.envs.program import SLOW
from lag_envs.scenes.checks import StepRefused
from lag_envs.tasks import load_task
from lag_envs.tasks.base import Task


class LagrangianEnv(TaskEnv, gym.Env[NDArray[np.float32], NDArray[np.float32]]):
    """One environment of any task; made by ``gym.make(id, **parameters)``.

    ``help(env.unwrapped.task)`` describes its task.

    Parameters
    ----------
    task : str
        The task, as "module:Class". With `gym.make` the id determines it.
    render_mode : {"human", "rgb_array"}, optional
        Whether `render` shows the scene in a window or returns a picture.
    diagnostics : bool, default False
        Whether `info` reports forces, needed friction and energy after each step.
    show_arrows : bool, default False
        Whether pictures have arrows for controls without arrows of their own, and for the forces that the
        scene names.
    show_trail : float, default 0.0 [s]
        How far back the bodies' trails in pictures go. A trail joins the states for which `render` was
        called, so call `render` after every step.
    show_readout : bool, default False
        Whether time, return, controls, score and state are written below a picture. In small pictures the
        last of them are left out.
    **options
        Parameters of the scene and of the task: ``mass``, ``damping``, ``dt``, ``duration``, ``target``, ...;
        and hidden parameters, imperfect sensors and actuators: ``randomize``, ``observation_noise``,
        ``observation_delay`` [s], ``observation_every``, ``action_noise``, ``action_delay`` [s], ``slew``,
        ``lag`` [s], ``push``. All are off by default. Delays are exact: a step is divided where a new command
        takes effect. See docs/usage.md.

    Notes
    -----
    ``reset(options={"state": ..., "target": ...})`` starts an episode from a given state, in the order of
    ``env.unwrapped.scene.state_names``.

    Examples
    --------
    >>> import gymnasium as gym, lag_envs
    >>> env = gym.make("PivotedBar-v0", mass=0.3)
    >>> observation, info = env.reset(seed=1)
    >>> observation, reward, terminated, truncated, info = env.step(env.action_space.sample())
    """

    # Gymnasium's own attribute; instances replace it and never modify it.
    metadata: dict[str, Any] = {"render_modes": RENDER_MODES, "render_fps": 50}  # noqa: RUF012

    def __init__(
        self,
        task: str,
        render_mode: str | None = None,
        diagnostics: bool = False,
        show_arrows: bool = False,
        show_trail: float = 0.0,
        show_readout: bool = False,
        **options: Any,
    ) -> None:
        check_render_mode(render_mode)
        check_flag("diagnostics", diagnostics)
        self._look = check_look(show_arrows, show_trail, show_readout)
        #: Whether there is something to draw or count after each step.
        self._seen = render_mode == "human" or bool(show_readout)
        self._options = options
        self.task: Task = load_task(task)(**options)
        self.scene, self._limit = self.task.scene, self.task.limit
        self.__doc__ = self.task.__doc__
        self.render_mode = render_mode
        self.diagnostics = diagnostics
        self.metadata = {"render_modes": RENDER_MODES, "render_fps": max(1, round(1.0 / self.task.dt))}
        self._actions = Actions(self.task.formulas)
        self.action_space = self._actions.space
        self._plain = not self._actions.values and self._actions.count == 1
        self.observation_space = observation_space([self.task])

        constants = constants_of(self.task)
        self._program = program = program_of(self.task, [constants])
        rows = program.kept + program.scratch
        numbers = [constants[name] for name in program.uniform]
        self._rows = np.array([0.0] * len(rows) + numbers + [0.0] * program.room)
        #: Key of the seed, number of the episode, key of the episode.
        self._ids = np.zeros(3, dtype=np.uint64)
        self._row = {name: j for j, name in enumerate(rows)}
        self._size = len(program.o)
        self._ready = self._started = False
        self._known: tuple[dict[str, float], Task] = {}, self.task
        self._bind()
        self._made = True

    def _bind(self) -> None:
        self._step = self._program.step_one
        self._viewer: Any = None

    # --- Gymnasium's interface -----------------------------------------------------------------------------

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Start an episode.

        Parameters
        ----------
        seed : int, optional
            Seed for the starts, targets and kicks of this episode and of the following ones; at least 0.
        options : dict, optional
            ``"state"``: the start, in the scene's order and units; ``"target"``, if the task has one.

        Returns
        -------
        observation : ndarray of float32
            The first observation.
        info : dict
            Empty, or the diagnostics.

        Raises
        ------
        ValueError, TypeError
            For unknown options, a state or target from which the task cannot start, and an invalid seed. An
            episode in progress is left unchanged.
        """
        seed = None if seed is None else check_seed("seed", seed)
        state, target = start_options(options)
        given_state = None if state is None else self.task.start_state(state)
        given_target = None if target is None else np.atleast_1d(self.task.check_target(target))
        super().reset(seed=seed)
        if seed is not None:
            self._ids[:2] = seed_key(seed), 0
        elif not self._started:
            self._ids[:2] = self.np_random.integers(2**63), 0
        if not self._started:
            self._started = True
        if given_state is not None:
            self._rows[: len(given_state)] = given_state
        if given_target is not None:
            self._rows[[self._row[name] for name in self._program.g]] = given_target
        observation = np.empty(self._size, dtype=np.float32)
        self._program.start_one(
            self._rows, observation, self._ids, given_state is not None, given_target is not None
        )
        self._ready = True
        if self._seen:
            self._total = 0.0
        if self.render_mode == "human":
            self.render()
        return observation, self._info()

    def step(
        self, action: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], SupportsFloat, bool, bool, dict[str, Any]]:
        """Hold one control for one control interval.

        Parameters
        ----------
        action : array_like, shape (n_actions,), or int
            The action; an int if values are listed. A finite number outside its range is clipped.

        Returns
        -------
        observation, reward, terminated, truncated, info
            As Gymnasium defines them.

        Raises
        ------
        ValueError
            For an action that is not finite, not real, not listed or of another shape.
        ResetNeeded
            Before the first reset, and after termination.
        StepRefused
            If the step cannot be taken to full accuracy. After any of these errors nothing has changed.
        """
        if self._plain and type(action) is np.ndarray and action.shape == (1,) and action.dtype.char in "fd":
            a = action.item()
            if not -math.inf < a < math.inf:
                raise ValueError(f"the action must be finite, got {action!r}")
        else:
            a = self._actions.one(action)
        if not self._ready:
            raise ResetNeeded(
                "call reset() before step(): "
                + ("the episode has terminated" if self._started else "no episode has begun")
            )
        observation = np.empty(self._size, FLOAT32)
        reward, over = self._step(self._rows, observation, a, self._ids)
        if over:
            if over == SLOW:
                reward, over = self._slow_step(observation)
            self._ready = over % 2 == 0
        if self._seen:
            self._total += float(reward)
            if self.render_mode == "human":
                self.render()
        return observation, reward, over % 2 == 1, over >= 2, self._info() if self.diagnostics else {}

    def render(self) -> NDArray[np.uint8] | None:
        """Draw the scene; in the mode "rgb_array", return an RGB picture of shape (height, width, 3)."""
        if self.render_mode is None:
            gym.logger.warn(
                'no render mode is set; make the environment with render_mode="rgb_array" or "human"'
            )
            return None
        if not self._started:
            raise ResetNeeded("call reset() before render(): no episode has begun")
        if self._viewer is None:
            from lag_envs.envs.rendering import Viewer

            self._viewer = Viewer(self.drawn_task, self.render_mode, self._look)
            self._viewed = self.drawn_task
        if self._viewed is not self.drawn_task:
            self._viewed = self.drawn_task
            self._viewer.use(self._viewed)
        steps = int(self._rows[self._row["n"]])
        episode = int(self._ids[2])
        over = not self._ready or steps >= self.task.limit
        return self._viewer.draw(self.state, self.control, self.target, steps, self._total, episode, over)

    def get_keys_to_action(self) -> dict[str, NDArray]:
        """Return keys for `gymnasium.utils.play`: a and d move all controls to their limits."""
        formulas, space, rest = self.task.formulas, self.action_space, self.task.rest_action
        low, high = np.array(-formulas.largest), np.array(formulas.largest)
        if formulas.choices:
            low, high = (np.array([end(a.values) for a in formulas.acting]) for end in (np.argmin, np.argmax))
        return {
            pressed: np.broadcast_to(np.asarray(action, space.dtype).squeeze(), self._actions.shape).copy()
            for pressed, action in {"": rest, "a": low, "d": high, "ad": rest}.items()
        }

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._viewer is not None:
            self._viewer.close()
            self._viewer = None

    def get_state(self) -> snapshots.Snapshot:
        """Return everything that decides how this and later episodes continue, for `set_state`.

        Raises
        ------
        ResetNeeded
            Before the first reset.
        """
        if not self._started:
            raise ResetNeeded("call reset() before get_state(): no episode has begun")
        rows = {name: self._rows[[self._row[name]]] for name in self._program.kept}
        total = np.array([self._total])
        return snapshots.Snapshot(
            self._about, rows, self._ids.reshape(3, 1).copy(), np.zeros(1, np.int64), total, self._ready
        )

    def set_state(self, snapshot: snapshots.Snapshot) -> None:
        """Restore the state in which `get_state` was called; all later results have the same bits.

        Parameters
        ----------
        snapshot : Snapshot
            A snapshot of this environment, or of one that was made in the same way, perhaps in another
            process.

        Raises
        ------
        TypeError, ValueError
            For something that is not a snapshot, or a snapshot of another environment; then nothing is
            changed.
        """
        snapshots.check_snapshot(snapshot, self._about, self._program.kept)
        for name, values in snapshot.rows.items():
            self._rows[self._row[name]] = values[0]
        self._ids[:] = snapshot.ids[:, 0]
        self._ready, self._total = snapshot.ready, float(snapshot.totals[0])
        self._started = True

    @property
    def _about(self) -> dict[str, Any]:
        """The properties that a snapshot must share."""
        return snapshots.properties([self.task], num_envs=None)

    # --- for inspection ------------------------------------------------------------------------------------

    @property
    def state(self) -> NDArray[np.float64]:
        """Copy of the state, in the order of ``scene.state_names``, in SI units."""
        return self._rows[: len(self.scene.state_names)].copy()

    @property
    def target(self) -> Any:
        """The episode's target; an array if there are several, None for a task without one."""
        return single_number(self._read(self._program.g)) if self._program.g else None

    @property
    def control(self) -> Any:
        """The control applied last, in SI units; an array if there are several; 0 after a reset."""
        return single_number(self._read(self._program.u))

    @property
    def parameters(self) -> dict[str, float]:
        """The parameters drawn for this episode, by name; empty if none are drawn."""
        return dict(zip(self._drawn, self._read([f"p_{name}" for name in self._drawn]).tolist(), strict=True))

    @property
    def drawn_task(self) -> Task:
        """The task of this episode: with the drawn parameters, and without imperfections."""
        parameters = self.parameters
        if not parameters:
            return self.task
        if self._known[0] != parameters:
            self._known = parameters, self.task.varied(**parameters)
        return self._known[1]

    def _read(self, names: list[str]) -> NDArray[np.float64]:
        return self._rows[[self._row[name] for name in names]]

    #: Sum of the episode's rewards, if pictures show this sum.
    _total = 0.0

    @property
    def _name(self) -> str:
        return self.spec.id if self.spec else type(self.task).__name__

    def __repr__(self) -> str:
        """Return the id and the parameters that were given."""
        given = (f"{name}={value!r}" for name, value in self._options.items())
        return f"{type(self).__name__}({', '.join([self._name, *given])})"

    def _repr_html_(self) -> str:
        """Return the HTML of a notebook: the current picture, spaces, controls, parameters."""
        from lag_envs.envs.html import environment_html, still

        now = (self.state, self.control, self.target) if self._started else ()
        spaces = {"observation": self.observation_space, "action": self.action_space}
        return environment_html(self.task, self._name, spaces, still(self.task, *now))

    # --- internal ------------------------------------------------------------------------------------------

    def _slow_step(self, observation: NDArray[np.float32]) -> tuple[float, int]:
        """Take a step that needs more than the fast formula; nothing is changed if it is refused."""
        program, rows = self._program, self._rows
        held = self._read(program.held)
        if program.tries_all:
            raise self._refusal(held)
        constants = constants_of(self.task)
        constants |= {name: rows[self._row[f"k_{name}"]] for name in program.varying}
        numbers = (constants[name] for name in program.advance_constants)
        *end, status = program.advance(*self._read(program.y), *held, self.task.dt, constants["x"], *numbers)
        if status < 0:
            raise self._refusal(held)
        for name, value in zip(program.u, held, strict=True):
            rows[self._row[name]] = value
        for name, value in zip(program.z, end, strict=True):
            rows[self._row[name]] = value
        return program.finish_one(rows, observation, self._ids)

    def _refusal(self, held: NDArray[np.float64]) -> StepRefused:
        return self.task.formulas.refusal(self.state, single_number(held), self.task.dt, "the step")

    def _info(self) -> dict[str, Any]:
        if not self.diagnostics:
            return {}
        return diagnostics(self.drawn_task.scene, self.state, np.float64(self.control))

    def __getstate__(self) -> dict[str, Any]:
        """Return the state for pickling, without compiled functions and windows."""
        return {
            k: v for k, v in self.__dict__.items() if k not in ("_step", "_viewer", "_viewed", "_program")
        }

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Restore the pickled state, and compile again (from the cache)."""
        self.__dict__.update(state)
        self._program = program_of(self.task, [constants_of(self.task)])
        self._bind()
