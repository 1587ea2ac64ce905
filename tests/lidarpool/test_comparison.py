"""Two clouds or recordings compared: figures against closed forms, formats, and what is wrong."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import laspy
import numpy as np
import pytest
from pypcd4 import PointCloud
from tests.drives import points_of, the_scene, the_sweeps, write_set

import lidarpool
from lidarfiles import save_cloud
from lidarfiles.clouds.recording import RayTimes
from lidarfiles.clouds.writing import ExportSpec
from lidarfiles.datasets.figures import rank_correlation
from lidarfiles.recordings.opening import open_recording
from lidarreal import compare
from lidarreal.comparing import comparison_charts, two_clouds
from lidarsim import Cloud, LidarError, Scene, Sensor, Survey
from lidarsim.sweeps.sweeps import Sweeps

RINGS = 16
COLUMNS = 720
ELEVATION = np.linspace(-15, 15, RINGS)
CELLS = RINGS * COLUMNS
ONE_SWEEP = replace(
    Sweeps.from_survey(Survey(Sensor.grid(360, RINGS), poses=[(0, 0, 0)], steps=36), Scene.seed()),
    coordinates="sensor",
)


def directions(azimuth_deg, elevation_deg):
    azimuth = np.radians(azimuth_deg)
    elevation = np.radians(elevation_deg)
    return np.stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth),
         np.sin(elevation) + 0 * azimuth], axis=-1,
    )  # fmt: skip


def room(azimuth_deg):
    """Ranges of a smooth room, (rings, columns)."""
    return 12 + 4 * np.cos(2 * np.radians(azimuth_deg)) + 0.1 * ELEVATION[:, None]


def cloud(
    ranges=None, *, azimuth=None, there=None, rings=None, light=None, names=("channel", "intensity")
):
    """A sweep of a spinning sensor, as a cloud in its axes."""
    azimuth = np.arange(COLUMNS) * 360 / COLUMNS + 0.1 if azimuth is None else azimuth
    azimuth = np.broadcast_to(azimuth, (RINGS, COLUMNS))
    ranges = room(azimuth) if ranges is None else ranges
    there = np.ones((RINGS, COLUMNS), bool) if there is None else there
    points = (ranges[..., None] * directions(azimuth, ELEVATION[:, None]))[there]
    rings = np.arange(RINGS) if rings is None else rings
    columns = {names[0]: np.broadcast_to(rings[:, None], there.shape)[there]}
    columns |= {name: np.zeros(len(points), int) for name in ("scan", "object")}
    if light is not None:
        columns[names[1]] = light[there]
    return Cloud(points, columns, sweeps=lambda: ONE_SWEEP)


AZIMUTH = np.arange(COLUMNS) * 360 / COLUMNS + 0.1
RANGES = room(AZIMUTH)


def of_image(a, b, **options):
    found = compare(a, b, **options)
    return found.figures["ranges"]


# -- closed forms ---------------------------------------------------------------------------------


def test_an_offset_is_the_residual_of_each_ring():
    found = compare(cloud(RANGES + 0.05), cloud())
    image = found.figures["ranges"]
    assert (len(image["rings"]), image["columns"]) == (RINGS, COLUMNS)
    assert image["azimuth_step_deg"] == pytest.approx(0.5, abs=1e-6)
    for told in (image["residual"], *image["rings"]):
        for name in ("bias_m", "median_m", "rmse_m", "p05_m", "p95_m"):
            assert told[name] == pytest.approx(0.05, abs=2e-6)
        assert told["mad_m"] < 2e-6
    assert [ring["ring"] for ring in image["rings"]] == list(range(RINGS))[::-1]
    assert [r["elevation_deg"] for r in image["rings"]] == pytest.approx(ELEVATION[::-1])
    assert image["no_return"]["returns_in_both"] == image["residual"]["cells"] == CELLS
    assert image["no_return"]["precision"] is None  # there is none to find


def test_noise_is_found_as_it_was_put_in():
    sigma = 0.02
    rng = np.random.default_rng(5)
    noisy = cloud(RANGES + rng.normal(0, sigma, RANGES.shape))
    told = of_image(noisy, cloud())["residual"]
    # Four standard deviations of each estimate.
    assert abs(told["bias_m"]) < 4 * sigma / np.sqrt(CELLS)
    assert told["rmse_m"] == pytest.approx(sigma, abs=4 * sigma / np.sqrt(2 * CELLS))
    assert told["mad_m"] == pytest.approx(0.67449 * sigma, abs=4 * 0.79 * sigma / np.sqrt(CELLS))
    assert told["p95_m"] == pytest.approx(1.64485 * sigma, abs=4 * 2.11 * sigma / np.sqrt(CELLS))
    again = cloud(RANGES + rng.normal(0, sigma, RANGES.shape))
    both = of_image(noisy, again)["residual"]
    assert both["rmse_m"] == pytest.approx(np.sqrt(2) * sigma, rel=4 / np.sqrt(2 * CELLS))


def test_lost_returns_are_counted_in_each_cell():
    rng = np.random.default_rng(7)
    sky = np.zeros((RINGS, COLUMNS), bool)
    sky[12:, 100:400] = True
    in_a, in_b = (~sky & (rng.uniform(size=sky.shape) >= share) for share in (0.2, 0.1))
    told = of_image(cloud(there=in_a), cloud(there=in_b))["no_return"]
    both = (~in_a & ~in_b).sum()
    only_a = (~in_a & in_b).sum()
    only_b = (in_a & ~in_b).sum()
    assert (told["in_both"], told["in_a_only"], told["in_b_only"]) == (both, only_a, only_b)
    precision = both / (~in_a).sum()
    recall = both / (~in_b).sum()
    assert told["precision"] == precision and told["recall"] == recall
    assert told["f1"] == pytest.approx(2 * precision * recall / (precision + recall))
    # With sky alone in B, and a share p lost of the other cells in A: sky / (sky + p (all - sky)).
    told = of_image(cloud(there=in_a), cloud(there=~sky))["no_return"]
    expected = sky.sum() / (sky.sum() + 0.2 * (~sky).sum())
    assert told["recall"] == 1 and told["precision"] == pytest.approx(expected, rel=0.05)


def test_rank_correlation_asks_for_the_order_alone():
    rng = np.random.default_rng(3)
    light = rng.uniform(0.1, 1, RANGES.shape)
    for other, expected in ((light**3 * 255, 1), (1 / light, -1)):
        found = compare(cloud(light=light), cloud(light=other))
        assert found.figures["intensity"]["rank_correlation"] == pytest.approx(expected)
        assert found.figures["intensity"]["of"] == "cells"
    # Ties have their mean rank: 1, 2.5, 2.5, 4 and 1.5, 1.5, 3, 4.
    assert rank_correlation(np.array([1, 2, 2, 3]), np.array([0, 0, 5, 9])) == pytest.approx(
        np.corrcoef([1, 2.5, 2.5, 4], [1.5, 1.5, 3, 4])[0, 1]
    )
    assert rank_correlation(np.ones(3), np.arange(3)) is None
    unlike = compare(cloud(light=light), cloud(light=rng.uniform(size=RANGES.shape)))
    assert abs(unlike.figures["intensity"]["rank_correlation"]) < 4 / np.sqrt(CELLS)
    assert compare(cloud(light=light), cloud()).figures["intensity"] is None


def test_distances_between_parallel_planes():
    x, y = np.meshgrid(np.arange(60) * 0.5, np.arange(50) * 0.5)
    plane = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
    far = np.array([650_000.0, 5_600_000.0, 100.0])  # of UTM
    a = Cloud(plane + far, {})
    b = Cloud(plane + far + [0, 0, 0.03], {})
    told = compare(a, b, distances_m=(0.05, 0.02)).figures
    for way in ("a_to_b", "b_to_a"):
        assert told["distances"][way]["points"] == 3000
        for name in ("mean_m", "median_m", "p99_m", "max_m"):
            assert told["distances"][way][name] == pytest.approx(0.03, abs=1e-6)
    assert told["distances"]["chamfer_m"] == pytest.approx(0.06, abs=1e-6)
    assert [(f["distance_m"], f["f1"]) for f in told["distances"]["f_scores"]] == [
        (0.02, 0.0), (0.05, 1.0),
    ]  # fmt: skip
    # Half of A has no B beside it: all that B has is found, half of what A has is right.
    half = b[plane[:, 0] < 15]
    score = compare(a, half, distances_m=[0.05]).figures["distances"]["f_scores"][0]
    assert (score["precision"], score["recall"]) == (0.5, 1.0)
    assert score["f1"] == pytest.approx(2 / 3)
    assert told["ranges"] is None and "cloud A has no sweeps" in told["notes"][0]


# -- cells ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("shift", [0.04, 0.21, 0.25, 0.49])
def test_no_pulse_falls_between_cells(shift):
    """Pulses at other azimuths, with jitter, and offsets of rings, are in one cell each."""
    rng = np.random.default_rng(2)
    offsets = rng.uniform(-2, 2, RINGS)[:, None]
    turned = AZIMUTH + offsets + shift + rng.normal(0, 0.02, RANGES.shape)
    image = of_image(cloud(azimuth=turned), cloud(azimuth=AZIMUTH + offsets))
    told = image["no_return"]
    assert (told["returns_in_both"], told["in_both"]) == (CELLS, 0)
    assert image["hidden_points"] == {"a": 0.0, "b": 0.0}


def test_the_step_is_found_where_most_returns_are_lost():
    rng = np.random.default_rng(0)
    in_a, in_b = (rng.uniform(size=RANGES.shape) > share for share in (0.9, 0.3))
    image = of_image(cloud(RANGES + 0.01, there=in_a), cloud(there=in_b))
    assert image["azimuth_step_deg"] == pytest.approx(0.5, abs=1e-6)
    assert image["residual"]["rmse_m"] == pytest.approx(0.01, abs=1e-5)
    assert image["no_return"]["returns_in_both"] == (in_a & in_b).sum()
    # Every second azimuth is not a loss: the cells are those of the coarser one.
    even = np.arange(COLUMNS) % 2 == 0
    image = of_image(cloud(), cloud(there=np.broadcast_to(even, RANGES.shape)))
    assert image["azimuth_step_deg"] == pytest.approx(1, abs=1e-6)
    assert image["no_return"]["returns_in_both"] == CELLS / 2


def test_the_first_of_several_returns_counts():
    first = cloud()
    second = cloud(RANGES + 3)
    dual = Cloud.concatenate([second, first])
    image = of_image(dual, first)
    assert image["residual"]["rmse_m"] < 1e-6
    assert image["hidden_points"] == {"a": 0.5, "b": 0.0}


@pytest.mark.parametrize(
    ("numbers", "note"),
    [
        (np.arange(RINGS) + 1, "ring n of A corresponds to ring n - 1 of B"),
        (RINGS - 1 - np.arange(RINGS), "ring n of A corresponds to ring 15 - n of B"),
        (
            np.arange(RINGS) * 7 % RINGS,
            "the rings of the two clouds are numbered in different orders",
        ),
    ],
)
def test_rings_are_matched_whatever_their_numbers(numbers, note):
    found = compare(cloud(RANGES + 0.05, rings=numbers), cloud())
    image = found.figures["ranges"]
    assert [ring["ring"] for ring in image["rings"]] == list(range(RINGS))[::-1]
    assert image["residual"]["mad_m"] < 2e-6 and image["residual"]["cells"] == CELLS
    assert [text for text in found.figures["notes"] if text.startswith(note)]


def test_what_has_no_range_image_says_why():
    made = cloud()
    ringless = {name: made[name] for name in ("scan", "object")}
    scattered = np.random.default_rng(8).normal(0, 10, (CELLS, 3))
    whole = Cloud(made.positions, made.columns)  # without sweeps, although zero is the sensor
    far = np.array([500_000, 5_400_000, 300])  # of UTM
    for a, b, says in (
        (
            replace(made, positions=scattered, columns=ringless),
            made,
            "cloud A has no ring column, such as `ring` or `channel`",
        ),
        (
            made,
            replace(made, positions=made.positions + 30),
            "elevation angles within the rings of cloud B vary",
        ),
        (
            made,
            replace(made, positions=made.positions + far),
            "cloud B are 5,423 km from the origin",
        ),
        (made, replace(made, positions=made.positions * [1, 1, 9]), "come from different sensors"),
        (whole, whole, "cloud A has no sweeps, so all points are compared at once in world"),
        (made, whole, "cloud B has no sweeps"),
    ):
        found = compare(a, b).figures
        assert found["ranges"] is None and found["distances"]["a_to_b"]["points"] == CELLS
        assert any(says in note for note in found["notes"]), found["notes"]


def test_of_many_points_and_cells_some_are_compared(monkeypatch):
    monkeypatch.setattr(two_clouds, "MAX_VALUES", 2000)
    rng = np.random.default_rng(5)
    found = compare(cloud(RANGES + rng.normal(0, 0.02, RANGES.shape)), cloud()).figures
    assert found["ranges"]["residual"]["cells"] == 2000
    assert found["ranges"]["no_return"]["returns_in_both"] == CELLS
    assert found["ranges"]["residual"]["rmse_m"] == pytest.approx(0.02, rel=0.07)
    assert "2,000 points and cells" in found["notes"][0]
    whole = Cloud(cloud().positions, {})
    thin = compare(whole, whole, max_points=3000).figures
    assert thin["a"]["points"] == 3000 and "26 % of the 11,520 points" in thin["notes"][1]
    assert "from 2,000 points of each cloud" in thin["notes"][3]
    assert thin["distances"]["a_to_b"]["points"] == 2000


# -- formats --------------------------------------------------------------------------------------

LAYERS = 16
SENSOR = Sensor.grid(360, LAYERS)
SURVEY = Survey(SENSOR, poses=[(0, 0, 1), (5, 2, 1.5), (9, 9, 1)], steps=36, precision_m=1e-4)


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """A survey of three sweeps in all formats: a result's folder, and what is exported of it."""
    folder = tmp_path_factory.mktemp("result")
    sweeps = Sweeps.from_survey(SURVEY, Scene.seed())
    azimuth = np.arange(360)[:, None]
    elevation = np.linspace(-30, 30, LAYERS)
    ranges = 10 + 2 * np.sin(np.radians(azimuth)) + 0 * elevation
    inside = ranges[..., None] * directions(azimuth + 0 * elevation, elevation)
    clouds = []
    for pose, begin in zip(sweeps.pose.positions, sweeps.begins_ns, strict=True):
        channel = np.broadcast_to(np.arange(LAYERS), ranges.shape).ravel()
        light = (0.2 + 0.1 * np.cos(np.radians(azimuth)) + 0.01 * np.arange(LAYERS)).ravel()
        scan = (
            np.repeat(np.arange(36), 10)[:, None]
            + 36 * len(clouds)
            + 0 * channel.reshape(-1, LAYERS)
        )
        columns = {
            "scan": scan.ravel(),
            "channel": channel,
            "object": 0 * channel,
            "intensity": light,
            "time": (begin + 1000 * scan.ravel()).astype(np.int64),
        }
        clouds.append(Cloud(inside.reshape(-1, 3) + pose, columns))  # fmt: skip
    made = Cloud.concatenate(clouds)
    for name in ("ply", "laz", "las", "pcd", "mcap", "rosbag2"):
        one = ExportSpec(name)
        one.write(folder / one.row.file, made, sweeps)
    sweeps.save(folder / "sweeps.npz")
    (folder / "bare.ply").write_bytes((folder / "cloud.ply").read_bytes())
    lines = ["ply", "format ascii 1.0", f"element vertex {len(made)}"]
    lines += [f"property float {name}" for name in ("x", "y", "z", "intensity")] + ["end_header"]
    rows = np.column_stack([made.positions, made.intensity])
    lines += [" ".join(f"{value:.6f}" for value in row) for row in rows]
    (folder / "text").mkdir()
    (folder / "text/text.ply").write_text("\n".join(lines) + "\n")
    return folder, made, sweeps


