"""Surveys compared in world coordinates: closed forms, pairing, signs, and what is refused."""

from __future__ import annotations

import csv
import json
import re
from dataclasses import replace
from importlib.util import find_spec

import laspy
import numpy as np
import pytest
import trimesh
from click.testing import CliRunner
from rasterio.crs import CRS
from tests.made_recordings import MadeCloud

from lidarfiles import open_recording
from lidarpool.cli.commands import cli
from lidarreal import compare, compare_strips, compare_surveys
from lidarreal.comparing.surveys import pairs, planes
from lidarreal.comparing.surveys.orientation import OrientedPoints
from lidarreal.comparing.surveys.survey_charts import draw_facades
from lidarreal.comparing.surveys.survey_clouds import SurveyCloud
from lidarsim import Cloud, LidarError, Scene, Sensor, Survey, Track
from lidarsim.columns.sweep import Sweep
from lidarsim.sweeps.sweeps import Sweeps

ORIGIN = np.array([500_000.0, 5_800_000.0, 100.0])
SHIFT = (0.03, -0.02, 0.05)


def plane(count=4000, *, side=20.0, seed=1, tilt_deg=0.0, height=0.0, noise=0.0):
    """Points of a plane that rises to the east, in a projected coordinate system."""
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(0, side, (2, count))
    z = height + x * np.tan(np.radians(tilt_deg)) + rng.normal(0, noise, count)
    return np.column_stack([x, y, z]) + ORIGIN


def cloud(points, **columns):
    return Cloud(points, columns)


def components(found, *names):
    values = [found.figures["components"][name] for name in names]
    return values[0] if len(values) == 1 else values


# -- pairs ----------------------------------------------------------------------------------------


def test_a_shift_is_found_whatever_the_order_and_the_lost_points():
    points = plane()
    time = np.arange(len(points)) * 1000
    ranges = np.full(len(points), 50.0)
    rows = np.random.default_rng(2).permutation(len(points))[:3000]
    a = cloud(points[rows] + SHIFT, time=time[rows], range=ranges[rows] + 0.007)
    b = cloud(points[5:], time=time[5:], range=ranges[5:])
    found = compare_surveys(a, b)
    count = np.count_nonzero(rows >= 5)
    assert found.figures["method"] == "pairs"
    assert found.figures["unpaired"] == {"a": 3000 - count, "b": len(points) - 5 - count}
    expected = dict(zip(("delta_e", "delta_n", "delta_h"), SHIFT, strict=True))
    for name, value in {**expected, "range": 0.007, "horizontal": np.hypot(*SHIFT[:2])}.items():
        one = components(found, name)
        assert one["count"] == count
        assert one["mean_m"] == pytest.approx(value, abs=1e-6)
        assert one["rmse_m"] == pytest.approx(abs(value), abs=1e-6)
        assert one["p95_abs_m"] == pytest.approx(abs(value), abs=1e-6)
        assert one["std_m"] < 1e-8


def test_noise_is_found_with_its_spread_and_its_95_percent():
    points = plane(20_000)
    time = np.arange(len(points))
    noisy = points + np.random.default_rng(3).normal(0, (0.01, 0.02, 0.03), points.shape)
    found = compare_surveys(cloud(noisy, time=time), cloud(points, time=time))
    for name, sigma in (("delta_e", 0.01), ("delta_n", 0.02), ("delta_h", 0.03)):
        one = components(found, name)
        assert one["std_m"] == pytest.approx(sigma, rel=4 / np.sqrt(2 * len(points)))
        assert one["p95_abs_m"] == pytest.approx(1.96 * sigma, rel=0.04)


def test_returns_of_a_pulse_are_paired_by_their_number():
    points = plane(400)
    time = np.repeat(np.arange(200), 2)
    number = np.tile([1, 2], 200).astype(np.uint8)
    kept = np.random.default_rng(4).permutation(400)[:300]
    a = cloud(points[kept] + SHIFT, time=time[kept], return_number=number[kept])
    found = compare_surveys(a, cloud(points, time=time, return_number=number))
    assert components(found, "delta_h")["count"] == 300
    assert components(found, "delta_h")["std_m"] < 1e-8
    without = compare_surveys(cloud(points[:-1], time=time[:-1]), cloud(points, time=time))
    assert without.figures["method"] == "planes", "all times but one are ambiguous"


def test_a_sample_keeps_both_points_of_a_pair():
    points = plane(8000)
    time = np.arange(len(points))
    order = np.random.default_rng(5).permutation(len(points))
    a = cloud(points[order] + SHIFT, time=time[order])
    found = compare_surveys(a, cloud(points, time=time), max_points=1000)
    one = components(found, "delta_n")
    assert 300 < one["count"] <= 1000
    assert one["mean_m"] == pytest.approx(SHIFT[1], abs=1e-8) and one["std_m"] < 1e-8
    assert found.figures["unpaired"] == {"a": 0, "b": 0}
    assert any("% of the rays are compared" in note for note in found.figures["notes"])


def test_clouds_without_common_times_are_not_paired():
    points = plane(1000)
    a, b = cloud(points, time=np.arange(1000)), cloud(points, time=np.arange(1000) + 5000)
    assert compare_surveys(a, b).figures["method"] == "planes"
    with pytest.raises(
        LidarError, match="hardly any points of cloud A and cloud B have the same time"
    ):
        compare_surveys(a, b, method="pairs")
    with pytest.raises(LidarError, match="no column `time` or `gps_time` in common"):
        compare_surveys(cloud(points), b, method="pairs")


@pytest.mark.parametrize("sizes", [(1000, 3000), (3000, 1000)])
@pytest.mark.parametrize("ambiguous", [0, 500])
@pytest.mark.parametrize("is_paired", [True, False])
def test_one_percent_of_the_smaller_cloud_must_be_paired(sizes, ambiguous, is_paired):
    """Points with the same time as another point belong to the cloud, but have no pair."""
    common = (1000 + ambiguous) // 100 - (not is_paired)
    clouds = []
    for number, size in enumerate(sizes):
        times = np.arange(size) + 10_000 * number
        times[:common] = np.arange(common) + 50_000
        times = np.append(times, np.full(ambiguous, 90_000 + number))
        points = plane(len(times), seed=1)
        clouds.append(cloud(points - number * np.array(SHIFT), time=times))
    if is_paired:
        found = compare_surveys(*clouds, method="pairs")
        assert components(found, "delta_h")["count"] == common
        assert found.figures["ambiguous"] == {"a": ambiguous, "b": ambiguous}
    else:
        with pytest.raises(LidarError, match="hardly any points of cloud A and cloud B have the"):
            compare_surveys(*clouds, method="pairs")


