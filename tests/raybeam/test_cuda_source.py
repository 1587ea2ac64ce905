"""intersect.cu compiles for every card that is supported, and spills no registers."""

import re
import shutil
import subprocess
import sysconfig
from itertools import product
from pathlib import Path

import pytest

from raybeam.cuda_backend import compiler_options, kernel_source

CARDS = (75, 80, 86, 89, 90, 100, 120)
AS_CUPY = "-ftz=true"  # what it adds of itself
# {(whether there are instances, whether there are masks): options}
FLAGS = {kind: (*compiler_options(64, *kind), AS_CUPY) for kind in product((False, True), repeat=2)}


@pytest.fixture(scope="module")
def nvcc():
    """The newest nvcc: of the package nvidia-cuda-nvcc, which is not in PATH, or the system's."""
    packages = Path(sysconfig.get_path("purelib"), "nvidia").glob("cu*/bin/nvcc")
    places = [*map(str, sorted(packages, reverse=True)), "nvcc", "/usr/local/cuda/bin/nvcc"]
    compiler = next(filter(None, map(shutil.which, places)), None)
    if compiler is None:
        pytest.skip("nvcc is not here")
    return compiler


def blocks_of(name, card, nested, masked):
    """Blocks of 128 threads that are to be under way on a multiprocessor."""
    if name == "cast_bodies":
        return (2 if masked else 3) if nested else 4
    if nested:
        return 4
    return 7 if not masked and int(card) < 100 else 5


def report(nvcc, folder, card, kind):
    """Registers, stack, and bytes of spill stores and loads of each kernel, by name."""
    known = subprocess.run([nvcc, "--list-gpu-arch"], capture_output=True, text=True).stdout
    if f"compute_{card}" not in known.split():
        pytest.skip(f"this nvcc does not know sm_{card}")
    (folder / "kernels.cu").write_text(kernel_source())
    done = subprocess.run(
        [nvcc, *FLAGS[kind], f"-arch=sm_{card}", "-cubin", "--resource-usage",
         "-o", str(folder / "out.cubin"), str(folder / "kernels.cu")],
        capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "warning" not in done.stderr
    rows = re.findall(
        r"entry function '(\w+)'.*?(\d+) bytes stack frame, (\d+) bytes spill stores, "
        r"(\d+) bytes spill loads.*?Used (\d+) registers",
        done.stderr,
        re.S,
    )
    return {name: tuple(map(int, numbers)) for name, *numbers in rows}


@pytest.mark.slow
@pytest.mark.slow(keep=("120-*",))
@pytest.mark.parametrize("kind", FLAGS)
@pytest.mark.parametrize("card", CARDS)
def test_compiles_without_spills(nvcc, tmp_path, card, kind):
    kernels = report(nvcc, tmp_path, card, kind)
    assert len(kernels) == kernel_source().count("\nKERNEL ")
    for name, (stack, stores, loads, registers) in kernels.items():
        assert (stores, loads) == (0, 0), name
        # The nodes that wait and nothing else: what has to be looked up is not kept there.
        walks = name.startswith("cast_")
        assert stack == (8 * 64 if walks else 0), name
        # Of 65,536 registers, for as many threads as are meant to be under way.
        blocks = blocks_of(name, card, *kind) if walks else 8
        assert registers <= 65_536 // (128 * blocks), name


@pytest.mark.slow(keep=("120-*",))
@pytest.mark.parametrize("kind", FLAGS)
@pytest.mark.parametrize("card", CARDS)
def test_nvrtc_compiles_as_cupy_does(card, kind):
    cupy = pytest.importorskip("cupy", reason="CuPy is not installed")
    nvrtc = cupy.cuda.nvrtc
    program = nvrtc.createProgram(kernel_source(), "intersect.cu", (), ())
    try:
        nvrtc.compileProgram(program, (*FLAGS[kind], f"-arch=sm_{card}"))
    except nvrtc.NVRTCError:
        log = nvrtc.getProgramLog(program)
        if "invalid value for --gpu-architecture" in log:
            pytest.skip(f"this NVRTC does not know sm_{card}")
        pytest.fail(log)
    assert nvrtc.getCUBIN(program)


def test_no_headers():
    """NVRTC has none, and g++ and nvcc would not mind."""
    assert "#include" not in kernel_source() and "INFINITY" not in kernel_source()