@pytest.mark.parametrize("name", ["pcd", "cloud.mcap", "rosbag2", "cloud.ply"])
def test_sweeps_of_each_format_are_those_of_the_result(written, name):
    folder, made, _ = written
    found = compare(folder / name, folder).figures
    image = found["ranges"]
    assert found["pairs"] == 3 and found["a"]["sweeps"] == 3 and not found["notes"]
    assert image["no_return"]["returns_in_both"] == found["b"]["points"] == len(made)
    assert image["no_return"]["in_both"] == 0
    assert image["residual"]["rmse_m"] < 1e-4
    assert found["intensity"]["rank_correlation"] == pytest.approx(1, abs=1e-6)
    assert found["distances"]["a_to_b"]["max_m"] < 3e-4
    one = compare(folder / name, folder, sweeps=[1])
    assert one.figures["pairs"] == 1 and one.figures["a"]["points"] == len(made) // 3
    assert one.figures["a"]["compared_sweeps"] == one.figures["b"]["compared_sweeps"] == [1]
    assert repr(one).count(f"{len(made) // 3:,} points, sweep 1 of 3") == 2
    two = repr(compare(folder / name, folder, sweeps=[0, 2]))
    assert two.count("points, 2 of 3 sweeps") == 2 and "A has" not in two


