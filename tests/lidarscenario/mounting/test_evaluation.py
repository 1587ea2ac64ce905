"""Points on targets and blind areas of single mounts: closed forms on level ground."""

from __future__ import annotations

import math

import numpy as np
import pytest
import yaml

from lidarscenario.mount_sections import VehicleFile
from lidarscenario.mounting.placements import azimuths_in_view, pack_sweeps
from lidarscenario.mounting.study import MountStudy
from lidarscenes.writers.scene_file import write_scene
from lidarsim import LidarError, Pose, Scene, SceneMesh, box

POST = {"box": [0.2, 0.2, 0.2]}  # a body that hides almost nothing
PLATE = {"box": [0.5, 1.2, 1.8]}
RING_DEG = 10.0
HEIGHT_M = 2.0


@pytest.fixture
def folder(tmp_path):
    """Write sensor files: a single ring, and 41 rings of 0.5°, both with 720 firings."""
    rings = {
        "ring": [-RING_DEG],
        "rings": [round(-0.5 * n, 3) for n in range(41)],
    }
    for name, elevations in rings.items():
        sensor = {
            "name": name,
            "firings_per_turn": 720,
            "rate_hz": 10,
            "range_m": [0.3, 100],
            "beams": {"elevation_deg": elevations},
        }
        (tmp_path / f"{name}.yaml").write_text(yaml.safe_dump(sensor))
    return tmp_path


def study(folder, model="ring.yaml", body=POST, mount=(0, 0, HEIGHT_M), **sections):
    data = {
        "body": body,
        "sensors": {"top": {"model": model, "mounts": list(mount)}},
        "targets": {"plate": PLATE},
        "region": {"distances_m": [10], "bearings": 1, "headings_deg": [0]},
        **sections,
    }
    return MountStudy.from_file(VehicleFile.from_data(data, folder=folder))


def evaluate(a_study):
    vehicle = a_study.vehicle
    (pose,) = vehicle.sensors["top"].mounts.values()
    return a_study.evaluator(vehicle.mounted_sensor("top", pose))


def cells(a_study):
    """Return x and y of the centers of all cells."""
    grid = a_study.evaluator.grid
    x = grid.x + (np.arange(grid.columns) + 0.5) * grid.cell_m
    y = grid.y + (np.arange(grid.rows) + 0.5) * grid.cell_m
    return np.meshgrid(x, y)


def test_a_ring_meets_level_ground_at_its_height_over_the_tangent(folder):
    """Objects of height h are seen from (H - h) / tan to H / tan: 9.64 to 11.34 m for 0.3 m."""
    one = study(folder, map={"margin_m": 15, "cell_m": 0.1})
    lowest = evaluate(one).lowest_m
    distance = np.hypot(*cells(one))
    slope = math.tan(math.radians(RING_DEG))
    radius = HEIGHT_M / slope
    on_ground = distance[lowest == 0]
    assert abs(on_ground - radius).max() < 0.08
    passed = (lowest > 0) & np.isfinite(lowest)
    expected = HEIGHT_M - distance[passed] * slope
    # A beam leaves a cell at most half a diagonal from its center.
    assert np.abs(expected - lowest[passed]).max() < 0.0708 * slope + 0.001
    straight = np.abs(cells(one)[1][passed]) < 0.05  # along x, it leaves at the side of the cell
    assert np.median((expected - lowest[passed])[straight]) == pytest.approx(0.05 * slope, rel=0.1)
    # Only cells between two neighboring beams are missed.
    assert (lowest[distance > radius + 0.1] == np.inf).all()
    below_map_height = (distance > 0.31 / slope + 0.1) & (distance < radius / 2)
    assert (lowest[below_map_height] < np.inf).all()
    assert (lowest[distance < 0.3 / slope - 0.1] == np.inf).all()
    # A cell is visible if any part of it is in the ring between both distances.
    sides = np.abs(np.stack(cells(one)))
    nearest = np.linalg.norm(np.maximum(sides - 0.05, 0), axis=0)
    farthest = np.linalg.norm(sides + 0.05, axis=0)
    result = one.run(workers=1).best
    for height in (0.3, 1.0):
        inner = (HEIGHT_M - height) / slope
        visible = (nearest <= radius) & (farthest >= inner)
        seen_m2 = result.map_m2 - result.blind_m2[height]
        assert 0.98 < seen_m2 / (0.01 * visible.sum()) <= 1  # few corners are between two beams
        assert seen_m2 == pytest.approx(math.pi * (radius**2 - inner**2), rel=0.07)


def test_only_a_body_below_the_ground_is_noted(folder):
    assert study(folder).notes == ()
    low = box("van", (4, 2, 1.5))
    low = SceneMesh("van", low.vertices - np.array([0, 0, 0.75]), low.faces)
    write_scene(folder / "low.glb", Scene.from_meshes([low]))
    (note,) = study(folder, body="low.glb").notes
    assert note.startswith("the body extends to z = -0.75 m, but the ground is z = 0")


