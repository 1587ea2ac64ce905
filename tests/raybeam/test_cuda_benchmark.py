"""The device's benchmark: it says where there is none, and runs where there is one."""

from __future__ import annotations

import json

import pytest
from benchmarks import cuda_kernel

from raybeam import available_backends


def test_says_so_without_a_device(capsys):
    if not available_backends()["cuda"]:
        pytest.skip("there is a device")
    assert cuda_kernel.main(["--rays", "100"]) == 2
    assert "Nothing was measured: " in capsys.readouterr().err


@pytest.mark.gpu
@pytest.mark.slow
def test_runs_at_toy_size(tmp_path, capsys):
    """The rates mean nothing, the checks do."""
    if reason := available_backends()["cuda"]:
        pytest.skip(f"cuda: {reason}")
    out = tmp_path / "out.json"
    options = ["--rays", "12800", "--triangles", "500", "--repeats", "3", "--leak-rays", "3000"]
    assert cuda_kernel.main([*options, "--many-rays", "30000", "--json", str(out)]) == 0
    results = json.loads(out.read_text())
    assert results["leaks"] == {"rays": 3000, "escaped": 0}
    assert results["many_rays"]["same_every_time"]
    assert "differences from numpy: none" in capsys.readouterr().out
