"""The parts of benchmarks/cuda_kernel.py that need no device."""

from __future__ import annotations

import json
import sys
import time
from types import SimpleNamespace

import numpy as np
import pytest
from benchmarks import cuda_kernel

from raybeam import RayCaster, available_backends


@pytest.mark.parametrize("triangles", [500, 20_000])
def test_city(triangles):
    vertices, faces = cuda_kernel.city(triangles)
    assert 0.5 < len(faces) / triangles < 1.5
    np.testing.assert_array_equal(cuda_kernel.city(triangles)[0], vertices)
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    assert low[2] == 0
    rng = np.random.default_rng(0)
    above = rng.uniform(low + 0.01, high - 0.01, (500, 3)) * [1, 1, 0] + [0, 0, high[2] + 1]
    down = RayCaster(vertices, faces, "numpy").cast(above, np.tile([0, 0, -1], (500, 1)))
    assert down.hit.all()
    assert 0.1 < (down.distance < high[2]).mean() < 0.9  # roofs, and streets between them


def test_six_objects_are_closed():
    vertices, faces = cuda_kernel.six_objects()
    directions = np.random.default_rng(1).normal(size=(2000, 3))
    assert RayCaster(vertices, faces, "numpy").cast([5, 5, 1], directions).hit.all()
    assert len(faces) == 6 * 79 * 80 * 2


def test_revolution():
    directions = cuda_kernel.revolution(1280, layers=128)
    assert directions.shape == (1280, 3)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1)


def test_says_so_without_a_device(capsys):
    if not available_backends()["cuda"]:
        pytest.skip("there is a device")
    assert cuda_kernel.main(["--rays", "100"]) == 2
    assert "Nothing was measured: " in capsys.readouterr().err


class Event:
    def record(self):
        self.at = time.perf_counter()

    def synchronize(self):
        pass


def test_runs_at_toy_size(source_backend, monkeypatch, tmp_path, capsys):
    """The whole of it, with the kernels on the CPU: the rates mean nothing, the checks do."""
    host = source_backend._library()
    cuda = SimpleNamespace(**vars(host.cuda))
    cuda.Event = Event
    cuda.get_elapsed_time = lambda start, stop: 1e3 * (stop.at - start.at)
    cuda.nvrtc = SimpleNamespace(getVersion=lambda: (0, 0))
    cuda.runtime = SimpleNamespace(
        **vars(host.cuda.runtime),
        CUDARuntimeError=RuntimeError,
        getDeviceProperties=lambda number: {"name": b"none"},
        driverGetVersion=lambda: 0,
        runtimeGetVersion=lambda: 0,
    )
    fake = type(host)(**vars(host))
    fake.cuda, fake.__version__ = cuda, "none"
    fake.RawKernel = lambda code, name: lambda grid, block, arguments: None
    monkeypatch.setitem(sys.modules, "cupy", fake)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: name)
    out = tmp_path / "out.json"
    options = ["--rays", "12800", "--triangles", "500", "--repeats", "3", "--leak-rays", "3000"]
    assert cuda_kernel.main([*options, "--json", str(out)]) == 0
    results = json.loads(out.read_text())
    assert [row["scene"] for row in results["scenes"]] == ["six objects", "city 5e+02"]
    assert results["leaks"] == {"rays": 3000, "escaped": 0}
    for row in results["scenes"]:
        assert row["coherent"]["rays"] == row["shuffled"]["rays"] == 12800
        assert row["coherent"]["hit_share"] == row["shuffled"]["hit_share"] > 0
        assert row["differences"]["hits"] > 0
    assert "differences from numpy: none" in capsys.readouterr().out
