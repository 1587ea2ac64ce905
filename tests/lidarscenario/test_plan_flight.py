"""Flight plans against closed forms and against simulations."""

from __future__ import annotations

import itertools
import json
import math
import re
from xml.etree import ElementTree

import numpy as np
import pytest
import shapely
from tests.shapes import level, quad
from tests.simulated_drives import simulated_points

from lidarscenario.plan.flight import plan_flight
from lidarscenario.plan.flight_area import read_area, transform_shape, utm_epsg
from lidarscenario.plan.flight_density import (
    DensityMap,
    Squares,
    expected_density,
    is_inside_grid,
    summarize_density,
)
from lidarscenario.plan.flight_files import to_geojson, to_kml
from lidarscenario.plan.flight_lines import Terrain
from lidarscenario.plan.flight_path import FlightLeg, fly, shortest_turn, turn_radius_m
from lidarscenario.plan.flight_scanner import AirborneScanner
from lidarsim import LidarError, Mounted, Scene, Survey, Track, load_sensor

SQUARE = shapely.box(0, 0, 1000, 1000)
RIEGL = "airborne/riegl-vq780i"  # 60°, 666,600 pulses per second on average, 20 to 300 Hz


@pytest.fixture(scope="module")
def scanner():
    return AirborneScanner.load(RIEGL)


def planned(scanner, area=SQUARE, terrain=None, agl_m=500, **options):
    return plan_flight(area, terrain or Terrain(), scanner, agl_m=agl_m, **options)


def test_swath_and_spacing(scanner):
    plan = planned(scanner, overlap=0.3)
    swath = 2 * 500 * math.tan(math.radians(30))
    assert plan.swath_m == pytest.approx(swath)
    # Three strips cover the square. Two would need an overlap of less than 30 %.
    assert plan.spacing_m == pytest.approx((1000 - swath) / 2)
    assert plan.min_overlap == pytest.approx(1 - plan.spacing_m / swath)
    across = sorted(float(line.leg.start[1]) for line in plan.lines)
    assert across == pytest.approx([swath / 2, 500, 1000 - swath / 2])
    assert not plan.notes


def test_speed_and_rates_for_a_density(scanner):
    plan = planned(scanner, density_m2=20)
    rates = plan.rates
    assert rates.speed_m_s == math.floor(scanner.pulses_hz / (20 * plan.swath_m) * 10) / 10
    assert rates.fired_hz <= scanner.fired_hz
    assert plan.densities_m2[0] == pytest.approx(20, rel=0.02)
    assert plan.along_m == pytest.approx(plan.across_m, rel=0.02)
    assert plan.line_density_m2(plan.lines[0]) == pytest.approx(plan.densities_m2)
    # At the speed limit, the pulse rate is reduced instead.
    slow = planned(scanner, density_m2=20, speeds_m_s=(5, 30))
    assert slow.rates.speed_m_s == 30
    assert slow.rates.fired_hz < 0.6 * scanner.fired_hz
    assert slow.densities_m2[0] == pytest.approx(20, rel=0.01)
    assert slow.rates.pulses_per_cycle * slow.rates.scan_hz == pytest.approx(slow.rates.fired_hz)


def test_lines_follow_the_longest_side_and_alternate(scanner):
    area = shapely.affinity.rotate(shapely.box(0, 0, 2000, 900), 30)
    plan = planned(scanner, area)
    directions = [math.degrees(line.leg.direction) % 360 for line in plan.lines]
    assert directions == pytest.approx([30, 210][: len(directions)])
    north = planned(scanner, area, heading_deg=0)
    assert math.degrees(north.lines[0].leg.direction) == pytest.approx(90)


def test_cross_strips_are_perpendicular(scanner):
    plan = planned(scanner, shapely.box(0, 0, 800, 400), cross=2)
    crossing = [line for line in plan.lines if line.kind == "cross"]
    assert [line.name for line in crossing] == ["cross-1", "cross-2"]
    assert [float(line.leg.start[0]) for line in crossing] == pytest.approx([600, 200])
    assert [line.leg.length_m for line in crossing] == pytest.approx([404, 404])


