"""Backends under test: the list grows with what the machine has.

Beside the three real ones there is "source": intersect.cu compiled for the CPU.
"""

from __future__ import annotations

import ctypes
import importlib.resources
import shutil
import subprocess
from collections.abc import Callable
from contextlib import nullcontext
from functools import cache, partial
from pathlib import Path
from types import SimpleNamespace
from typing import ClassVar

import numpy as np
import pytest
from benchmarks.cuda_scenes import grid_faces

from raybeam import RayCaster, available_backends, cuda_backend, registry
from raybeam.cuda_backend import CudaBackend

HERE = Path(__file__).parent
STACK = 256


class Array(np.ndarray):
    """An array "on the device"."""

    def get(self, out=None):
        if out is None:
            return np.array(self)
        assert out.shape == self.shape
        assert out.dtype == self.dtype
        out[...] = self
        return out

    def set(self, values):
        assert values.shape == self.shape
        assert values.dtype == self.dtype
        self[...] = values


class Device(nullcontext):
    def __init__(self, number=None):
        super().__init__()
        self.id = number or 0

    def synchronize(self):
        pass


KINDS = {
    np.int32: ctypes.c_int, np.int64: ctypes.c_longlong, np.float64: ctypes.c_double,
}  # fmt: skip


def pointed(argument):
    """A kernel's argument, as something that `ctypes.byref` can point to."""
    if isinstance(argument, np.ndarray):
        assert argument.flags.c_contiguous
        return ctypes.c_void_p(argument.ctypes.data)
    return KINDS[type(argument)](argument)


class Kernels:
    """Stands for CuPy's RawModule: the kernels of intersect.cu, run thread by thread."""

    compile_for: ClassVar[Callable[..., ctypes.CDLL]]

    def __init__(self, code, options):
        self.library = self.compile_for("-DNESTED=1" in options, "-DMASKED=1" in options)
        for option in options:
            if option.startswith("-DSTACK="):
                assert int(option.partition("=")[2]) <= STACK

    def compile(self):
        pass

    def get_function(self, name):
        def launch(grid, block, arguments):
            assert block == (128,)
            assert getattr(self.library, f"parameters_{name}")() == len(arguments)
            values = [pointed(argument) for argument in arguments]
            pointers = (ctypes.c_void_p * len(values))(*(ctypes.addressof(v) for v in values))
            getattr(self.library, f"run_{name}")(ctypes.c_uint(grid[0]), pointers)

        launch.num_regs = launch.local_size_bytes = 0
        return launch


class CudaError(RuntimeError):
    """What CuPy raises when a call of CUDA fails."""


class Module(SimpleNamespace):
    __hash__ = object.__hash__


def poisoned(shape, dtype=np.float64):
    """Memory that nobody has written to yet."""
    array = np.empty(shape, dtype)
    array.view(np.uint8).fill(0xA5)
    return array.view(Array)


# As much of CuPy as the backend uses, on the CPU.
HOST = Module(
    RawModule=Kernels,
    asarray=lambda a: np.array(a, order="K").view(Array),
    empty=poisoned,
    cumsum=np.cumsum,
    get_default_memory_pool=lambda: SimpleNamespace(free_all_blocks=lambda: None),
    cuda=SimpleNamespace(
        Device=Device,
        get_current_stream=lambda: SimpleNamespace(synchronize=lambda: None),
        runtime=SimpleNamespace(getDeviceCount=lambda: 1, CUDARuntimeError=CudaError),
    ),
)


class SourceBackend(CudaBackend):
    """The cuda backend, its kernels compiled for the CPU and CuPy's part played by NumPy."""

    name = "source"
    chunk = 1 << 16

    @classmethod
    def missing(cls):
        return ""

    @staticmethod
    def _library():
        return HOST


def compiled(compiler, folder, nested, masked):
    """intersect.cu made a library for the CPU."""
    library = folder / f"intersect{nested:d}{masked:d}.so"
    flags = cuda_backend.flags(STACK, nested, masked)
    with importlib.resources.as_file(
        importlib.resources.files("raybeam") / "intersect.cu"
    ) as kernels:
        command = [
            compiler, "-O2", "-Wall", "-Werror", "-Wno-unknown-pragmas",
            "-ffp-contract=off", "-shared", "-fPIC",
            *(flag for flag in flags if flag != "-fmad=false"), f'-DSOURCE="{kernels}"',
            "-o", str(library), str(HERE / "host" / "intersect.cpp"),
        ]  # fmt: skip
        done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return ctypes.CDLL(str(library))


@pytest.fixture(scope="session")
def source_backend(tmp_path_factory):
    """`SourceBackend`, its libraries made by g++ when they are needed."""
    compiler = shutil.which("g++")
    if compiler is None:
        pytest.skip("g++ is not here to compile the kernels for the CPU")
    folder = tmp_path_factory.mktemp("source")
    Kernels.compile_for = staticmethod(cache(partial(compiled, compiler, folder)))
    return SourceBackend


