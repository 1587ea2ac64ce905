"""Benchmarks at toy size: the rates mean nothing, that they run and agree does."""

from __future__ import annotations

import json

import pytest
from benchmarks import cuda_kernel, instances, raycast_moving

from raybeam import available_backends


@pytest.mark.slow
def test_moving_sensors_of_all_numbers_of_beams(capsys):
    if reason := available_backends()["embree"]:
        pytest.skip(f"embree: {reason}")
    assert raycast_moving.main(["--quick"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [int(line.split()[0]) for line in lines] == [16, 16, 64, 64, 128, 128]
    assert all("x bare; moving" in line and "hits 0 %" not in line for line in lines)


@pytest.mark.slow
def test_forests_of_instances_hit_as_one_mesh_does(capsys):
    if reason := available_backends()["embree"]:
        pytest.skip(f"embree: {reason}")
    assert instances.main(["--quick"]) == 0
    _, many, few, flat = (line.split("|") for line in capsys.readouterr().out.splitlines())
    assert "10,002" in many[3]
    assert few[-2] == flat[-2] != " 0 % "


def test_the_devices_benchmark_says_so_without_a_device(capsys):
    if not available_backends()["cuda"]:
        pytest.skip("there is a device")
    assert cuda_kernel.main(["--rays", "100"]) == 2
    assert "Nothing was measured: " in capsys.readouterr().err


@pytest.mark.gpu
@pytest.mark.slow
def test_the_devices_benchmark_runs(tmp_path, capsys):
    if reason := available_backends()["cuda"]:
        pytest.skip(f"cuda: {reason}")
    out = tmp_path / "out.json"
    options = ["--rays", "12800", "--triangles", "500", "--repeats", "3", "--leak-rays", "3000"]
    assert cuda_kernel.main([*options, "--many-rays", "30000", "--json", str(out)]) == 0
    results = json.loads(out.read_text())
    assert results["leaks"] == {"rays": 3000, "escaped": 0}
    assert results["many_rays"]["same_every_time"]
    assert "differences from numpy: none" in capsys.readouterr().out