def test_lines_end_where_the_area_ends_within_their_swath(scanner):
    triangle = shapely.Polygon([(0, 0), (3000, 0), (0, 1200)])
    plan = planned(scanner, triangle)
    lengths = [line.leg.length_m for line in plan.lines]
    assert lengths == sorted(lengths, reverse=True)
    low = float(plan.lines[-1].leg.start[1]) - plan.swath_m / 2
    assert lengths[-1] == pytest.approx(3000 * (1 - low / 1200) + 4, abs=0.01)


def test_hills_narrow_the_spacing_and_slow_the_aircraft(scanner):
    hill = quad("Ridge", (-2000, -2000, 0), (2000, -2000, 0), (2000, 3000, 150), (-2000, 3000, 150))
    area = shapely.box(-500, 0, 1500, 1000)
    ground = Terrain(Scene.from_meshes([hill]))
    plan = planned(scanner, area, ground, density_m2=20, heading_deg=90)
    level_plan = planned(scanner, area, density_m2=20, heading_deg=90)
    assert plan.min_overlap >= 0.29
    assert plan.lowest_m < 495
    assert plan.rates.speed_m_s < level_plan.rates.speed_m_s
    # Each line is level, at its height above the mean ground below it.
    for line in plan.lines:
        below = 0.03 * (float(line.leg.start[1]) + 2000)
        assert line.leg.heights == pytest.approx(below + 500)
        assert line.clearance_m[1] == pytest.approx(500)


@pytest.mark.parametrize(
    ("overlap", "shown"), [(0.204, "20%"), (0.004, "0%"), (-0.004, "0%"), (-0.024, "-2%")]
)
def test_the_overlap_over_a_small_hill_is_noted(scanner, overlap, shown):
    def hilly(height_m):
        hill = level("Hill", height_m, 60, (700, 500))
        return Terrain(Scene.from_meshes([level("Plain", half=8000), hill]))

    flat = planned(scanner)
    # The lines are level at their height above the mean ground, which rises with the hill.
    share = (500 - planned(scanner, terrain=hilly(100)).lowest_m) / 100
    lowest_m = flat.spacing_m / (1 - overlap) / (flat.swath_m / 500)
    plan = planned(scanner, terrain=hilly((500 - lowest_m) / share))
    assert plan.spacing_m == flat.spacing_m
    assert plan.min_overlap == pytest.approx(overlap, abs=1e-4)
    (note,) = [note for note in plan.notes if "overlap" in note]
    assert f"the overlap is {shown} instead of 30%. Increase `--overlap`" in note


