"""Benchmarks at toy size: the rates mean nothing, that they run and agree does."""

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest
from benchmarks import gpu, gpu_points, gpu_rays, instances
from tests.cuda_on_host import played_cuda, source_backend  # noqa: F401 - fixtures

from raybeam import available_backends


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
    assert gpu.main(["--quick"]) == 2
    assert "Nothing was measured: " in capsys.readouterr().err


def results_of(tmp_path, *options):
    path = tmp_path / "gpu.json"
    code = gpu.main(["--quick", "--json", str(path), "--folder", str(tmp_path), *options])
    return code, json.loads(path.read_text())["sections"]


@pytest.mark.slow
def test_all_that_the_device_is_measured_at(played_cuda, tmp_path, capsys, monkeypatch):  # noqa: F811
    monkeypatch.setattr(gpu_points, "START", "fork")
    names = [name for name in gpu.SECTIONS if name not in ("run", "peers", "mujoco")]
    code, found = results_of(tmp_path, "--in-process", "--only", *names)
    said = capsys.readouterr()
    assert code == 0, said
    assert [*found] == names
    assert not any("error" in rows or "left out" in rows for rows in found.values())
    for title, rows in found["kernels"].items():
        if title.endswith(("coherent", "shuffled", "revolution")):
            assert 0.1 < rows["hits"] < 1 and all(rate > 0 for rate in rows["grays_s"].values())
    assert found["leaks"]["edges and corners"] == {"rays": 5000, "escaped": 0}
    assert 0 < found["large"]["many rays"]["last ray"] < 6144
    assert set(found["columns"]["a batch, ms"]) == {
        "cast_table", "pack", "make_rays", "columns", "copy", "all",
    }  # fmt: skip
    assert found["columns"]["plain"]["bytes_a_point"] == 30
    assert found["durable"]["disk"]["mpoints_s"] > 0 < found["sharing"]["two to one"]["ratio"]
    assert "| values that differ from NumPy's in samples; rays that escape | 0, 0 |" in said.out


def test_a_section_that_fails_leaves_the_others(played_cuda, tmp_path, capsys, monkeypatch):  # noqa: F811
    def broken(here):
        yield "first", {"figure": 1.0}
        raise MemoryError("no room")

    monkeypatch.setattr(gpu_rays, "moving", broken)
    monkeypatch.setitem(gpu.SECTIONS, "peers", ("gpu_of_nobody", 1))
    code, found = results_of(tmp_path, "--in-process", "--only", "moving", "peers", "leaks")
    assert code == 1
    assert found["moving"]["first"] == {"figure": 1.0}
    assert found["moving"]["error"] == "MemoryError: no room"
    assert found["leaks"]["edges and corners"]["escaped"] == 0
    said = capsys.readouterr().out
    assert "wrong: moving: MemoryError: no room" in said
    assert "left out: peers, because benchmarks.gpu_of_nobody is not installed" in said


def test_the_page_has_the_rows_of_the_table():
    page = Path(__file__).parents[2].joinpath("docs", "performance.md").read_text("utf-8")
    names = [name for name, _, _ in gpu.ROWS]
    rows = re.findall(r"^\| (.*) \| .* \|$", page[page.index("## On a GPU") :], re.M)
    assert rows[: len(names)] == names


@pytest.mark.gpu
@pytest.mark.slow
def test_the_device_is_measured(tmp_path):
    if reason := available_backends()["cuda"]:
        pytest.skip(f"cuda: {reason}")
    code, found = results_of(tmp_path)
    assert code == 0
    assert found["leaks"]["edges and corners"]["escaped"] == 0


def test_a_section_that_dies_is_named(tmp_path, monkeypatch):
    script = tmp_path / "python"
    script.write_text("#!/bin/sh\nkill -9 $$\n")
    script.chmod(0o755)
    monkeypatch.setattr(gpu.sys, "executable", str(script))
    assert gpu.apart("moving", ["--quick"], 30) == {"error": "its process ended with -9"}


def test_what_a_device_is_tested_with_needs_no_dask():
    """Machines with a GPU often have few packages and no network."""
    script = (
        "import sys, pytest; sys.modules.update(dict.fromkeys(['dask', 'distributed', 'open3d']));"
        "sys.exit(pytest.main(['--collect-only', '-q', '-m', 'gpu', 'tests']))"
    )
    root = Path(__file__).parents[2]
    done = subprocess.run([sys.executable, "-c", script], cwd=root, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout
    for name in ("raybeam/test_cast", "lidarsim/test_device", "lidarsim/test_gpu_benchmarks"):
        assert f"tests/{name}.py" in done.stdout
    assert "tests/lidarpool" not in done.stdout
