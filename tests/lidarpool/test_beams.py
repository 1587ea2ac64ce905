"""Beams of several rays: their cross-section, planes at any angle, edges."""

from __future__ import annotations

import math

import numpy as np
import pytest
from tests.lidarpool.test_echoes import cast, wall

from lidarpool import Beams, Material, Returns, Sensor, Spin, load_sensor
from lidarpool.scene.mesh import Mesh


def plane(point, normal, size=4000.0):
    """A large rectangle through a point."""
    normal = np.asarray(normal, float) / np.linalg.norm(normal)
    one = np.cross(normal, [0.0, 0.0, 1.0] if abs(normal[2]) < 0.9 else [0.0, 1.0, 0.0])
    one /= np.linalg.norm(one)
    other = np.cross(normal, one)
    corners = [
        point + size * (a * one + b * other) for a, b in [(-1, -1), (1, -1), (1, 1), (-1, 1)]
    ]
    return Mesh("Plane", np.array(corners), np.array([[0, 1, 2], [0, 2, 3]]))


def ground(rough_m=0.0, cell_m=2.0, reach_m=200.0):
    """Level ground of many triangles, below the origin by 1.8 m."""
    steps = np.arange(-reach_m, reach_m + 1, cell_m)
    x, y = np.meshgrid(steps, steps)
    z = np.random.default_rng(0).normal(-1.8, rough_m, x.shape)
    n = len(steps)
    corner = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
    low = np.stack([corner, corner + 1, corner + n], axis=1)
    high = np.stack([corner + 1, corner + n + 1, corner + n], axis=1)
    return Mesh("Ground", np.stack([x, y, z], axis=-1).reshape(-1, 3), np.concatenate([low, high]))


def fan(elevations_deg, optics, max_range_m=math.inf):
    return Sensor(Beams(np.radians(elevations_deg)), Spin(1, 360), 0, max_range_m, optics=optics)


# -- the cross-section ---------------------------------------------------------------------------


def beyond(offset):
    """Share of the unit disc beyond a straight edge at an offset from the middle."""
    return (math.acos(offset) - offset * math.sqrt(1 - offset**2)) / math.pi


@pytest.mark.parametrize("angle_deg", [0, 17, 45, 90, 133])
@pytest.mark.parametrize("offset", [-0.8, -0.3, 0.0, 0.5])
def test_surfaces_on_both_sides_of_an_edge_get_their_shares(angle_deg, offset):
    """The light of a beam, on a near wall that ends at an edge and on a far one."""
    at = offset * 1e-3 * 5  # the beam has a radius of 1 mrad
    near = wall("Near", 5, y=(at, 60), z=(-60, 60))
    cosine, sine = math.cos(math.radians(angle_deg)), math.sin(math.radians(angle_deg))
    turned = near.vertices @ [[1, 0, 0], [0, cosine, sine], [0, -sine, cosine]]
    materials = [Material("Near", 0.2), Material("Far", 0.8)]  # as bright both, at 5 and 10 m
    meshes = [Mesh("Near", turned, near.faces), wall("Far", 10)]
    beam = Returns("all", subrays=217, divergence_mrad=2, pulse_ns=5)
    found = cast(meshes, materials=materials, returns=beam)
    assert found["range"] == pytest.approx([5, 10], abs=1e-3)
    share = found["intensity"][0] / found["intensity"].sum()
    assert share == pytest.approx(beyond(offset), abs=0.015)


# -- planes --------------------------------------------------------------------------------------


def footprint(distance_m, grazing, radius):
    """Range, and energy relative to the middle's, of a cone on a plane: integrals over the disc.

    With s the sine of the angle to the plane, ranges are as 1 / s, energies as s**3.
    """
    slope = math.cos(grazing) / math.sin(grazing) * radius
    variance = slope**2 / 4
    return distance_m * (1 + variance) / (1 + 3 * variance), 1 + 3 * variance