def test_an_aircraft_follows_the_ground(scanner):
    slope = quad("Slope", (-500, -500, 0), (1500, -500, 200), (1500, 1500, 200), (-500, 1500, 0))
    ground = Terrain(Scene.from_meshes([slope]))
    plan = planned(scanner, terrain=ground, heading_deg=90, agl_m=200, follow=True)
    line = plan.lines[0].leg
    assert line.heights[len(line.heights) // 2] == pytest.approx(300, abs=1)
    assert np.ptp(line.heights) > 80
    assert planned(scanner, terrain=ground, heading_deg=90, agl_m=200).lowest_m < plan.lowest_m


def test_a_path_passes_all_lines_at_their_times(scanner):
    plan = planned(scanner, cross=1)
    path = plan.path
    track = Track(path.times_s, path.positions, yaw_deg=path.yaw_deg, roll_deg=path.roll_deg,
                  smooth=True)  # fmt: skip
    for line, start_s, duration_s in zip(plan.lines, path.starts_s, path.durations_s, strict=True):
        for share in (0, 0.5, 1):
            pose = track.pose(0, (start_s + share * duration_s) * 1e9)
            expected = line.leg.start + share * (line.leg.stop - line.leg.start)
            assert pose.position[:2] == pytest.approx(expected, abs=1e-3)
            assert abs(pose.roll_deg) < 1e-3
            off = (pose.yaw_deg - math.degrees(line.leg.direction) + 180) % 360 - 180
            assert abs(off) < 1e-3
    steps = np.hypot(*np.diff(path.positions[:, :2], axis=0).T) / np.diff(path.times_s)
    assert steps == pytest.approx(plan.rates.speed_m_s, rel=0.02)


@pytest.mark.parametrize("heights", [(300.0, 420.0), (420.0, 300.0)])
def test_the_height_changes_smoothly_between_lines(heights):
    """Between the lines, it follows 3 s² - 2 s³ of the share of the distance."""
    speed_m_s = 60.0
    first = FlightLeg(np.array([0.0, 0]), np.array([3000.0, 0]), np.full(4, heights[0]))
    last = FlightLeg(np.array([3000.0, 900]), np.array([0.0, 900]), np.full(3, heights[1]))
    path = fly([first, last], speed_m_s)
    stop_s, start_s = path.starts_s[0] + path.durations_s[0], path.starts_s[1]
    share = np.clip((path.times_s - stop_s) / (start_s - stop_s), 0, 1)
    expected = heights[0] + (heights[1] - heights[0]) * (3 * share**2 - 2 * share**3)
    np.testing.assert_allclose(path.positions[:, 2], expected, atol=0.05)
    assert ((share > 0.1) & (share < 0.4)).sum() > 10


def test_turns_are_as_short_as_possible():
    radius = turn_radius_m(30)
    half_circle = shortest_turn(np.zeros(2), 0.0, np.array([0, 2 * radius]), math.pi, radius)
    assert sum(s.length_m for s in half_circle) == pytest.approx(math.pi * radius)
    straight = shortest_turn(np.zeros(2), 0.0, np.array([500.0, 0]), 0.0, radius)
    assert sum(s.length_m for s in straight) == pytest.approx(500)
    # Lines that are closer than the diameter of a turn require a turn of three arcs.
    narrow = shortest_turn(np.zeros(2), 0.0, np.array([0, radius]), math.pi, radius)
    assert all(s.curvature for s in narrow)
    legs = [FlightLeg(np.zeros(2), np.array([100.0, 0]), np.array([50.0])) for _ in range(2)]
    assert fly(legs, 30).times_s[-1] > 2 * 100 / 30


def turn_length(start, first, stop, last):
    turn = shortest_turn(np.array(start), first, np.array(stop), last, 1.0)
    return sum(section.length_m for section in turn)


def test_turns_are_as_short_in_a_mirror_and_backward():
    """If the length of one kind of path was wrong, that of its mirror image would differ."""
    rng = np.random.default_rng(3)
    cos, sin = math.cos(2), math.sin(2)
    for x, y, first, last in rng.uniform(-1, 1, (300, 4)) * (3.5, 3.5, math.pi, math.pi):
        length = turn_length((0, 0), first, (x, y), last)
        assert length >= math.hypot(x, y)
        for other in (
            turn_length((0, 0), -first, (x, -y), -last),
            turn_length((x, y), last + math.pi, (0, 0), first + math.pi),
            turn_length(
                (5, 7), first + 2, (5 + x * cos - y * sin, 7 + x * sin + y * cos), last + 2
            ),
        ):
            assert other == pytest.approx(length, abs=1e-6)


def test_a_single_arc_has_no_further_circle():
    rng = np.random.default_rng(1)
    for heading, angle in rng.uniform((-math.pi, 0.1), (math.pi, 3), (200, 2)):
        for sign in (1, -1):
            center = sign * np.array([-math.sin(heading), math.cos(heading)])
            end = heading + sign * angle
            stop = center + sign * np.array([math.sin(end), -math.cos(end)])
            assert turn_length((0, 0), heading, stop, end) == pytest.approx(angle, abs=1e-6)


@pytest.mark.parametrize(
    ("first", "stop", "last", "expected"),
    [
        (0.0, (0.0, 4.0), math.pi, math.pi + 2),  # a half circle with a straight section
        (0.0, (0.0, -4.0), math.pi, math.pi + 2),
        (0.0, (2.0, 2.0), 0.0, math.pi),  # a quarter to the left, and one to the right
        (0.0, (2.0, -2.0), 0.0, math.pi),
    ],
)
def test_lengths_of_turns(first, stop, last, expected):
    assert turn_length((0, 0), first, stop, last) == pytest.approx(expected)


@pytest.mark.parametrize("cliff_m", [60.0, -60.0])
def test_an_aircraft_that_follows_the_ground_passes_a_cliff_on_a_ramp(scanner, cliff_m):
    """Heights are averaged over a distance equal to the height above ground."""
    steps = [(-1000, 500, 0.0), (500, 2000, cliff_m)]
    meshes = [quad(f"{a}", (a, -600, z), (b, -600, z), (b, 800, z), (a, 800, z))
              for a, b, z in steps]  # fmt: skip
    ground = Terrain(Scene.from_meshes(meshes))
    area = shapely.box(0, 0, 1000, 200)
    plan = planned(scanner, area, ground, heading_deg=90, agl_m=200, follow=True)
    leg = plan.lines[0].leg
    along = np.linspace(0, leg.length_m, len(leg.heights)) + leg.start[0]
    expected = 200 + cliff_m * np.clip((along - 400) / 200, 0, 1)
    np.testing.assert_allclose(leg.heights, expected, atol=2.5)
    low_m, mean_m, high_m = plan.lines[0].clearance_m
    assert (low_m, high_m) == pytest.approx((170, 230), abs=3)
    assert mean_m == pytest.approx(200, abs=0.5)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"density_m2": 500, "speeds_m_s": (50, 70)}, "Reduce `--speed` to 2.3 or `--agl` to 23"),
        ({"agl_m": 5500}, r"maximum range of RIEGL VQ-780i is 5600 m. Reduce `--agl` to 4800"),
        ({"agl_m": 90}, "minimum range of RIEGL VQ-780i is 100 m. Increase `--agl` to 100"),
        (
            {"agl_m": 150, "speeds_m_s": (70, 70)},
            "maximum scan frequency is 300 Hz. Reduce `--speed` to ",
        ),
    ],
)
def test_what_a_plan_cannot_meet(scanner, options, words):
    plan = planned(scanner, **options)
    assert any(words in note for note in plan.notes), plan.notes