TIMES = {
    "zero": (np.zeros(500), "the gps time of all points in cloud {} is 0"),
    "constant": (np.full(500, 3.2e8), r"the gps time of all points in cloud {} is 3.2e\+08"),
    "nan": (np.full(500, np.nan), "the gps time of the points in cloud {} is not finite"),
    "infinite": (np.full(500, -np.inf), "the gps time of the points in cloud {} is not finite"),
    "coarse": (
        np.repeat(np.arange(50.0), 10),
        "most points in cloud {} have the same gps time as another point",
    ),
}


@pytest.mark.parametrize("name", TIMES)
@pytest.mark.parametrize("wrong", ["A", "B"])
def test_what_does_not_identify_points_is_named(name, wrong):
    times, says = TIMES[name]
    points = plane(500)
    clouds = {
        key: cloud(points, gps_time=times if key == wrong else np.arange(500.0)) for key in "AB"
    }
    reason = says.format(wrong)
    with pytest.raises(LidarError, match=rf"{reason}\. Use `--survey planes`\.$"):
        compare_surveys(clouds["A"], clouds["B"], method="pairs")
    found = compare_surveys(clouds["A"], clouds["B"], radius_m=2)
    assert found.figures["method"] == "planes"
    assert any(re.search(f"because {reason}, so", note) for note in found.figures["notes"])


@pytest.mark.parametrize(
    "times",
    [
        1.7e27 + np.arange(900) * 1e18,  # more tenths of a microsecond than an integer can count
        -4e20 - np.arange(900) * 1e9,
        np.arange(900, dtype=np.uint64) + np.uint64(2**63),
        np.arange(900, dtype=np.float32),
    ],
)
def test_times_of_any_size_identify_points(times):
    points = plane(900)
    order = np.random.default_rng(20).permutation(900)
    a = cloud(points[order] + SHIFT, gps_time=times[order])
    one = components(compare_surveys(a, cloud(points, gps_time=times), method="pairs"), "delta_n")
    assert one["count"] == 900
    assert one["mean_m"] == pytest.approx(SHIFT[1], abs=1e-8) and one["std_m"] < 1e-8


@pytest.mark.parametrize("coordinates", ["world", "sensor"])
def test_ranges_of_a_moving_sensor_start_where_each_ray_is_fired(monkeypatch, coordinates):
    # 60 sweeps of one scan line each. The platform moves by 2 m during a sweep.
    track = Track([0, 7], [[0, 0, 30], [140, 35, 37]])
    survey = Survey(Sensor.grid(360, 1), trajectory=track, steps=60 * 36)
    sweeps = replace(Sweeps.from_survey(survey, Scene.seed()), coordinates=coordinates)
    time = np.arange(60 * 18) * 5_555_555
    columns = {"scan": np.arange(60 * 18) * 2, "channel": 0 * time, "object": 0 * time}
    rng = np.random.default_rng(21)
    rays = rng.normal((0, 0, -3), size=(len(time), 3))
    rays /= np.linalg.norm(rays, axis=1)[:, None]
    ranges = rng.uniform(20, 40, len(time))
    starts = np.array([0, 0, 30]) + time[:, None] / 1e9 * np.array([20, 5, 1])
    read = []

    def counted(cloud, *arguments, chunks=Cloud.chunks):
        for chunk in chunks(cloud, *arguments):
            read.append(len(chunk))
            yield chunk

    monkeypatch.setattr(Cloud, "chunks", counted)
    a, b = (
        Cloud(
            (ranges + longer)[:, None] * rays @ turned + starts * (coordinates == "world"),
            {**columns, "time": time},
            sweeps=lambda: sweeps,
        )
        for longer in (0.03, 0.0)
        for turned in [sweeps.pose.rotations[0] if coordinates == "sensor" else np.eye(3)]
    )
    shown = []
    found = compare_surveys(a, b, method="pairs", on_progress=lambda *row: shown.append(row))
    delta_h, lengths = components(found, "delta_h", "range")
    assert lengths["count"] == len(time)
    assert lengths["mean_m"] == pytest.approx(0.03, abs=1e-6) and lengths["std_m"] < 1e-5
    assert delta_h["mean_m"] == pytest.approx(0.03 * rays[:, 2].mean(), abs=1e-5)
    apart = np.linalg.norm(found.points[:, None] - (starts + ranges[:, None] * rays), axis=2)
    assert apart.min(axis=0).max() < 1e-4 and apart.min(axis=1).max() < 1e-4
    assert shown[-1] == ("reading cloud B", 60, 60, "sweeps")
    assert sum(read) < 3 * 2 * len(time), "no sweep is searched for in a larger chunk"


def test_points_without_a_time_are_counted():
    points = plane(800)
    time = np.arange(800.0)
    time[5:12] = np.nan
    a = cloud(points, gps_time=np.arange(800.0))
    found = compare_surveys(a, cloud(points, gps_time=time))
    assert components(found, "delta_e")["count"] == 793
    assert found.figures["unpaired"] == {"a": 7, "b": 0}
    note = "the comparison excludes 7 points of cloud B with a gps time that is not finite"
    assert note in found.figures["notes"]


def test_rows_of_floating_point_times_have_the_same_key_if_they_are_equal_to_a_tenth_microsecond():
    key = pairs.PairKey(("gps_time",), has_ranges=False)
    from lidarsim.columns.sweep import Sweep

    times = 3.2e8 + np.arange(5) * 1e-6
    first, second = (
        key.of(Sweep(np.zeros((5, 3)), {"gps_time": times + shift})).keys for shift in (0, 2e-8)
    )
    assert len(set(first.tolist())) == 5
    assert np.array_equal(first, second)


