"""Environments of one task whose whole step runs on a GPU, one thread for each; see `lag_envs.torch`.

The kernels are those of `lag_envs.envs.kernels`. The function that compiles and starts them is a parameter:
tests use any C++ compiler and the CPU's memory.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode

from lag_envs import nvrtc
from lag_envs.envs.interface import seed_key, start_options
from lag_envs.envs.kernels import APART, kernels_of
from lag_envs.envs.vector import LagrangianVectorEnv, for_environment, seeds_of
from lag_envs.scenes.checks import check_count
from lag_envs.stepping.cache import kept
from lag_envs.tasks.base import Task
from lag_envs.tasks.imperfections import KEYWORDS

Tensor = torch.Tensor
#: Starts a kernel, given its name, the number of environments and the arguments.
Launch = Callable[..., None]
Load = Callable[[str, torch.device, bool], Launch]
#: Practically no limit of steps.
ENDLESS = 2**62


def made_vector(task: str | type[Task], num_envs: int, cannot: str, **options: Any) -> LagrangianVectorEnv:
    """Return the vector environment of an id or a task; raise a ValueError for one of another package."""
    if not isinstance(task, str):
        return LagrangianVectorEnv(task, num_envs, **options)
    made = gym.make_vec(task, num_envs, **options).unwrapped
    if not isinstance(made, LagrangianVectorEnv):
        raise ValueError(f"{task} {cannot}: it is not an environment of this package")
    return made


class DeviceEnvs:
    """Environments on a GPU.

    Parameters
    ----------
    task, num_envs, device, dtype, **options
        See `lag_envs.torch.TorchVectorEnv`.
    load : callable, optional
        Compiles the kernels' text and returns a function that starts them.

    Attributes
    ----------
    rows : Tensor, shape (n_rows, num_envs)
        The numbers that are kept for the environments, including states, targets and controls.
    ages : Tensor of int32, shape (num_envs,)
        Steps taken in the present episodes; negative where an episode is over.

    Raises
    ------
    ValueError
        For tasks and options that kernels do not support; the message gives the remedy.
    """

    def __init__(
        self,
        task: str | type[Task],
        num_envs: int,
        device: str | torch.device = "cuda",
        dtype: torch.dtype = torch.float64,
        load: Load | None = None,
        **options: Any,
    ) -> None:
        if dtype not in (torch.float32, torch.float64):
            raise ValueError(f"dtype must be torch.float32 or torch.float64, got {dtype}")
        self.num_envs = check_count("num_envs", num_envs)
        self.device = checked_device(device) if load is None else torch.device(device)
        self.dtype = dtype
        name = task if isinstance(task, str) else task.__name__
        for option, value in options.items():
            if option not in KEYWORDS and isinstance(value, list | tuple | np.ndarray):
                raise ValueError(
                    f"on a GPU all environments have the same parameters: give {option} one value, "
                    "or make one TorchVectorEnv for each value"
                )
        #: One environment on the CPU, which provides task, spaces and modes.
        self.sample = sample = made_vector(task, 1, "cannot be on a GPU", **options)
        if sample.render_mode or sample.diagnostics:
            raise ValueError(
                "environments on a GPU have neither render_mode nor diagnostics; leave these keywords out"
            )
        if sample.task.imperfections:
            raise ValueError(
                f"{name} cannot be on a GPU: it has imperfect sensors, imperfect actuators or hidden "
                "parameters; leave these keywords out, take an id without them, or use device='cpu'"
            )
        self.task = sample.task
        kernels = kernels_of(self.task, dtype == torch.float32)
        self._launch = (load or load_nvrtc)(kernels.source, self.device, dtype == torch.float32)
        self._limit = int(min(sample.limits[0], ENDLESS))
        self._shape = self.num_envs, *(sample.single_action_space.shape or ())
        self._states = slice(0, len(self.task.formulas.state))
        self._targets, self._controls = kernels.targets, kernels.controls
        self.rows = self._new(kernels.kept, dtype=dtype).zero_()
        self._ids = self._new(2, dtype=torch.int64).zero_()
        self.ages = self._new(dtype=torch.int32).zero_()
        self._constants = torch.tensor(kernels.constants, dtype=dtype, device=self.device)
        self._started = False

    def _new(self, *rows: int, dtype: torch.dtype) -> Tensor:
        return torch.empty((*rows, self.num_envs), dtype=dtype, device=self.device)

    @property
    def state(self) -> Tensor:
        """The states, shape (num_envs, n_state): memory that the next step overwrites."""
        return self.rows[self._states].T

    @property
    def target(self) -> Tensor:
        """The targets, shape (num_envs, n_targets), in the same way as `state`."""
        return self.rows[self._targets].T

    @property
    def control(self) -> Tensor:
        """The controls applied last, shape (num_envs, n_controls), in the same way as `state`."""
        return self.rows[self._controls].T

    def reset(self, seed: Any = None, options: dict[str, Any] | None = None) -> Tensor:
        """Start episodes; return the observations, as `TorchVectorEnv.reset` does."""
        seeds = seeds_of(seed, self.num_envs)
        state, target, mask = start_options(options, ("state", "target", "reset_mask"))
        mask = self._mask(mask)
        if not self._started and not mask.all():
            raise ResetNeeded(
                "the first reset must reset every environment, got a reset_mask that leaves some out"
            )
        targets = self.task.formulas.targets
        states = self._given("state", state, self._states.stop, mask, self.task.start_state)
        goals = self._given("target", target, targets, mask, self.task.check_target)
        if not self._started:
            drawn = self.sample.np_random.integers(2**63, size=self.num_envs)
            self._ids[0] = torch.from_numpy(drawn).to(self.device)
        if seeds:
            lanes = torch.tensor([i for i, _ in seeds], device=self.device)
            keys = np.array([seed_key(s) for _, s in seeds], np.uint64).view(np.int64)
            chosen = mask[lanes]
            self._ids[0, lanes[chosen]] = torch.from_numpy(keys).to(self.device)[chosen]
            self._ids[1, lanes[chosen]] = 0
        observations = self._new(len(self.task.observation), dtype=torch.float32)
        self._launch(
            "begin", self.num_envs, self.rows, self._ids, self.ages, self._constants,
            mask, states, goals, observations,
        )  # fmt: skip
        self._started = True
        return observations.T

    def step(self, actions: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, dict[str, Any]]:
        """Take a control step, as `TorchVectorEnv.step` does."""
        if not isinstance(actions, Tensor):
            kind = type(actions).__name__
            raise TypeError(f"actions must be a tensor, got {kind}; torch.as_tensor makes one")
        if actions.device != self.device:
            raise ValueError(f"actions must be on {self.device}, got a tensor on {actions.device}")
        whole = bool(self.task.formulas.choices)
        if actions.is_complex() or actions.dtype == torch.bool or actions.is_floating_point() == whole:
            kind = "whole" if whole else "real"
            raise TypeError(f"actions must be {kind} numbers, got {actions.dtype}")
        if tuple(actions.shape) != self._shape:
            raise ValueError(f"actions must have shape {self._shape}, got {tuple(actions.shape)}")
        if not self._started:
            raise ResetNeeded("call reset() before step(): no episode has begun")
        mode = self.sample.autoreset_mode
        if mode == AutoresetMode.DISABLED and bool((self.ages < 0).any()):
            raise ResetNeeded("episodes are over: reset their environments with options['reset_mask']")
        count = len(self.task.observation)
        observations = self._new(count, dtype=torch.float32)
        rewards = self._new(dtype=self.dtype)
        terminated, truncated, refused = (self._new(dtype=torch.bool) for _ in range(3))
        last = over = None
        if mode == AutoresetMode.SAME_STEP:
            last, over = self._new(count, dtype=torch.float32), self._new(dtype=torch.bool)
        self._launch(
            "step", self.num_envs, self.rows, self._ids, self.ages, self._constants, self._limit,
            actions.detach().to(self.dtype).contiguous(), observations, rewards, terminated, truncated,
            refused, last, over,
        )  # fmt: skip
        infos: dict[str, Any] = {"refused": refused}
        if last is not None:
            infos |= {"final_obs": last.T, "_final_obs": over}
        return observations.T, rewards, terminated, truncated, infos

    def _mask(self, mask: Any) -> Tensor:
        if mask is None:
            return torch.ones(self.num_envs, dtype=torch.bool, device=self.device)
        found = torch.as_tensor(mask)
        if found.dtype != torch.bool or found.shape != (self.num_envs,):
            raise ValueError(
                f"options['reset_mask'] must be {self.num_envs} of torch.bool, "
                f"got shape {tuple(found.shape)} of {found.dtype}"
            )
        if not found.any():
            raise ValueError("options['reset_mask'] must select at least one environment")
        return found.to(self.device)

    def _given(self, name: str, values: Any, width: int, mask: Tensor, check: Callable) -> Tensor | None:
        """Return given starts in the form that kernels take, checked for the environments of the mask."""
        if values is None:
            return None
        array = torch.as_tensor(values).detach().to("cpu", torch.float64).numpy()
        shape = (self.num_envs,) if name == "target" and width <= 1 else (self.num_envs, width)
        if array.shape != shape:
            raise ValueError(f"options[{name!r}] must have shape {shape}, got {array.shape}")
        found = np.zeros((self.num_envs, width))
        for i in torch.nonzero(mask)[:, 0].tolist():
            found[i] = for_environment(i, check, array[i])
        return torch.from_numpy(found).to(self.device, self.dtype)


def load_nvrtc(source: str, device: torch.device, single: bool) -> Launch:
    """Compile kernels for a GPU; return a function that starts them on its current stream."""
    major, minor = torch.cuda.get_device_capability(device)
    target, options = f"sm_{major}{minor}", () if single else APART[:1]
    parts = repr((source, target, options, nvrtc.version()))
    code = kept("kernels", parts, lambda: nvrtc.compiled(source, target, options))
    with torch.cuda.device(device):
        torch.cuda.synchronize()  # creates the context in which the module is loaded
        module = nvrtc.Module(code)

    def launch(name: str, count: int, *arguments: Any) -> None:
        stream = torch.cuda.current_stream(device).cuda_stream
        module.launch(name, count, stream, [count, *map(kernel_argument, arguments)])

    return launch


def kernel_argument(argument: Tensor | int | None) -> int:
    """Return a kernel's argument as an integer: a tensor's address, a number, or a null pointer."""
    if argument is None:
        return 0
    return argument.data_ptr() if isinstance(argument, Tensor) else argument


def checked_device(device: str | torch.device) -> torch.device:
    """Return an available NVIDIA GPU, with its number, or raise a ValueError."""
    if not re.fullmatch("cuda(:[0-9]+)?", str(device)):
        raise ValueError(f"device must be 'cpu' or 'cuda', got {str(device)!r}")
    found = torch.device(device)
    if torch.version.cuda is None or not torch.cuda.is_available():
        why = (
            "this PyTorch has been built without CUDA. Install a build with CUDA (see pytorch.org),"
            if torch.version.cuda is None
            else "PyTorch sees no GPU. Use nvidia-smi to check for a GPU and its driver,"
        )
        raise ValueError(f"this machine has no device {str(device)!r}: {why} or leave device out")
    number = torch.cuda.current_device() if found.index is None else found.index
    if number >= (count := torch.cuda.device_count()):
        raise ValueError(f"this machine has no device {str(device)!r}: the last GPU is cuda:{count - 1}")
    return torch.device("cuda", number)