def test_the_advice_of_a_shortfall_is_sufficient(scanner):
    short = planned(scanner, density_m2=30, speeds_m_s=(60, 60))
    assert short.notes
    for options in ({"speeds_m_s": (38, 38)}, {"agl_m": 320}):
        better = planned(scanner, density_m2=30, **{"speeds_m_s": (60, 60), **options})
        assert not any("density" in note for note in better.notes), options


def test_the_advice_on_the_minimum_range_is_sufficient():
    # The strips of higher lines are wider, so they contain higher ground beyond the area.
    pit = [(-3000, 1490), (-20, 0), (120, 0), (3100, 1490)]
    slopes = [
        quad(f"Slope {k}", (x0, -3000, z0), (x1, -3000, z1), (x1, 4000, z1), (x0, 4000, z0))
        for k, ((x0, z0), (x1, z1)) in enumerate(itertools.pairwise(pit))
    ]
    ground = Terrain(Scene.from_meshes(slopes))
    als = AirborneScanner.load("airborne/leica-als50-ii")
    settings = {"area": shapely.box(0, 0, 100, 1000), "terrain": ground}
    low = planned(als, agl_m=199, **settings)
    (note,) = (note for note in low.notes if "minimum range" in note)
    assert not re.search(r"only 200 m .* is 200 m", note)
    advised = int(re.search(r"Increase `--agl` to (\d+)$", note)[1])
    assert not any("minimum range" in n for n in planned(als, agl_m=advised, **settings).notes)
    with pytest.raises(LidarError, match="No point is within the range limits") as error:
        planned(als, agl_m=90, **settings)
    advised = int(re.search(r"Increase `--agl` to (\d+), or", str(error.value))[1])
    assert not any("minimum range" in n for n in planned(als, agl_m=advised, **settings).notes)


def test_no_line_is_added_for_a_negligible_strip(scanner):
    swath = scanner.swath_m(500)
    assert len(planned(scanner, shapely.box(0, 0, 2000, 1.009 * swath)).lines) == 1
    close = planned(scanner, shapely.box(0, 0, 2000, 1.05 * swath))
    assert len(close.lines) == 2
    (note,) = close.notes
    agl_m = int(re.search(r"covers the area with `--agl (\d+)`", note)[1])
    assert len(planned(scanner, shapely.box(0, 0, 2000, 1.05 * swath), agl_m=agl_m).lines) == 1