def test_sweeps_left_over_are_noted_unless_sweeps_are_chosen(written, tmp_path):
    folder, _, _ = written
    for name in ("000000.pcd", "000001.pcd"):
        (tmp_path / name).write_bytes((folder / "pcd" / name).read_bytes())
    found = compare(tmp_path, folder / "pcd")
    assert found.figures["notes"] == [
        "A has 2 sweeps and B has 3. Matching by order results in 2 pairs"
    ]
    head_a, head_b = repr(found).splitlines()[:2]
    assert head_a.endswith(" points, 2 sweeps")
    assert head_b.endswith(" points, 2 of 3 sweeps (the reference)")
    one = compare(tmp_path, folder / "pcd", sweeps=[1])
    assert one.figures["notes"] == []
    assert "sweep 1 of 2\n" in repr(one) and "sweep 1 of 3 (the reference)" in repr(one)


def test_intensities_have_one_scale_only_if_both_are_energies(written):
    folder, made, sweeps = written
    strong, weak = (
        Cloud(
            made.positions,
            {**made.columns, "intensity": made["intensity"] / factor},
            sweeps=lambda: sweeps,
        )
        for factor in (1, 100)
    )
    energies = compare(weak, strong)
    assert energies.figures["intensity"]["same_scale"]
    axes = comparison_charts.draw_distances(energies).figure.axes[1]
    assert (axes.get_xlabel(), axes.get_ylabel()) == (
        "intensity in B, energy",
        "intensity in A, energy",
    )
    assert axes.get_xlim() == axes.get_ylim()
    # Bags state their layout, which contains energies.
    assert compare(folder / "cloud.mcap", folder).figures["intensity"]["same_scale"]
    recorded = compare(folder / "cloud.laz", folder)
    assert not recorded.figures["intensity"]["same_scale"]
    axes = comparison_charts.draw_distances(recorded).figure.axes[1]
    assert (axes.get_xlabel(), axes.get_ylabel()) == (
        "intensity in B, scale of B",
        "intensity in A, scale of A",
    )


