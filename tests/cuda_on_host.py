"""A CUDA device played by the CPU: kernels compiled by g++, and CuPy's part by NumPy."""

from __future__ import annotations

import ctypes
import hashlib
import os
import re
import shutil
import subprocess
import time
from collections import deque
from collections.abc import Callable
from contextlib import nullcontext
from functools import cache, partial
from pathlib import Path
from types import SimpleNamespace
from typing import ClassVar

import numpy as np
import pytest

from raybeam import registry
from raybeam.cuda_backend import CudaBackend

HOST_FILES = Path(__file__).parent / "raybeam" / "host"
STACK = 256
VOTING = ("pack",)  # kernels in which the threads of a warp wait for each other


class Array(np.ndarray):
    """An array "on the device"."""

    def get(self, stream=None, out=None, blocking=True):
        if out is None:
            assert blocking
            return np.array(self)
        assert out.shape == self.shape
        assert out.dtype == self.dtype
        assert not np.shares_memory(self, out)
        if blocking:
            out[...] = self
        else:  # only when somebody waits for it: until then, neither may be touched
            out.view(np.uint8).fill(0x5A)
            stream.begun.append((out, self))
        return out

    def set(self, values, stream=None):
        assert values.shape == self.shape
        assert values.dtype == self.dtype
        self[...] = values


class Device(nullcontext):
    def __init__(self, number=None):
        super().__init__()
        self.id = number or 0

    def synchronize(self):
        pass


class Event:
    """What was begun in a stream before it was recorded, and when."""

    def __init__(self, begun=()):
        self.begun = begun
        self.record()

    def record(self):
        self.time = time.perf_counter()

    def synchronize(self):
        while self.begun:
            out, given = self.begun.popleft()
            out[...] = given


class Stream:
    def __init__(self, non_blocking=False):
        self.begun = deque()

    def record(self):
        return Event(self.begun)

    def wait_event(self, event):
        event.synchronize()

    def synchronize(self):
        self.record().synchronize()


KINDS = {
    np.int32: ctypes.c_int, np.int64: ctypes.c_longlong, np.float64: ctypes.c_double,
    np.uint32: ctypes.c_uint, np.float32: ctypes.c_float,
}  # fmt: skip


# {what a kernel declares: what it may be given}
DECLARED = {
    "int": np.int32, "Count": np.int64, "double": np.float64, "float": np.float32,
    "unsigned int": np.uint32, "unsigned char": np.uint8, "unsigned short": np.uint16,
    "unsigned long long": np.int64, "float4": np.float32,
}  # fmt: skip


def pointed(argument, declared):
    """A kernel's argument, as something that `ctypes.byref` can point to."""
    kind, pointer = re.fullmatch(
        r"(?:const )?([\w ]+?)(\*?) ?(?:__restrict__ )?\w+", declared
    ).groups()
    if pointer:
        assert argument.flags.c_contiguous
        assert argument.dtype == DECLARED[kind] or not argument.size, declared
        return ctypes.c_void_p(argument.ctypes.data)
    assert type(argument) is DECLARED[kind], declared
    return KINDS[type(argument)](argument)


class Kernels:
    """Stands for CuPy's RawModule: kernels that run thread by thread."""

    compile_for: ClassVar[Callable[[str, tuple[str, ...]], ctypes.CDLL]]

    def __init__(self, code, options):
        stack = re.search(r"-DSTACK=(\d+)", " ".join(options))
        assert stack is None or int(stack[1]) <= STACK
        # Libraries are shared by scenes of all depths.
        same = (f"-DSTACK={STACK}" if "STACK" in option else option for option in options)
        self.library = self.compile_for(code, tuple(same))
        self.declared = {
            name: [" ".join(words.split()) for words in given.split(",")]
            for name, given in re.findall(r"^KERNEL (\w+)\((.*?)\)\n", code, re.M | re.S)
        }

    def compile(self):
        pass

    def get_function(self, name):
        def launch(grid, block, arguments):
            assert block == (128,)
            assert getattr(self.library, f"parameters_{name}")() == len(arguments)
            values = [*map(pointed, arguments, self.declared[name])]
            pointers = (ctypes.c_void_p * len(values))(*(ctypes.addressof(v) for v in values))
            getattr(self.library, f"run_{name}")(ctypes.c_uint(grid[0]), pointers)

        launch.num_regs = launch.local_size_bytes = 0
        return launch


class CudaError(RuntimeError):
    """What CuPy raises when a call of CUDA fails."""


