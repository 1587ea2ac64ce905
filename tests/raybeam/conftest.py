"""Backends under test: the list grows with what the machine has.

Beside the three real ones there is "source": intersect.cu compiled for the CPU.
"""

from __future__ import annotations

import ctypes
import importlib.resources
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from raybeam import RayCaster, available_backends, registry
from raybeam.backend import Backend, Found
from raybeam.hits import Returns
from raybeam.layout import lay_out

HERE = Path(__file__).parent
STACK = 256


def pointer(array):
    return array.ctypes.data_as(ctypes.c_void_p)


class Tables(ctypes.Structure):
    _fields_ = [
        (name, ctypes.c_void_p) for name in ("nodes", "triangles", "corners", "faces", "frame")
    ]


class SourceBackend(Backend):
    """The kernels of intersect.cu, run thread by thread on the CPU."""

    name = "source"
    chunk = 1 << 16
    library: ctypes.CDLL

    @classmethod
    def missing(cls):
        return ""

    def __init__(self, mesh, threads=None, device=None):
        super().__init__(mesh, threads, device)
        self.layout = lay_out(mesh)
        assert self.layout.stack <= STACK
        names = [name for name, _ in Tables._fields_]
        self.tables = Tables(*(pointer(getattr(self.layout, name)) for name in names))

    def run(self, kernel, count, rays, t_min, t_max):
        t, place = np.full(count, np.nan), np.empty(count, np.int32)
        scale = self._mesh.scale
        limits = ctypes.c_double(t_min * scale), ctypes.c_double(t_max * scale)
        getattr(self.library, f"run_{kernel}")(
            ctypes.byref(self.tables), *rays, ctypes.c_longlong(count), *limits,
            pointer(t), pointer(place),
        )  # fmt: skip
        ray = np.flatnonzero(place >= 0)
        return ray, t[ray], place[ray]

    def closest(self, rays):
        stride = 0 if len(rays.origins) == 1 else 3
        origins = np.ascontiguousarray(rays.origins)
        directions = np.ascontiguousarray(rays.directions)
        table = pointer(origins), ctypes.c_int(stride), pointer(directions)
        ray, t, place = self.run("cast_table", len(rays), table, rays.t_min, rays.t_max)
        u, v = np.empty((2, len(ray)))
        self.library.run_weigh_table(
            ctypes.byref(self.tables), *table, pointer(ray), pointer(place),
            ctypes.c_longlong(len(ray)), pointer(u), pointer(v),
        )  # fmt: skip
        return Found(ray, t, self.layout.faces[place], u, v)

    def scan(self, pattern, window, origin, rotation, interval):
        turn = np.eye(3) if rotation is None else rotation
        pose = np.concatenate([origin.ravel(), turn.ravel()])
        directions = np.ascontiguousarray(pattern.directions[slice(*window)])
        rays = pointer(pose), ctypes.c_int(rotation is not None), pointer(directions)
        ray, t, place = self.run("cast_pattern", len(directions), rays, *interval)
        return Returns(ray, t / self._mesh.scale, self.layout.faces[place])


@pytest.fixture(scope="session")
def source_backend(tmp_path_factory):
    """`SourceBackend` with its library, made by g++."""
    compiler = shutil.which("g++")
    if compiler is None:
        pytest.skip("g++ is not here to compile intersect.cu for the CPU")
    library = tmp_path_factory.mktemp("source") / "intersect.so"
    with importlib.resources.as_file(
        importlib.resources.files("raybeam") / "intersect.cu"
    ) as kernels:
        command = [
            compiler, "-std=c++17", "-O2", "-Wall", "-Werror", "-ffp-contract=off", "-shared",
            "-fPIC", f"-DSTACK={STACK}", f'-DINTERSECT_CU="{kernels}"',
            "-o", str(library), str(HERE / "host" / "run.cpp"),
        ]  # fmt: skip
        done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    SourceBackend.library = ctypes.CDLL(str(library))
    return SourceBackend


@pytest.fixture(params=["numpy", "source", "embree", pytest.param("cuda", marks=pytest.mark.gpu)])
def backend(request, monkeypatch):
    """Name of a backend that can be used here, for ``RayCaster(..., backend=backend)``."""
    name = request.param
    if name == "source":
        made = request.getfixturevalue("source_backend")
        monkeypatch.setattr(registry, "_BACKENDS", (*registry._BACKENDS, made))
    elif reason := available_backends()[name]:
        pytest.skip(f"{name}: {reason}")
    return name


@pytest.fixture
def exact_backend(backend):
    """A backend that decides in float64: all but embree."""
    if backend == "embree":
        pytest.skip("embree decides in float32")
    return backend


@pytest.fixture
def caster(backend):
    """Make a `RayCaster` with the backend under test."""
    return lambda vertices, faces, **more: RayCaster(vertices, faces, backend, **more)


@pytest.fixture
def exact_caster(exact_backend):
    """Make a `RayCaster` with the backend under test, when it decides in float64."""
    return lambda vertices, faces, **more: RayCaster(vertices, faces, exact_backend, **more)
