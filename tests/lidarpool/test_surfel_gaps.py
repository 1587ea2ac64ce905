"""Expected loss of returns in gaps between surfels: by areas, and by scanning again."""

import numpy as np
import pytest
from click.testing import CliRunner

from lidarpool.cli.scenario_commands import scene as command
from lidarscenario.points.point_scene import points_to_scene
from lidarscenario.points.surfel_gaps import expected_loss
from lidarsim import Pose, Scanner, Scene, Sensor, box

pytest.importorskip("open3d", reason="Open3D does not exist")

OPTIONS = {
    "size": 1.0, "unit": None, "epsg": None, "keep_noise": False, "color": None,
    "report": lambda note: None,
}  # fmt: skip
RINGS = Sensor.grid(rays_per_revolution=1800, layers=16, step_deg=0.2, vertical_fov_deg=40)


def wall_of_squares(half_m):
    """Return points on a wall 10 m away, 0.1 m apart, and squares in their middles."""
    y, z = np.mgrid[-3:3:61j, -3:3:61j].reshape(2, -1)
    points = np.stack([np.full(len(y), 10.0), y, z], axis=1)
    corners = points[:, None] + half_m * np.array([(0, -1, -1), (0, 1, -1), (0, 1, 1), (0, -1, 1)])
    return points, corners


@pytest.mark.extended(every=4)
@pytest.mark.parametrize("half_m", [0.01, 0.025, 0.04, 0.05])
@pytest.mark.parametrize("origin", [(0, 0, 0), (500_000, 5_400_000, 300)])
def test_the_loss_is_the_area_between_surfels(half_m, origin):
    points, corners = wall_of_squares(half_m)
    scanners = np.broadcast_to(origin, points.shape)
    loss = expected_loss(points + origin, scanners, corners + origin)
    assert loss == pytest.approx(1 - (half_m / 0.05) ** 2, abs=0.03)


def test_stations_fill_each_other_s_gaps_and_distant_surfels_do_not_count():
    points, corners = wall_of_squares(0.025)
    scanners = np.zeros_like(points)
    scanners[::2] = (0, 1, 0)
    both = expected_loss(points, scanners, corners)
    assert both == pytest.approx(0.75, abs=0.04)
    behind = np.array([[(30, -90, -90), (30, 90, -90), (30, 90, 90), (30, -90, 90.0)]])
    assert expected_loss(points, scanners, np.concatenate([corners, behind])) == both


def test_without_known_or_with_very_many_positions_nothing_is_estimated():
    points, corners = wall_of_squares(0.025)
    assert expected_loss(points, np.full_like(points, np.nan), corners) is None
    assert expected_loss(points, points - [10, 0, 0], corners) is None  # of a moving sensor
    assert expected_loss(points[:20], np.zeros((20, 3)), corners[:20]) is None


@pytest.fixture(scope="module")
def hall(tmp_path_factory):
    """Scan a hall with two blocks from a place, into a .pcd with the place as its viewpoint."""
    scene = Scene.from_meshes([box("Hall", (40, 30, 8)), box("Block", (3, 2, 4))])
    place = (7, 4, 1.8)
    positions = Scanner(scene, RINGS).sweep(Pose(place), number=0).positions
    head = (
        "VERSION .7\nFIELDS x y z\nSIZE 8 8 8\nTYPE F F F\nCOUNT 1 1 1\n"
        f"WIDTH {len(positions)}\nHEIGHT 1\nVIEWPOINT 7 4 1.8 1 0 0 0\n"
        f"POINTS {len(positions)}\nDATA binary\n"
    )
    path = tmp_path_factory.mktemp("hall") / "hall.pcd"
    local = positions - place
    path.write_bytes(head.encode() + local.astype("<f8").tobytes())
    return scene, place, path


@pytest.mark.extended
@pytest.mark.parametrize("voxel_m", [None, 0.7])
def test_the_loss_is_that_of_a_scan_from_the_same_place(hall, voxel_m):
    scene, place, path = hall
    made = points_to_scene(path, voxel_m=voxel_m, **OPTIONS)
    tilts = [(0.5, 0.2), (-0.7, 0.9), (1.1, -0.4), (-1.2, -1.0)]
    poses = [Pose(place, yaw_deg=30, pitch_deg=pitch, roll_deg=roll) for pitch, roll in tilts]
    true_m, found_m = (Scanner(one, RINGS).ranges(poses) for one in (scene, made.scene))
    seen = np.isfinite(true_m)
    lost = (seen & np.isinf(found_m)).sum() / seen.sum()
    assert made.loss == pytest.approx(lost, abs=0.07)
    assert made.loss > 0.3 if voxel_m is None else made.loss < 0.1
    note = f"would lose about {made.loss:.0%} of the returns in gaps"
    assert (note in made.gap_note) == (made.loss >= 0.02)


def test_the_command_notes_the_loss(hall, tmp_path):
    _, _, path = hall
    noted = CliRunner().invoke(command, ["points", str(path), str(tmp_path / "a.glb")]).stderr
    assert "% of the returns in gaps between points, such as those between" in noted
    assert "increase `--voxel-m` (`voxel_m` in Python), such as to " in noted
    np.save(tmp_path / "b.npy", np.random.default_rng(0).uniform(0, 1, (500, 3)))
    arguments = ["points", str(tmp_path / "b.npy"), str(tmp_path / "b.glb")]
    assert "the scanner positions are unknown" in CliRunner().invoke(command, arguments).stderr