# -- planes and M3C2 ------------------------------------------------------------------------------


def test_a_tilted_plane_has_the_distances_of_its_angle():
    tilt_deg = 1.5
    tilted = plane(tilt_deg=tilt_deg, seed=6)
    found = compare_surveys(cloud(tilted), cloud(plane()), method="planes", max_distance_m=5)
    heights = (tilted[:, 0] - ORIGIN[0]) * np.tan(np.radians(tilt_deg))
    one = components(found, "distance")
    assert one["count"] > 0.99 * len(tilted)
    assert one["mean_m"] == pytest.approx(heights.mean(), rel=0.01)
    assert one["max_m"] == pytest.approx(heights.max(), rel=0.01)
    below = compare_surveys(cloud(plane()), cloud(tilted), method="planes", max_distance_m=5)
    expected = -np.sin(np.radians(tilt_deg)) * (plane()[:, 0] - ORIGIN[0]).mean()
    assert components(below, "distance")["mean_m"] == pytest.approx(expected, rel=0.01)


def sheet(along, across, count=6000, *, seed, front=0.0, noise=0.0):
    """Points of a rectangle between two vectors, shifted along its normal (along x across)."""
    along, across = np.array(along, float), np.array(across, float)
    rng = np.random.default_rng(seed)
    shares = rng.uniform(0, 1, (count, 2))
    normal = np.cross(along, across)
    normal /= np.linalg.norm(normal)
    offsets = front + rng.normal(0, noise, count)
    return shares @ np.stack([along, across]) + offsets[:, None] * normal


# Rectangles whose normals face the side on which distances are positive by default.
SHEETS = {
    "wall to the east": ((-3, 12, 0), (-0.1, 0, 4)),
    "wall to the west": ((2, 9, 0), (0.1, 0, 4)),
    "wall to the north": ((-9, 0, 0), (0, 0.1, 4)),
    "overhanging wall": ((0, 12, 0), (0.1, 0, 4)),
    "slope": ((12, 0, 5), (2, 9, 0)),
    "ground": ((12, 0.1, 0), (0, 9, 0.1)),
}
METHODS = [
    "planes",
    pytest.param(
        "m3c2",
        marks=[
            pytest.mark.extended,
            pytest.mark.skipif(find_spec("py4dgeo") is None, reason="py4dgeo is not installed"),
        ],
    ),
]


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("name", SHEETS)
@pytest.mark.parametrize("front", [0.02, -0.03])
def test_distances_from_a_surface_have_one_sign(method, name, front):
    a, b = (
        sheet(*SHEETS[name], seed=seed, front=shift, noise=0.001)
        for seed, shift in ((7, front), (8, 0))
    )
    found = compare_surveys(cloud(a + ORIGIN), cloud(b + ORIGIN), method=method, radius_m=0.6)
    one = components(found, "distance")
    assert one["mean_m"] == pytest.approx(front, abs=2e-4)
    assert one["std_m"] < 0.0015
    if method == "m3c2":  # both signs exceed the level of detection
        level = found.figures["level_of_detection"]
        assert level["significant"] > 0.95 * level["core_points"]


def tube(radius, count=20_000, *, seed, height=0.0):
    """Points of a tunnel that rises to the east."""
    rng = np.random.default_rng(seed)
    angles, x = rng.uniform(0, 2 * np.pi, count), rng.uniform(0, 30, count)
    return np.column_stack([x, radius * np.cos(angles), height + radius * np.sin(angles) + 0.2 * x])