def test_the_required_extent_of_the_terrain_is_sufficient():
    avia = AirborneScanner.load("livox/avia")  # looks forward, too
    area = shapely.box(0, 0, 200, 100)

    def notes(margin_m):
        corners = [(-margin_m, -margin_m, 0), (200 + margin_m, -margin_m, 0),
                   (200 + margin_m, 100 + margin_m, 0), (-margin_m, 100 + margin_m, 0)]  # fmt: skip
        ground = Terrain(Scene.from_meshes([quad("Ground", *corners)]))
        plan = planned(avia, area, ground, agl_m=90)
        return [note for note in plan.notes if "terrain is missing" in note]

    (note,) = notes(10)
    required_m = int(re.search(r"beyond the area by (\d+) m", note)[1])
    assert required_m > 2 + avia.ahead * 90
    assert not notes(required_m)


def test_holes_in_the_terrain_are_named(scanner):
    halves = [quad(f"{x}", (x, -2e3, 0), (x + 1800, -2e3, 0), (x + 1800, 3e3, 0), (x, 3e3, 0))
              for x in (-1000, 1200)]  # fmt: skip
    plan = planned(scanner, shapely.box(0, 0, 2000, 900), Terrain(Scene.from_meshes(halves)))
    (note,) = [note for note in plan.notes if "terrain is missing" in note]
    assert note.endswith("Use a terrain that covers the area without holes")


def test_what_cannot_be_planned(scanner):
    with pytest.raises(LidarError, match="no ground below line-1"):
        planned(scanner, terrain=Terrain(Scene.from_meshes([level("Far", middle=(9000, 0))])))
    with pytest.raises(LidarError, match=r"needs .* flight lines, but the limit is 255"):
        planned(scanner, shapely.box(0, 0, 30_000, 30_000), agl_m=120)
    with pytest.raises(LidarError, match=r"field of view of RIEGL VQ-780i .* is 60°"):
        AirborneScanner.load(RIEGL, 75)
    with pytest.raises(LidarError, match="The ground rises"):
        tower = [level("Ground", half=2000), level("Roof", 90, half=400, middle=(500, 500))]
        planned(scanner, terrain=Terrain(Scene.from_meshes(tower)), agl_m=30)


def strip(agl_m=200.0, speed=40.0, seconds=4.0, slope=0.0, columns=400):
    """A strip along x, over ground that rises by `slope` per meter."""
    sensor = load_sensor(RIEGL, rate_hz=40, columns=columns, step_deg=360)
    track = Track([0, seconds], [[0, 0, agl_m], [speed * seconds, 0, agl_m]], yaw_deg=0)
    survey = Survey(trajectory=track, sensors=[Mounted(sensor)], precision_m=0.01)
    ends = [(x, x * slope) for x in (-50.0, speed * seconds + 50)]
    ground = quad(
        "Ground", *((x, y, z) for (x, z), ys in zip(ends, [(300, -300), (-300, 300)], strict=True)
                    for y in ys)
    )  # fmt: skip
    return Scene.from_meshes([ground]), survey


def test_the_density_of_a_strip_over_flat_ground_and_a_slope():
    # The ground below a line scanner is level across the track, so that the closed form holds at
    # each position along the track.
    for slope in (0.0, 0.3):
        scene, survey = strip(slope=slope)
        points = simulated_points(scene, survey).positions
        for begin, end in ((10, 60), (100, 150)):
            height = 200 - slope * (begin + end) / 2
            swath = 2 * height * math.tan(math.radians(30))
            strip_points = points[(points[:, 0] >= begin) & (points[:, 0] < end)]
            found = len(strip_points) / ((end - begin) * swath)
            assert found == pytest.approx(40 * 400 / (40 * swath), rel=0.03)
            assert np.ptp(strip_points[:, 1]) == pytest.approx(
                swath * (1 + slope * 25 / height), rel=0.02
            )


def test_the_expected_density_is_that_of_a_simulation():
    scene, survey = strip(slope=0.2)
    area = [[(20, -80), (140, -80), (140, 80), (20, 80)]]
    expected = expected_density(scene, survey, area)
    points = simulated_points(scene, survey).positions[:, :2]
    low = np.array([20, -80])
    shape = np.array(expected.density_m2.shape[::-1])
    column, row = np.floor((points - low) / expected.cell_m).astype(int).T
    inside = (column >= 0) & (row >= 0) & (column < shape[0]) & (row < shape[1])
    counts = np.zeros(shape[::-1])
    np.add.at(counts, (row[inside], column[inside]), 1)
    assert expected.density_m2 == pytest.approx(counts / expected.cell_m**2, rel=0.01)
    summary = summarize_density(expected, 2.0)
    assert summary.mean_m2 == pytest.approx(inside.sum() / (120 * 160), rel=0.02)
    assert summary.low_m2 < summary.mean_m2