CUDA = pytest.param("cuda", marks=pytest.mark.gpu)


def usable(name, request):
    """Make a backend known to `RayCaster` for a test; skips where it cannot be used."""
    if name == "source":
        made = request.getfixturevalue("source_backend")
        patch = request.getfixturevalue("monkeypatch")
        patch.setattr(registry, "_BACKENDS", (*registry._BACKENDS, made))
    elif reason := available_backends()[name]:
        pytest.skip(f"{name}: {reason}")
    return name


@pytest.fixture(params=["numpy", "source", "embree", CUDA])
def backend(request):
    """Name of a backend that can be used here, for ``RayCaster(..., backend=backend)``."""
    return usable(request.param, request)


@pytest.fixture(params=["source", CUDA])
def kernels(request):
    """Name of a backend whose rays intersect.cu casts."""
    return usable(request.param, request)


@pytest.fixture(params=["numpy", "source", CUDA])
def exact_backend(request):
    """Name of a backend that decides in float64: all but embree."""
    return usable(request.param, request)


@pytest.fixture
def caster(backend):
    """Make a `RayCaster` with the backend under test."""
    return lambda vertices, faces, **more: RayCaster(vertices, faces, backend, **more)


@pytest.fixture
def exact_caster(exact_backend):
    """Make a `RayCaster` with the backend under test, when it decides in float64."""
    return lambda vertices, faces, **more: RayCaster(vertices, faces, exact_backend, **more)


def _cube():
    x, y, z = np.meshgrid([-1.0, 1.0], [-1.0, 1.0], [-1.0, 1.0], indexing="ij")
    faces = [
        [0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1],
        [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3],
    ]  # fmt: skip
    return np.stack([x, y, z], axis=-1).reshape(-1, 3), np.array(faces)


def _sphere(rows=40, columns=60, radius=1.0):
    polar = np.linspace(0, np.pi, rows)[:, None]
    around = np.arange(columns) * 2 * np.pi / columns
    ring = np.sin(polar)
    ring[[0, -1]] = 0
    points = np.broadcast_arrays(ring * np.cos(around), ring * np.sin(around), np.cos(polar))
    return radius * np.stack(points, axis=-1).reshape(-1, 3), grid_faces(rows, columns, wrap=True)


def _vase(rows=80, columns=80):
    """A surface of revolution like the default survey's objects, with a waist."""
    points, faces = _sphere(rows, columns, 2.0)
    height = points[:, 2]
    points[:, :2] *= (0.65 + 0.35 * np.cos(3 * height))[:, None]
    return points, faces


def _terrain_box(cells=60):
    """Rough ground with walls and a lid: closed."""
    line = np.linspace(-1, 1, cells + 1)
    x, y = np.meshgrid(line, line, indexing="ij")
    ground = np.stack([x, y, 0.1 * np.sin(17 * x) * np.cos(23 * y) + 0.05 * np.sin(91 * x * y)], -1)
    points = ground.reshape(-1, 3)
    lid = points * [1, 1, 0] + [0, 0, 1]
    n = cells + 1
    faces = grid_faces(n, n)
    rim = np.concatenate([
        np.arange(n), np.arange(1, n) * n + n - 1,
        (n - 1) * n + np.arange(n - 2, -1, -1), np.arange(n - 2, 0, -1) * n,
    ])  # fmt: skip
    nxt = np.roll(rim, -1)
    top = rim + len(points)
    above = np.roll(top, -1)
    walls = np.concatenate([np.stack([rim, nxt, above], -1), np.stack([rim, above, top], -1)])
    return np.concatenate([points, lid]), np.concatenate([faces, faces + len(points), walls])


def _soup(kind, count=300, seed=0):
    """Unconnected triangles of one kind, some 20 m around zero."""
    rng = np.random.default_rng(seed)
    first = rng.uniform(-20, 20, (count, 1, 3))
    edges = rng.normal(size=(count, 2, 3))
    if kind == "sliver":
        edges *= 8
        edges[:, 1] = edges[:, 0] * rng.uniform(0.1, 1, (count, 1)) + 1e-4 * edges[:, 1]
    else:
        edges *= {"random": 4.0, "huge": 1e3, "tiny": 1e-3}[kind]
    points = np.concatenate([first, first + edges], axis=1).reshape(-1, 3)
    return points, np.arange(3 * count).reshape(-1, 3)


@pytest.fixture(scope="session")
def shapes():
    """Makers of meshes, by name: each returns vertices and faces."""
    return {
        "cube": _cube,
        "sphere": _sphere,
        "vase": _vase,
        "terrain box": _terrain_box,
        "soup": _soup,
    }