@pytest.mark.parametrize("name", ["cloud.las", "cloud.laz", "text/text.ply", "pcd/000000.pcd"])
def test_clouds_of_each_format_lie_on_the_result(written, name):
    folder, made, _ = written
    found = compare(folder / name, made).figures
    count = len(made) // 3 if name.endswith("pcd") else len(made)
    assert found["a"]["points"] == found["distances"]["a_to_b"]["points"] == count
    assert found["distances"]["a_to_b"]["max_m"] < 1e-3
    assert found["intensity"]["rank_correlation"] > 0.98
    assert found["intensity"]["of"] == "nearest points"


def test_a_survey_that_moved_is_compared_with_a_map(written):
    """Whole clouds are in the world: each sweep is brought there by its pose."""
    folder, made, sweeps = written
    inside = [sweeps.as_fired(k, points) for k, points in enumerate(sweeps.points(made))]
    own = replace(sweeps, coordinates="sensor")
    carried = Cloud(np.concatenate(inside), made.columns, sweeps=lambda: own)
    for a in (folder, folder / "pcd", folder / "cloud.mcap", carried):
        found = compare(a, folder / "cloud.laz").figures
        assert found["distances"]["b_to_a"]["points"] == len(made)
        assert max(found["distances"][way]["max_m"] for way in ("a_to_b", "b_to_a")) < 2e-3
        assert "cloud.laz has no sweeps" in found["notes"][0]


def test_sweeps_are_matched_by_time(written, tmp_path):
    folder, _, sweeps = written
    later = replace(sweeps, begins_ns=sweeps.begins_ns + 1e8)  # by one turn
    (tmp_path / "cloud.ply").write_bytes((folder / "cloud.ply").read_bytes())
    later.save(tmp_path / "sweeps.npz")
    found = compare(tmp_path, folder, match="time").figures
    assert found["pairs"] == 2
    assert found["notes"][0] == "A has 3 sweeps and B has 3. Matching by time results in 2 pairs"
    assert found["distances"]["a_to_b"]["max_m"] < 20  # one turn on: in the sensors' own axes
    with pytest.raises(LidarError, match=r"has no sweep times\. Omit `--match time`"):
        compare(folder / "pcd", folder, match="time")
    for name in ("0.pcd", "1.pcd"):
        (tmp_path / name).write_bytes((folder / "pcd/000000.pcd").read_bytes())
    (tmp_path / "cloud.ply").unlink()
    assert (
        compare(tmp_path, folder).figures["notes"][0]
        == "A has 2 sweeps and B has 3. Matching by order results in 2 pairs"
    )