def test_the_edge_of_a_roof_hides_the_ground_behind_it(folder):
    """The sight line over an edge at e meets the ground at e H / (H - roof), 12 m and 5.4 m."""
    body = {"box": [4, 1.8, 1.5]}
    one = study(folder, "rings.yaml", body, (0, 0, 1.8), map={"margin_m": 14, "cell_m": 0.1})
    result = evaluate(one)
    x, y = cells(one)
    for along, across, edge in ((x, y, 2.0), (y, x, 0.9)):
        reach = edge * 1.8 / 0.3
        row = (np.abs(across) < 0.1) & (along > edge)
        seen = row & (result.lowest_m == 0)
        # The first ring outside the shadow is at most 0.5° farther.
        angle = math.degrees(math.atan(1.8 / reach))
        ring = 1.8 / math.tan(math.radians(math.floor(angle * 2) / 2))
        assert reach - 0.1 < along[seen].min() <= ring + 0.1
        # In the shadow, objects are visible above the sight line.
        within = row & (along < 5)
        line = 1.8 - along[within] * 0.3 / edge
        over = result.lowest_m[within] - line
        assert over.min() > -0.05 and over.max() < 0.005 + along[within].max() * math.radians(0.5)
    open_view = result.unobstructed_m[(np.abs(y) < 0.1) & (x > 5.2) & (x < 6)]
    assert open_view.min() < 0.01
    azimuth, depression = np.radians(np.meshgrid(np.arange(0, 360, 0.5), np.arange(0, 20.5, 0.5)))
    edge_m = np.minimum(
        2 / np.abs(np.cos(azimuth)), 0.9 / np.maximum(np.abs(np.sin(azimuth)), 1e-9)
    )
    blocked = (np.tan(depression) > 0.3 / edge_m).sum()
    assert result.blocked == pytest.approx(int(blocked), abs=20) and result.beams == 720 * 41


@pytest.mark.parametrize("distance_m", [6.0, 15.0, 30.0])
def test_points_on_a_box_are_as_many_as_beams_in_its_angles(folder, distance_m):
    region = {"distances_m": [distance_m], "bearings": 4, "headings_deg": [0, 90]}
    one = study(folder, "rings.yaml", POST, region=region)
    points = evaluate(one).points.reshape(4, 2)
    near_m = {0: distance_m - 0.25, 1: distance_m - 0.6}
    for bearing in range(4):
        for heading in range(2):
            # A box across the line of sight shows its front alone.
            turned = (heading + bearing) % 2
            front, half = near_m[turned], (0.6, 0.25)[turned]
            steps = 2 * math.degrees(math.atan(half / front)) / 0.5
            highest = math.degrees(math.atan((HEIGHT_M - 1.8) / front)) / 0.5
            lowest = min(math.degrees(math.atan(HEIGHT_M / front)), 20.0) / 0.5
            assert abs(points[bearing, heading] - steps * (lowest - highest)) <= (
                steps + lowest - highest + 1
            )


def test_points_are_limited_by_reflectance_and_weather(folder):
    """With a detection range of 20 m at 10 %, 90 % are seen up to 60 m."""
    region = {"distances_m": [15, 30], "bearings": 1, "headings_deg": [0]}
    noise = {"detection_range_m": 20}
    targets = {"dark": PLATE | {"reflectance": 0.1}, "light": PLATE | {"reflectance": 0.9}}
    sections = {"region": region, "noise": noise, "targets": targets}
    near_dark, far_dark, near_light, far_light = evaluate(
        study(folder, "rings.yaml", **sections)
    ).points
    assert near_dark > 30 and far_dark == 0
    assert near_light == pytest.approx(near_dark, abs=8) and far_light > 15
    foggy = evaluate(study(folder, "rings.yaml", **sections, weather={"visibility_km": 0.05}))
    assert foggy.points[3] == 0  # 3 / visibility * 60 m: transmission of 3 %
    assert foggy.points[2] > 30


def test_objects_on_the_map_are_seen_within_the_detection_range(folder):
    """At 10 % reflectance, objects are visible up to 8 m, and ground returns end before."""
    one = study(folder, noise={"detection_range_m": 8}, map={"margin_m": 14})
    lowest = evaluate(one).lowest_m
    distance = np.hypot(*cells(one))
    horizontal = 8 * math.cos(math.radians(RING_DEG))
    assert distance[np.isfinite(lowest)].max() == pytest.approx(horizontal, abs=0.2)
    assert (lowest > 0).all()


