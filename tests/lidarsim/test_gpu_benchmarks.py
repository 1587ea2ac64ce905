"""Benchmarks at toy size: the rates mean nothing, that they run and agree does."""

import re
import subprocess
import sys
from pathlib import Path

import pytest
from benchmarks import gpu, gpu_points, gpu_rays
from benchmarks.harness import read_results
from tests.cuda_on_host import (  # noqa: F401 - fixtures
    played_cuda,
    source_backend,
    write_cupy,
)

from raybeam import available_backends


def test_the_devices_benchmark_says_so_without_a_device(capsys):
    if not available_backends()["cuda"]:
        pytest.skip("there is a device")
    assert gpu.main(["--quick"]) == 2
    assert "Nothing was measured: " in capsys.readouterr().err


def results_of(tmp_path, *options):
    path = tmp_path / "gpu.json"
    code = gpu.main(["--quick", "--json", str(path), "--folder", str(tmp_path), *options])
    return code, read_results(path)


@pytest.mark.slow
def test_all_that_the_device_is_measured_at(played_cuda, tmp_path, capsys, monkeypatch):  # noqa: F811
    monkeypatch.setattr(gpu_points, "START", "fork")
    patient = {name: (module, 600) for name, (module, _) in gpu.SECTIONS.items()}
    monkeypatch.setattr(gpu, "SECTIONS", patient)
    names = [name for name in gpu.MEASURED if name not in ("run", "peers")]
    code, found = results_of(tmp_path, "--in-process", "--only", *names)
    said = capsys.readouterr()
    assert code == 0, said
    assert [*found] == names
    assert not any("error" in rows or "left out" in rows for rows in found.values())
    for title, rows in found["kernels"].items():
        if title.endswith(("coherent", "shuffled", "revolution", "scattered")):
            assert 0.05 < rows["hits"] < 1 and all(rate > 0 for rate in rows["grays_s"].values())
    assert found["leaks"]["edges and corners"] == {"rays": 5000, "escaped": 0}
    assert 0 < found["large"]["many rays"]["last ray"] < 6144
    assert set(found["columns"]["a batch, ms"]) == {
        "cast_table", "pack", "make_rays", "columns", "copy", "all",
    }  # fmt: skip
    assert found["columns"]["plain"]["bytes_a_point"] == 30
    assert found["durable"]["disk"]["mpoints_s"] > 0 < found["sharing"]["two to one"]["ratio"]
    assert "| sampled values that differ from NumPy; rays that escape | 0, 0 |" in said.out


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
    assert "skipped: peers, because benchmarks.gpu_of_nobody is not installed" in said


def test_the_page_has_the_rows_of_the_table():
    page = Path(__file__).parents[2].joinpath("docs", "performance.md").read_text("utf-8")
    names = [name for name, _, _ in gpu.ROWS]
    rows = re.findall(r"^\| (.*) \| .* \|$", page[page.index("## On a GPU") :], re.M)
    assert rows[1 : len(names) + 1] == names  # after the header


def test_limits_of_sections():
    """A command on a device that somebody lends ends after ten minutes."""
    limits = {name: seconds for name, (_, seconds) in gpu.SECTIONS.items()}
    assert sum(limits[name] for name in gpu.MEASURED) <= gpu.MEASURED_S == 400
    names = [*gpu.SECTIONS]
    first = names[: names.index("counters") + 1]
    assert sum(limits[name] for name in first) <= gpu.FIRST_S == 540


# What NVIDIA's tools print; with --quick they would run for a minute.
SANITIZER = """#!/bin/sh
echo "bits: six objects: rays 342"
case $2 in
memcheck) echo "========= ERROR SUMMARY: 2 errors"; exit 1;;
racecheck)
    echo "========= Warning: Race reported between Read access at cupy_nonzero+0x460"
    echo "=========     and Write access at cupy_nonzero+0x630 [256 hazards]"
    echo "========= RACECHECK SUMMARY: 1 hazards displayed (0 errors, 1 warnings)";;
esac
"""
NCU = """#!/bin/sh
while [ "$1" != --log-file ]; do shift; done
cat >"$2" <<'END'
==PROF== Connected to process 7
"ID","Kernel Name","Section Name","Metric Name","Metric Unit","Metric Value"
"0","cast_table(const Node *)","Launch Statistics","Registers Per Thread","register/thread","64"
"0","cast_table(const Node *)","Occupancy","Achieved Occupancy","%","41.5"
"0","cast_table(const Node *)","Instruction Statistics","Executed Instructions","inst","1,234"
"0","cast_table(const Node *)","Warp State Statistics","Avg. Active Threads Per Warp","","19.25"
"1","pack(const int *)","Occupancy","Achieved Occupancy","%","n/a"
END
"""


def write_program(folder, name, text):
    path = folder / name
    path.write_text(text)
    path.chmod(0o755)