def test_one_of_several_sensors_is_chosen(tmp_path):
    scene = the_scene()
    of = the_sweeps(scene)
    made = points_of(scene, 0)
    for name in ("ply", "mcap"):
        form = ExportSpec(name, compensated=name == "mcap")
        form.write(tmp_path / form.row.file, made, of)
    of.save(tmp_path / "sweeps.npz")
    bag = tmp_path / "cloud.mcap"
    for place, names in (
        (tmp_path, "sensors front and rear/left"),
        (bag, "/front/points and /rear"),
    ):
        with pytest.raises(LidarError, match=rf"{names}.*Choose one of them with `--sensor-a`\.$"):
            compare(place, tmp_path, sensor_b="front")
        with pytest.raises(LidarError, match=rf"{names}.*Choose one of them with `--sensor-b`\.$"):
            compare(tmp_path, place, sensor_a="front")
        with pytest.raises(LidarError, match=rf"{names}.*Choose one of them with `--sensor`\.$"):
            open_recording(place)
    found = compare(bag, tmp_path, sensor_a="/rear_left/points", sensor_b="rear/left").figures
    assert found["pairs"] == 3 and found["distances"]["a_to_b"]["max_m"] < 2e-3


@pytest.mark.parametrize("kind", ["kitti", "folder"])
def test_sweeps_of_data_sets(tmp_path, kind):
    scene = the_scene()
    write_set(tmp_path, kind, scene, the_sweeps(scene))
    found = compare(tmp_path, tmp_path, sensor_a="front", sensor_b="front").figures
    assert found["pairs"] == found["a"]["sweeps"] == 15  # of five jobs
    assert found["distances"]["a_to_b"]["max_m"] == 0
    assert "5 of 15 pairs of sweeps have an empty sweep and are skipped" in found["notes"]
    other = compare(tmp_path, tmp_path, sensor_a="front", sensor_b="rear/left", sweeps=[3]).figures
    assert other["pairs"] == 1 and other["distances"]["a_to_b"]["median_m"] > 1


def test_names_and_places_of_other_programs(tmp_path):
    """Numbers of beams by other names, no-returns as zeros and NaN, and any column as intensity."""
    made = cloud(light=np.broadcast_to(AZIMUTH, RANGES.shape))
    rows = np.vstack([made.positions, np.zeros((5, 3)), np.full((5, 3), np.nan)]).astype("f4")
    ring = np.append(made["channel"], np.zeros(10)).astype("u2")
    signal = np.append(made["intensity"], np.zeros(10)).astype("f4")
    arrays = [*rows.T, ring, signal]
    fields = ("x", "y", "z", "laser_id", "signal")
    file = PointCloud.from_points(arrays, fields, [one.dtype for one in arrays])
    file.save(tmp_path / "turn.pcd")
    found = compare(tmp_path / "turn.pcd", tmp_path, intensity_a="signal", intensity_b="signal")
    assert found.figures["ranges"]["no_return"]["returns_in_both"] == CELLS
    assert found.figures["intensity"]["rank_correlation"] == pytest.approx(1)
    with pytest.raises(LidarError, match=r"no column 'signl'.* Did you mean 'signal'\?"):
        compare(tmp_path, tmp_path, intensity_a="signl")


@pytest.mark.parametrize(
    ("is_ring_by_ring", "source"),
    [(True, "the order of the points"), (False, "the elevation angles of the points")],
)
def test_rings_of_kitti_are_found_in_its_points(tmp_path, is_ring_by_ring, source):
    """KITTI has no ring column; five points after the last ring belong to no ring."""
    pytest.importorskip("scipy", reason="the extra fit is not installed")
    rng = np.random.default_rng(4)
    there = rng.uniform(size=RANGES.shape) > 0.1
    for name, sweep in (("a", cloud(RANGES + 0.05)), ("b", cloud(there=there))):
        labels = np.zeros(len(sweep), np.uint8)
        columns = {**sweep.columns, "reflectivity": labels, "class": labels}
        made = Cloud(sweep.positions, columns, sweeps=lambda: ONE_SWEEP)
        if is_ring_by_ring:
            made = made[np.append(np.arange(len(made)), np.arange(5))]
        else:
            azimuth = np.arctan2(made.positions[:, 1], made.positions[:, 0]) % (2 * np.pi)
            made = made[np.lexsort((made["channel"], azimuth))]
        save_cloud(made, tmp_path / name, format="kitti")
    found = compare(tmp_path / "a", tmp_path / "b").figures
    image = found["ranges"]
    assert [ring["ring"] for ring in image["rings"]] == list(range(RINGS))[::-1]
    assert [r["elevation_deg"] for r in image["rings"]] == pytest.approx(ELEVATION[::-1], abs=1e-4)
    for ring in image["rings"]:
        assert ring["bias_m"] == pytest.approx(0.05, abs=1e-4)
    lost = image["no_return"]
    assert (lost["returns_in_both"], lost["in_b_only"]) == (there.sum(), (~there).sum())
    assert lost["in_both"] == lost["in_a_only"] == 0
    assert found["a"]["points"] == CELLS + 5 * is_ring_by_ring
    assert image["hidden_points"] == {"a": 0.0, "b": 0.0}
    assert found["notes"] == [
        f"{tmp_path / name} has no ring column. Its 16 rings were determined from {source}"
        for name in ("a", "b")
    ]
    stated = compare(tmp_path / "a", cloud()).figures
    assert sum("no ring column" in note for note in stated["notes"]) == 1