@pytest.mark.parametrize("subrays", [7, 19, 37, 61])
@pytest.mark.parametrize(
    "model",
    ["velodyne/vlp32c", "ouster/os1-64", "terrestrial/riegl-vz400", "airborne/riegl-vq780i"],
)
def test_a_beam_on_a_road_is_one_return(model, subrays):
    """However shallow it meets the road: with the converged range and energy."""
    optics = load_sensor(model).optics
    down = np.array([-0.67, -0.8, -1.0, -1.33, -2.0, -3.0, -5.0, -10.0, -25.0])
    for mode in ("all", "strongest"):
        beam = Returns(mode, subrays=subrays)
        found = cast([plane((0, 0, -1.8), (0, 0, 1))], fan(down, optics), returns=beam)
        assert found["ray"].tolist() == list(range(len(down)))
        middle = cast([plane((0, 0, -1.8), (0, 0, 1))], fan(down, optics))
        for ray, elevation in enumerate(np.radians(down)):
            straight = 1.8 / math.sin(-elevation)
            distance, energy = footprint(straight, -elevation, optics.divergence_mrad / 2000)
            assert found["range"][ray] == pytest.approx(distance, abs=optics.resolution_m)
            exact = float(middle["intensity"][ray]) * energy
            assert found["intensity"][ray] == pytest.approx(exact, rel=0.05, abs=1e-6)


@pytest.mark.parametrize("model", ["velodyne/vlp32c", "ouster/os1-64"])
@pytest.mark.parametrize("subrays", [1, 7, 19, 37, 61])
def test_a_whole_sensor_reports_the_ground_once(model, subrays):
    """Also where the ground is a mesh, and where the sensor's range ends within a beam."""
    sensor = load_sensor(model)
    for mesh in (plane((0, 0, -1.8), (0, 0, 1)), ground()):
        found = cast([mesh], sensor, returns=Returns("all", subrays=subrays))
        assert len(found["ray"]) > 40
        assert (found["returns"] == 1).all()


def test_rough_ground_is_seldom_more_than_one_return():
    sensor = load_sensor("velodyne/vlp32c")
    for subrays in (7, 61):
        found = cast([ground(rough_m=0.01)], sensor, returns=Returns("all", subrays=subrays))
        assert (found["returns"] > 1).mean() < 0.02


def test_a_road_is_one_return_behind_glass_and_in_a_mirror():
    beam = Returns("all", subrays=19, divergence_mrad=3)
    down = fan([-1.33], load_sensor("velodyne/vlp32c").optics)
    road = plane((0, 0, -1.8), (0, 0, 1))
    plain = cast([road], down, returns=beam)
    pane = [wall("Pane", 3), road]
    materials = [Material("*"), Material("Pane", transparent="pass")]
    behind = cast(pane, down, returns=beam, materials=materials)
    assert behind["range"] == pytest.approx(plain["range"], abs=1e-3)
    mirror = [Mesh("Pane", wall("Pane", 3).vertices @ _turn(45), wall("Pane", 3).faces), road]
    materials = [Material("*"), Material("Pane", transparent="mirror")]
    seen = cast(mirror, down, returns=beam, materials=materials)
    assert seen["range"] == pytest.approx(plain["range"], abs=1e-3)


def _turn(degrees):
    """A rotation about the vertical, for rows."""
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    return np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])


# -- what stays apart ----------------------------------------------------------------------------


@pytest.mark.parametrize("subrays", [7, 19, 61])
def test_a_shelf_that_is_grazed_and_the_wall_behind_it_are_two_returns(subrays):
    """The plane of the shelf goes on to the wall, the shelf does not."""
    shelf = np.array([[3, -1, -8e-3], [6, -1, -8e-3], [6, 1, -8e-3], [3, 1, -8e-3]])
    meshes = [Mesh("Shelf", shelf, np.array([[0, 1, 2], [0, 2, 3]])), wall("Wall", 40)]
    beam = Returns("all", subrays=subrays, divergence_mrad=4)
    found = cast(meshes, returns=beam)
    assert found["object"].tolist() == [0, 1]
    assert found["range"][0] < 6
    assert found["range"][1] == pytest.approx(40, abs=1e-3)


@pytest.mark.parametrize("subrays", [7, 61])
def test_slanted_surfaces_one_behind_the_other_are_two_returns(subrays):
    """The near one covers half of the beam."""
    near, far = plane((20, 0, 0), (1, 0, -3)), plane((24, 0, 0), (1, 0, -3))
    near.vertices[:, 1] = np.maximum(near.vertices[:, 1], 0)
    beam = Returns("all", subrays=subrays, divergence_mrad=3)
    assert cast([near, far], returns=beam)["returns"].tolist() == [2, 2]
