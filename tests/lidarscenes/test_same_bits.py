"""The same bytes on every processor: a search for functions that differ, and a comparison."""

import ast
import hashlib
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import lidarscenes
import lidarsim
import raybeam
from lidarsim import Actor, Column, Material, Noise, Returns, Scanner, Scene, Track, load_sensor
from lidarsim.scene.shapes import capsule, cylinder

# Of numpy and math: their last bits depend on the processor, or on versions of C's library.
NAMES = """
acos acosh arccos arccosh arcsin arcsinh arctan arctan2 arctanh asin asinh atan atan2 atanh cbrt
convolve corrcoef correlate cos cosh cov dist dot einsum erf erfc exp exp2 expm1 fft float_power
gamma geomspace hypot inner interp kron lgamma linalg log log10 log1p log2 logaddexp logspace
matmul matvec outer polyfit polyval pow power sin sinc sinh sumprod tan tanh tensordot vdot vecdot
vecmat
"""
FUNCTIONS = {*NAMES.split()}
SOURCES = {
    f"{package.__name__}/{path.relative_to(root).as_posix()}": path
    for package in (lidarscenes, lidarsim, raybeam)
    for root in (Path(package.__file__).parent,)
    for path in sorted(root.rglob("*.py"))
}
# What no byte of a cloud depends on, or what one process makes for all.
EXCEPTIONS = {
    "lidarscenes/helios/": "surveys are imported once",
    "lidarscenes/procedural/": "scenes are made once, and read by all",
    "lidarscenes/writers/": "scenes are written once, and read by all",
    "lidarsim/scene/simplified.py": "for pictures and planning",
    "lidarsim/sensor/helios_scanner.py": "sensors are written once, for another program",
    "lidarsim/columns/sweep.py": "poses move recorded points, which one process reads",
    "lidarsim/sweeps/": "files of sweeps are written by one process for all",
    "lidarscenes/files/usd_child.py": "OpenUSD computes places itself; the rest are checks",
}


def suspects(source):
    """Lines with functions, products of matrices or powers that differ."""
    modules = {"np", "numpy", "math", "cmath", "scipy"}
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Attribute):
            inner = node.value
            bad = node.attr in FUNCTIONS and isinstance(inner, ast.Name) and inner.id in modules
        elif isinstance(node, ast.ImportFrom):
            names = {alias.name for alias in node.names}
            bad = (node.module or "").split(".")[0] in modules and not node.level
            bad = bad and bool(names & FUNCTIONS)
        elif isinstance(node, ast.BinOp | ast.AugAssign) and isinstance(node.op, ast.Pow):
            # Squares of arrays are products; powers of two are exact.
            exponent = node.right if isinstance(node, ast.BinOp) else node.value
            two = isinstance(node, ast.BinOp) and ast.unparse(node.left) in ("2", "2.0")
            bad = ast.unparse(exponent) != "2" and not two
        else:
            bad = isinstance(node, ast.BinOp | ast.AugAssign) and isinstance(node.op, ast.MatMult)
        if bad:
            yield node.lineno


@pytest.mark.extended(every=10)
@pytest.mark.parametrize("name", SOURCES)
def test_no_byte_comes_from_functions_that_differ(name):
    lines = sorted({*suspects(SOURCES[name].read_text())})
    if name in EXCEPTIONS:
        assert lines, f"{name} is no exception any more"
    if not name.startswith((*EXCEPTIONS,)):
        assert not lines, (
            f"{SOURCES[name]}, lines {lines}: use lidarsim.numerics.elementary or vectors"
        )


@pytest.mark.parametrize(
    "line",
    [
        "np.sin(x)",
        "x @ y",
        "x @= y",
        "x ** 0.5",
        "x **= 3",
        "np.linalg.inv(x)",
        "math.hypot(x, y)",
        "from math import log, pi",
        "np.einsum('ij->i', x)",
        "x ** n",
        "np.interp(x, y, z)",
    ],
)
def test_the_search_finds(line):
    assert [*suspects(line)] == [1]


@pytest.mark.parametrize(
    "line", ["x ** 2", "2.0 ** -24", "np.sqrt(x)", "from math import pi, sqrt"]
)
def test_the_search_passes(line):
    assert not [*suspects(line)]


