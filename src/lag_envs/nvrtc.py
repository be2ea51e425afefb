"""Compiles and starts kernels on an NVIDIA GPU, using the bindings that come with CUDA builds of PyTorch."""

from __future__ import annotations

import ctypes
import threading
from collections.abc import Sequence
from functools import cache
from typing import Any

#: Threads per block. On an H100, 128 threads are 1 to 4 % slower in single precision, and 256 are slower
#: still.
BLOCK = 64


def version() -> tuple[int, int]:
    """Return the compiler's version."""
    status, *found = _bindings()[1].nvrtcVersion()
    _checked((status,))
    return found[0], found[1]


def compiled(source: str, architecture: str, options: tuple[str, ...] = ()) -> bytes:
    """Return a GPU's machine code for a C++ text.

    Parameters
    ----------
    source : str
        The text.
    architecture : str
        The GPUs' architecture, such as ``"sm_90"``.
    options : tuple of str
        Further options of NVRTC.

    Raises
    ------
    ModuleNotFoundError
        Without `cuda.bindings`.
    RuntimeError
        With the compiler's messages, if the text cannot be compiled.
    """
    _, nvrtc = _bindings()
    program = _checked(nvrtc.nvrtcCreateProgram(source.encode(), b"environment.cu", 0, [], []))
    given = [option.encode() for option in ("--std=c++17", f"--gpu-architecture={architecture}", *options)]
    status, *_ = nvrtc.nvrtcCompileProgram(program, len(given), given)
    if status.value:
        log = b" " * _checked(nvrtc.nvrtcGetProgramLogSize(program))
        _checked(nvrtc.nvrtcGetProgramLog(program, log))
        raise RuntimeError(f"NVRTC cannot compile the step: {log.decode().strip(chr(0)).strip()}")
    code = b" " * _checked(nvrtc.nvrtcGetCUBINSize(program))
    _checked(nvrtc.nvrtcGetCUBIN(program, code))
    _checked(nvrtc.nvrtcDestroyProgram(program))
    return code


class Module:
    """Machine code on the GPU of the current context.

    Parameters
    ----------
    code : bytes
        The result of `compiled`.
    """

    def __init__(self, code: bytes) -> None:
        self._driver, _ = _bindings()
        self._context = _checked(self._driver.cuCtxGetCurrent())
        self._module = _checked(self._driver.cuModuleLoadData(code))
        self._kernels: dict[str, tuple[Any, Any, Any]] = {}
        self._lock = threading.Lock()  # threads that launch a kernel share its arguments' memory

    def launch(self, name: str, count: int, stream: int, arguments: Sequence[int]) -> None:
        """Start a kernel, with one thread for each of `count` environments.

        Parameters
        ----------
        name : str
            The kernel.
        count : int
            Number of threads.
        stream : int
            Address of the stream; its earlier work is done first.
        arguments : sequence of int
            Addresses and 64-bit integers.
        """
        if name not in self._kernels:
            kernel = _checked(self._driver.cuModuleGetFunction(self._module, name.encode()))
            numbers = (ctypes.c_longlong * len(arguments))()
            places = [ctypes.addressof(numbers) + 8 * i for i in range(len(arguments))]
            self._kernels[name] = kernel, numbers, (ctypes.c_void_p * len(arguments))(*places)
        kernel, numbers, places = self._kernels[name]
        grid, block = (-(-count // BLOCK), 1, 1), (BLOCK, 1, 1)
        _checked(self._driver.cuCtxPushCurrent(self._context))  # a new thread may have no context yet
        try:
            with self._lock:
                numbers[:] = arguments  # the launch copies these values
                given = ctypes.addressof(places)
                _checked(self._driver.cuLaunchKernel(kernel, *grid, *block, 0, stream, given, 0))
        finally:
            _checked(self._driver.cuCtxPopCurrent())


@cache
def _bindings() -> tuple[Any, Any]:
    try:
        from cuda.bindings import driver, nvrtc
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(
            "cuda.bindings is missing; CUDA builds of PyTorch include it: pip install cuda-bindings",
            name=error.name,
        ) from error
    return driver, nvrtc


def _checked(result: tuple) -> Any:
    """Return the result of a function of the bindings, or raise a RuntimeError with its status."""
    status, *found = result
    if status.value:
        raise RuntimeError(f"CUDA reports {status.name}")
    return found[0] if found else None
