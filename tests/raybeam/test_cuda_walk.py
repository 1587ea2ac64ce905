"""Where intersect.cu decides late: triangles that wait must not be lost or win wrongly."""

import numpy as np
import pytest

from raybeam import RayCaster

SHEETS = [0.0, 1e-300, 1e-12, 1e-9, 1e-7, 3e-7, 1e-6, 4e-6, 1e-5, 1e-3]


@pytest.fixture
def same_as_numpy(kernels):
    """Cast with the kernels and with NumPy; all bits must be equal. Returns the hits."""

    def cast(mesh, *rays):
        want, got = (RayCaster(*mesh, backend=name).cast(*rays) for name in ("numpy", kernels))
        for name in ("triangle", "distance", "u", "v"):
            np.testing.assert_array_equal(getattr(got, name), getattr(want, name), err_msg=name)
        return want

    return cast


def sheets(gaps, slope=0.0, cells=4):
    """Parallel sheets, the first at z = 0, each so far below the one before."""
    line = np.linspace(-1, 1, cells + 1)
    x, y = (c.ravel() for c in np.meshgrid(line, line, indexing="ij"))
    i = (np.arange(cells)[:, None] * (cells + 1) + np.arange(cells)).ravel()
    one = np.concatenate(
        [np.stack([i, i + 1, i + cells + 2], -1), np.stack([i, i + cells + 2, i + cells + 1], -1)]
    )
    depth = np.cumsum(gaps)
    points = [np.stack([x, y, slope * x - z], -1) for z in depth]
    faces = [one + k * len(x) for k in range(len(depth))]
    order = np.random.default_rng(len(gaps)).permutation(len(faces))  # not nearest first
    return np.concatenate(points), np.concatenate([faces[k] for k in order])


def rays_down(count, tilt, seed=0):
    rng = np.random.default_rng(seed)
    origins = np.column_stack([rng.uniform(-1, 1, (count, 2)), np.full(count, 2.0)])
    return origins, np.column_stack([tilt * rng.normal(size=(count, 2)), np.full(count, -1.0)])


@pytest.mark.extended
@pytest.mark.slow(every=3)
@pytest.mark.parametrize("gap", SHEETS)
def test_sheets_close_together(same_as_numpy, gap):
    for slope, tilt in ((0.0, 0.0), (0.0, 0.3), (30.0, 0.0), (30.0, 0.3)):
        hits = same_as_numpy(sheets([gap] * 12, slope), *rays_down(400, tilt))
        assert hits.hit.sum() > 100


@pytest.mark.extended
def test_limits_at_the_surfaces(same_as_numpy):
    """Limits that are exactly, or nearly, the distance of a hit."""
    mesh = sheets([0.0, 1e-7, 1e-7, 1e-3, 0.5])
    origins, directions = rays_down(300, 0.0)
    for t in (2.0, np.nextafter(2, 0), np.nextafter(2, 3), 2 + 1e-7, 2 + 2e-7, 2.0010002):
        same_as_numpy(mesh, origins, directions, 0.0, t)
        same_as_numpy(mesh, origins, directions, t, np.inf)
        same_as_numpy(mesh, origins, directions, t, t)


@pytest.mark.parametrize("height", [0.0, 1e-8, 1e-6, 1e-4])
def test_starts_on_and_near_a_surface(same_as_numpy, height):
    origins, directions = rays_down(400, 0.5)
    origins[:, 2] = height
    same_as_numpy(sheets([0.0, 1e-7, 1e-5, 0.1]), origins, directions)


def test_grazing_rays(same_as_numpy):
    rng = np.random.default_rng(3)
    origins = np.column_stack([np.full(800, -3.0), rng.uniform(-1, 1, 800), np.zeros(800)])
    origins[:, 2] = rng.choice([1e-9, 1e-7, 1e-5, 1e-3], 800)
    directions = np.column_stack(
        [np.ones(800), 0.1 * rng.normal(size=800), -rng.choice([1e-9, 1e-7, 1e-5, 1e-3], 800)]
    )
    same_as_numpy(sheets([0.0, 1e-7, 1e-6, 1e-4]), origins, directions)


@pytest.mark.slow(every=3)
@pytest.mark.parametrize("power", range(14, 24))
def test_triangles_whose_products_underflow(same_as_numpy, power):
    """Of edges around 1e-20 of the scene, float32 keeps no area: all must go to the exact test."""
    rng = np.random.default_rng(power)
    tiny = rng.normal(size=(40, 3, 3)) * 10.0 ** -rng.uniform(power, power + 1, (40, 1, 1))
    tiny -= tiny.mean(axis=1, keepdims=True)  # a ray along an axis passes inside
    frame = np.array([[[1, 1, 1], [1, 0.9, 1], [0.9, 1, 1]]])
    points = np.concatenate([tiny, frame, -frame]).reshape(-1, 3)
    axes = np.concatenate([np.eye(3), -np.eye(3)])
    rays = 0.5 * axes, -axes
    hits = same_as_numpy((points, np.arange(len(points)).reshape(-1, 3)), *rays)
    assert hits.hit.all()
    np.testing.assert_allclose(hits.distance, 0.5, rtol=1e-12)