def test_a_thinned_result_has_no_lost_returns(written, tmp_path):
    folder, *_ = written
    for name in ("cloud.ply", "sweeps.npz"):
        (tmp_path / name).write_bytes((folder / name).read_bytes())
    (tmp_path / "report.json").write_text(json.dumps({"parameters": {"keep_every": 5}}))
    found = compare(tmp_path, folder).figures
    assert found["ranges"]["no_return"] is None and "only one in every 5 hits" in found["notes"][0]
    assert "only one in every 5 hits" in repr(compare(tmp_path, folder))


@pytest.mark.parametrize(("late_s", "number"), [(-0.04, 0), (0.16, 2), (0.24, 2)])
def test_a_single_sweep_is_matched_by_time(written, late_s, number):
    """Sweeps are expected to be 0.1 s apart, so they match if they are less than 0.05 s apart."""
    folder, made, sweeps = written
    survey = replace(SURVEY, poses=[SURVEY.poses[number]], trajectory=None)
    single = Sweeps.from_survey(survey, Scene.seed())
    single = replace(single, begins_ns=sweeps.begins_ns[:1] + 1e9 * late_s)
    rows = made["scan"] // 36 == number
    columns = {name: values[rows] for name, values in made.columns.items()}
    columns["scan"] = columns["scan"] - 36 * number
    one = Cloud(made.positions[rows], columns, sweeps=lambda: single)
    found = compare(folder, one, match="time").figures
    assert found["pairs"] == 1
    assert found["distances"]["a_to_b"]["max_m"] < 2e-3


