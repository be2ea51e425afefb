"""Environments for PyTorch, with exact gradients through the step; they need the extra ``torch``.

`Step` is a task's step as a function of tensors. `TorchVectorEnv` is a vector environment whose `step` can be
differentiated. Both use the compiled step and its derivatives; torch records one operation per step.

>>> import torch
>>> envs = TorchVectorEnv("PivotedBar-v0", num_envs=2)
>>> observations, _ = envs.reset(seed=1)
>>> push = torch.tensor([[0.5], [-0.5]], requires_grad=True)
>>> total = sum(envs.step(push)[1].sum() for _ in range(10))
>>> (slope,) = torch.autograd.grad(total, push)
>>> slope.shape
torch.Size([2, 1])
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, NoReturn

import gymnasium as gym
import numpy as np
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

try:
    import torch
    from torch.autograd.forward_ad import unpack_dual
except ModuleNotFoundError as error:
    raise ModuleNotFoundError(
        f'{error.name} is missing: pip install "lag-envs[torch]"', name=error.name
    ) from error

import lag_envs  # noqa: F401  (registers the environments)
from lag_envs.device import DeviceEnvs, made_vector
from lag_envs.envs.interface import start_options
from lag_envs.envs.model import Model
from lag_envs.envs.reverse import kick_depends_on_state
from lag_envs.envs.single import LagrangianEnv
from lag_envs.envs.snapshots import Snapshot
from lag_envs.envs.vector import LagrangianVectorEnv
from lag_envs.tasks.base import Task

Tensor = torch.Tensor

FIRST_ONLY = "a step has first derivatives only; leave out create_graph=True"
REVERSE_ONLY = (
    "a step has no forward mode and no second derivatives: use jacrev in place of jacfwd, and avoid jvp and "
    "hessian"
)


class StepResult(NamedTuple):
    """The result of a step.

    Attributes
    ----------
    states : Tensor, shape (..., n_state)
        The states after the step, with the type of the given states.
    observations : Tensor, shape (..., n_observations)
        The observations of these states, with the type of the actions.
    rewards : Tensor, shape (...)
        The rewards, with the type of the actions.
    terminated : Tensor of bool, shape (...)
        Whether the episode terminates.
    """

    states: Tensor
    observations: Tensor
    rewards: Tensor
    terminated: Tensor


class Step:
    """A task's step as a differentiable function: any states, any actions, no random kick, no time limit.

    It can be used with `torch.autograd`, and with `vmap`, `grad`, `vjp` and `jacrev` of `torch.func`. There
    is no forward mode (`jvp`, `jacfwd`), and there are no second derivatives (`hessian`).

    Parameters
    ----------
    task : str, type or Task
        Id of an environment, a task's class, or ``env.unwrapped.task``.
    **options
        Parameters of the environment, if an id or a class is given.

    Raises
    ------
    ValueError
        For a task with discrete actions, and for one with imperfect sensors or actuators.

    Examples
    --------
    >>> step = Step("PivotedBar-v0")
    >>> state, action = torch.tensor([0.0, 0.0, 3.0, 0.1]), torch.tensor([0.5])
    >>> torch.func.jacrev(lambda s: step(s, action).states)(state).shape
    torch.Size([4, 4])
    """

    def __init__(self, task: str | type[Task] | Task, **options: Any) -> None:
        if isinstance(task, str):
            made: Any = gym.make(task, **options).unwrapped
            if not isinstance(made, LagrangianEnv):
                raise ValueError(f"{task} has no derivatives: it is not an environment of this package")
            task = made.task
        elif isinstance(task, type) and issubclass(task, Task):
            task = task(**options)
        elif options:
            raise ValueError(
                f"options go with an id or a class; the given task has options already, got {sorted(options)}"
            )
        self.task = _checked_task(task)
        self.model = Model(self.task)
        formulas = self.task.formulas
        self._sizes = len(formulas.state), formulas.actions, formulas.targets

    def __call__(self, states: Tensor, actions: Tensor, targets: Tensor | None = None) -> StepResult:
        """Take one step from each state.

        Parameters
        ----------
        states : Tensor, shape (..., n_state)
            States in the order of ``task.scene.state_names``, float32 or float64.
        actions : Tensor, shape (..., n_actions)
            Actions; values outside their space are clipped, and their gradient is then 0.
        targets : Tensor, shape (..., n_targets), optional
            Targets, for a task whose targets are random.

        Raises
        ------
        ValueError, TypeError
            For tensors of another shape, type or device, or with numbers that are not finite.
        StepRefused
            If a step cannot be taken to full accuracy.
        """
        n_state, n_actions, n_targets = self._sizes
        _check("states", states, (n_state,))
        shape = states.shape[:-1]
        _check("actions", actions, (*shape, n_actions), whole=True)
        if targets is None:
            fixed = self.task.fixed_target
            if n_targets and fixed is None:
                raise ValueError("the task's target is random, so targets must be given")
            given = torch.as_tensor(np.zeros(0) if fixed is None else np.asarray(fixed, np.float64))
            targets = given.reshape(n_targets).expand(*shape, n_targets)
        _check("targets", targets, (*shape, n_targets), whole=True)
        rows = (x.reshape(shape.numel(), x.shape[-1]) for x in (states, actions, targets))
        found = _RowStep.apply(self.model, *rows)
        return StepResult(*(x.reshape((*shape, *x.shape[1:])) for x in found))


class TorchVectorEnv:
    """Many environments of one task as tensors, with a differentiable `step`.

    On the CPU the numbers are those of the native vector environment, bit for bit, and tensors share its
    memory. If the actions, or the states that earlier actions led to, require a gradient, `step` is
    recorded: gradients flow from observations and rewards to actions, and along `state` from step to step
    until `detach` cuts them off. No gradient flows across an episode's end. Copies and snapshots have no
    history. If `envs` itself is stepped, reset or set, `state` follows; if this breaks the history of
    `state`, a RuntimeError says so until `detach` is called. Inside `vmap`, `grad` and the like of
    `torch.func` use `Step`.

    On an NVIDIA GPU one kernel takes the whole step, states stay on the GPU, and there are no gradients. In
    float64 the bits are those of the unfused step, `lag_envs.envs.unfused.Unfused`. `step` does not wait for
    the GPU, so it neither raises `StepRefused` nor rejects actions that are not finite. Instead, if a step
    cannot be taken, the environment keeps its state, its reward is 0, and the episode is truncated;
    ``infos["refused"]`` says which. On a GPU, `state` is memory that the next step overwrites.

    Parameters
    ----------
    task : str or type
        Id of an environment, or a task's class.
    num_envs : int
        Number of environments.
    device : str or torch.device
        Device of the tensors: ``"cpu"``, or ``"cuda"`` for an NVIDIA GPU.
    dtype : torch.dtype
        Type of states and rewards: float64, or float32 on a GPU.
    **options
        Keywords of ``gym.make_vec``: `autoreset_mode`, parameters of the scene and of the task. Their values
        are the same for all environments.

    Attributes
    ----------
    envs : LagrangianVectorEnv or DeviceEnvs
        The environments.

    Raises
    ------
    ValueError
        For an unavailable device, a task with imperfect sensors or actuators, and parameters that differ
        between environments; on the CPU also for float32, and for a task with discrete actions or with kicks
        that depend on the state.
    """

    envs: LagrangianVectorEnv | DeviceEnvs

    def __init__(
        self,
        task: str | type[Task],
        num_envs: int = 1,
        device: str | torch.device = "cpu",
        dtype: torch.dtype = torch.float64,
        **options: Any,
    ) -> None:
        self._model: Model | None = None
        self._state, self._moment = torch.empty(0), (0, 0, 0)
        self._infos: dict[str, Any] = {}
        if str(device) not in ("cpu", "cpu:0"):
            self.envs = found = DeviceEnvs(task, num_envs, device, dtype, **options)
            self.num_envs, self.device = found.num_envs, found.device
            self._take_spaces(found.sample)
            self.observation_space = batch_space(self.single_observation_space, num_envs)
            self.action_space = batch_space(self.single_action_space, num_envs)
            return
        if dtype != torch.float64:
            raise ValueError(f"on the CPU dtype must be torch.float64, got {dtype}")
        made = made_vector(task, num_envs, "has no derivatives", **options)
        if any(other is not made.task for other in made.tasks):
            raise ValueError("gradients need the same parameters in all environments; give one value for all")
        _checked_task(made.task)
        if made.task.draws and kick_depends_on_state(made.task):
            raise ValueError(
                f"the kick of {made.task.id or type(made.task).__name__} depends on the state, and gradients "
                "would ignore this; lag_envs.torch.Step takes steps without kicks"
            )
        self.envs, self.num_envs, self.device = made, made.num_envs, torch.device("cpu")
        self._take_spaces(made)
        self.observation_space, self.action_space = made.observation_space, made.action_space

    def __getstate__(self) -> dict[str, Any]:
        history = self._state.requires_grad
        return vars(self) | ({"_state": self._state.detach()} if history else {})

    def _take_spaces(self, made: LagrangianVectorEnv) -> None:
        self.single_observation_space = made.single_observation_space
        self.single_action_space = made.single_action_space

    @property
    def state(self) -> Tensor:
        """The states, shape (num_envs, n_state), on the CPU with their history.

        They cannot be assigned; ``reset(options={"state": ...})`` begins with other states.

        Raises
        ------
        ResetNeeded
            Before the first reset; on a GPU the states are 0 then.
        RuntimeError
            If the environments are no longer where the history of the states leads.
        """
        if isinstance(self.envs, DeviceEnvs):
            return self.envs.state
        if self.envs.moment == (0, 0):
            raise ResetNeeded("call reset() first: no episode has begun")
        if self._moment == (*self.envs.moment, self._state._version):
            return self._state
        state, now = self._state, self.envs.state
        if not np.array_equal(state.detach().numpy(), now):
            if state.requires_grad:
                raise RuntimeError(
                    "the environments are not where the history of `state` leads: a step was refused, the "
                    "environments were changed through `envs`, or `state` was changed in place; call "
                    "detach() to continue from their present states, and use reset and set_state of this "
                    "object"
                )
            state = torch.from_numpy(now)
        self._keep(state)
        return state

    @state.setter
    def state(self, value: Any) -> NoReturn:
        raise AttributeError(
            "state cannot be assigned, since the environments would not follow; call "
            "reset(options={'state': ...}), or set_state with a snapshot from get_state"
        )

    @property
    def model(self) -> Model:
        """The step and its derivatives, compiled on first use."""
        if self._model is None:
            self._model = Model(self.envs.task)
        return self._model

    def reset(
        self, *, seed: Any = None, options: dict[str, Any] | None = None
    ) -> tuple[Tensor, dict[str, Any]]:
        """Start an episode in every environment, or in those of a mask; see `LagrangianVectorEnv.reset`.

        `options` may hold tensors. A state that requires a gradient must be a leaf. Gradients of later
        results then reach this state, but not through the observations returned here.

        Returns
        -------
        observations : Tensor of float32, shape (num_envs, n_observations)
            The observations.
        infos : dict
            Empty, or the diagnostics.

        Raises
        ------
        NotImplementedError
            As `step` does.
        """
        _check_reverse(*(options or {}).values() if isinstance(options, Mapping | None) else ())
        if isinstance(self.envs, DeviceEnvs):
            return self.envs.reset(seed, options), {}
        state, _, mask = start_options(options, ("state", "target", "reset_mask"))
        given = dict(options or {})
        if isinstance(state, Tensor):
            _check("options['state']", state, (self.num_envs, len(self.envs.scene.state_names)))
            if state.requires_grad and not state.is_leaf:
                raise ValueError(
                    "options['state'] is the result of other operations: give state.detach(), or use "
                    "lag_envs.torch.Step for gradients through these operations"
                )
        before = self._before(mask)
        observations, infos = self.envs.reset(seed=seed, options=_plain(given) or None)
        now = torch.from_numpy(self.envs.state)
        if isinstance(state, Tensor) and state.requires_grad:
            now = state.to(torch.float64)
        self._keep(now, before, mask)
        return torch.from_numpy(observations), infos

    def get_state(self) -> Snapshot:
        """Return everything that decides how these and later episodes continue, for `set_state`.

        Raises
        ------
        ResetNeeded
            Before the first reset.
        ValueError
            On a GPU.
        """
        return self._on_cpu().get_state()

    def set_state(self, snapshot: Snapshot, mask: Any = None) -> None:
        """Restore the state in which `get_state` was called; see `LagrangianVectorEnv.set_state`.

        In the environments that are set, no gradient flows to earlier steps.

        Parameters
        ----------
        snapshot : Snapshot
            A snapshot of this batch, or of one made alike.
        mask : ndarray or Tensor of bool, shape (num_envs,), optional
            The environments to set; by default all.

        Raises
        ------
        TypeError, ValueError, ResetNeeded
            As `LagrangianVectorEnv.set_state` does; ValueError also on a GPU.
        """
        envs, before = self._on_cpu(), self._before(mask)
        envs.set_state(snapshot, _plain(mask))
        self._keep(torch.from_numpy(envs.state), before, mask)

    def step(self, actions: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, dict[str, Any]]:
        """Hold one control for one control interval in every environment.

        Parameters
        ----------
        actions : Tensor, shape (num_envs, n_actions)
            Actions, float32 or float64; finite values outside their space are clipped, and their gradient is
            then 0. On a GPU, listed actions are whole numbers.

        Returns
        -------
        observations : Tensor of float32, shape (num_envs, n_observations)
            The observations.
        rewards : Tensor, shape (num_envs,)
            The rewards; float64, on a GPU the `dtype` of the environments.
        terminations, truncations : Tensor of bool, shape (num_envs,)
            Whether episodes end.
        infos : dict
            The infos that Gymnasium defines, as NumPy arrays; on a GPU as tensors, with ``refused``.

        Raises
        ------
        ValueError, TypeError
            For actions that have another shape, type or device, or are not finite; then nothing is stepped.
            On a GPU, an action that is not finite ends its episode instead.
        NotImplementedError
            Inside a transform of `torch.func`, and for actions with a tangent (forward mode).
        ResetNeeded, StepRefused
            As `LagrangianVectorEnv.step` does.
        """
        _check_reverse(actions)
        if isinstance(self.envs, DeviceEnvs):
            if torch.is_grad_enabled() and isinstance(actions, Tensor) and actions.requires_grad:
                raise ValueError(
                    "a GPU's step has no gradients: give actions.detach(), or make the environments with "
                    "device='cpu'"
                )
            return self.envs.step(actions)
        _check("actions", actions, (self.num_envs, self.envs.task.formulas.actions))
        if torch.is_grad_enabled() and (actions.requires_grad or self._state.requires_grad):
            observations, rewards, after, *ends = _EnvStep.apply(self, self.state, actions)
            self._keep(after)
            return observations, rewards, *ends, self._infos
        results = [torch.from_numpy(x) for x in self._advance(actions)]
        self._keep(torch.from_numpy(self.envs.state))
        return *results, self._infos  # type: ignore[return-value]

    def detach(self) -> None:
        """Forget the history of the states: no gradient flows to steps before this call."""
        self._state = self._state.detach()

    def close(self) -> None:
        """Close the environments."""
        if isinstance(self.envs, LagrangianVectorEnv):
            self.envs.close()

    def _before(self, mask: Any) -> Tensor | None:
        """Return the states, some of which a mask keeps; None without a mask, or before the first reset."""
        return None if mask is None or not len(self._state) else self.state

    def _keep(self, state: Tensor, before: Tensor | None = None, mask: Any = None) -> None:
        """Store the current states and their history; outside a mask, keep the old history."""
        assert isinstance(self.envs, LagrangianVectorEnv)
        if before is not None:
            state = torch.where(torch.as_tensor(mask)[:, None], state, before)
        if state.is_inference():  # inference tensors could not be differentiated later
            with torch.inference_mode(False):
                state = state.clone()
        self._state, self._moment = state, (*self.envs.moment, state._version)

    def _on_cpu(self) -> LagrangianVectorEnv:
        """Return the environments, or raise a ValueError if they are on a GPU."""
        if isinstance(self.envs, DeviceEnvs):
            raise ValueError(
                "environments on a GPU have no snapshots; keep state.clone() and give it to "
                "reset(options={'state': ...}), or make the environments with device='cpu'"
            )
        return self.envs

    def _advance(self, actions: Tensor) -> list[Any]:
        assert isinstance(self.envs, LagrangianVectorEnv)
        *results, self._infos = self.envs.step(actions.numpy(force=True))
        return list(results)


class _RowStep(torch.autograd.Function):
    """`Step`, on rows."""

    @staticmethod
    def forward(model: Model, states: Tensor, actions: Tensor, targets: Tensor) -> tuple[Tensor, ...]:
        y, a, g = _rows(model, states, actions, targets)
        ends, rewards, ended = model(y, a, g)
        seen = torch.from_numpy(np.ascontiguousarray(model.observe(ends, g)))
        return (
            torch.from_numpy(ends).to(states.dtype),
            seen.to(actions.dtype),
            torch.from_numpy(rewards).to(actions.dtype),
            torch.from_numpy(ended),
        )

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: tuple) -> None:
        ctx.model, *given = inputs
        ctx.save_for_backward(*given, output[0])
        ctx.mark_non_differentiable(output[3])

    @staticmethod
    def backward(ctx: Any, *seeds: Tensor) -> tuple:
        return None, *_RowStepBackward.apply(ctx.model, *ctx.saved_tensors, *seeds[:3])

    @staticmethod
    def jvp(ctx: Any, *tangents: Tensor | None) -> NoReturn:
        raise NotImplementedError(REVERSE_ONLY)

    @staticmethod
    def vmap(info: Any, in_dims: tuple, *given: Any) -> tuple:
        return _over_batch(_RowStep, info, in_dims, given)


class _RowStepBackward(torch.autograd.Function):
    """The derivatives of `_RowStep`."""

    @staticmethod
    def forward(
        model: Model,
        states: Tensor,
        actions: Tensor,
        targets: Tensor,
        ends: Tensor,
        by_states: Tensor,
        by_observations: Tensor,
        by_rewards: Tensor,
    ) -> tuple[Tensor, ...]:
        given = states, actions, targets
        y, a, g, z, *seeds = map(_numbers, (*given, ends, by_states, by_observations, by_rewards))
        slopes = model.reverse().vjp(y, a, g, z, z, *seeds)
        return tuple(
            torch.from_numpy(np.ascontiguousarray(slope)).to(x.dtype)
            for slope, x in zip(slopes, given, strict=False)
        )

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple, output: tuple) -> None: ...

    @staticmethod
    def backward(ctx: Any, *seeds: Tensor) -> tuple:
        raise NotImplementedError(FIRST_ONLY)

    @staticmethod
    def vmap(info: Any, in_dims: tuple, *given: Any) -> tuple:
        return _over_batch(_RowStepBackward, info, in_dims, given)


class _EnvStep(torch.autograd.Function):
    """`TorchVectorEnv.step`."""

    @staticmethod
    def forward(ctx: Any, env: TorchVectorEnv, state: Tensor, actions: Tensor) -> tuple[Tensor, ...]:
        envs: Any = env.envs
        ctx.model, ctx.targets = env.model, envs.target
        ctx.set_materialize_grads(False)
        #: Environments whose episode was over, which take no step; and those in which another episode has
        #: begun.
        ended = envs.ended
        ctx.waiting = ctx.begun = np.flatnonzero(() if ended is None else ended)
        ctx.clock = envs.clock if envs.task.draws else None
        observations, rewards, terminated, truncated = map(torch.from_numpy, env._advance(actions))
        if (
            envs.autoreset_mode == AutoresetMode.SAME_STEP
            and (over := (terminated | truncated).numpy()).any()
        ):
            ctx.begun = np.flatnonzero(over)
        after = torch.from_numpy(envs.state)
        ctx.save_for_backward(state, actions, after)
        ctx.mark_non_differentiable(terminated, truncated)
        return observations, rewards, after, terminated, truncated

    @staticmethod
    def backward(ctx: Any, *seeds: Tensor | None) -> tuple:
        if torch.is_grad_enabled():  # torch's `once_differentiable` would drop some of the second derivatives
            raise NotImplementedError(FIRST_ONLY)
        model, waiting, begun = ctx.model, ctx.waiting, ctx.begun
        y, a, ends = (x.detach().numpy() for x in ctx.saved_tensors)
        task = model.task
        shapes = (len(y), len(task.formulas.observation)), (len(y),), y.shape
        by_observations, by_rewards, by_states = (
            np.broadcast_to(0.0, shape) if seed is None else seed.numpy(force=True)
            for seed, shape in zip(seeds, shapes, strict=False)
        )
        y, ends = (_replaced(x, waiting, task.centre) for x in (y, ends))
        a, by_observations, by_states = (
            _replaced(x, rows, 0.0)
            for x, rows in ((a, waiting), (by_observations, begun), (by_states, begun))
        )
        after = ends
        if task.draws:
            ends = after - model.kicks(*ctx.clock)
        if begun is not waiting:  # where another episode has begun, the end of the step is not known
            random = ctx.targets is not None and task.fixed_target is None
            actions = a[begun, 0] if a.shape[1] == 1 else a[begun]
            ends = _replaced(ends, begun, model(y[begun], actions, ctx.targets[begun] if random else None)[0])
            after = after if task.draws else ends
        g = np.zeros((len(y), 0)) if ctx.targets is None else ctx.targets.reshape(len(y), -1)
        by_state, by_action, _, _ = model.reverse().vjp(
            y, a, g, ends, after, by_states, by_observations, by_rewards
        )
        by_state[waiting] = by_action[waiting] = 0.0
        return None, torch.from_numpy(by_state), torch.from_numpy(by_action).to(ctx.saved_tensors[1].dtype)


def _replaced(x: NDArray[Any], rows: NDArray[np.intp], values: Any) -> NDArray[Any]:
    """Return an array with other values in some rows, or the array itself if there are no such rows."""
    if len(rows):
        x = np.array(x)
        x[rows] = values
    return x


def _plain(value: Any) -> Any:
    """Return tensors, including those in a mapping, as arrays, and other values unchanged."""
    if isinstance(value, Mapping):
        return {name: _plain(v) for name, v in value.items()}
    return value.detach().numpy() if isinstance(value, Tensor) else value


def _numbers(x: Tensor) -> NDArray[np.float64]:
    return x.to(torch.float64).numpy(force=True)  # of views that are negated or conjugated too


def _rows(model: Model, states: Tensor, actions: Tensor, targets: Tensor) -> tuple[Any, Any, Any]:
    """Return states, actions and targets in the form that `Model` takes."""
    y, a, g = map(_numbers, (states, actions, targets))
    random = model.task.formulas.targets and model.task.fixed_target is None
    return y, a[:, 0] if a.shape[1] == 1 else a, (g[:, 0] if g.shape[1] == 1 else g) if random else None


def _over_batch(function: Callable, info: Any, in_dims: tuple, given: tuple) -> tuple[tuple, tuple]:
    """Apply a function of rows to batches of rows."""
    model, *tensors = given
    n = info.batch_size
    batches = [
        x.expand(n, *x.shape) if dim is None else x.movedim(dim, 0)
        for x, dim in zip(tensors, in_dims[1:], strict=True)
    ]
    found = function.apply(model, *(x.flatten(0, 1) for x in batches))  # type: ignore[attr-defined]
    return tuple(x.unflatten(0, batches[0].shape[:2]) for x in found), (0,) * len(found)


def _checked_task(task: Any) -> Task:
    """Return a task whose steps are differentiable, or raise a ValueError."""
    if not isinstance(task, Task):
        raise TypeError(f"task must be an id, a class or a Task, got {task!r:.60}")
    name = task.id or type(task).__name__
    if task.formulas.choices:
        raise ValueError(f"{name} has a list of actions to choose from; choices have no derivatives")
    if task.imperfections:
        raise ValueError(
            f"{name} has imperfect sensors, imperfect actuators or hidden parameters, for which there are "
            "no derivatives; leave these keywords out, or take an id without them"
        )
    return task


def _check_reverse(*given: Any) -> None:
    """Raise NotImplementedError for tensors of torch.func, and for tangents, which would be lost."""
    for x in given:
        if not isinstance(x, Tensor):
            continue
        if torch.func.debug_unwrap(x, recurse=False) is not x:
            raise NotImplementedError(
                "TorchVectorEnv cannot be used inside torch.func (vmap, grad, jacrev, ...), because it "
                "changes the environments; use lag_envs.torch.Step there, or torch.autograd outside"
            )
        if unpack_dual(x).tangent is not None:
            raise NotImplementedError(REVERSE_ONLY)


def _check(name: str, x: Any, shape: tuple[int, ...], *, whole: bool = False) -> None:
    """Raise an error unless x is a tensor of real numbers on the CPU of this shape.

    A shape of one number applies to the last axis only, unless it is the `whole` shape.
    """
    if not isinstance(x, Tensor):
        raise TypeError(f"{name} must be a tensor, got {type(x).__name__}; torch.as_tensor makes one")
    if x.device.type != "cpu":
        raise ValueError(f"{name} must be on the CPU, got a tensor on {x.device}; call .cpu()")
    if x.layout != torch.strided:
        raise TypeError(f"{name} must be dense, got a tensor of layout {x.layout}; call .to_dense()")
    if x.dtype not in (torch.float32, torch.float64):
        raise TypeError(f"{name} must be float32 or float64, got {x.dtype}")
    last = len(shape) == 1 and not whole
    if tuple(x.shape[-1:] if last else x.shape) != shape:
        wanted = f"(..., {shape[0]})" if last else str(shape)
        raise ValueError(f"{name} must have shape {wanted}, got {tuple(x.shape)}")