def chamber(size, count=20_000, *, seed):
    """Points of the six sides of a room whose center is at the origin."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-0.5, 0.5, (count, 3))
    side = rng.integers(0, 6, count)
    points[np.arange(count), side % 3] = side // 3 - 0.5
    return points * size


def mast(radius, count=8000, *, seed):
    rng = np.random.default_rng(seed)
    angles, z = rng.uniform(0, 2 * np.pi, count), rng.uniform(0, 20, count)
    return np.column_stack([radius * np.cos(angles), radius * np.sin(angles), z])


SOLIDS = {
    # Rooms and tunnels face inward, so larger ones have negative distances.
    "tunnel": (lambda grown, seed: tube(3 + grown, seed=seed), -1),
    "room": (lambda grown, seed: chamber(np.array([9, 6, 4]) + 2 * grown, seed=seed), -1),
    "mast": (lambda grown, seed: mast(2 + grown, seed=seed), 1),
}


@pytest.mark.parametrize("name", SOLIDS)
@pytest.mark.parametrize("grown", [0.1, -0.1])
def test_the_sides_of_a_solid_face_inward_or_outward_together(name, grown):
    points, sign = SOLIDS[name]
    a, b = cloud(points(grown, 9) + ORIGIN), cloud(points(0.0, 10) + ORIGIN)
    found = compare_surveys(a, b, method="planes", radius_m=0.5)
    one = components(found, "distance")
    assert one["median_m"] == pytest.approx(sign * grown, abs=0.015)
    distances = found.components["distance"]
    assert np.mean(np.sign(distances) == np.sign(sign * grown)) > 0.995


def write_ptx(path, *scans):
    """Write scans, each a scanner position and points in world coordinates, with identical axes."""
    with path.open("w") as file:
        for position, points in scans:
            axes = "1 0 0\n0 1 0\n0 0 1\n"
            rows = "1 0 0 0\n0 1 0 0\n0 0 1 0\n" + " ".join(map(str, position)) + " 1\n"
            file.write(f"{len(points)}\n1\n" + " ".join(map(str, position)) + "\n" + axes + rows)
            np.savetxt(file, np.column_stack([points - position, np.ones(len(points))]), "%.5f")
    return path


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("scanned", ["a", "b"])
@pytest.mark.parametrize("above", [True, False])
def test_distances_are_positive_toward_the_scanner(tmp_path, method, scanned, above):
    # A slab that is thinner than the radius, scanned from above or from below, which moved up.
    station = np.array([2.0, -3.0, 4.0 if above else -4.0]) + ORIGIN
    clouds = {
        key: ORIGIN + sheet((12, 0, 1), (0, 9, 0), seed=seed, front=front, noise=0.001)
        for key, seed, front in (("a", 3, 0.03), ("b", 4, 0.0))
    }
    sources = {key: cloud(points) for key, points in clouds.items()}
    sources[scanned] = write_ptx(tmp_path / "scanned.ptx", (station, clouds[scanned]))
    found = compare_surveys(sources["a"], sources["b"], method=method, radius_m=0.5)
    one = components(found, "distance")
    assert one["mean_m"] == pytest.approx(0.03 if above else -0.03, abs=2e-4)
    assert one["std_m"] < 0.0015


def test_both_sides_of_a_thin_wall_face_their_stations(tmp_path):
    # The wall becomes thicker by 3 cm on the side of the first station, and thinner on the other.
    stations = np.array([[8.0, 5, 2], [-9.0, 4, 1]]) + ORIGIN
    sides = [
        (sheet((0, 12, 0), (0, 0, 4), seed=11), (0.03, 0.0, 0.0)),
        (sheet((0, 12, 0), (0, 0, 4), seed=12) - (0.15, 0, 0), (0.02, 0.0, 0.0)),
    ]
    files = [
        write_ptx(
            tmp_path / f"{number}.ptx",
            *(
                (station, points + ORIGIN + number * np.array(moved))
                for station, (points, moved) in zip(stations, sides, strict=True)
            ),
        )
        for number in (1, 0)
    ]
    found = compare_surveys(*files, method="planes", radius_m=0.12, max_distance_m=0.06)
    east = found.points[:, 0] > ORIGIN[0] - 0.07
    distances = found.components["distance"]
    assert np.allclose(distances[east], 0.03, atol=1e-4)
    assert np.allclose(distances[~east], -0.02, atol=1e-4)
    assert 0.4 < east.mean() < 0.6


@pytest.mark.parametrize("known", [1.0, 0.1])
def test_normals_face_the_scanner_of_their_surface(known):
    """Two walls between which a scanner stands, and one behind it that another scanner sees.

    The signs of the normals are random, and the points of the walls are mixed.
    """
    rng = np.random.default_rng(8)
    walls = [(-4.0, (1, 2, 0)), (5.0, (1, 2, 0)), (12.0, (20, 0, 0))]
    points = np.concatenate(
        [sheet((0, 9, 0), (0, 0, 3), 600, seed=3) + np.array([x, 0, 0]) for x, _ in walls]
    )
    scanners = np.repeat(np.array([scanner for _, scanner in walls], float), 600, axis=0)
    expected = np.sign(scanners[:, :1] - points[:, :1]) * [1.0, 0, 0]
    normals = expected * rng.choice([-1, 1], (1800, 1))
    scanners[rng.random(1800) >= known] = np.nan
    order = rng.permutation(1800)[:-9]
    kept, others = order[9:], order[:9]
    oriented = OrientedPoints.from_normals(points[kept], normals[kept], scanners[kept], 0.3)
    assert np.array_equal(oriented.normals, expected[kept])
    for there in (scanners[others], np.full((9, 3), np.nan), None):
        assert np.array_equal(
            oriented.orient(points[others], normals[others], there), expected[others]
        )


@pytest.mark.parametrize("counts", [(1000,) * 8, (300, 5000, 20, 1500, 1180)])
def test_a_sample_is_even_if_the_number_of_points_is_unknown(counts):
    parts = [Sweep(np.full((count, 3), number + 1.0)) for number, count in enumerate(counts)]
    scans = MadeCloud("scans", parts)
    points, notes = SurveyCloud("scans", (scans,), None).sample(2000)
    found = np.bincount(points.positions[:, 0].astype(int) - 1)
    np.testing.assert_allclose(found, np.array(counts) / 4, atol=3)
    assert notes == ["25 % of the points in scans are used, sampled evenly"]


def swept(points, scans, poses):
    """A result whose sensor has one sweep at each pose, with ten scans each."""
    survey = Survey(Sensor.grid(360, 4), poses=poses, steps=10)
    sweeps = replace(Sweeps.from_survey(survey, Scene.seed()), coordinates="world")
    columns = {"scan": scans, "channel": 0 * scans, "object": 0 * scans}
    return Cloud(points, columns, sweeps=lambda: sweeps)


@pytest.mark.parametrize("moved", [0.04, -0.04])
def test_distances_are_positive_toward_the_poses_of_sweeps(moved):
    # Sweep 0 is above the slab, and sweep 1 is below it. Each of them sees one half.
    scans = np.repeat([3, 14], 3000)
    halves = [sheet((6, 0, 0), (0, 9, 0.5), 3000, seed=seed) for seed in (1, 2)]
    points = np.concatenate([halves[0] - (6.5, 0, 0), halves[1] + (0.5, 0, 0)])
    poses = [(-4.0, 3.0, 2.0), (4.0, 5.0, -3.0)]
    b = swept(points, scans, poses)
    found = compare_surveys(
        cloud(points + np.array([0, 0, moved])), b, method="planes", radius_m=0.5
    )
    expected = moved * np.cos(np.arctan2(0.5, 9)) * np.where(found.points[:, 0] < 0, 1, -1)
    assert len(expected) > 5900
    assert np.allclose(found.components["distance"], expected, atol=1e-6)


@pytest.mark.parametrize("batch", [70, 1000])
def test_points_without_a_counterpart_are_counted(monkeypatch, batch):
    monkeypatch.setattr(planes, "_BATCH", batch)
    far = np.concatenate([plane(500), plane(100) + np.array([0, 0, 5])])
    far = far[np.random.default_rng(22).permutation(600)]
    found = compare_surveys(cloud(far), cloud(plane()), method="planes", max_distance_m=2)
    assert found.figures["without_counterpart"] == 100
    assert components(found, "distance")["count"] + found.figures["without_plane"] == 500


@pytest.mark.extended
@pytest.mark.skipif(find_spec("py4dgeo") is None, reason="py4dgeo is not installed")
def test_m3c2_finds_a_shift_and_what_is_above_the_level_of_detection():
    noise = 0.01
    a, b = plane(seed=8, height=0.04, noise=noise), plane(noise=noise)
    found = compare_surveys(cloud(a), cloud(b), method="m3c2", radius_m=0.8)
    one = components(found, "distance")
    level = found.figures["level_of_detection"]
    assert one["mean_m"] == pytest.approx(0.04, abs=0.001)
    # Lague et al. 2013: 1.96 sqrt(s1² / n1 + s2² / n2), with the points of a cylinder.
    per_cylinder = 10 * np.pi * 0.8**2
    expected = 1.96 * np.sqrt(2 * noise**2 / per_cylinder)
    assert level["median_m"] == pytest.approx(expected, rel=0.1)
    assert one["count"] - 2 < level["core_points"] <= one["count"]
    assert level["significant"] >= level["core_points"] - 2
    same = compare_surveys(cloud(plane(seed=9, noise=noise)), cloud(b), method="m3c2", radius_m=0.8)
    level = same.figures["level_of_detection"]
    assert level["significant"] < 0.12 * level["core_points"]


def test_m3c2_omits_core_points_without_a_plane():
    """py4dgeo does not set the normals of points with less than two neighbors."""
    rng = np.random.default_rng(1)
    b = plane(noise=0.01)
    alone = rng.uniform(20, 90, (40, 3))
    b = np.concatenate([b, alone, alone[:5] + 0.1])
    a = b + np.array([0, 0, 0.01])
    found = compare_surveys(cloud(a), cloud(b), method="m3c2", radius_m=0.8)
    assert len(alone) <= found.figures["without_plane"] <= len(alone) + 5
    assert components(found, "distance")["mean_m"] == pytest.approx(0.01, abs=0.003)
    with pytest.raises(LidarError, match="two neighbors"):
        compare_surveys(cloud(b), cloud(alone), method="m3c2", radius_m=0.8)


# -- meshes ---------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def ball(tmp_path_factory):
    file = tmp_path_factory.mktemp("ball") / "ball.ply"
    mesh = trimesh.creation.icosphere(subdivisions=4, radius=5.0)
    mesh.apply_translation((10, 20, 30))
    mesh.export(file)
    return file


@pytest.mark.parametrize("offset", [0.2, -0.2])
def test_points_outside_a_sphere_are_positive_and_points_inside_negative(ball, offset):
    directions = np.random.default_rng(10).normal(size=(2000, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    found = compare_surveys(cloud(directions * (5 + offset) + (10, 20, 30)), ball)
    one = components(found, "distance")
    assert found.figures["method"] == "mesh" and found.figures["is_closed"]
    # The triangles are up to 5 (1 - cos 2.4°) = 4 mm inside the sphere.
    assert offset <= one["mean_m"] <= offset + 0.005
    assert np.sign(one["min_m"]) == np.sign(one["max_m"]) == np.sign(offset)


def test_an_open_mesh_is_positive_in_front_of_its_triangles(tmp_path):
    corners = np.array([[0, 0, 0], [20, 0, 0], [20, 20, 0], [0, 20, 0]], float)
    trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], process=False).export(tmp_path / "ground.stl")
    points = plane(500, height=0.03) - ORIGIN
    found = compare_surveys(cloud(points), tmp_path / "ground.stl", method="mesh")
    assert components(found, "distance")["mean_m"] == pytest.approx(0.03, abs=1e-9)
    assert any("is not closed" in note for note in found.figures["notes"])
    in_mm = compare_surveys(cloud(points / 1000), tmp_path / "ground.stl", unit_b="mm")
    assert components(in_mm, "distance")["mean_m"] == pytest.approx(0.03e-3, abs=1e-9)


# -- strips ---------------------------------------------------------------------------------------


def test_strips_have_the_height_difference_between_them():
    first, second = plane(8000, tilt_deg=8), plane(8000, seed=11, tilt_deg=8, height=-0.07)
    for points in (first, second):
        points[:, 2] += 0.3 * (points[:, 1] - ORIGIN[1])
    found = compare_strips(cloud(first), cloud(second[second[:, 1] > ORIGIN[1] + 10]), cell_m=2.0)
    (overlap,) = found.figures["overlaps"]
    assert (overlap["a"], overlap["b"]) == ("cloud 1", "cloud 2")
    assert overlap["count"] == 50 and overlap["area_m2"] == 200
    for name in ("mean_m", "median_m", "rmse_m", "p95_abs_m"):
        assert overlap[name] == pytest.approx(0.07, abs=1e-6)


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_heights_of_strips_that_are_tilted_against_each_other_are_compared_in_between(order):
    # In each cell of 2 m, the points of the strips are on opposite sides, and off center.
    rng = np.random.default_rng(31)
    ranges = [((0.1, 0.2), (1.5, 1.6)), ((0.55, 0.5), (1.9, 1.7))]
    slopes = np.array([[0.05, -0.03], [-0.04, 0.08]])
    cells = np.stack(np.meshgrid(np.arange(7), np.arange(4)), axis=-1).reshape(-1, 2)
    strips, means = [], []
    for (low, high), slope, height in zip(ranges, slopes, (0.0, 0.3), strict=True):
        within = rng.uniform(low, high, (len(cells), 150, 2))
        positions = 2 * cells[:, None] + within
        means.append(positions.mean(axis=1))
        strips.append(np.dstack([positions, height + positions @ slope]).reshape(-1, 3))
    middle = (means[0] + means[1]) / 2
    expected = middle @ (slopes[0] - slopes[1]) - 0.3
    origin = ORIGIN - (0, 0, 7)
    clouds = [cloud(strips[number] + origin) for number in order]
    found = compare_strips(*clouds, cell_m=2.0)
    assert np.ptp(expected) > 1.5
    key = {tuple(center): value for center, value in zip(cells * 2 + 1, expected, strict=True)}
    local = np.round(found.points[:, :2] - origin[:2]).astype(int)
    sign = 1 if order == (0, 1) else -1
    assert len(local) == len(cells)
    for center, difference in zip(local, found.components["delta_h"], strict=True):
        assert difference == pytest.approx(sign * key[tuple(center)], abs=1e-6)
    (overlap,) = found.figures["overlaps"]
    assert (overlap["a"], overlap["b"]) == ("cloud 1", "cloud 2")
    assert overlap["min_m"] == pytest.approx(min(sign * expected), abs=1e-6)
    assert overlap["area_m2"] == 4 * len(cells)


def test_strips_of_a_file_are_its_point_sources_and_rough_cells_are_omitted(tmp_path):
    rng = np.random.default_rng(12)
    ground = [plane(3000, seed=seed, height=h) for seed, h in ((13, 0.0), (14, 0.05), (15, -0.02))]
    tree = plane(500, side=4.0, seed=16) + np.column_stack(
        [*np.zeros((2, 500)), 9 * rng.random(500)]
    )
    points = np.concatenate([*ground, tree])
    sources = np.repeat([3, 7, 9, 7], [3000, 3000, 3000, 500])
    found = compare_strips(write_las(tmp_path / "flight.laz", points, sources), cell_m=2.0)
    expected = {("3", "7"): -0.05, ("3", "9"): 0.02, ("7", "9"): 0.07}
    for overlap in found.figures["overlaps"]:
        difference = expected.pop((overlap["a"], overlap["b"]))
        assert overlap["median_m"] == pytest.approx(difference, abs=0.001)
        assert overlap["count"] == (96 if "7" in (overlap["a"], overlap["b"]) else 100)
    assert not expected and found.figures["rough_cells"] == 8


def test_returns_of_split_pulses_are_not_used_for_strips():
    first = plane(3000)
    branches = plane(3000, seed=17, height=0.09)
    both = np.concatenate([plane(3000, seed=18, height=0.02), branches])
    returns = np.repeat([1, 2], 3000).astype(np.uint8)
    found = compare_strips(cloud(both, returns=returns), cloud(first), cell_m=2.0)
    assert found.figures["single_returns"] == 6000
    assert found.figures["overlaps"][0]["mean_m"] == pytest.approx(0.02, abs=1e-6)


def test_one_strip_and_strips_apart_are_refused():
    with pytest.raises(LidarError, match="contains 1 strip, and at least two are required"):
        compare_strips(cloud(plane(500)))
    with pytest.raises(LidarError, match="No two strips have cells of 1 m in common"):
        compare_strips(cloud(plane(500)), cloud(plane(500) + np.array([100, 0, 0])))


@pytest.mark.parametrize(
    ("cell_m", "noise_m", "says"),
    [
        (500.0, 0.0, r"in a small part of cells of 500 m, or on a line\. Reduce `--cell`"),
        (2.0, 0.5, r"rougher than 0\.\d+ m\. Increase `--max-roughness`, or reduce `--cell`"),
        (0.5, 0.0, r"fewer than 5 points of each strip\. Increase `--cell`"),
    ],
)
def test_what_makes_strips_comparable_is_told(cell_m, noise_m, says):
    noise = np.random.default_rng(3).normal(0, noise_m, (2, 500))
    first, second = (plane(500) + [[0, 0, z] for z in heights] for heights in noise)
    with pytest.raises(LidarError, match=says):
        compare_strips(cloud(first), cloud(second), cell_m=cell_m)


# -- what is refused, and files -------------------------------------------------------------------


def write_las(path, points, sources=None, epsg=None):
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.scales, header.offsets = np.full(3, 1e-4), np.floor(points.mean(axis=0))
    if epsg is not None:
        wkt = CRS.from_epsg(epsg).to_wkt()
        header.vlrs.append(laspy.vlrs.known.WktCoordinateSystemVlr(wkt))
        header.global_encoding.wkt = True
    data = laspy.LasData(header)
    data.x, data.y, data.z = points.T
    data.gps_time = np.arange(len(points)) * 1e-5
    data.return_number = data.number_of_returns = np.ones(len(points), np.uint8)
    if sources is not None:
        data.point_source_id = sources
    data.write(path)
    return path


def in_result(path, points, origin):
    """Write points to the folder of a result with a world origin."""
    path.mkdir()
    (path / "report.json").write_text(json.dumps({"parameters": {"world_origin": [*origin]}}))
    return write_las(path / "cloud.las", points)


@pytest.mark.parametrize("placed", ["a", "b"])
@pytest.mark.parametrize("method", ["pairs", "planes", "strips", "sweeps"])
def test_the_world_origin_of_a_result_is_added_to_local_coordinates(tmp_path, placed, method):
    local = plane(900, tilt_deg=4) - ORIGIN
    points = {"a": local + SHIFT, "b": local}
    files = {
        key: in_result(tmp_path / key, points[key] + ORIGIN, ORIGIN)
        if key == placed
        else write_las(tmp_path / "local.las", points[key])
        for key in "ab"
    }
    note = (
        rf"the world origin of .*{placed}.cloud\.las, \(500000, 5800000, 100\) m, is added to the "
        r"coordinates of .*local\.las$"
    )
    if method == "sweeps":
        found = compare(files["a"], files["b"])
        assert found.figures["distances"]["a_to_b"]["max_m"] < 0.07
    elif method == "strips":
        found = compare_strips(files["a"], files["b"], cell_m=4)
        height = SHIFT[2] - np.tan(np.radians(4)) * SHIFT[0]
        assert components(found, "delta_h")["mean_m"] == pytest.approx(height, abs=1e-4)
    else:
        found = compare_surveys(files["a"], files["b"], method=method)
        heights = components(found, "delta_h" if method == "pairs" else "distance")
        assert heights["mean_m"] == pytest.approx(0.05, abs=0.003)
    assert any(re.match(note, text) for text in found.figures["notes"])


def test_the_world_origin_is_not_added_to_world_coordinates(tmp_path):
    points = plane(900)
    a = in_result(tmp_path / "a", points, (3.0, -4.0, 0.0))
    found = compare_surveys(a, write_las(tmp_path / "b.las", points + SHIFT), method="pairs")
    assert components(found, "delta_h")["mean_m"] == pytest.approx(-0.05, abs=1e-4)
    assert not any("world origin" in note for note in found.figures["notes"])
    both = in_result(tmp_path / "b", points, (3.0, -4.0, 0.0))
    assert not any("world origin" in note for note in compare_surveys(a, both).figures["notes"])


@pytest.mark.parametrize("name", ["scene.glb", "scene.ply"])
def test_a_mesh_in_local_coordinates_is_moved_to_the_world_origin(tmp_path, name):
    corners = np.array([[0, 0, 0], [20, 0, 0], [20, 20, 0], [0, 20, 0]], float)
    trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], process=False).export(tmp_path / name)
    a = in_result(tmp_path / "a", plane(500, height=-0.04), ORIGIN)
    found = compare_surveys(a, tmp_path / name, method="mesh", up_axis="z")
    one = components(found, "distance")
    assert one["count"] == 500
    assert one["mean_m"] == pytest.approx(-0.04, abs=1e-4) and one["std_m"] < 1e-4
    assert np.allclose(found.points.mean(axis=0), plane(500).mean(axis=0) - (0, 0, 0.04), atol=1e-3)
    start = f"the world origin of {a}, (500000, 5800000, 100) m, is added"
    assert any(note.startswith(start) for note in found.figures["notes"])
    (tmp_path / "a" / "report.json").unlink()
    with pytest.raises(LidarError, match=r"The nearest point is 5,\d\d\d,\d\d\d\.\d+ m away"):
        compare_surveys(a, tmp_path / name, method="mesh")


def test_different_coordinate_systems_are_refused(tmp_path):
    points = plane(300)
    a = write_las(tmp_path / "a.las", points, epsg=25832)
    b = write_las(tmp_path / "b.las", points, epsg=25833)
    with pytest.raises(
        LidarError, match=r"a.las has the coordinate system EPSG:25832, but .*b.las"
    ):
        compare_surveys(a, b)
    with pytest.raises(LidarError, match="EPSG:25833"):
        compare_strips(a, b)
    none = write_las(tmp_path / "none.las", points)
    found = compare_surveys(none, a)
    assert found.figures["coordinate_system"] == "EPSG:25832"
    assert any("is assumed to be in EPSG:25832" in note for note in found.figures["notes"])


def test_results_in_different_coordinate_systems_are_refused():
    survey = Survey(Sensor.grid(360, 4), poses=[(0, 0, 0)], steps=36)
    sweeps = replace(Sweeps.from_survey(survey, Scene.seed()), coordinates="world")
    columns = {name: np.zeros(100, int) for name in ("scan", "channel", "object")}
    a, b = (
        Cloud(plane(100), columns, sweeps=lambda epsg=epsg: replace(sweeps, epsg=epsg))
        for epsg in (25832, 25833)
    )
    with pytest.raises(LidarError, match="cloud A has the coordinate system EPSG:25832, but"):
        compare_surveys(a, b)


def test_different_units_are_refused(tmp_path):
    points = plane(300)
    np.savetxt(tmp_path / "feet.xyz", points)
    meters = tmp_path / "meters.xyz"
    np.savetxt(meters, points * 0.3048)
    found = compare_surveys(tmp_path / "feet.xyz", meters, unit_a="ft", method="planes", radius_m=2)
    assert abs(components(found, "distance")["mean_m"]) < 1e-6
    from lidarreal.comparing.surveys.survey_clouds import SurveyCloud, check_same_frame

    feet = SurveyCloud.open(tmp_path / "feet.xyz", "", unit="ft")
    feet = SurveyCloud(feet.name, feet.recordings, None)  # as if the file stated its unit
    with pytest.raises(LidarError, match=r"feet.xyz has the unit ft, but .*meters.xyz has m"):
        check_same_frame([feet, SurveyCloud.open(meters, "")])


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"method": "nearest"}, "method"),
        ({"method": "pairs", "radius_m": 1}, "`radius` does not apply to the method pairs"),
        ({"method": "mesh"}, "is not a mesh"),
        ({"method": "planes", "radius_m": 0}, "radius_m"),
        ({"method": "planes", "up_axis": "y"}, "`up-axis` does not apply"),
    ],
)
def test_wrong_options_are_refused(options, says):
    a = cloud(plane(200), time=np.arange(200))
    with pytest.raises(LidarError, match=says):
        compare_surveys(a, a, **options)


def test_clouds_that_are_apart_are_refused():
    with pytest.raises(LidarError, match=r"are 80\.\d+ m apart, so there is nothing to compare"):
        compare_surveys(cloud(plane(300)), cloud(plane(300) + np.array([100, 0, 0])))


def invoke(*arguments):
    return CliRunner().invoke(cli, ["compare", *map(str, arguments)])


def test_the_command_writes_a_table_maps_and_a_page(tmp_path):
    points = plane(900)
    a = write_las(tmp_path / "a.laz", points + SHIFT)
    b = write_las(tmp_path / "b.laz", points)
    done = invoke(a, b, "--survey", "pairs", "--out", tmp_path / "out")
    assert done.exit_code == 0, done.output
    assert "Δh               900      50.0" in done.output
    rows = [*csv.DictReader((tmp_path / "out" / "compare.csv").read_text().splitlines())]
    assert [row["component"] for row in rows] == ["delta_e", "delta_n", "delta_h", "horizontal"]
    assert float(rows[2]["rmse_m"]) == pytest.approx(0.05, abs=1e-4)
    figures = json.loads((tmp_path / "out" / "compare.json").read_text())
    assert figures["paired_by"] == "gps time, return number"
    page = (tmp_path / "out" / "compare.html").read_text()
    assert page.count("<svg") == 2 and "ΔE" in page and "95th percentile" in page
    for name in ("map", "histogram"):
        assert (tmp_path / "out" / f"compare-{name}.png").stat().st_size > 10_000


def building(seed, *, dent=0.0):
    """The ground around a building that is rotated by 25 degrees, and its four walls.

    The wall to the southeast, which is 16 m wide, is dented near its right end, seen from outside.
    """
    rng = np.random.default_rng(seed)
    ground = rng.uniform((-20, -20, 0), (20, 20, 0), (6000, 3))
    is_inside = (np.abs(ground[:, 0]) < 8) & (np.abs(ground[:, 1]) < 5)
    walls = []
    for start, along in (
        ((-8, -5), (16, 0)), ((8, -5), (0, 10)), ((8, 5), (-16, 0)), ((-8, 5), (0, -10)),
    ):  # fmt: skip
        shares = rng.uniform(0, 1, (3000, 2))
        wall = np.column_stack([np.array(start) + shares[:, :1] * along, 6 * shares[:, 1]])
        wall[np.hypot(wall[:, 0] - 5, wall[:, 2] - 2) < 1.5 * (along[0] > 0), 1] += dent
        walls.append(wall)
    points = np.concatenate([ground[~is_inside], *walls])
    c, s = np.cos(np.radians(25)), np.sin(np.radians(25))
    return points @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]) + ORIGIN


def test_facades_are_seen_from_the_front_and_the_scale_contains_a_small_change(tmp_path):
    for name, dent in (("before", 0.0), ("after", 0.15)):
        (tmp_path / name).mkdir()
        points = building(int(dent > 0), dent=dent)
        write_las(tmp_path / name / "cloud.laz", points, epsg=25832)
    a, b = tmp_path / "after" / "cloud.laz", tmp_path / "before" / "cloud.laz"
    arguments = ("--survey", "planes", "--out", tmp_path / "out", "--radius", 0.7)
    done = invoke(a, b, *arguments, "--points", tmp_path / "deviations.laz")
    assert done.exit_code == 0, done.output
    page = (tmp_path / "out" / "compare.html").read_text()
    title = re.search("<title>(.*?)</title>", page, re.DOTALL)[1]
    assert " ".join(title.split()) == "after/cloud.laz and before/cloud.laz"
    assert (tmp_path / "out" / "compare-facades.png").stat().st_size > 10_000

    written = laspy.read(tmp_path / "deviations.laz")
    assert open_recording(tmp_path / "deviations.laz").info.epsg == 25832
    found = compare_surveys(a, b, method="planes", radius_m=0.7)
    assert len(written.points) == len(found.points) > 14_000
    distances = found.components["distance"]
    assert np.allclose(np.sort(written["distance"]), np.sort(distances), atol=1e-6)
    front = np.array([np.sin(np.radians(25)), -np.cos(np.radians(25))])
    local = np.stack([written.x, written.y, written.z], axis=1) - ORIGIN
    dented = np.abs(local[:, :2] @ front - 4.85) < 0.005
    assert np.median(written["distance"][dented]) == pytest.approx(-0.15, abs=0.01)
    normals = np.stack([written["NormalX"], written["NormalY"]], axis=1)[dented]
    assert np.median(normals @ front) > 0.99

    charts = draw_facades(found.points, found.components, found.columns).figure.axes[:4]
    names = [axes.get_title(loc="left") for axes in charts]
    sides = dict(zip([name.removeprefix("facing ") for name in names], charts, strict=True))
    assert sides.keys() == {"southeast", "northeast", "northwest", "southwest"}
    (image,) = sides["southeast"].images
    left, right, bottom, top = image.get_extent()
    values = np.ma.filled(image.get_array(), 0)
    row, column = np.unravel_index(values.argmin(), values.shape)
    assert right - left == pytest.approx(16, abs=0.5)
    assert left + (column + 0.5) / values.shape[1] * (right - left) == pytest.approx(13, abs=1.5)
    assert bottom + (row + 0.5) / values.shape[0] * (top - bottom) == pytest.approx(102, abs=1.5)
    assert image.norm.vmax > 100, "mm: the scale contains the dent"
    for name in ("northeast", "northwest", "southwest"):
        others = sides[name].images[0].get_array().compressed()
        assert np.median(np.abs(others)) < 1, "mm: only one side is dented"


def test_hardly_any_steep_points_are_no_facade():
    found = compare_surveys(cloud(plane(900)), cloud(plane(900, seed=2)), method="planes")
    assert draw_facades(found.points, found.components, found.columns) is None


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["a", "b", "--points", "x.laz"], "`--points` requires `--survey`"),
        (["a", "b", "--survey", "planes", "--points", "x.pdf"], "its extension must be .laz,"),
        (["a"], "Missing argument 'B'"),
        (["a", "b", "c"], "More than two clouds require `--survey strips`"),
        (["a", "b", "--cell", "2"], "`--cell` requires `--survey`"),
        (["a", "b", "--cell", "2", "--radius", "1"], "`--radius` and `--cell` require `--survey`"),
        (["a", "b", "--survey", "pairs", "--cell", "2"], "`--cell` requires `--survey strips`"),
        (["a", "b", "--survey", "auto", "--sweep", "0"], "`--sweep` cannot be used"),
        (["a", "--survey", "strips", "--unit-a", "ft"], "`--unit-a` cannot be used"),
    ],
)
def test_options_of_another_kind_of_comparison_are_refused(arguments, says):
    done = invoke(*arguments)
    assert done.exit_code == 2
    assert says in " ".join(done.output.split())


@pytest.mark.parametrize("method", ["planes", "mesh"])
def test_the_progress_continues_after_the_clouds_are_read(tmp_path, monkeypatch, method):
    """Three batches of points, and for planes as many of reference points."""
    monkeypatch.setattr(f"lidarreal.comparing.surveys.{method}._BATCH", 300)
    x, y = np.meshgrid(np.arange(30.0), np.arange(30.0))
    plane = np.stack([x.ravel(), y.ravel(), np.zeros(900)], axis=1)
    b = Cloud(plane, {})
    if method == "mesh":
        b = tmp_path / "b.obj"
        b.write_text("v 0 0 0\nv 29 0 0\nv 29 29 0\nv 0 29 0\nf 1 2 3\nf 1 3 4\n")
    shown = []
    found = compare_surveys(
        Cloud(plane + np.array([0, 0, 0.02]), {}),
        b,
        method=method,
        radius_m=None if method == "mesh" else 2.5,
        on_progress=lambda *row: shown.append(row),
    )
    distance = found.figures["components"]["distance"]
    assert distance["mean_m"] == pytest.approx(0.02, abs=1e-6)
    what = "measuring distances" if method == "mesh" else "fitting planes"
    rows = [row for row in shown if not row[0].startswith("reading")]
    assert rows[-3:] == [(what, done, 900, "points") for done in (300, 600, 900)]
    surfaces = [row for row in rows if row[0] == "finding surfaces"]
    assert bool(surfaces) == (method == "planes")
    assert all(row[1] <= row[2] and row[3] == "planes" for row in surfaces)