@pytest.mark.extended(keep=("ray-True",))
@pytest.mark.parametrize("scans_in_rings", [True, False])
@pytest.mark.parametrize("told", ["time", "ray", "neither"])
def test_results_with_the_same_rays_are_paired_by_ray(tmp_path, told, scans_in_rings):
    """A moving platform sees one cell by several rays, and airborne scanners have no rings.

    Two returns of a ray are told apart.
    """
    rng = np.random.default_rng(2)
    speed = 8.0
    track = lidarpool.Track([0, 1], [[0, 0, 1], [speed, 0, 1]])
    survey = Survey(SENSOR, trajectory=track, steps=36, precision_m=1e-4)
    sweeps = Sweeps.from_survey(survey, Scene.seed())
    ray = np.repeat(np.arange(360 * LAYERS), 2)  # two returns each
    firing, channel = np.divmod(ray, LAYERS)
    ranges = 10 + 20 * rng.integers(0, 2, len(ray) // 2)[:, None] + [0, 5]  # posts before walls
    elevation = np.linspace(-30, 30, LAYERS)[channel]
    if not scans_in_rings:
        elevation = 40 * np.sin(np.radians(7 * firing))
    way = directions(firing, elevation)
    start = np.array([0, 0, 1]) + firing[:, None] / 360 * [0.1 * speed, 0, 0]
    columns = {"scan": firing // 10, "channel": channel, "object": 0 * ray, "intensity": 0.0 * ray}
    if told != "neither":
        columns[told] = ray % (10 * LAYERS) if told == "ray" else firing * 277_778
    noise = 0.01 * rng.normal(size=len(ray))
    there = rng.uniform(size=len(ray)) > 0.1
    there |= np.arange(len(ray)) % 2 == 0  # of A's second returns, a tenth is lost
    for name, errors, kept in (("a", noise, there), ("b", 0 * noise, there | True)):
        (tmp_path / name).mkdir()
        places = start + (ranges.ravel() + errors)[:, None] * way
        made = Cloud(places, columns, sweeps=lambda: sweeps)[kept]
        save_cloud(made, tmp_path / name / "cloud.ply")
        sweeps.save(tmp_path / name / "sweeps.npz")
    found = compare(tmp_path / "a", tmp_path / "b")
    image = found.figures["ranges"]
    assert found.figures["pairs"] == 1 and found.figures["pictured"] == [0, 0]
    assert len(found.save(tmp_path / "page")) == (6 if scans_in_rings else 4)
    page = (tmp_path / "page/compare.html").read_text()
    by_ray = told != "neither"
    assert ("RMSE of the range residuals" in page) == by_ray
    assert ("ranges are compared ray by ray" in page) == by_ray
    assert ("A cell covers one ring" in page) == (scans_in_rings and not by_ray)
    assert "Intensities are compared" not in page  # all are 0
    assert found.figures["a"]["compared_sweeps"] is None
    if not scans_in_rings:
        (note,) = found.figures["notes"]
        assert "1 pair of sweeps cannot be shown as range images" in note
        assert ("run both with `cloud: {columns: [time]}`" in note) == (told == "neither")
        if told == "neither":
            assert image is None
            return
        lost = image["no_return"]
        assert lost["in_both"] is None and image["rings"] == []
        assert f"no return {lost['in_a_only']:,} in A only, 0 in B only\n" in repr(found)
    else:
        assert found.figures["notes"] == []
        assert image["paired_by"] == ("cells" if told == "neither" else "rays")
        assert f" {image['paired_by']} of 16 rings" in repr(found)
    if told == "neither":
        assert image["residual"]["rmse_m"] > 0.5
        return
    assert image["residual"]["rmse_m"] == pytest.approx(0.01, rel=0.05)
    lost = image["no_return"]
    assert (image["residual"]["cells"], lost["in_a_only"]) == (there.sum(), (~there).sum())
    assert lost["in_b_only"] == 0


@pytest.mark.parametrize("name", ["mcap", "rosbag2", "pcd"])
def test_compensated_sweeps_are_told_from_sweeps_as_fired(tmp_path, name):
    """A platform at 8 m/s moves by 0.8 m during a sweep, which only one of the files removes."""
    track = lidarpool.Track([0, 1], [[0, 0, 1], [8, 0, 1]])
    sweeps = Sweeps.from_survey(Survey(SENSOR, trajectory=track, steps=36), Scene.seed())
    scan, channel = np.divmod(np.arange(36 * LAYERS), LAYERS)
    way = directions(10 * scan, np.linspace(-30, 30, LAYERS)[channel])
    columns = {"scan": scan, "channel": channel, "object": 0 * scan, "intensity": 0.5 + 0.0 * scan}
    columns["time"] = scan * 2_777_778
    made = Cloud(way * 12 + [0, 0, 1], columns)
    result, fired, compensated = (tmp_path / kind for kind in ("result", "fired", "compensated"))
    for folder in (result, fired, compensated):
        folder.mkdir()
    ExportSpec("ply").write(result / "cloud.ply", made, sweeps)
    sweeps.save(result / "sweeps.npz")
    file = ExportSpec(name).row.file
    ExportSpec(name).write(fired / file, made, sweeps)
    ExportSpec(name, compensated=True).write(compensated / file, made, sweeps)
    for a, b in ((result, fired / file), (fired / file, compensated / file)):
        found = compare(a, b).figures
        first, second = (b, a) if a == fired / file else (a, b)
        assert f"{first} is compensated for the motion" in found["notes"][0]
        assert f"but {second} contains points as fired" in found["notes"][0]
        assert "`lidarpool export RESULT --format mcap`" in found["notes"][0]
        assert found["distances"]["a_to_b"]["max_m"] > 0.5
    same = compare(result, compensated / file).figures
    assert not any("as fired" in note for note in same["notes"])
    assert same["distances"]["a_to_b"]["max_m"] < 2e-3


# -- what is wrong --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "name", ["cloud.ply", "cloud.las", "cloud.laz", "cloud.mcap", "pcd/000000.pcd", "text/text.ply"]
)
def test_cut_and_garbled_files_are_a_line(written, tmp_path, name):
    folder, *_ = written
    path = tmp_path / Path(name).name
    whole = (folder / name).read_bytes()
    rng = np.random.default_rng(0)
    garbled = bytearray(whole)
    for place in rng.integers(0, min(len(whole), 400), 60):
        garbled[place] = rng.integers(256)
    for content in (b"", b"x", whole[:40], whole[: len(whole) // 2], whole[:-40], bytes(garbled)):
        path.write_bytes(content)
        with pytest.raises(LidarError) as raised:
            compare(path, folder)
        assert path.name in str(raised.value)
        assert len(str(raised.value).splitlines()) == 1 and len(str(raised.value)) < 400


def test_what_cannot_be_compared_says_what_to_give(written, tmp_path):
    folder, made, _ = written
    (tmp_path / "notes.md").write_text("none")
    (tmp_path / "empty").mkdir()
    header = laspy.LasHeader(point_format=6, version="1.4")
    laspy.LasData(header).write(tmp_path / "none.las")
    for path, says in (
        ("nowhere.pcd", r"does not exist\. Specify the folder of a result"),
        ("notes.md", r"format of .* is not supported\. Specify the folder of a result"),
        ("empty", "is not supported"),
        ("none.las", "contains no points, so there is nothing to compare"),
    ):
        with pytest.raises(LidarError, match=says):
            compare(tmp_path / path, made)
    for options, says in (
        (
            {"sweeps": [3]},
            r"Sweep pair 3 does not exist\. Pairs are numbered from 0 to 2",
        ),
        ({"sensor_a": "roof"}, r"does not contain 'roof'\. Its sensors have no names"),
        ({"sensor_b": "/points"}, "does not contain '/points'"),
        ({"distances_m": [0.0]}, "it must contain positive lengths in meters"),
    ):
        with pytest.raises(LidarError, match=says):
            compare(folder, folder, **options)
    with pytest.raises(LidarError, match=r"has no sweeps\. Omit `--sweep` and `--match`"):
        compare(made, folder, sweeps=[0])
    with pytest.raises(LidarError, match=r"'/point'\. Did you mean '/points'\? It contains"):
        open_recording(folder / "cloud.mcap", "/point")


# -- the page -------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_page_by_itself_with_all_figures(tmp_path):
    rng = np.random.default_rng(5)
    light = rng.uniform(size=RANGES.shape)
    there = rng.uniform(size=RANGES.shape) > 0.1
    noisy = cloud(RANGES + rng.normal(0, 0.02, RANGES.shape), there=there, light=light)
    folder = tmp_path / "<b>A & B"
    folder.mkdir()
    save_cloud(noisy, folder / "cloud.ply")
    ONE_SWEEP.save(folder / "sweeps.npz")
    found = lidarpool.compare(folder, cloud(light=light))
    assert found.figures["ranges"]["residual"]["cells"] == np.count_nonzero(there)
    names = [path.name for path in found.save(tmp_path / "out")]
    assert sorted(names) == sorted(path.name for path in (tmp_path / "out").iterdir())
    assert {"compare.json", "compare.html", "compare-ranges.png", "compare-above.png"} <= {*names}
    assert json.loads((tmp_path / "out/compare.json").read_text()) == found.figures
    page = (tmp_path / "out/compare.html").read_text()
    assert "<b>A &" not in page and "&lt;b&gt;A &amp; B" in page
    assert "<script" not in page and 'src="http' not in page and page.count("<svg") == 4
    assert page.count("data-ring=") == RINGS
    assert ">−15.00°</td>" in page and "-15.00°" not in page
    assert "the point closest to its center is used" in page and "ray by ray" not in page
    assert "about 0.67 times the standard deviation" in page
    assert "Intensities are compared by rank." in page  # both are energies
    assert "RMSE of the range residuals" not in page
    plain = compare(Cloud(cloud().positions, {}), Cloud(cloud().positions, {}))
    left = plain.save(tmp_path / "out")  # no pictures of ranges and rings, nor those of before
    assert len(left) == 4 and {*left} == {*(tmp_path / "out").iterdir()}
    page = (tmp_path / "out/compare.html").read_text()
    assert "no sweeps" in page and "0.67 times" not in page and "Intensities are" not in page


def test_range_images_are_yellow_where_it_is_near():
    page = comparison_charts.draw_ranges(compare(cloud(), cloud()))
    (image,) = page.figure.axes[0].images
    colors = np.asarray(image.get_array()).reshape(-1, 3)
    green = colors[:, 1]  # rises from violet to yellow
    order = np.argsort(green)
    assert colors[order[-1]] == pytest.approx([0.99, 0.91, 0.14], abs=0.02), "yellow"
    columns = np.argsort(green.reshape(RINGS, COLUMNS).mean(axis=0))
    azimuth = image.get_extent()[0] - columns * 360 / COLUMNS
    near, far = np.cos(2 * np.radians(azimuth[[-1, 0]]))  # of the room: -1 is near, 1 is far
    assert near < -0.99 and far > 0.99


@pytest.mark.parametrize("dead_in", ["a", "b"])
@pytest.mark.parametrize(
    ("dead", "says"), [((3,), "ring 3 (-9.0°)"), ((14, 3), "rings 14 (13.0°) and 3 (-9.0°)")]
)
def test_channels_without_returns_in_one_cloud_are_named_and_drawn(dead_in, dead, says):
    there = np.ones((RINGS, COLUMNS), bool)
    there[list(dead)] = False
    there[8, :72] = False  # a tenth of a ring that works
    clouds = {"a": cloud(), "b": cloud(), dead_in: cloud(there=there)}
    found = compare(clouds["a"], clouds["b"])
    assert found.figures["notes"] == [f"cloud {dead_in.upper()} has no returns in {says}"]
    gaps = comparison_charts.draw_rings(found).figure.axes[1]
    drawn = {
        line.get_label(): dict(zip(np.round(line.get_ydata()), line.get_xdata(), strict=True))
        for line in gaps.lines
    }
    assert len(drawn["A"]) == len(drawn["B"]) == RINGS
    for ring, elevation in enumerate(np.round(ELEVATION)):
        expected = 100 if ring in dead else 10 if ring == 8 else 0
        assert drawn[dead_in.upper()][elevation] == pytest.approx(expected)
        assert drawn["B" if dead_in == "a" else "A"][elevation] == 0
    assert gaps.get_xlim()[1] > 100


def test_maps_of_georeferenced_clouds_have_short_numbers():
    """The offset is in the titles of the axes, not above the chart, where the heading is."""
    corner = np.array([500_000, 5_400_000, 300])
    positions = corner + np.random.default_rng(6).uniform(0, 40, (50, 3))
    page = comparison_charts.draw_above(compare(Cloud(positions, {}), Cloud(positions, {})))
    page.figure.draw_without_rendering()
    for axes in page.figure.axes[:2]:
        for axis, title in ((axes.xaxis, axes.get_xlabel()), (axes.yaxis, axes.get_ylabel())):
            assert axis.get_offset_text().get_text() == ""
            shown = [float(text.get_text()) for text in axis.get_ticklabels()]
            assert len(shown) >= 4 and min(shown) >= 0 and max(shown) <= 50
            if title:  # the second chart shares the title of the first
                offset = float(title[4:-4].replace("\u2009", ""))
                np.testing.assert_allclose(axis.get_ticklocs(), np.add(shown, offset))


def test_the_axis_of_small_distances_has_numbers_that_can_be_read():
    positions = np.random.default_rng(6).uniform(0, 9, (50, 3))
    page = comparison_charts.draw_distances(compare(Cloud(positions, {}), Cloud(positions, {})))
    page.figure.draw_without_rendering()
    axis = page.figure.axes[0].xaxis
    texts = [text.get_text() for text in axis.get_ticklabels(which="both") if text.get_text()]
    assert {"0.001", "0.002", "0.005", "0.01"} <= {*texts}
    assert not [text for text in texts if "times" in text]


def test_coordinates_of_a_damaged_file_are_refused(tmp_path):
    points = np.random.default_rng(1).uniform(-9, 9, (1000, 3))
    np.save(tmp_path / "whole.npy", points)
    points[7] = 1e226, 0, 0
    np.save(tmp_path / "damaged.npy", points)
    with pytest.raises(LidarError, match=r"damaged\.npy extends 1e\+226 m from the origin, .* dam"):
        compare(tmp_path / "damaged.npy", tmp_path / "whole.npy")


def test_rays_of_a_measured_trajectory_are_the_same_despite_its_errors():
    positions, quaternions = np.zeros((3, 3)), np.tile([0.0, 0, 0, 1], (3, 1))
    true = RayTimes("key", positions, quaternions, is_measured=False)
    moved = true._replace(positions=positions + 0.2)
    assert true.are_same(true)
    assert not true.are_same(moved)
    assert true.are_same(moved._replace(is_measured=True))
    assert moved._replace(is_measured=True).are_same(true)
    assert not true.are_same(moved._replace(is_measured=True, key="other times"))
    assert not true.are_same(true._replace(positions=positions + 50, is_measured=True))