def test_the_expected_density_may_come_from_a_part_of_the_rays(monkeypatch):
    scene, survey = strip()
    area = [[(20, -80), (140, -80), (140, 80), (20, 80)]]
    every_ray = summarize_density(expected_density(scene, survey, area), 2.0)
    assert survey.ray_count > 50_000
    monkeypatch.setattr("lidarscenario.plan.flight_density.SAMPLED_RAYS", 10_000)
    sampled = summarize_density(expected_density(scene, survey, area), 2.0)
    assert sampled.mean_m2 == pytest.approx(every_ray.mean_m2, rel=0.02)
    assert sampled.low_m2 == pytest.approx(every_ray.low_m2, rel=0.2)


def test_squares_are_placed_from_their_southwest_corner():
    squares = Squares(np.arange(6.0).reshape(2, 3), np.array([10.0, -4.0]), 2.0)
    x, y = squares.centers
    assert (x.tolist(), y.tolist()) == ([11, 13, 15], [-3, -1])
    over = squares.over([[(13, -3), (19, -3), (19, 1), (13, 1)]])
    assert over.corner.tolist() == [12, -4]
    assert over.counts.tolist() == [[1, 2, 0, 0], [4, 5, 0, 0], [0, 0, 0, 0]]
    before = squares.over([[(7, -7), (11, -7), (11, -3), (7, -3)]])
    assert before.corner.tolist() == [6, -8]
    assert not before.counts.any()


def test_a_twentieth_of_an_area_may_be_sparser():
    density = np.arange(1.0, 101.0).reshape(10, 10)
    covered = np.ones((10, 10))
    covered[0, :4] = 0.1  # too small for a density
    found = summarize_density(DensityMap(density, covered, np.zeros(2), 1.0), 51.0)
    assert found.low_m2 == 9  # 4.8 of the 96 cells from 5 to 100 are below
    assert found.reached == pytest.approx(50 / 96)
    assert found.mean_m2 == pytest.approx((5050 - 0.9 * 10) / 96.4)


def test_areas_with_holes():
    area = [[(0, 0), (10, 0), (10, 10), (0, 10)], [(4, 4), (6, 4), (6, 6), (4, 6)]]
    x, y = np.array([-1.0, 1, 5, 11]), np.array([1.0, 5, 7])
    assert is_inside_grid(x, y, area).tolist() == [
        [False, True, True, False],
        [False, True, False, False],
        [False, True, True, False],
    ]
    grid = DensityMap.from_squares(Squares(np.ones((10, 10)), np.zeros(2), 1.0), area, 5.0)
    assert grid.density_m2 == pytest.approx(np.ones((2, 2)))
    assert grid.covered == pytest.approx(np.full((2, 2), 0.96))


def squares_with_density(density, side_m=0.37, corner=(-7.0, -9.0), shape=(400, 400)):
    """Squares that are not aligned with the area, with a density that depends on x."""
    x = corner[0] + (np.arange(shape[1]) + 0.5) * side_m
    counts = np.broadcast_to(density(x), shape) * side_m**2
    return Squares(counts, np.array(corner), side_m)


@pytest.mark.parametrize(
    ("corners", "mean_m2", "low_m2"),
    [
        ([(0, 0), (100, 0), (100, 60), (0, 60)], 50, 5),
        ([(0, 0), (100, 0), (100, 100)], 200 / 3, 100 * 0.05**0.5),
    ],
)
def test_the_density_of_an_area_includes_its_border(corners, mean_m2, low_m2):
    # The density is x. Beyond the border, it is not.
    squares = squares_with_density(lambda x: np.where(x > 0, np.where(x < 100, x, 7e4), 0))
    for cell_m in (2.0, 5.0):
        found = summarize_density(DensityMap.from_squares(squares, [corners], cell_m), mean_m2)
        assert found.cell_m == cell_m
        assert found.mean_m2 == pytest.approx(mean_m2, rel=0.005)
        assert found.low_m2 == pytest.approx(low_m2, abs=cell_m / 2 + 0.5)
        assert found.empty == 0
    assert found.reached == pytest.approx(0.5 if low_m2 == 5 else 5 / 9, abs=0.03)