def test_the_vehicle_blocks_beams_within_the_minimum_range(folder):
    """A roof 0.05 m below the sensor is closer than its minimum range of 0.3 m."""
    roof = {"box": [2, 2, 1.95]}
    blocked = evaluate(study(folder, "ring.yaml", roof))
    assert blocked.blocked == blocked.blocked_near == blocked.beams == 720
    assert blocked.points.tolist() == [0]
    assert np.isinf(blocked.lowest_m).all()
    # A target within the minimum range has no points.
    region = {"distances_m": [0.5], "bearings": 1, "headings_deg": [0]}
    thin = {"plate": {"box": [0.5, 0.1, 1.8]}}
    close = study(folder, "rings.yaml", mount=(0, 0, 1.8), region=region, targets=thin)
    assert evaluate(close).points.tolist() == [0]


def test_notes_name_mounts_at_the_body_and_sensors_without_ranges(folder):
    body = {"box": [2, 2, 1.5]}
    mounts = {"inside": [0, 0, 0.7], "flush": [0, 0, 1.5], "roof": [0, 0, 2]}
    sensors = {
        "top": {"model": "rings.yaml", "mounts": mounts},
        "side": {"model": "ouster/os1-32", "columns": 512, "mounts": [0, 1.3, 2]},
    }
    one = study(folder, body=body, sensors=sensors, map={"heights_m": [0, 1], "cell_m": 1})
    notes = " ".join(one.run(workers=1).notes)
    assert "more than 95% of the beams of top at the mount inside." in notes
    assert "at the mount flush, top is on the surface of the body," in notes
    assert "Set `performance: datasheet` for side. No data sheet range is known for top" in (notes)
    assert "the score uses the blind area at 1 m" in notes
    assert "roof" not in notes and "of side at" not in notes


@pytest.mark.extended
def test_targets_in_a_sweep_have_the_points_that_they_have_alone(folder):
    """Many targets around a car, evaluated together and one by one."""
    region = {"distances_m": [2.5, 4, 7], "bearings": 7, "headings_deg": [0, 30]}
    sections = {"region": region, "targets": ["pedestrian", "car", "cone"]}
    one = study(folder, "rings.yaml", "saloon", (1.0, 0.5, 1.7), **sections)
    placements = one.placements
    together = evaluate(one).points
    assert 30 < len(placements) <= 126 and together.max() > 100
    for row in range(0, len(placements), 9):
        mask = np.arange(len(placements)) == row
        alone = study(folder, "rings.yaml", "saloon", (1.0, 0.5, 1.7), **sections)
        object.__setattr__(alone.evaluator, "placements", placements.select(mask))
        assert evaluate(alone).points.tolist() == [together[row]], row


def test_azimuths_in_a_sweep_do_not_overlap(folder):
    region = {"distances_m": [3, 10], "bearings": 12, "headings_deg": [0, 90]}
    one = study(folder, "rings.yaml", "saloon", region=region)
    sensor = one.vehicle.mounted_sensor("top", Pose((1, 0.3, 1.7))).sensor
    origin = np.array([1.0, 0.3, 1.7])
    around = np.array([[np.cos(a), np.sin(a), 0] for a in np.linspace(0, 2 * np.pi, 720)])
    sweeps = [*pack_sweeps(one.placements, origin, sensor, azimuths_in_view(around))]
    assert sorted(np.concatenate(sweeps).tolist()) == list(range(len(one.placements)))
    assert 2 <= len(sweeps) < len(one.placements) / 4
    corners = one.placements.footprints() - origin[:2]
    for sweep in sweeps:
        spans = []
        for quad in corners[sweep]:
            angles = np.unwrap(np.arctan2(quad[:, 1], quad[:, 0]))
            spans.append((angles.min() % (2 * np.pi), np.ptp(angles)))
        spans.sort()
        ends = [*spans[1:], (spans[0][0] + 2 * np.pi, 0)]
        assert all(
            start + width < end for (start, width), (end, _) in zip(spans, ends, strict=True)
        )
    # A sensor that looks ahead omits the targets behind.
    ahead = around[np.abs(np.arctan2(around[:, 1], around[:, 0])) < 0.5]
    kept = np.concatenate([*pack_sweeps(one.placements, origin, sensor, azimuths_in_view(ahead))])
    assert 0 < len(kept) < len(one.placements) / 2


def test_targets_that_overlap_the_vehicle_are_omitted(folder):
    region = {"distances_m": [1.5, 4], "bearings": 4, "headings_deg": [0]}
    one = study(folder, body="saloon", region=region)
    positions = one.placements.positions.round(3).tolist()
    # The car is 4.6 m long and 1.8 m wide: a plate of 0.5 m by 1.2 m fits beside it, not in front.
    assert [1.5, 0, 0] not in positions and [4, 0, 0] in positions
    assert [0, 1.5, 0] not in positions or len(positions) == 6
    with pytest.raises(LidarError, match="No target is outside the vehicle"):
        study(folder, body="saloon", region=region | {"distances_m": [0.5]})
