"""Embree casts rays in packets; which rays share one has no effect on any bit."""

from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
import pytest

from raybeam import Pattern, RayCaster, available_backends

if reason := available_backends()["embree"]:
    pytest.skip(f"embree: {reason}", allow_module_level=True)

RINGS, FIRINGS = 24, 600


def lidar():
    """Directions of a turn, firing by firing (n, 3)."""
    azimuth = 2 * np.pi * np.arange(FIRINGS)[:, None] / FIRINGS
    elevation = np.radians(np.linspace(-40, 30, RINGS))
    x, y = np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth)
    return np.stack([x, y, np.broadcast_to(np.sin(elevation), x.shape)], axis=-1).reshape(-1, 3)


def soup(rng, count=4_000):
    """Triangles that pierce each other; some lie in one plane, and some of these are the same."""
    corners = rng.uniform(-20, 20, (count, 1, 3)) + rng.normal(size=(count, 3, 3))
    flat = rng.uniform(-20, 20, (count // 2, 3, 3))
    flat[..., 2] = -3
    whole = np.concatenate([corners, flat, flat[:100], flat[:50]])
    return whole.reshape(-1, 3), np.arange(3 * len(whole)).reshape(-1, 3)


@pytest.fixture(params=["soup", "vase", "terrain box"])
def mesh(request, shapes):
    return soup(np.random.default_rng(4)) if request.param == "soup" else shapes[request.param]()


def found(caster, directions, order, **options):
    """Distance and triangle of each ray, cast in some order from near the middle."""
    returns = caster.scan(Pattern(directions[order]), [0.05, 0.1, 0.4], **options)
    distance, triangle = np.full(len(directions), np.inf), np.full(len(directions), -1)
    distance[order[returns.ray]] = returns.distance
    triangle[order[returns.ray]] = returns.triangle
    return distance, triangle


def test_neighbours_have_no_effect(mesh):
    directions, rng = lidar(), np.random.default_rng(2)
    caster = RayCaster(*mesh, "embree", threads=1)
    straight = np.arange(len(directions))
    want = found(caster, directions, straight)
    assert np.isfinite(want[0]).mean() > 0.3
    rings = straight.reshape(-1, RINGS).T.reshape(-1)
    for order in (rings, straight[::-1], rng.permutation(len(directions))):
        np.testing.assert_array_equal(found(caster, directions, order), want)
    few = np.sort(rng.choice(straight, 2_000, replace=False))
    got = caster.cast([0.05, 0.1, 0.4], directions[few])
    np.testing.assert_array_equal(got.distance, want[0][few])
    np.testing.assert_array_equal(got.triangle, want[1][few])


@pytest.mark.parametrize("limits", [(0.0, np.inf), (0.7, 1.5)])
def test_embree_has_the_bits_of_numpy(mesh, limits):
    """But for rays through an edge, exactly: Embree may propose one of its two triangles alone."""
    directions = lidar()
    straight = np.arange(len(directions))
    given = {"t_min": limits[0], "t_max": limits[1]}
    (t, triangle), (t_2, triangle_2) = (
        found(RayCaster(*mesh, name), directions, straight, **given) for name in ("embree", "numpy")
    )
    np.testing.assert_allclose(t, t_2, rtol=1e-15)
    differ = (t != t_2) | (triangle != triangle_2)
    assert differ.mean() < 1e-3


def run_python(code, *arguments, **environment):
    given = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), **environment}
    subprocess.run([sys.executable, "-c", code, *arguments], check=True, env=given, timeout=300)


def test_forked_processes_cast_too():
    """Workers are forked from a process that may have cast: threads do not survive that."""
    run_python(
        "import os, sys; from raybeam import RayCaster; "
        "mesh = [[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]]; "
        "cast = lambda: RayCaster(*mesh, 'embree', threads=2).cast([0.2, 0.2, 5], [0, 0, -1]); "
        "assert cast().distance == 5; child = os.fork(); "
        "assert cast().distance == 5; child or os._exit(0); "
        "sys.exit(os.waitpid(child, 0)[1])"
    )


@pytest.mark.parametrize("isa", ["sse4.2", "avx2"])
def test_vector_width_has_no_effect(isa, tmp_path):
    """Packets of 4 and of 8 rays; SSE has no fused multiply-add, and may propose others at rims."""
    mesh = soup(np.random.default_rng(4))
    np.savez(tmp_path / "mesh.npz", vertices=mesh[0], faces=mesh[1], directions=lidar())
    code = (
        "import numpy as np, sys; from raybeam import Pattern, RayCaster; "
        "d = np.load(sys.argv[1]); "
        "caster = RayCaster(d['vertices'], d['faces'], 'embree'); "
        "r = caster.scan(Pattern(d['directions']), [0.05, 0.1, 0.4]); "
        "np.savez(sys.argv[2], ray=r.ray, distance=r.distance, triangle=r.triangle)"
    )
    results = []
    for given in ({}, {"RAYBEAM_EMBREE_ISA": isa}):
        out = tmp_path / f"{len(given)}.npz"
        run_python(code, tmp_path / "mesh.npz", out, **given)
        results.append(np.load(out))
    one, other = results
    if isa == "avx2":
        for name in ("ray", "distance", "triangle"):
            np.testing.assert_array_equal(one[name], other[name])
    else:
        alike = np.intersect1d(one["ray"], other["ray"])
        assert len(alike) >= max(len(one["ray"]), len(other["ray"])) - 1