def test_a_part_of_an_area_without_squares_is_empty():
    squares = squares_with_density(lambda x: 0 * x + 4)  # up to x = 141
    area = [[(0, 0), (282, 0), (282, 60), (0, 60)]]
    found = summarize_density(DensityMap.from_squares(squares, area, 5.0), 4.0)
    assert found.empty == pytest.approx(0.5, abs=0.02)
    assert found.mean_m2 == pytest.approx(2, rel=0.01)


def test_areas_from_text_and_files(tmp_path):
    assert read_area("hills.ply") is None
    assert read_area("-5,0,5,20").shape.bounds == (-5, 0, 5, 20)
    wkt = "POLYGON ((0 0, 100 0, 100 50, 0 0))"
    (tmp_path / "area.wkt").write_text(wkt)
    for text in (wkt, str(tmp_path / "area.wkt")):
        assert read_area(text).shape.area == 2500
        assert read_area(text).epsg is None
    ring = [[9.1, 48.7], [9.2, 48.7], [9.2, 48.8], [9.1, 48.7]]
    polygon = {"type": "Polygon", "coordinates": [ring]}
    crs = {"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::25832"}}
    file = tmp_path / "area.geojson"
    collection = {
        "type": "FeatureCollection",
        "features": [{"type": "Feature", "geometry": polygon}],
    }
    for content, epsg in (
        (polygon, 4326),
        (collection, 4326),
        ({"type": "Polygon", "coordinates": [[[5e5, 0], [6e5, 0], [6e5, 1e5], [5e5, 0]]]}
         | {"crs": crs}, 25832),
    ):  # fmt: skip
        file.write_text(json.dumps(content))
        assert read_area(str(file)).epsg == epsg


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("5,0,-5,20", "bounds must be"),
        ("POLYGON ((0 0, 1 1", "not a valid polygon in WKT. Expected, for example, `POLYGON"),
        ("POLYGON (0 0, 10 0, 10 10, 0 0)", "with two pairs of parentheses"),
        ("POLYGON ((0 0, 10 0, 10 10))", "not closed. Repeat the first point at its end"),
        ("POLYGON ((0 0, 10 10, 10 0, 0 10, 0 0))", "not a valid polygon: Self-intersection"),
        ("missing.geojson", "missing.geojson does not exist"),
        ("11.5,48.1,11.6,48.2", r"has an extent of 0\.1 x 0\.1 m\. WKT and bounds are in meters"),
    ],
)
def test_areas_that_are_invalid(text, words):
    with pytest.raises(LidarError, match=words):
        read_area(text)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ([1], "contains no GeoJSON object, which has the member `type`"),
        ({"type": "FeatureCollection", "features": ["a"]}, "contains no GeoJSON object"),
        (
            {"type": "Polygon", "coordinates": [[[-180, 0], [180, 0], [180, 1], [-180, 0]]]},
            "If it crosses the antimeridian, plan the parts on both sides separately",
        ),
    ],
)
def test_geojson_that_is_no_area(tmp_path, content, words):
    file = tmp_path / "area.geojson"
    file.write_text(json.dumps(content))
    with pytest.raises(LidarError, match=words):
        read_area(str(file))


@pytest.mark.parametrize(
    ("longitude", "latitude", "epsg"),
    [
        (9.1, 48.7, 32632),
        (-179.9, 1, 32601),
        (179.9, -1, 32760),
        (-70.7, -33.4, 32719),
        (-0.1, 51.5, 32630),
        (0.1, 51.5, 32631),
    ],
)
def test_utm_zones(longitude, latitude, epsg):
    shape = shapely.box(longitude - 0.05, latitude - 0.05, longitude + 0.05, latitude + 0.05)
    assert utm_epsg(shape) == epsg


