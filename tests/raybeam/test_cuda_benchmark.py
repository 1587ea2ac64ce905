"""The parts of the device's benchmark that need no device."""

from __future__ import annotations

import json
import sys
import time
from types import SimpleNamespace

import numpy as np
import pytest
from benchmarks import cuda_kernel, cuda_limits, cuda_scenes, cuda_warp

from raybeam import RayCaster, available_backends


@pytest.mark.parametrize("triangles", [500, 20_000])
def test_city(triangles):
    vertices, faces = cuda_scenes.city(triangles)
    assert 0.5 < len(faces) / triangles < 1.5
    np.testing.assert_array_equal(cuda_scenes.city(triangles)[0], vertices)
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    assert low[2] == 0
    rng = np.random.default_rng(0)
    above = rng.uniform(low + 0.01, high - 0.01, (500, 3)) * [1, 1, 0] + [0, 0, high[2] + 1]
    down = RayCaster(vertices, faces, "numpy").cast(above, np.tile([0, 0, -1], (500, 1)))
    assert down.hit.all()
    assert 0.1 < (down.distance < high[2]).mean() < 0.9  # roofs, and streets between them


def test_six_objects_are_closed():
    vertices, faces = cuda_scenes.six_objects()
    directions = np.random.default_rng(1).normal(size=(2000, 3))
    assert RayCaster(vertices, faces, "numpy").cast([5, 5, 1], directions).hit.all()
    assert len(faces) == 6 * 79 * 80 * 2


def test_revolution():
    directions = cuda_scenes.revolution(1280, layers=128)
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
    cuda.PinnedMemoryPointer = lambda block, offset: block.bytes
    cuda.Event = Event
    cuda.get_elapsed_time = lambda start, stop: 1e3 * (stop.at - start.at)
    cuda.nvrtc = SimpleNamespace(getVersion=lambda: (0, 0))
    cuda.runtime = SimpleNamespace(
        **vars(host.cuda.runtime),
        getDeviceProperties=lambda number: {"name": b"none"},
        driverGetVersion=lambda: 0,
        runtimeGetVersion=lambda: 0,
    )
    fake = type(host)(**vars(host))
    fake.cuda, fake.__version__ = cuda, "none"
    fake.empty_like = lambda array: host.empty(array.shape, array.dtype)
    fake.copyto = np.copyto
    fake.RawKernel = lambda code, name: lambda grid, block, arguments: None
    monkeypatch.setitem(sys.modules, "cupy", fake)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: name)
    out = tmp_path / "out.json"
    monkeypatch.setattr(cuda_limits, "CROSSOVER", (100, 1000))
    monkeypatch.setattr(cuda_kernel.cuda_warp, "available", lambda: False)
    monkeypatch.setattr(cuda_limits.transfers, "__defaults__", (1 << 12,))
    options = ["--rays", "12800", "--triangles", "500", "--repeats", "3", "--leak-rays", "3000"]
    assert cuda_kernel.main([*options, "--many-rays", "30000", "--json", str(out)]) == 0
    results = json.loads(out.read_text())
    assert [row["scene"] for row in results["scenes"]] == ["six objects", "city 5e+02"]
    assert results["leaks"] == {"rays": 3000, "escaped": 0}
    assert results["many_rays"]["same_every_time"]
    assert [row["triangles"] > 0 for row in results["crossover"]] == [True, True]
    for row in results["scenes"]:
        assert row["build"]["device_ms"]["median"] > 0
        assert row["coherent"]["rays"] == row["shuffled"]["rays"] == 12800
        assert row["coherent"]["hit_share"] == row["shuffled"]["hit_share"] > 0
        assert row["differences"]["hits"] > 0
    assert "differences from numpy: none" in capsys.readouterr().out


def test_warp_casts_the_same_rays():
    """On the CPU, where Warp falls back to its own builder: the hits must be the same."""
    pytest.importorskip("warp", reason="Warp is not installed")
    mesh, origin = cuda_scenes.city(2000), np.array([10.0, 10.0, 2.0])
    directions = cuda_scenes.revolution(1280)
    hits = int(RayCaster(*mesh, backend="numpy").cast(origin, directions).hit.sum())
    rows = cuda_warp.casts(mesh, origin, {"coherent": directions}, 1, device="cpu")
    assert rows
    assert all(abs(row["coherent"]["hits"] - hits) <= 3 for row in rows)
    assert cuda_warp.best(rows, "coherent") > 0