PROPERTIES = {"name": b"g++", "totalGlobalMem": 8e9, "multiProcessorCount": 2}


class Module(SimpleNamespace):
    __hash__ = object.__hash__


def poisoned(shape, dtype=np.float64):
    """Memory that nobody has written to yet."""
    array = np.empty(shape, dtype)
    array.view(np.uint8).fill(0xA5)
    return array.view(Array)


# As much of CuPy as the backend uses, on the CPU.
HOST = Module(
    __version__="of the tests",
    RawModule=Kernels,
    asarray=lambda a: np.array(a, order="K").view(Array),
    empty=poisoned,
    empty_like=np.empty_like,
    copyto=np.copyto,
    full=lambda shape, value, dtype: np.full(shape, value, dtype).view(Array),
    zeros=lambda shape, dtype=np.float64: np.zeros(shape, dtype).view(Array),
    cumsum=np.cumsum,
    flatnonzero=lambda a: np.flatnonzero(a).view(Array),
    get_default_memory_pool=lambda: SimpleNamespace(free_all_blocks=lambda: None),
    cuda=SimpleNamespace(
        Device=Device,
        Stream=Stream,
        get_current_stream=Stream,
        alloc_pinned_memory=bytearray,
        set_allocator=lambda allocate: None,
        Event=Event,
        get_elapsed_time=lambda one, other: max(1e3 * (other.time - one.time), 1e-3),
        runtime=SimpleNamespace(
            getDeviceCount=lambda: 1,
            getDeviceProperties=lambda number: PROPERTIES,
            driverGetVersion=lambda: 13000,
            runtimeGetVersion=lambda: 12090,
            CUDARuntimeError=CudaError,
        ),
        nvrtc=SimpleNamespace(getVersion=lambda: (13, 0)),
    ),
)


class SourceBackend(CudaBackend):
    """The cuda backend, its kernels compiled for the CPU and CuPy's part played by NumPy."""

    name = "source"
    chunk = 1 << 16

    @classmethod
    def unavailable_reason(cls):
        return ""

    @staticmethod
    def load_cupy():
        return HOST


def compiled(compiler, folder, code, options):
    """Load kernels as a library for the CPU; compile the library if no process has done so."""
    names = re.findall(r"^KERNEL (\w+)\(", code, re.M)
    runs = "".join(f"RUN({name}, {str(name in VOTING).lower()})\n" for name in names)
    text = f'#include "launch.h"\n{code}\n{runs}'
    key = hashlib.sha256("\0".join([text, *options]).encode()).hexdigest()[:16]
    library = folder / f"{key}.so"
    if not library.exists():
        source = folder / f"{key}-{os.getpid()}.cpp"
        unfinished = source.with_suffix(".new")
        source.write_text(text)
        command = [
            compiler, "-O2", "-Wall", "-Werror", "-Wno-unknown-pragmas", "-ffp-contract=off",
            "-shared", "-fPIC", *(option for option in options if option != "-fmad=false"),
            f"-I{HOST_FILES}", "-o", str(unfinished), str(source),
        ]  # fmt: skip
        done = subprocess.run(command, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        unfinished.replace(library)
    return ctypes.CDLL(str(library))


def compile_into(folder):
    """Have g++ compile kernels into a folder, which processes may share."""
    compiler = shutil.which("g++")
    if compiler is None:
        pytest.skip("g++ is not here to compile the kernels for the CPU")
    Kernels.compile_for = staticmethod(cache(partial(compiled, compiler, folder)))


def write_cupy(folder):
    """Write a package `cupy` for processes that have `folder` and the checkout on their path."""
    package = folder / "cupy"
    libraries = folder / "libraries"
    package.mkdir(parents=True)
    libraries.mkdir()
    package.joinpath("__init__.py").write_text(
        "from pathlib import Path\n\nfrom tests.cuda_on_host import HOST, compile_into\n\n"
        f"compile_into(Path({str(libraries)!r}))\nglobals().update(vars(HOST))\n"
    )


@pytest.fixture(scope="session")
def source_backend(tmp_path_factory):
    """`SourceBackend`, its libraries made by g++ when they are needed."""
    compile_into(tmp_path_factory.mktemp("source"))
    return SourceBackend


@pytest.fixture
def played_cuda(source_backend, monkeypatch):
    """Have the CPU play the device of backend "cuda"."""
    others = [backend for backend in registry.BACKENDS if backend.name != "cuda"]
    played = type("Played", (source_backend,), {"name": "cuda"})
    monkeypatch.setattr(registry, "BACKENDS", (played, *others))
