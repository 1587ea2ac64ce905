"""Points of recorded sweeps are compensated and calibrated: a turning sensor, in closed form."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from lidarreal.comparing.fit.smooth_surfaces import find_surfaces
from lidarreal.reconstruction.alignment import Alignment
from lidarreal.reconstruction.free_space import RangeImage
from lidarreal.reconstruction.labels import SurfelMaterial, labels_of, split_by_object
from lidarreal.reconstruction.motion import Motion
from lidarreal.reconstruction.odometry import RecordedPoses
from lidarreal.reconstruction.porosity import Porosity
from lidarreal.scan_patterns.lasers import RingLasers
from lidarscenario.points.point_scene import CLASS_MATERIAL, surfel_faces
from lidarsim import SceneMesh
from lidarsim.columns.sweep import Sweep
from lidarsim.scene.face_materials import FaceMaterials

STAMPS_S = np.array([0.0, 0.1, 0.26, 0.33, 0.5])
SPIN_RAD_S = np.array([0.1, -0.2, 0.8])
VELOCITY_M_S = np.array([9.0, -2.0, 0.5])
RINGS = 3


def pose_at(time_s):
    """Return the pose (4, 4) of a sensor that moves straight and turns steadily.

    After the last stamp it moves as in the step before, seen from the sensor.
    """
    pose = np.eye(4)
    pose[:3, :3] = turned(time_s)
    known_s = min(time_s, STAMPS_S[-1])
    seen = turned(STAMPS_S[-2]).T @ VELOCITY_M_S
    pose[:3, 3] = known_s * VELOCITY_M_S + turned(known_s) @ seen * (time_s - known_s)
    return pose


def turned(time_s):
    from scipy.spatial.transform import Rotation

    return Rotation.from_rotvec(time_s * SPIN_RAD_S).as_matrix()


def in_frame(world, time_s):
    """Return points (n, 3) of the world in the sensor frame at times (n,) or at one."""
    poses = np.stack([pose_at(time) for time in np.broadcast_to(time_s, len(world))])
    return np.einsum("nji,nj->ni", poses[:, :3, :3], world - poses[:, :3, 3])


def poses():
    return np.stack([pose_at(time) for time in STAMPS_S])


def sweep(points, time_s=None, start_rad=0.0):
    row = np.arange(len(points)) % RINGS
    starts_rad = np.full(len(points), start_rad)
    return Sweep(points).with_columns(row=row, time_s=time_s, start_rad=starts_rad)


@pytest.fixture
def world():
    return np.random.default_rng(4).uniform(-40, 40, (50, 3))


@pytest.mark.parametrize("number", range(5))
def test_points_are_compensated_to_the_stamp_of_their_sweep(world, number):
    times_s = np.linspace(-0.09, 0.12, len(world))
    stamp_s = STAMPS_S[number]
    alignment = Alignment(poses(), STAMPS_S, 0.1, 0.2, Motion.TIMED, np.zeros((RINGS, 3)))
    fired = in_frame(world, stamp_s + times_s)
    points, origins = alignment.compensate(sweep(fired, times_s), number)
    sensors = np.stack([pose_at(time_s)[:3, 3] for time_s in stamp_s + times_s])
    np.testing.assert_allclose(points, in_frame(world, stamp_s), atol=1e-9)
    np.testing.assert_allclose(origins, in_frame(sensors, stamp_s), atol=1e-9)


@pytest.mark.parametrize(("motion", "sign"), [(Motion.COUNTERCLOCKWISE, 1), (Motion.CLOCKWISE, -1)])
def test_points_without_times_are_compensated_by_their_azimuth(motion, sign):
    turns = np.linspace(0.02, 0.98, 30)
    start_rad = 0.4
    azimuth = start_rad + sign * 2 * np.pi * turns
    fired = np.stack([20 * np.cos(azimuth), 20 * np.sin(azimuth), turns], axis=1)
    world = np.stack(
        [(pose_at(0.1 + 0.15 * t) @ [*p, 1])[:3] for t, p in zip(turns, fired, strict=True)]
    )
    alignment = Alignment(poses(), STAMPS_S, 0.15, 0.2, motion, np.zeros((RINGS, 3)))
    points, _ = alignment.compensate(sweep(fired, start_rad=start_rad), 1)
    np.testing.assert_allclose(points, in_frame(world, 0.1), atol=1e-9)


def test_compensated_points_stay_and_get_the_offsets_of_their_rings(world):
    offsets = np.array([[0.1, 0.0, 0.0], [0.0, 0.01, 0.0], [0.0, 0.0, -0.02]])
    alignment = Alignment(poses(), STAMPS_S, 0.1, 0.2, Motion.COMPENSATED, offsets)
    points, origins = alignment.compensate(sweep(world), 2)
    x, y, z = world.T
    ranges, elevation, azimuth = (
        np.linalg.norm(world, axis=1),
        np.arctan2(z, np.hypot(x, y)),
        np.arctan2(y, x),
    )
    shifted = np.stack([ranges, elevation, azimuth], axis=1) + offsets[np.arange(50) % RINGS]
    level = shifted[:, 0] * np.cos(shifted[:, 1])
    expected = np.stack(
        [
            level * np.cos(shifted[:, 2]),
            level * np.sin(shifted[:, 2]),
            shifted[:, 0] * np.sin(shifted[:, 1]),
        ],
        axis=1,
    )
    np.testing.assert_allclose(points, expected, atol=1e-9)
    assert not origins.any()


def test_poses_by_registration_are_moved_to_the_stamps_of_sweeps():
    registered = np.stack([pose_at(0.1 * n + 0.02 + 0.4 * 0.1) for n in range(5)])
    found = RecordedPoses(registered, 0.1 * np.arange(5), "", np.zeros(3), share=0.4, first_s=0.02)
    alignment = Alignment.from_poses(found, 0.2, Motion.TIMED, RINGS)
    expected = np.stack([pose_at(0.1 * n) for n in range(5)])
    np.testing.assert_allclose(alignment.poses[:4], expected[:4], atol=1e-9)
    kept = Alignment.from_poses(found, 0.2, Motion.COMPENSATED, RINGS)
    np.testing.assert_array_equal(kept.poses, registered)


def test_slopes_and_edges_of_a_room_are_those_of_its_planes():
    """A box around the sensor: the planes of its six faces are known."""
    azimuth = (np.arange(360) + 0.5) * np.pi / 180
    elevation = np.linspace(-0.6, 0.6, 25)[:, None]
    directions = np.stack(
        np.broadcast_arrays(
            np.cos(elevation) * np.cos(azimuth),
            np.cos(elevation) * np.sin(azimuth),
            np.sin(elevation),
        ),
        axis=-1,
    )
    faces = np.concatenate([np.eye(3), -np.eye(3)])
    offsets = np.array([6.0, 4.0, 2.0, 7.0, 5.0, 1.5])
    cosines = directions @ faces.T
    ranges = np.where(cosines > 0, offsets / np.maximum(cosines, 1e-9), np.inf)
    face, distance = ranges.argmin(axis=-1), ranges.min(axis=-1)
    stack = SimpleNamespace(directions=directions)
    found = find_surfaces(stack, distance, np.full(distance.shape, 1e-3))

    shifted = [np.roll(face, shift, axis=1) for shift in (-2, -1, 1, 2)]
    rows = np.arange(len(face))
    shifted += [face[np.clip(rows + shift, 0, rows[-1])] for shift in (-1, 1)]
    inside = np.all([other == face for other in shifted], axis=0)
    inside[[0, -1]] = False  # rings at the ends have one neighbor
    assert np.all(found.smooth[inside]) and inside.mean() > 0.7
    next_to_corner = (shifted[1] != face) | (shifted[2] != face)
    assert not found.smooth[next_to_corner & (np.abs(elevation) < 0.05)].any()

    normal = np.take_along_axis(faces[None, None], face[..., None, None], axis=2)[:, :, 0]
    cosine = (normal * directions).sum(axis=-1)
    scaled = normal / cosine[..., None]
    np.testing.assert_allclose(found.scaled_normal[inside], scaled[inside], atol=1e-6)
    slope = distance * np.sqrt(1 / cosine**2 - 1)
    np.testing.assert_allclose(found.slope[inside], slope[inside], atol=1e-5)
    east = np.stack([-directions[..., 1], directions[..., 0]], axis=-1)  # change with azimuth
    by_azimuth = -distance * (normal[..., :2] * east).sum(axis=-1) / cosine
    np.testing.assert_allclose(found.azimuth_slope[inside], by_azimuth[inside], atol=1e-5)


def test_surfels_are_divided_by_the_objects_and_classes_of_their_labels():
    columns = {
        "class": np.array([7, 0, 9, 7, 70_000]),
        "object": np.array([2, 0, -1, 2, 0]),
    }
    labels = labels_of(Sweep(np.zeros((5, 3)), columns))
    corners = np.arange(5 * 4 * 3, dtype=float).reshape(-1, 3)
    rows = np.unique(labels)
    names = tuple(f"{CLASS_MATERIAL}{label}" for label in rows.tolist())
    index = np.repeat(np.searchsorted(rows, labels), 2).astype(np.int32)
    mesh = SceneMesh("SurfaceMap", corners, surfel_faces(5), materials=FaceMaterials(names, index))
    porosity = Porosity(np.array([0, 0, 0.2, 0, 0.4]), np.array([0, 0, 0, 0, 0.06]))
    parts = split_by_object(mesh, porosity, np.array([0, 0, 0, 0, 0.2]))
    assert [part.name for part in parts] == ["object 0", "object 2", "SurfaceMap"]
    surfels = corners.reshape(5, 4, 3)
    for part, expected in zip(parts, ([1, 4], [0, 3], [2]), strict=True):
        np.testing.assert_array_equal(part.vertices.reshape(-1, 4, 3), surfels[expected])
    assert parts[0].materials.names == (
        "",
        "gaps 0.4, spread 0.06, contrast 0.2",
    )  # no class above 65,535
    np.testing.assert_array_equal(parts[0].materials.index, [0, 0, 1, 1])
    assert parts[1].materials.names == (f"{CLASS_MATERIAL}7",)
    assert parts[2].materials.names == (f"{CLASS_MATERIAL}9, gaps 0.2",)
    for part in parts:
        for name in part.materials.names[-1:]:
            assert SurfelMaterial.from_name(name).name == name
    assert SurfelMaterial(7, 0.4, 0.06, 0.2).entry() == {
        "material": "class 7, gaps 0.4, spread 0.06, contrast 0.2",
        "class": 7,
        "gap_fraction": 0.4,
        "range_spread_m": 0.06,
        "reflectance_spread": 0.2,
    }


def test_range_images_have_a_row_around_each_ring():
    """Each cell has the nearest and farthest range of its row and of the rows beside it."""
    elevation = np.radians([10.0, 4.0, 0.0, -10.0, -20.0])
    ranges = np.array([10.0, 20.0, 30.0, 40.0, 50.0])
    points = ranges[:, None] * np.stack(
        [np.cos(elevation), 0 * elevation, np.sin(elevation)], axis=1
    )
    image = RangeImage.from_points(points, RingLasers.at_origin(elevation))
    column = np.isfinite(image.nearest_m).all(axis=0)
    assert column.sum() == 3
    np.testing.assert_allclose(image.nearest_m[:, column].T, [[10, 10, 20, 30, 40]] * 3)
    np.testing.assert_allclose(image.farthest_m[:, column].T, [[20, 30, 40, 50, 50]] * 3)
    passed, confirmed = image.classify(points * 0.5)
    assert passed.tolist() == [True, False, True, True, True] and not confirmed[2:].any()