def test_geojson_has_the_values_of_each_line(scanner):
    """The ground rises along x, below lines that cross it at two heights."""
    slope = quad("Slope", (-500, -500, 0), (1500, -500, 100), (1500, 1500, 100), (-500, 1500, 0))
    ground = Terrain(Scene.from_meshes([slope]))
    plan = planned(scanner, shapely.box(0, 0, 800, 400), ground, heading_deg=90, cross=2)
    assert plan.counts == "1 flight line and 2 cross strips"
    assert planned(scanner, shapely.box(0, 0, 800, 400)).counts == "1 flight line"
    assert plan.length_m == pytest.approx(804 + 2 * 404)
    assert plan.duration_s == plan.path.times_s[-1] > plan.length_m / plan.rates.speed_m_s
    assert plan.farthest_m == pytest.approx(plan.highest_m / math.cos(math.radians(30)))
    assert plan.is_in_range and not planned(scanner, agl_m=5500).is_in_range
    content = json.loads(to_geojson(plan, None, np.zeros(3)))
    by_name = {feature["properties"]["name"]: feature for feature in content["features"]}
    assert [*by_name] == ["area", "line-1", "cross-1", "cross-2", "path"]
    assert by_name["area"]["properties"]["agl_m"] == 500
    line, values = plan.lines[0], by_name["line-1"]["properties"]
    assert (values["kind"], by_name["cross-2"]["properties"]["kind"]) == ("line", "cross")
    low_m, mean_m, high_m = line.clearance_m
    assert high_m - low_m == pytest.approx(804 * 0.05, abs=0.1)
    assert (values["min_clearance_m"], values["max_clearance_m"]) == pytest.approx(
        (low_m, high_m), abs=0.01
    )
    swaths = tuple(2 * height_m * math.tan(math.radians(30)) for height_m in (low_m, high_m))
    assert (values["min_swath_m"], values["max_swath_m"]) == pytest.approx(swaths, abs=0.01)
    rates = plan.rates
    assert values["max_density_m2"] == pytest.approx(
        rates.pulses_hz / rates.speed_m_s / swaths[0], abs=1e-3
    )
    assert values["min_density_m2"] == pytest.approx(
        rates.pulses_hz / rates.speed_m_s / swaths[1], abs=1e-3
    )
    assert values["length_m"] == 804 and values["speed_m_s"] == rates.speed_m_s
    starts_s = [by_name[line.name]["properties"]["start_s"] for line in plan.lines]
    assert starts_s == pytest.approx(plan.path.starts_s, abs=1e-3) and starts_s[0] == 5
    ends = np.array(by_name["line-1"]["geometry"]["coordinates"])[[0, -1]]
    np.testing.assert_allclose(ends, [(-2, 200, mean_m + 45), (802, 200, mean_m + 45)], atol=0.05)
    crossing = np.array(by_name["cross-1"]["geometry"]["coordinates"])
    assert len(crossing) == 2 and crossing[0, 0] == pytest.approx(600)
    path = by_name["path"]
    assert path["properties"]["duration_s"] == pytest.approx(plan.duration_s, abs=0.05)
    np.testing.assert_allclose(
        path["geometry"]["coordinates"][0], plan.path.positions[0], atol=1e-3
    )


@pytest.mark.extended
def test_geojson_and_kml_are_in_longitudes_and_latitudes(scanner):
    plan = planned(scanner, shapely.box(0, 0, 800, 400), cross=1)
    origin = np.array([512_000.0, 5_403_000.0, 0.0])
    content = json.loads(to_geojson(plan, 32632, origin))
    by_name = {f["properties"]["name"]: f for f in content["features"]}
    assert set(by_name) == {"area", "line-1", "cross-1", "path"}
    back = transform_shape(shapely.geometry.shape(by_name["line-1"]["geometry"]), 4326, 32632)
    start = np.array(back.coords)[0, :2] - origin[:2]
    assert start == pytest.approx(plan.lines[0].leg.start, abs=1e-3)
    root = ElementTree.fromstring(to_kml(plan, 32632, origin))
    names = [e.text for e in root.iter("{http://www.opengis.net/kml/2.2}name")]
    assert names == ["Flight plan", "area", "line-1", "cross-1", "path"]
    local = json.loads(to_geojson(plan, None, np.zeros(3)))
    assert local["features"][1]["geometry"]["coordinates"][0][:2] == [-2.0, 200.0]
