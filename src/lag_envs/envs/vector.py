"""The native vector environment: all environments of a batch in one compiled call."""

from __future__ import annotations

import inspect
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from lag_envs.envs import sharing, snapshots
from lag_envs.envs.actions import Actions, single_number
from lag_envs.envs.imperfect.constants import constants_of
from lag_envs.envs.imperfect.programs import program_of
from lag_envs.envs.interface import (
    FLOAT32,
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
from lag_envs.envs.program import BLOCK
from lag_envs.scenes import StepRefused
from lag_envs.scenes.checks import check_count, is_masked, real_array, shown
from lag_envs.stepping.primitives import is_refused
from lag_envs.tasks import load_task
from lag_envs.tasks.base import Task
from lag_envs.tasks.imperfections import KEYWORDS

BOOL = np.dtype(np.bool_)


class LagrangianVectorEnv(TaskEnv, VectorEnv[NDArray[np.float32], NDArray[np.float32], Any]):
    """Many environments of one task, stepped together.

    Made by ``gym.make_vec(id, num_envs=..., **parameters)``.

    Sub-environment i of a batch with seed s gives the same numbers, bit for bit, as the single environment
    with seed s + i. (They agree only to rounding if a parameter is 0 in some environments of the batch and
    the scene has no flow of its own; see docs/numerics.md.)

    Parameters
    ----------
    task : str or type
        The task, as a class or as "module:Class". With `gym.make_vec` the id determines it.
    num_envs : int
        Number of environments.
    max_episode_steps : int, optional
        Steps after which an episode is truncated, if that is earlier than the task's own limit.
    autoreset_mode : {"NextStep", "SameStep", "Disabled"} or AutoresetMode
        What happens when an episode is over; see `gymnasium.vector.AutoresetMode`.
    render_mode : {"rgb_array"}, optional
        `render` then returns a picture of each environment, as Gymnasium's wrappers expect; with
        `show_tiles`, a single picture of them all.
    diagnostics : bool, default False
        Whether `info` reports forces, needed friction and energy after each step.
    num_threads : int, optional
        Number of threads that step the batch; by default one for each 4,096 environments and each core, and
        one in worker processes; see `sharing.default_threads`. The bits do not depend on it.
    show_arrows, show_trail, show_readout
        Additional content of pictures; see `LagrangianEnv`.
    show_tiles : int, optional
        Show at most this many environments, side by side in one picture.
    **options
        Parameters of the scene and of the task. A list of `num_envs` values gives each environment its own
        value. Hidden parameters, imperfect sensors and actuators are set as in `LagrangianEnv`: they are the
        same for all environments, but each environment has its own draws.

    Notes
    -----
    ``reset(options=...)`` takes ``"state"`` (num_envs, n_state), ``"target"`` (num_envs,), or
    (num_envs, n_targets) if there are several, and ``"reset_mask"``, a boolean array (num_envs,) of the
    environments to reset.

    Examples
    --------
    >>> import gymnasium as gym, lag_envs
    >>> envs = gym.make_vec("PivotedBar-v0", num_envs=3, damping=[0.0, 0.001, 0.1])
    >>> observations, infos = envs.reset(seed=1)
    >>> observations.shape
    (3, 5)
    """

    #: Drawn parameters that viewers show, for each environment.
    _viewed: dict[int, dict[str, float]]
    _viewers: tuple[Any, ...] = ()  # defined even if __init__ fails and Gymnasium closes the environment

    def __init__(
        self,
        task: str | type[Task],
        num_envs: int = 1,
        max_episode_steps: int | None = None,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        render_mode: str | None = None,
        diagnostics: bool = False,
        num_threads: int | None = None,
        show_arrows: bool = False,
        show_trail: float = 0.0,
        show_readout: bool = False,
        show_tiles: int | None = None,
        **options: Any,
    ) -> None:
        if render_mode == "human":
            raise ValueError("render_mode must be 'rgb_array' or None for a vector environment, got 'human'")
        check_render_mode(render_mode)
        check_flag("diagnostics", diagnostics)
        self._look = check_look(show_arrows, show_trail, show_readout)
        self.num_envs = check_count("num_envs", num_envs)
        self._num_threads = None if num_threads is None else check_count("num_threads", num_threads)
        self._tiles = (
            None if show_tiles is None else min(check_count("show_tiles", show_tiles), self.num_envs)
        )
        self.render_mode = render_mode
        self.diagnostics = diagnostics
        #: TorchRL expects this name, which Gymnasium's own vector environments use.
        self.autoreset_mode = check_mode(autoreset_mode)
        #: The task of each environment; they differ only in numbers.
        self.tasks = make_tasks(load_task(task), self.num_envs, options)
        self.task = self.tasks[0]
        self.scene = self.task.scene
        self.__doc__ = self.task.__doc__
        self.metadata = {
            "render_modes": ["rgb_array"],
            "render_fps": max(1, round(1.0 / self.task.dt)),
            "autoreset_mode": self.autoreset_mode,
        }
        self._actions = Actions(self.task.formulas)
        self.single_action_space = self._actions.space
        self.single_observation_space = observation_space(self.tasks)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)

        constants = {id(task): constants_of(task) for task in {id(t): t for t in self.tasks}.values()}
        self._constants = [dict(constants[id(task)]) for task in self.tasks]
        endless = type(max_episode_steps) is int and max_episode_steps == -1  # Gymnasium's word for it
        if max_episode_steps is not None and not endless:
            steps = float(check_count("max_episode_steps", max_episode_steps))
            for own in self._constants:
                own["limit"] = min(own["limit"], steps)
        self._limit = self._constants[0]["limit"]
        self._compile()
        program = self._program
        uniform = [self._constants[0][name] for name in program.uniform]
        #: For each thread the constants, followed by working memory for a step.
        self._pars = [on_a_line(np.array(uniform + [0.0] * program.room_of_all), len(uniform))]
        blocks = -(-self.num_envs // BLOCK)
        self._memory = on_a_line(np.zeros(blocks * len(program.kept) * BLOCK))
        #: Keys of the seeds, numbers of the episodes, keys of the episodes, and numbers that threads share.
        self._ids = np.zeros(3 * self.num_envs + sharing.words(blocks), dtype=np.uint64)
        sharing.write_places(self._ids, self.num_envs, program.kept)
        #: Number of the step, counted over all episodes, and how many threads a step can keep busy.
        self._turn, self._most_threads = 0, min(blocks, self._num_threads or self.num_envs // sharing.SHARE)
        self._lanes = np.arange(self.num_envs)
        for name in program.varying:  # drawn parameters are written when an episode begins
            values = [constants[name] for constants in self._constants]
            self._write(f"k_{name}", self._lanes, np.array(values))
        self._started = False
        self._over = self._starts = 0
        #: Steps and sums of rewards of the episodes, if pictures show these.
        self._steps, self._totals = np.zeros(self.num_envs, np.int64), np.zeros(self.num_envs)
        self._seen = render_mode is not None and bool(show_readout or show_trail)

    def _compile(self) -> None:
        self._program = program_of(self.task, self._constants)
        self._row = {name: j for j, name in enumerate(self._program.kept)}
        self._viewers = ()
        self._step_all = sharing.compile_step_all()
        #: Type of the last actions, and the place in memory of the loop over blocks for this type.
        self._kind: np.dtype | None = None
        self._loop = 0
        #: Arguments of the calls that helpers are offered, by their number and the type of actions.
        self._calls: dict[tuple[int, np.dtype], list[tuple]] = {}
        self._made = True

    # --- Gymnasium's interface -----------------------------------------------------------------------------

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Start an episode in every environment, or in those of a mask.

        Parameters
        ----------
        seed : int or sequence of int, optional
            A seed s seeds environment i with s + i. A list, tuple, range or array gives each environment its
            own seed; None, alone or in a list, keeps the present seed.
        options : dict, optional
            ``"state"`` (num_envs, n_state), ``"target"`` (num_envs,), ``"reset_mask"`` (num_envs,) of bool.
            Several targets are (num_envs, n_targets), or a mapping of their names to one number for all or
            to (num_envs,). Rows not selected by the mask are ignored.

        Returns
        -------
        observations : ndarray of float32, shape (num_envs, n_observation)
            The observations; for environments not selected by the mask, their latest ones.
        infos : dict
            Empty, or the diagnostics.

        Raises
        ------
        ValueError, TypeError
            For unknown options, and arrays of the wrong shape, type or content; then nothing is reset.
        """
        seeds = seeds_of(seed, self.num_envs)
        state, target, mask = start_options(options, ("state", "target", "reset_mask"))
        mask = self._check_mask(mask)
        lanes = self._lanes[mask]
        if isinstance(state, Mapping):
            names = ", ".join(self.scene.state_names)
            raise ValueError(f"options['state'] must be rows of ({names}), without names, got {shown(state)}")
        if state is not None:
            state = self._check_rows("options['state']", state, (self.num_envs, len(self.scene.state_names)))
            state = np.array([for_environment(i, self.tasks[i].start_state, state[i]) for i in lanes])
        if target is not None:
            many = self.task.formulas.targets
            if many and isinstance(target, Mapping):
                target = self._targets_by_name(target)
            target = self._check_rows(
                "options['target']", target, (self.num_envs, *([many] if many > 1 else []))
            )
            target = np.array(
                [np.atleast_1d(for_environment(i, self.tasks[i].check_target, target[i])) for i in lanes]
            )
        if not self._started and not mask.all():
            raise ResetNeeded(
                "the first reset must reset every environment, got a reset_mask that leaves some out"
            )
        super().reset(seed=int(seed) if isinstance(seed, int | np.integer) else None)
        if not self._started:
            self._ids[: self.num_envs] = self.np_random.integers(2**63, size=self.num_envs)
        for i, s in seeds:
            if mask[i]:
                self._ids[i], self._ids[self.num_envs + i] = seed_key(s), 0
        if state is not None:
            for j, column in enumerate(state.T):
                self._write(f"y{j}", lanes, column)
        if target is not None:
            for name, column in zip(self._program.g, target.T, strict=True):
                self._write(name, lanes, column)
        observations = np.empty((len(self._program.o), self.num_envs), dtype=FLOAT32).T
        self._start(observations, mask, True, state is not None, target is not None)
        self._started = True
        self._starts += 1
        self._over = int(np.count_nonzero(self._read("n") < 0.0))
        self._steps[mask] = self._totals[mask] = 0
        return observations, self._infos(mask)

    def step(
        self, actions: NDArray[np.float32]
    ) -> tuple[
        NDArray[np.float32], NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]
    ]:
        """Hold one control for one control interval in every environment.

        Parameters
        ----------
        actions : array_like, shape (num_envs, n_actions), or (num_envs,) where one list of values is given
            Actions; ints if values are listed. Finite numbers outside a range are clipped.

        Returns
        -------
        observations, rewards, terminations, truncations, infos
            As Gymnasium defines them; the reward is float64.

        Raises
        ------
        ValueError
            For actions that are not finite, not real or of another shape; then nothing is stepped.
        ResetNeeded
            Before the first reset; with autoreset disabled also if an episode is over.
        StepRefused
            If an environment's step cannot be taken to full accuracy. That environment keeps its state; all
            others have been stepped. The error's ``results`` are what would have been returned; in their
            infos, ``"refused"`` marks all such environments.
        """
        actions = self._actions.many(actions, self.num_envs)
        if not self._started:
            raise ResetNeeded("call reset() before step(): no episode has begun")
        if self._over and self.autoreset_mode == AutoresetMode.DISABLED:
            done = np.flatnonzero(self._read("n") < 0.0)
            raise ResetNeeded(
                f"the episodes of environments {done.tolist()} are over: "
                "reset them with options['reset_mask']"
            )
        n, program = self.num_envs, self._program
        # An array with one row per entry is faster to fill; the caller gets its transpose.
        observations = np.empty((len(program.o), n), FLOAT32)
        rewards, terminations, truncations = np.empty(n), np.empty(n, BOOL), np.empty(n, BOOL)
        arrays = (actions, observations, rewards, terminations, truncations)
        if actions.dtype is not self._kind:
            every = (self._memory, self._ids, self._pars[0], *arrays)
            self._kind, self._loop = actions.dtype, sharing.address_of(program.step_blocks, *every)
        turn = self._turn = self._turn + 1
        rest = (*arrays, n, turn)
        shares = self._get_help(*rest) if self._most_threads > 1 else 1
        call = (self._loop, self._memory, self._ids, self._pars[0], *rest, 0, shares)
        status, over = self._step_all(*call)
        while over < 0:  # another program took a helper's core for a while
            time.sleep(1e-5)
            status, over = self._step_all(*call)
        if status < 0:
            raise ValueError(
                f"actions must be finite, got {actions.reshape(n, -1)[-status - 1]} "
                f"for environment {-status - 1}"
            )
        self._over = over
        observations = observations.T
        infos = self._infos(None)
        refused = is_refused(rewards) if status > 0 else None
        if refused is not None:
            rewards[refused] = 0.0
        if self._over and self.autoreset_mode == AutoresetMode.SAME_STEP:
            observations, infos = self._restart(observations, terminations | truncations, infos)
        if self._seen:
            self._count(rewards, refused)
        results = observations, rewards, terminations, truncations, infos
        if refused is not None:
            infos["refused"] = refused
            raise self._refusal(results)
        return results

    def render(self) -> Any:
        """Return a picture (height, width, 3) of each environment; with `show_tiles`, one of them all."""
        if self.render_mode is None:
            gym.logger.warn('no render mode is set; make the environment with render_mode="rgb_array"')
            return None
        if not self._started:
            raise ResetNeeded("call reset() before render(): no episode has begun")
        if not self._viewers:
            self._viewers, self._viewed = self._make_viewers(), {}
        self._use_drawn()
        targets = self.target if self.target is not None else [None] * self.num_envs
        of_each = (self.state, self.control, targets, self._steps.tolist(), self._totals.tolist())
        episodes = self._keys[2].tolist()
        # An episode that `max_episode_steps` cuts short is scored as one that goes on.
        over = ((self._read("n") < 0.0) & (self.limits == self.task.limit)).tolist()
        pictures = tuple(
            viewer.draw(*now) for viewer, *now in zip(self._viewers, *of_each, episodes, over, strict=False)
        )
        if self._tiles is None:
            return pictures
        from lag_envs.envs.rendering import columns_of, tiled

        return tiled(pictures, columns_of(self._tiles))

    def close_extras(self, **kwargs: Any) -> None:
        """Release the pictures."""
        for viewer in self._viewers:
            viewer.close()
        self._viewers = ()

    def get_state(self) -> snapshots.Snapshot:
        """Return everything that decides how these and later episodes continue, for `set_state`.

        Raises
        ------
        ResetNeeded
            Before the first reset.
        """
        if not self._started:
            raise ResetNeeded("call reset() before get_state(): no episode has begun")
        rows = {name: self._read(name) for name in self._program.kept}
        ids, steps, totals = self._keys.copy(), self._steps.copy(), self._totals.copy()
        return snapshots.Snapshot(self._about, rows, ids, steps, totals)

    def set_state(self, snapshot: snapshots.Snapshot, mask: NDArray[np.bool_] | None = None) -> None:
        """Restore the state in which `get_state` was called; all later results have the same bits.

        Parameters
        ----------
        snapshot : Snapshot
            A snapshot of this batch, or of one that was made in the same way, perhaps in another process.
        mask : ndarray of bool, shape (num_envs,), optional
            The environments to set; by default all. The others stay unchanged.

        Raises
        ------
        TypeError, ValueError
            For something that is not a snapshot or not a mask, or for a snapshot of another batch; then
            nothing is changed.
        ResetNeeded
            Before the first reset, if the mask does not select all environments.
        """
        snapshots.check_snapshot(snapshot, self._about, self._program.kept)
        mask = self._check_mask(mask, "mask")
        if not self._started and not mask.all():
            raise ResetNeeded("call reset() before set_state() with a mask that leaves some out")
        lanes = self._lanes[mask]
        for name, values in snapshot.rows.items():
            self._write(name, lanes, values[lanes])
        self._keys[:, lanes] = snapshot.ids[:, lanes]
        self._steps[lanes], self._totals[lanes] = snapshot.steps[lanes], snapshot.totals[lanes]
        self._started = True
        self._starts += 1
        self._over = int(np.count_nonzero(self._read("n") < 0.0))

    @property
    def _about(self) -> dict[str, Any]:
        """The properties that a snapshot must share."""
        options = {"num_envs": self.num_envs, "autoreset_mode": self.autoreset_mode.value}
        return snapshots.properties(self.tasks, **options, max_episode_steps=self._limit, order=self.order)

    # --- for inspection ------------------------------------------------------------------------------------

    @property
    def state(self) -> NDArray[np.float64]:
        """Copy of the states, shape (num_envs, n_state), ordered as ``scene.state_names``, in SI units."""
        blocks = self._blocks
        found = np.empty((len(blocks), BLOCK, len(self.scene.state_names)))
        for j in range(found.shape[2]):
            found[..., j] = blocks[:, self._row[f"y{j}"]]
        return found.reshape(-1, found.shape[2])[: self.num_envs]

    @property
    def target(self) -> NDArray[np.float64] | None:
        """The targets, shape (num_envs,), or (num_envs, n) if there are several; None if there are none."""
        names = self._program.g
        return single_number(np.stack([self._read(name) for name in names], axis=1)) if names else None

    @property
    def control(self) -> NDArray[np.float64]:
        """The controls applied last [SI], shape (num_envs,), or (num_envs, n) if there are several.

        They are 0 after a reset.
        """
        return self._controls(self._program.u)

    def _controls(self, rows: Sequence[str]) -> NDArray[np.float64]:
        return single_number(np.array([self._read(name) for name in rows]).reshape(-1, self.num_envs).T)

    @property
    def parameters(self) -> dict[str, NDArray[np.float64]]:
        """The parameters drawn for these episodes, shape (num_envs,) each; empty if none are drawn."""
        return {name: self._read(f"p_{name}") for name in self._drawn}

    @property
    def num_threads(self) -> int:
        """Number of threads that may step the batch."""
        return self._num_threads or sharing.default_threads(self.num_envs)

    @property
    def order(self) -> int | None:
        """Order of the general series, see `Task.order`; None if the scene has a flow of its own."""
        name = self._program.order_constant
        return None if name is None else int(self._pars[0][self._program.uniform.index(name)])

    def _repr_html_(self) -> str:
        """Return the HTML of a notebook: the current pictures, spaces, controls, parameters."""
        from lag_envs.envs.html import environment_html, still
        from lag_envs.envs.rendering import columns_of, tiled

        shown, pictures = self.tasks[:9], []
        columns = columns_of(len(shown))
        targets = self.target if self._started and self.target is not None else [None] * self.num_envs
        for i, task in enumerate(shown):
            now = (self.state[i], self.control[i], targets[i]) if self._started else ()
            if (picture := still(task, *now, columns=columns)) is not None:
                pictures.append(picture)
        title = f"{self.spec.id if self.spec else type(self.task).__name__} × {self.num_envs}"
        if 0 < len(pictures) < self.num_envs:
            title += f" (the first {len(pictures)} are shown)"
        spaces = {"observation of each": self.single_observation_space, "action": self.single_action_space}
        grid = tiled(pictures, columns) if pictures else None
        return environment_html(self.task, title, spaces, grid)

    # --- internal ------------------------------------------------------------------------------------------

    def _make_viewers(self) -> tuple[Any, ...]:
        from lag_envs.envs.rendering import HEIGHT, WIDTH, Viewer, tile_size

        size = (WIDTH, HEIGHT) if self._tiles is None else tile_size(self._tiles)
        return tuple(
            Viewer(task, "rgb_array", self._look, size) for task in self.tasks[: self._tiles or self.num_envs]
        )

    def _use_drawn(self) -> None:
        """Let the viewers show the drawn parameters."""
        drawn = self.parameters
        if drawn:
            for i, viewer in enumerate(self._viewers):
                values = {name: float(column[i]) for name, column in drawn.items()}
                if self._viewed.get(i) != values:
                    self._viewed[i] = values
                    viewer.use(self.tasks[i].varied(**values))

    def _count(self, rewards: NDArray[np.float64], refused: NDArray[np.bool_] | None) -> None:
        """Count steps and rewards of the episodes."""
        begun, taken = self._read("n") == 0.0, 1 if refused is None else ~refused
        self._steps = np.where(begun, 0, self._steps + taken)
        self._totals = np.where(begun, 0.0, self._totals + rewards)

    @property
    def ended(self) -> NDArray[np.bool_] | None:
        """A mask of the environments whose episodes are over; None if no episode is over."""
        return self._read("n") < 0.0 if self._over else None

    @property
    def moment(self) -> tuple[int, int]:
        """Numbers of steps and of other starts; while both stay the same, so do the states."""
        return self._turn, self._starts

    @property
    def clock(self) -> tuple[NDArray[np.uint64], NDArray[np.uint64]]:
        """Keys of the episodes' random numbers, and the numbers of the next steps; for `Model.kicks`."""
        return self._keys[2].copy(), np.maximum(self._read("n") + 1.0, 0.0).astype(np.uint64)

    @property
    def limits(self) -> NDArray[np.float64]:
        """Steps of an episode in each environment; infinity for one without an end."""
        return np.array([constants["limit"] for constants in self._constants])

    def _read(self, row: str) -> NDArray[np.float64]:
        return self._blocks[:, self._row[row]].reshape(-1)[: self.num_envs].copy()

    def _write(self, row: str, lanes: NDArray[np.intp], values: Any) -> None:
        self._blocks[lanes // BLOCK, self._row[row], lanes % BLOCK] = values

    @property
    def _keys(self) -> NDArray[np.uint64]:
        """Keys of the seeds, numbers of the episodes, keys of the episodes, shape (3, num_envs)."""
        return self._ids[: 3 * self.num_envs].reshape(3, self.num_envs)

    @property
    def _blocks(self) -> NDArray[np.float64]:
        """The rows that are kept, as (block, row, lane)."""
        return self._memory.reshape(-1, len(self._row), BLOCK)

    def _start(self, observations: NDArray[np.float32], mask: NDArray[np.bool_], *given: bool) -> None:
        """Begin episodes where the mask is set.

        ``given`` says whether to write all observations, whether states are given, and whether targets are
        given.
        """
        self._program.start_all(
            self._memory, self._ids, self._pars[0], observations.T, mask, *given, self.num_envs
        )

    def _get_help(self, actions: NDArray, *rest: Any) -> int:
        """Ask other threads to take part in a step; return how many may take part, including this thread."""
        shares, kind = min(self.num_threads, self._most_threads), actions.dtype
        if (calls := self._calls.get((shares, kind))) is None:
            while len(self._pars) < shares:
                self._pars.append(on_a_line(self._pars[0], len(self._program.uniform)))
            calls = self._calls[shares, kind] = [
                (self._loop, self._memory, self._ids, self._pars[i], actions, *rest, i, shares)
                for i in range(1, shares)
            ]
        if calls:
            sharing.offer(calls, kind)
        return shares

    def _restart(
        self, observations: NDArray[np.float32], over: NDArray[np.bool_], infos: dict[str, Any]
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Begin new episodes in the same step; put the old ones' last observations and infos into `infos`."""
        final = np.full(self.num_envs, None, dtype=object)
        for i in np.flatnonzero(over):
            final[i] = observations[i].copy()
        rows = over[:, None]
        last = {
            k: v if k.startswith("_") else np.where(rows if v.ndim > 1 else over, v, 0)
            for k, v in infos.items()
        }
        last |= {k: over & v for k, v in last.items() if k.startswith("_")}
        self._start(observations, over, False, False, False)
        self._over = 0
        infos = self._infos(None)
        ends = {"final_obs": final, "_final_obs": over.copy(), "final_info": last, "_final_info": over.copy()}
        return observations, infos | ends

    def _infos(self, mask: NDArray[np.bool_] | None) -> dict[str, Any]:
        if not self.diagnostics:
            return {}
        mask = np.ones(self.num_envs, dtype=np.bool_) if mask is None else mask
        infos: dict[str, Any] = {}
        states, controls = self.state, self.control
        drawn = self.parameters
        for i in self._lanes[mask]:
            task = self.tasks[i]
            if drawn:
                task = task.varied(**{name: float(values[i]) for name, values in drawn.items()})
            infos = self._add_info(infos, diagnostics(task.scene, states[i], controls[i]), int(i))
        return infos

    def _refusal(self, results: tuple) -> StepRefused:
        i, *others = np.flatnonzero(results[-1]["refused"]).tolist()
        where = f"the step of environment {i}"
        if others:
            few = ", ".join(map(str, others[:10])) + (", ..." if len(others) > 10 else "")
            where += f" (like those of {few}; results[-1]['refused'] of this error marks all)"
        control = self._controls(self._program.asked or self._program.u)[i]
        error = self.tasks[i].formulas.refusal(self.state[i], control, self.task.dt, where)
        error.results = results
        return error

    def _check_mask(self, mask: Any, name: str = "options['reset_mask']") -> NDArray[np.bool_]:
        if mask is None:
            return np.ones(self.num_envs, dtype=np.bool_)
        if not isinstance(mask, np.ndarray) or mask.dtype != np.bool_ or is_masked(mask):
            raise TypeError(f"{name} must be a NumPy array of bool, got {shown(mask)}")
        if mask.shape != (self.num_envs,):
            raise ValueError(
                f"{name} must have shape ({self.num_envs},), got shape {mask.shape}: {shown(mask)}"
            )
        if not mask.any():
            raise ValueError(f"{name} must select at least one environment, got {shown(mask)}")
        return mask

    def _check_rows(
        self, name: str, values: Any, shape: tuple[int, ...], single: bool = False
    ) -> NDArray[np.float64]:
        """Return values of a shape (or one number for all, if `single`), or raise a ValueError."""
        array = real_array(name, values)
        if array.shape != shape and not (single and array.ndim == 0):
            wanted = f"be one number or have shape {shape}" if single else f"have shape {shape}"
            raise ValueError(f"{name} must {wanted}, got shape {array.shape}: {shown(values)}")
        return np.broadcast_to(array, shape)

    def _targets_by_name(self, given: Mapping[str, Any]) -> NDArray[np.float64]:
        """Return targets by name, each one number for all or one for each environment, as rows."""
        names = [t.name for t in self.task.formulas.target_boxes]
        if set(given) != set(names):
            raise ValueError(f"target must give {', '.join(names)}, got {shown(given)}")
        rows = np.stack(
            [
                self._check_rows(f"options['target'][{name!r}]", given[name], (self.num_envs,), single=True)
                for name in names
            ],
            axis=-1,
        )
        return rows[:, 0] if len(names) == 1 else rows

    def __getstate__(self) -> dict[str, Any]:
        """Return the state for pickling, without compiled functions, pictures and the helpers' data."""
        without = ("_program", "_viewers", "_viewed", "_row", "_step_all", "_kind", "_loop", "_calls")
        return {k: v for k, v in self.__dict__.items() if k not in without}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Restore the pickled state, and compile again (from the cache)."""
        self.__dict__.update(state)
        sharing.forget_helpers(self._ids, self.num_envs)
        self._compile()


def on_a_line(numbers: NDArray[np.float64], first: int = 0) -> NDArray[np.float64]:
    """Return a copy with number `first` at the start of a cache line, so that each vector is on one line."""
    room = np.empty(len(numbers) + 8)
    start = (-(room.ctypes.data // 8) - first) % 8
    copy = room[start : start + len(numbers)]
    copy[:] = numbers
    return copy


def for_environment(i: int, function: Callable, /, *arguments: Any, **keywords: Any) -> Any:
    """Call a function; if it raises a ValueError, add that this was for environment i."""
    try:
        return function(*arguments, **keywords)
    except ValueError as error:
        raise ValueError(f"environment {i}: {error}") from error


def seeds_of(seed: Any, n: int) -> list[tuple[int, int]]:
    """Return (environment, seed) for each of n environments to be seeded, or raise an error."""
    if seed is None:
        return []
    if isinstance(seed, list | tuple | range) or (type(seed) is np.ndarray and seed.ndim == 1):
        if len(seed) != n:
            raise ValueError(f"seed must be one number or {n}, got {len(seed)}: {shown(seed)}")
        return [(i, check_seed(f"seed[{i}]", s)) for i, s in enumerate(seed) if s is not None]
    first = check_seed("seed", seed)
    return [(i, first + i) for i in range(n)]


def check_mode(mode: str | AutoresetMode) -> AutoresetMode:
    """Return the autoreset mode named by a string or the enum itself."""
    for known in AutoresetMode:
        if mode is known or (
            isinstance(mode, str) and mode.replace("_", "").lower() == known.value.replace("_", "").lower()
        ):
            return known
    raise ValueError(
        f"autoreset_mode must be one of {', '.join(m.value for m in AutoresetMode)}, got {shown(mode)}"
    )


def _is_one_target(kind: type[Task], values: Any) -> bool:
    """Return whether a sequence has a number for each of several targets, which hold for all environments."""
    several = isinstance(kind.target, Mapping) and len(kind.target) > 1
    return several and not any(isinstance(v, (Mapping, list, tuple, np.ndarray)) for v in values)


def _is_one_tuple(kind: type[Task], name: str, values: Any) -> bool:
    """Return whether a sequence is the value of a field that is a tuple, and not one such value for each."""
    field = inspect.signature(kind.scene).parameters.get(name) if isinstance(kind.scene, type) else None
    return field is not None and isinstance(field.default, tuple) and _depth(values) <= _depth(field.default)


def _depth(value: Any) -> int:
    """Return how many sequences lie within each other."""
    return 1 + max(map(_depth, value), default=0) if isinstance(value, list | tuple) else 0


def make_tasks(kind: type[Task], n: int, options: dict[str, Any]) -> list[Task]:
    """Return a task for each environment; all are the same object if no option varies."""
    many = {
        name: values
        for name, values in options.items()
        if (isinstance(values, list | tuple) or (isinstance(values, np.ndarray) and values.ndim > 0))
        and name not in KEYWORDS
        and not (name == "target" and _is_one_target(kind, values))
        and not _is_one_tuple(kind, name, values)
    }
    for name, values in many.items():
        if is_masked(values):
            raise ValueError(f"{name} must be real numbers, got {shown(values)}")
        if len(values) != n:
            raise ValueError(
                f"{name} must be one value or {n}, one per environment, got {len(values)}: {shown(values)}"
            )
        if name in ("control", "dt", "duration"):
            raise ValueError(f"{name} must be the same for all environments, got {shown(values)}")
    if not many:
        task = kind(**options)
        try:
            return [task] * n
        except MemoryError as error:
            raise MemoryError(
                f"num_envs={n}: the list of tasks alone takes {8 * n / 2**30:.3g} GiB"
            ) from error
    own = [options | {name: values[i] for name, values in many.items()} for i in range(n)]
    tasks = [for_environment(i, kind, **own[i]) for i in range(n)]
    if len({t.variant for t in tasks}) > 1:
        raise ValueError(
            "the environments of a batch may differ in numbers only: they must agree in structural options, "
            "in whether the track is finite and the target fixed, and in zeros that a formula divides by; "
            f"got {shown(many)}"
        )
    if len({t.formulas.key for t in tasks}) > 1:
        raise ValueError(
            f"the formulas of {kind.__name__} differ between the environments of a batch, got {shown(many)}: "
            "they use numbers that the task computes from its parameters; compute them within the formulas, "
            "from self.scene"
        )
    return tasks
