"""The .cu files compile for every card that is supported, and spill no registers."""

from __future__ import annotations

import importlib.resources
import re
import shutil
import subprocess

import pytest

from raybeam import cuda_backend, cuda_build
from raybeam.cuda_module import source

CARDS = [75, 80, 86, 89, 90, 100, 120]
FLAGS = {"intersect.cu": cuda_backend.flags(64), "build.cu": cuda_build.flags()}


def nvcc():
    found = shutil.which("nvcc") or shutil.which("/usr/local/cuda/bin/nvcc")
    if found is None:
        pytest.skip("nvcc is not here")
    return found


@pytest.mark.parametrize("file", FLAGS)
@pytest.mark.parametrize("card", [75, 90, 120])
def test_compiles_without_spills(tmp_path, card, file):
    compiler = nvcc()
    known = subprocess.run([compiler, "--list-gpu-arch"], capture_output=True, text=True).stdout
    if f"compute_{card}" not in known.split():
        pytest.skip(f"this nvcc does not know sm_{card}")
    (tmp_path / "kernels.cu").write_text(source(file))
    done = subprocess.run(
        [compiler, *FLAGS[file], f"-arch=sm_{card}", "-cubin", "-Xptxas", "-v",
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
    text = source(file)
    assert len(report) == max(text.count("\nKERNEL "), text.count("__global__ void BOUNDS"))
    for name, stores, loads, registers in report:
        # The compiler may prefer a word of spilling to the occupancy that it would lose.
        assert max(int(stores), int(loads)) <= (8 if name.startswith("count_") else 0), name
        assert int(registers) <= 128, name  # four blocks of 128 threads on every card


@pytest.mark.parametrize("file", FLAGS)
@pytest.mark.parametrize("card", CARDS)
def test_nvrtc_compiles_as_cupy_does(card, file):
    cupy = pytest.importorskip("cupy", reason="CuPy is not installed")
    nvrtc = cupy.cuda.nvrtc
    program = nvrtc.createProgram(source(file), file, (), ())
    try:
        nvrtc.compileProgram(program, (*FLAGS[file], f"-arch=sm_{card}"))
    except nvrtc.NVRTCError:
        log = nvrtc.getProgramLog(program)
        if "invalid value for --gpu-architecture" in log:
            pytest.skip(f"this NVRTC does not know sm_{card}")
        pytest.fail(log)
    assert nvrtc.getCUBIN(program)


@pytest.mark.parametrize("file", FLAGS)
def test_no_headers(file):
    text = (importlib.resources.files("raybeam") / file).read_text("utf-8")
    assert "#include" not in text
    assert "INFINITY" not in text
    assert source(file).startswith(f'#line 1 "{file}"\n')
