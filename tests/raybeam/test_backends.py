"""Which backend is taken, and what is said when it cannot be."""

import re
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace

import numpy as np
import pytest

from raybeam import BackendUnavailable, RayCaster, available_backends
from raybeam.cuda_backend import CudaBackend
from raybeam.instances import single_mesh_scene
from raybeam.mesh import local_mesh
from raybeam.tile_backend import TileBackend

MESH = [[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]]


def test_auto_takes_the_first_that_can_be_used(monkeypatch):
    usable = [name for name, reason in available_backends().items() if not reason]
    assert RayCaster(*MESH).backend == usable[0]
    for backend in (CudaBackend, TileBackend):
        monkeypatch.setattr(backend, "unavailable_reason", classmethod(lambda _: "not today"))
    assert RayCaster(*MESH).backend == "numpy"


def test_backend_asked_for_is_taken(backend):
    caster = RayCaster(*MESH, backend=backend, threads=1)
    assert repr(caster) == f"RayCaster(1 triangles, backend='{backend}')"


def test_what_cannot_be_had_says_why(monkeypatch):
    with pytest.raises(
        ValueError, match=r"Unknown backend 'optix'. The backends are auto, cuda, tiles, numpy"
    ):
        RayCaster(*MESH, backend="optix")
    with pytest.raises(ValueError, match="threads must be at least 1"):
        RayCaster(*MESH, backend="numpy", threads=0)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert "pip install cupy" in CudaBackend.unavailable_reason()
    with pytest.raises(BackendUnavailable, match=r"'tiles' cannot be used: .* run pip install"):
        RayCaster(*MESH, backend="tiles")


def run_python(code):
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_import_needs_numpy_only():
    """Neither numba nor CuPy is loaded by importing, nor by casting with numpy."""
    code = (
        "import sys, raybeam; "
        "raybeam.RayCaster([[0,0,0],[1,0,0],[0,1,0]], [[0,1,2]], 'numpy').cast([0,0,1],[0,0,-1]); "
        "heavy = {'numba', 'open3d', 'cupy', 'dask', 'trimesh'} & set(sys.modules); "
        "sys.exit(str(heavy) if heavy else 0)"
    )
    run_python(code)


@pytest.mark.extended
def test_threads_of_one_process_may_share_a_caster(backend, shapes):
    caster = RayCaster(*shapes["vase"](), backend, threads=1)
    directions = np.random.default_rng(0).normal(size=(8, 5000, 3))
    want = [caster.cast([0.05, 0.1, 0.4], part) for part in directions]
    with ThreadPoolExecutor(4) as pool:
        got = list(pool.map(lambda part: caster.cast([0.05, 0.1, 0.4], part), directions))
    for one, other in zip(got, want, strict=True):
        np.testing.assert_array_equal(one.distance, other.distance)


def test_device_that_is_not_there(source_backend):
    with pytest.raises(ValueError, match=r"CUDA device 99 does not exist. This process has 1 "):
        source_backend(single_mesh_scene(local_mesh(*MESH)), device=99)


class CudaError(RuntimeError):
    pass


def refuse(message):
    raise CudaError(message)


@pytest.mark.parametrize(
    ("devices", "version", "headers", "words"),
    [
        (lambda: refuse("too old"), lambda: (13, 0), "/usr", "not find a CUDA device .too old"),
        (lambda: 0, lambda: (13, 0), "/usr", "no CUDA device is available"),
        (
            lambda: 1,
            lambda: refuse("no nvrtc\nat all"),
            "/usr",
            r"not find a compiler .no nvrtc.; run pip",
        ),
        (lambda: 1, lambda: (13, 0), None, "not find the CUDA headers; run pip"),
        (lambda: 2, lambda: (13, 0), "/usr", "^$"),
        (lambda: 1, lambda: (13, 0), "no finder", "^$"),  # not every CuPy looks for them with it
    ],
)
def test_what_cuda_lacks(monkeypatch, devices, version, headers, words):
    runtime = SimpleNamespace(getDeviceCount=devices, CUDARuntimeError=CudaError)
    cuda = SimpleNamespace(runtime=runtime, nvrtc=SimpleNamespace(getVersion=version))
    monkeypatch.setitem(sys.modules, "cupy", SimpleNamespace(cuda=cuda))
    finder = SimpleNamespace(find_nvidia_header_directory={"cudart": headers}.get)
    if headers == "no finder":
        finder = None
    monkeypatch.setitem(sys.modules, "cuda", SimpleNamespace(pathfinder=finder))
    monkeypatch.setitem(sys.modules, "cuda.pathfinder", finder)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: name)
    assert re.search(words, CudaBackend.unavailable_reason())


def casting_threads():
    return {thread for thread in threading.enumerate() if thread.name.startswith("tiles")}


def test_tiles_take_as_many_threads_as_are_given(shapes):
    """Each of several gets its share of the rays, and the answer has the same bits."""
    if reason := available_backends()["tiles"]:
        pytest.skip(f"tiles: {reason}")
    directions = np.random.default_rng(1).normal(size=(40_000, 3))
    casters = {n: RayCaster(*shapes["vase"](), "tiles", threads=n) for n in (1, 3)}
    before = casting_threads()
    one = casters[1].cast([0.05, 0.1, 0.4], directions)
    assert casting_threads() <= before
    more = casters[3].cast([0.05, 0.1, 0.4], directions)
    started = casting_threads() - before
    assert 1 <= len(started) <= 3
    np.testing.assert_array_equal(one.distance, more.distance)
    np.testing.assert_array_equal(one.triangle, more.triangle)
    del casters[3]
    for thread in started:  # which end with their caster
        thread.join(120)
        assert not thread.is_alive()