def test_tools_of_nvidia(played_cuda, tmp_path, capsys, monkeypatch):  # noqa: F811
    monkeypatch.setenv("PATH", str(tmp_path), prepend=":")
    write_program(tmp_path, "compute-sanitizer", SANITIZER)
    write_program(tmp_path, "ncu", NCU)
    names = ("sanitizer", "counters")
    code, sections = results_of(tmp_path, "--in-process", "--first-device", "--only", *names)
    assert code == 1
    assert sections["sanitizer"]["memcheck"]["errors"] == 2
    assert sections["sanitizer"]["racecheck"] == {
        "scenes": 1,
        "exit code": 0,
        "errors": 0,
        "hazards in kernels of CuPy": 1,
    }
    assert sections["counters"] == {
        "cast_table": {
            "Registers Per Thread, register per thread": 64,
            "Achieved Occupancy, %": 41.5,
            "Executed Instructions, inst": 1234,
            "Avg. Active Threads Per Warp": 19.25,
        },
        "clocks": sections["counters"]["clocks"],
    }
    page = (tmp_path / "gpu.md").read_text("utf-8")
    assert (
        "| casting kernel (ncu): registers, occupancy in %, active threads per warp | 64, 42, 19 |"
        in page
    )
    assert page.endswith("- wrong: sanitizer: memcheck failed\n")


def test_tools_that_cannot_be_used(played_cuda, tmp_path, monkeypatch):  # noqa: F811
    monkeypatch.setenv("PATH", str(tmp_path), prepend=":")
    write_program(tmp_path, "compute-sanitizer", "#!/bin/sh\necho Device not supported; exit 1\n")
    write_program(tmp_path, "ncu", "#!/bin/sh\necho '==ERROR== ERR_NVGPUCTRPERM'; exit 1\n")
    names = ("sanitizer", "counters")
    code, sections = results_of(tmp_path, "--in-process", "--only", *names)
    assert code == 0
    assert sections["sanitizer"]["memcheck"]["left out"] == "Device not supported"
    assert sections["counters"]["ncu"] == {"left out": "==ERROR== ERR_NVGPUCTRPERM"}


@pytest.mark.slow
def test_a_device_on_which_nothing_has_run(source_backend, tmp_path, monkeypatch):  # noqa: F811
    """The whole command, with a device that the CPU plays in all of its processes."""
    root = Path(__file__).parents[2]
    stand_in = tmp_path / "stand-in"
    write_cupy(stand_in)
    paths = [root, *(root / name for name in ("kernels", "scheduler", "workflows")), stand_in]
    monkeypatch.setenv("PYTHONPATH", ":".join(map(str, paths)))
    monkeypatch.setenv("PATH", str(tmp_path), prepend=":")
    sanitizer = '#!/bin/sh\nshift 6; "$@" || exit 1\necho "ERROR SUMMARY: 0 errors"\n'
    write_program(tmp_path, "compute-sanitizer", sanitizer)
    write_program(tmp_path, "ncu", NCU)
    # g++ takes longer than a device's compiler: "compiling" comes when the libraries are there.
    sections = ["device", "tests", "leaks", "sanitizer", "compiling", "scanner", "counters"]
    command = [sys.executable, "-m", "benchmarks.gpu", "--first-device", "--quick"]
    options = ["--folder", str(tmp_path), "--json", str(tmp_path / "first.json")]
    done = subprocess.run(
        [*command, *options, "--only", *sections], cwd=root, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stdout + done.stderr
    results = read_results(tmp_path / "first.json")
    assert list(results) == sections
    assert results["compiling"]["instances, masked"]["cast_table"]["registers"] == 0
    assert results["tests"]["tests/raybeam/test_device.py"] == {"passed": 10}
    assert results["sanitizer"]["memcheck"]["scenes"] == 20
    page = (tmp_path / "first.md").read_text("utf-8")
    assert "| tests that require a device: passed, failed | 10, 0 |" in page
    assert "| sampled values that differ from NumPy; rays that escape | not measured, 0 |" in page


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
    assert gpu.apart("moving", ["--quick"], 30)["error"] == "its process ended with -9"


@pytest.mark.slow
def test_what_a_device_is_tested_with_needs_no_dask():
    """Machines with a GPU often have few packages and no network."""
    script = (
        "import sys, pytest; sys.modules.update(dict.fromkeys(['dask', 'distributed', 'open3d']));"
        "sys.exit(pytest.main(['--collect-only', '-q', '-m', 'gpu', 'tests']))"
    )
    root = Path(__file__).parents[2]
    done = subprocess.run([sys.executable, "-c", script], cwd=root, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout
    for name in (
        "raybeam/test_cast",
        "lidarsim/test_device_columns",
        "lidarsim/test_gpu_benchmarks",
    ):
        assert f"tests/{name}.py" in done.stdout
    assert "tests/lidarpool" not in done.stdout
