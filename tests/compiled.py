"""The kernels of `lag_envs.envs.kernels`, compiled for the processor by the machine's C++ compiler."""

import ctypes
import hashlib
import shutil
import subprocess
import tempfile
from functools import cache, partial
from pathlib import Path

import pytest

from lag_envs.device import DeviceEnvs, kernel_argument
from lag_envs.envs.kernels import APART

COMPILER = shutil.which("c++") or shutil.which("g++") or shutil.which("clang++")
needs_compiler = pytest.mark.skipif(COMPILER is None, reason="there is no C++ compiler")


@cache
def folder():
    return tempfile.TemporaryDirectory(prefix="lag-envs-kernels-")  # removed with the process


@cache
def library(source):
    name = Path(folder().name) / hashlib.sha256(source.encode()).hexdigest()[:16]
    text, made = name.with_suffix(".cpp"), name.with_suffix(".so")
    text.write_text(source)
    options = f"-std=c++17 -O1 -shared -fPIC {APART[1]} -Wall -Werror -Wno-unused-function"
    subprocess.run([COMPILER, *options.split(), text, "-o", made], check=True)
    return ctypes.CDLL(str(made))


def load(source, device, single):
    made = library(source)

    def launch(name, count, *arguments):
        getattr(made, name)(*(ctypes.c_longlong(x) for x in (count, *map(kernel_argument, arguments))))

    return launch


#: Environments as on a GPU, but in the CPU's memory.
on_processor = partial(DeviceEnvs, device="cpu", load=load)
