"""The parts of the device's benchmark that need no device."""

from __future__ import annotations

import json
import sys
import time
from types import SimpleNamespace

import numpy as np
import pytest
from benchmarks import cuda_kernel, cuda_limits

from raybeam import available_backends


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


@pytest.mark.slow
def test_runs_at_toy_size(source_backend, monkeypatch, tmp_path, capsys):
    """The whole of it, with the kernels on the CPU: the rates mean nothing, the checks do."""
    host = source_backend._library()
    cuda = SimpleNamespace(**vars(host.cuda))
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
    monkeypatch.setattr(cuda_kernel.cuda_warp, "available", lambda: False)
    monkeypatch.setattr(cuda_limits.transfers, "__defaults__", (1 << 12,))
    options = ["--rays", "12800", "--triangles", "500", "--repeats", "3", "--leak-rays", "3000"]
    assert cuda_kernel.main([*options, "--many-rays", "30000", "--json", str(out)]) == 0
    results = json.loads(out.read_text())
    assert [row["scene"] for row in results["scenes"]] == ["six objects", "city 5e+02"]
    assert results["leaks"] == {"rays": 3000, "escaped": 0}
    assert results["many_rays"]["same_every_time"]
    for row in results["scenes"]:
        assert row["build"]["tree_ms"] > 0
        assert row["coherent"]["rays"] == row["shuffled"]["rays"] == 12800
        assert row["coherent"]["hit_share"] == row["shuffled"]["hit_share"] > 0
        assert row["differences"]["hits"] > 0
    assert "differences from numpy: none" in capsys.readouterr().out
