"""intersect.cu compiles for every card that is supported, and its casts spill no registers."""

from __future__ import annotations

import importlib.resources
import re
import shutil
import subprocess
from pathlib import Path

import pytest

from raybeam.cuda_backend import options, source

CARDS = [75, 80, 86, 89, 90, 100, 120]


def nvcc():
    found = shutil.which("nvcc") or shutil.which("/usr/local/cuda/bin/nvcc")
    if found is None:
        pytest.skip("nvcc is not here")
    return found


@pytest.mark.parametrize("card", [75, 90, 120])
def test_compiles_without_spills(tmp_path, card):
    compiler = nvcc()
    known = subprocess.run([compiler, "--list-gpu-arch"], capture_output=True, text=True).stdout
    if f"compute_{card}" not in known.split():
        pytest.skip(f"this nvcc does not know sm_{card}")
    (tmp_path / "kernels.cu").write_text(source())
    done = subprocess.run(
        [compiler, *options(64), f"-arch=sm_{card}", "-cubin", "-Xptxas", "-v",
         "-o", str(tmp_path / "out.cubin"), str(tmp_path / "kernels.cu")],
        capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "warning" not in done.stderr
    report = re.findall(
        r"entry function '(\w+)'.*?(\d+) bytes spill stores, (\d+) bytes spill loads.*?"
        r"Used (\d+) registers",
        done.stderr,
        re.S,
    )
    assert {name for name, *_ in report} == {"cast_table", "cast_pattern", "weigh_table"}
    for name, stores, loads, registers in report:
        assert (stores, loads) == ("0", "0"), name
        assert int(registers) <= 128, name  # four blocks of 128 threads on every card


@pytest.mark.parametrize("card", CARDS)
def test_nvrtc_compiles_as_cupy_does(card):
    cupy = pytest.importorskip("cupy", reason="CuPy is not installed")
    nvrtc = cupy.cuda.nvrtc
    program = nvrtc.createProgram(source(), "intersect.cu", (), ())
    try:
        nvrtc.compileProgram(program, (*options(64), f"-arch=sm_{card}"))
    except nvrtc.NVRTCError:
        log = nvrtc.getProgramLog(program)
        if "invalid value for --gpu-architecture" in log:
            pytest.skip(f"this NVRTC does not know sm_{card}")
        pytest.fail(log)
    assert nvrtc.getCUBIN(program)


def test_no_headers():
    text = (importlib.resources.files("raybeam") / "intersect.cu").read_text("utf-8")
    assert "#include" not in text
    assert "INFINITY" not in text
    assert source().startswith('#line 1 "intersect.cu"\n')


def test_host_shim_is_beside_the_tests():
    assert (Path(__file__).parent / "host" / "shim.h").is_file()