def survey():
    """Hash of a small survey with most effects, in double precision."""
    turns = np.array([[0, 0, np.sin(a), np.cos(a)] for a in (0.1, 0.4, 0.9, 1.3)])
    way = Track(np.arange(4) * 0.07, [[6, -5, 0], [5, -2, 0.2], [6, 2, 0.1], [4, 5, 0]], turns)
    walls = [
        cylinder(30.0, 8.0, 64, "Around"),
        cylinder(1.0, 3.0, 24, "Mirror").affine_transform(
            "Mirror", np.eye(3), np.array([-6.0, 3, 0])
        ),
        capsule(1.2, 1.0, 24, "Water").affine_transform(
            "Water", np.eye(3), np.array([3.0, 4.5, 0])
        ),
        cylinder(0.8, 3.0, 24, "Pane").affine_transform(
            "Pane", np.eye(3), np.array([4.0, -4.0, 0])
        ),
        capsule(1.5, 0.5, 16, "Tree").affine_transform("Tree", np.eye(3), np.array([-4.0, -5, 0])),
        capsule(0.6, 0.5, 16, "Sign").affine_transform("Sign", np.eye(3), np.array([0.0, 8, 0])),
    ]
    scene = Scene.from_meshes(walls).with_actors([Actor(capsule(0.9, 0.6, 24, "Car"), way)])
    materials = [
        Material("Sign", 0.9, retro=True),
        Material("Tree", 0.4, leaf_area_density=1.2, leaf_angle=1.7),
        Material("Pane", 0.1, transparent="pass", specular_reflectance="fresnel"),
        Material("Water", 0.1, transparent="pass", refractive_index=1.33, attenuation_per_m=0.3),
        Material("Mirror", 0.9, specular_reflectance=1),
        Material("*", 0.3, roughness=0.4),
    ]
    noise = Noise(
        range_m=0.02, range_per_m=1e-4, angle_deg=0.02, dropout=0.01, detection_range_m=80.0,
        overlap_m=3.0, range_at_threshold_m=0.05, walk_m=0.02, false_alarm_hz=1e4,
        stray_light=1e-5, velocity_m_s=0.1, saturation=50.0,
    )  # fmt: skip
    precise = [
        Column(f"{name}_64", "float64", "", "in double precision", name)
        for name in ("azimuth", "elevation", "range", "intensity", "radial_velocity")
    ]
    names = ("time", "return_number", "cause", "object", "pulse_width", "reflectivity")
    path = Track([0, 1], [[0, 0, 0.3], [1.5, 0.4, 0.5]], [[0, 0, 0, 1], [0.1, 0.1, 0.1, 0.985]])
    digest = hashlib.sha256()
    for model, returns in (
        ("velodyne/vlp16", Returns("all", subrays=7, divergence_mrad=3.0, beam_profile="gaussian")),
        ("livox/mid40", Returns("all", subrays=7, divergence_mrad=3.0, waveform="gaussian")),
    ):
        scanner = Scanner(
            scene, load_sensor(model), columns=[*names, *precise], precision_m=1e-6,
            materials=materials, returns=returns, noise=noise, visibility_km=0.5,
            fog_lidar_ratio_sr=18.8, rain_mm_h=20.0, snow_mm_h=2.0, wet=0.7,
            threads=1,
        )  # fmt: skip
        cloud = scanner.sweep(path)
        for name in sorted(cloud.columns):
            digest.update(name.encode() + cloud.columns[name].tobytes())
        digest.update(cloud.positions.tobytes())
    return digest.hexdigest()


def hashed(**environment):
    code = "from tests.lidarscenes.test_same_bits import survey; print(survey())"
    done = subprocess.run(
        [sys.executable, "-c", code], env={**os.environ, **environment}, capture_output=True,
        text=True, check=False, timeout=600,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.slow
def test_narrower_instructions_give_the_same_bytes(tmp_path):
    """Those of NumPy and of compiled loops; each by itself, to name what differs."""
    expected = hashed()
    dispatched = " ".join(np._core._multiarray_umath.__cpu_dispatch__)
    plain = {
        "NUMBA_CPU_NAME": "generic",
        "NUMBA_CPU_FEATURES": "",
        "NUMBA_CACHE_DIR": str(tmp_path),
    }
    assert hashed(NPY_DISABLE_CPU_FEATURES=dispatched) == expected
    assert hashed(**plain) == expected
