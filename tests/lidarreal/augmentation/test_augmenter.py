"""Effects on recorded sweeps, compared with the same effects on cast rays."""

from dataclasses import replace

import numpy as np
import pytest
from tests.made_recordings import changed_recording, made_recording
from tests.simulated_drives import simulated_drive

from lidarfiles import open_recording
from lidarreal import augment
from lidarreal.augmentation.augmenter import Augmenter
from lidarreal.augmentation.effects import Effects, Insertion
from lidarreal.augmentation.insertions import load_insertion
from lidarreal.augmentation.object_classes import find_class
from lidarsim import Fault, Pose, Scanner, Scene, Survey, Track, load_sensor
from lidarsim.columns.sweep import Sweep
from lidarsim.columns.table import CAUSES
from lidarsim.errors import LidarError
from lidarsim.media.weather import Weather
from lidarsim.motion.rotations import matrices
from lidarsim.scene.actors import Actor, box
from lidarsim.scene.scene_mesh import SceneMesh

HEIGHT_M = 1.9
SWEEPS = 4
AIR = CAUSES.index("air")
CAR = box("Car", (4.5, 1.8, 1.5))


@pytest.fixture(scope="module")
def sensor():
    model = load_sensor("ouster/os1-32", columns=512, performance="datasheet")
    return replace(model, returns=replace(model.returns, subrays=1))


@pytest.fixture(scope="module")
def scene():
    """A floor and two walls. About half of the pulses have no return."""
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    floor = np.array([[-80, -80, 0], [80, -80, 0], [80, 80, 0], [-80, 80, 0.0]])
    wall = np.array([[30, -40, 0], [30, 40, 0], [30, 40, 8], [30, -40, 8.0]])
    near = np.array([[-20, 6, 0], [10, 6, 0], [10, 6, 4], [-20, 6, 4.0]])
    meshes = zip(("floor", "wall", "near"), (floor, wall, near), strict=True)
    return Scene.from_meshes([SceneMesh(name, corners, faces) for name, corners in meshes])


def scan(scene, sensor, count=SWEEPS, **weather):
    """Simulate sweeps of a stationary sensor."""
    columns = ["range", "intensity", "cause", "time"]
    scanner = Scanner(scene, sensor, columns=columns, coordinates="sensor", **weather)
    return [scanner.sweep(Pose((0, 0, HEIGHT_M))) for _ in range(count)]


def recording_of(clouds, **fields):
    """Make a recording with the energies of simulated sweeps."""

    def read(number):
        cloud = clouds[number]
        columns = {
            "channel": cloud["channel"],
            "intensity": cloud["intensity"],
            "time": 1e-9 * (cloud["time"] - cloud["time"].min()),
        }
        return Sweep(np.asarray(cloud.positions, np.float64), columns)

    stamps_ns = 1e8 * np.arange(len(clouds))
    options = {"energy_unit": 1.0, "read_stamps": lambda: stamps_ns, "compensated": False}
    return made_recording("drive", len(clouds), read, **options | fields)


@pytest.fixture(scope="module")
def clear(scene, sensor):
    return recording_of(scan(scene, sensor))


def augmented(recording, sensor, **effects):
    augmenter = Augmenter(recording, Effects(**effects), sensor)
    return [augmenter.sweep(number) for number in range(len(recording))]


def concatenated(sweeps, name):
    return np.concatenate([sweep.sweep.columns[name] for sweep in sweeps])


def ranges_of(sweeps):
    return np.concatenate([np.linalg.norm(sweep.sweep.points, axis=1) for sweep in sweeps])


def assert_same_distribution(a, b):
    """Compare two samples by the Kolmogorov-Smirnov statistic, at a significance of 1e-4."""
    values = np.sort(np.concatenate([a, b]))
    shares = [np.searchsorted(np.sort(part), values, "right") / len(part) for part in (a, b)]
    distance = np.abs(shares[0] - shares[1]).max()
    assert distance < 2.2 * np.sqrt(1 / len(a) + 1 / len(b))


def test_without_effects_nothing_changes(clear, sensor):
    for number, result in enumerate(augmented(clear, sensor)):
        recorded = clear[number]
        assert result.is_recorded.all()
        np.testing.assert_array_equal(result.template, np.arange(len(recorded)))
        np.testing.assert_array_equal(result.sweep.points, recorded.points)
        for name, values in recorded.columns.items():
            np.testing.assert_array_equal(result.sweep.columns[name], values)


@pytest.mark.parametrize(
    "weather",
    [
        {"visibility_km": 0.1},
        {"rain_mm_h": 40.0},
        {"snow_mm_h": 2.0},
        {"dust_mg_m3": 60.0},
    ],
    ids=lambda weather: next(iter(weather)),
)
def test_weather_has_the_distributions_of_a_simulation_in_that_weather(
    weather, clear, scene, sensor
):
    results = augmented(clear, sensor, weather=Weather(**weather))
    clouds = scan(scene, sensor, **weather)
    causes = concatenated(results, "cause"), np.concatenate([c["cause"] for c in clouds])
    ranges = (
        ranges_of(results),
        np.concatenate([np.linalg.norm(c.positions, axis=1) for c in clouds]),
    )
    energies = concatenated(results, "intensity"), np.concatenate([c["intensity"] for c in clouds])
    for cause in (CAUSES.index("surface"), AIR):
        chosen = [values == cause for values in causes]
        counts = np.array([mask.sum() for mask in chosen])
        assert counts.min() > 30
        assert abs(counts[0] - counts[1]) < 4 * np.sqrt(counts.sum())
        for values in (ranges, energies):
            assert_same_distribution(values[0][chosen[0]], values[1][chosen[1]])


def test_pulses_without_a_return_return_from_fog(clear, sensor):
    results = augmented(clear, sensor, weather=Weather(visibility_km=0.05))
    directions = np.concatenate([r.sweep.points[~r.is_recorded] for r in results])
    elevation = np.degrees(np.arcsin(directions[:, 2] / np.linalg.norm(directions, axis=1)))
    assert (elevation > 10).sum() > 100  # nothing was recorded there
    top = max(clear[number].points[:, 2].max() for number in range(SWEEPS))
    assert top < 8


def test_weak_returns_are_not_lost_again(clear, sensor):
    """Recorded returns were detected, however weak they are, so clear air loses none of them."""
    (first, *_) = augmented(clear, sensor, weather=Weather(visibility_km=1e6))
    assert first.is_recorded.sum() == len(clear[0])


def test_intensities_of_attenuated_returns_are_scaled(clear, sensor):
    weather = Weather(visibility_km=0.5, fog_lidar_ratio_sr=None)
    (first, *_) = augmented(clear, sensor, weather=weather)
    recorded = clear[0]
    range_m = np.linalg.norm(recorded.points, axis=1)[first.template]  # within 3 cm
    extinction = weather.extinction_at(sensor.optics.simulated_nm)
    expected = recorded.columns["intensity"][first.template] * np.exp(-2 * extinction * range_m)
    np.testing.assert_allclose(first.sweep.columns["intensity"], expected, rtol=1e-3)


def test_dead_channels_and_dropped_packets(clear, sensor):
    faults = (
        Fault("dead_channels", channels=[3, 5]),
        Fault("dropped_packets", share=0.25, packet=16),
    )
    results = augmented(clear, sensor, faults=faults)
    channels = concatenated(results, "channel")
    assert not np.isin(channels, [3, 5]).any()
    recorded = np.concatenate([clear[number].columns["channel"] for number in range(SWEEPS)])
    alive = (~np.isin(recorded, [3, 5])).sum()
    assert 0.6 < len(channels) / alive < 0.9


def test_dirt_blocks_a_sector(clear, sensor):
    faults = (Fault("dirt", azimuth_deg=(-45, 45), transmission=0.0),)
    (first, *_) = augmented(clear, sensor, faults=faults)
    azimuth = np.degrees(np.arctan2(*first.sweep.points[:, 1::-1].T))
    assert not (np.abs(azimuth) < 44.9).any()
    expected = np.degrees(np.arctan2(*clear[0].points[:, 1::-1].T))
    assert (np.abs(azimuth) > 45.1).sum() == (np.abs(expected) > 45.1).sum()


def test_noise_is_added_to_recorded_ranges(clear, sensor):
    (first, *_) = augmented(clear, sensor, noise={"range_m": 0.1})
    recorded = clear[0].points[first.template]
    shift = first.sweep.points - recorded
    errors = np.linalg.norm(shift, axis=1)
    assert 0.095 < np.sqrt((errors**2).mean()) < 0.105
    along_beam = (shift * recorded).sum(axis=1) / np.linalg.norm(recorded, axis=1)
    np.testing.assert_allclose(np.abs(along_beam), errors, rtol=1e-3)


def test_the_number_of_a_sweep_determines_its_random_numbers(clear, sensor):
    effects = Effects(weather=Weather(snow_mm_h=2.0))
    augmenter = Augmenter(clear, effects, sensor)
    forward = [augmenter.sweep(number).sweep.points for number in range(SWEEPS)]
    again = Augmenter(clear, effects, sensor).sweep(2).sweep.points
    np.testing.assert_array_equal(forward[2], again)
    other = Augmenter(clear, replace(effects, seed=1), sensor).sweep(2).sweep.points
    assert other.shape != again.shape or not np.array_equal(other, again)


def test_inserted_car_has_the_points_of_a_simulation_with_the_car(scene, sensor):
    ideal = replace(sensor, noise=None)
    recording = recording_of(scan(scene, ideal, 1), energy_unit=1.0)
    pose = Pose((12, -3, 0), yaw_deg=30)
    (truth,) = scan(scene.with_actors([_static(CAR, pose)]), ideal, 1)
    insertion = Insertion(CAR, 12, -3, -HEIGHT_M, heading_deg=30, class_name="")
    augmenter = Augmenter(recording, Effects(insertions=(insertion,)), ideal)
    result = augmenter.sweep(0)
    on_car = truth["object"] == len(scene.names)
    expected = np.asarray(truth.positions)[on_car]
    added = result.sweep.points[~result.is_recorded]
    # Sub-rays at the outline also hit the car, and pulses into the sky were restored.
    distance = np.linalg.norm(expected[:, None] - added, axis=2).min(axis=1)
    assert np.quantile(distance, 0.95) < 0.02
    assert abs(len(added) - len(expected)) < 0.1 * len(expected)
    box_rows = result.boxes.rows
    np.testing.assert_allclose(box_rows[0, :2], [12, -3], atol=0.5)
    np.testing.assert_allclose(box_rows[0, 3:6], [4.5, 1.8, 1.5], atol=1e-6)
    assert result.boxes.points[0] == len(added)
    assert result.visibility[0] > 0.95


def _static(mesh, pose):
    vertices = mesh.vertices @ pose.rotation_matrix.T + pose.position
    return Actor(replace(mesh, vertices=vertices))


def test_no_point_is_visible_behind_an_inserted_car(clear, sensor):
    insertion = Insertion(CAR, 12, -3, heading_deg=0)
    result = Augmenter(clear, Effects(insertions=(insertion,)), sensor).sweep(0)
    added = result.sweep.points[~result.is_recorded]
    kept = result.sweep.points[result.is_recorded]
    units = [points / np.linalg.norm(points, axis=1)[:, None] for points in (added, kept)]
    cosine = units[1] @ units[0].T
    nearest = cosine.argmax(axis=1)
    same = cosine[np.arange(len(kept)), nearest] > np.cos(np.radians(0.05))
    added_m = np.linalg.norm(added, axis=1)[nearest]
    assert not (np.linalg.norm(kept, axis=1)[same] > added_m[same] + 2).any()


def test_inserted_car_stands_on_the_ground(clear, sensor):
    result = Augmenter(clear, Effects(insertions=(Insertion(CAR, 12, -3),)), sensor).sweep(0)
    center, size = result.boxes.rows[0, 2], result.boxes.rows[0, 5]
    assert center - size / 2 == pytest.approx(-HEIGHT_M, abs=0.02)


def test_points_of_an_inserted_car_are_labeled(clear, sensor):
    effects = Effects(
        insertions=(Insertion(CAR, 12, -3, class_name="car"),),
        weather=Weather(snow_mm_h=2.0),
        classes={10: "car"},
    )
    result = Augmenter(clear, effects, sensor).sweep(0)
    columns = result.sweep.columns
    on_car = columns["object"] == result.boxes.objects[0]
    assert on_car.sum() == result.boxes.points[0] > 100
    assert (columns["class"] == np.where(on_car, 10, 0)).all()
    assert (columns["object"][~on_car] == -1).all()
    assert not result.is_recorded[on_car].any()
    assert (columns["cause"] == AIR).any()


def test_an_occluded_car_is_invisible(clear, sensor):
    """The car stands behind the near wall at y = 6 m."""
    insertion = Insertion(CAR, -5, 9, -HEIGHT_M)
    result = Augmenter(clear, Effects(insertions=(insertion,)), sensor).sweep(0)
    assert result.is_recorded.all()
    assert result.boxes.points[0] == 0
    assert result.visibility[0] == 0


def test_a_stationary_car_keeps_its_place_while_the_sensor_moves(scene, sensor):
    columns = ["range", "intensity", "cause", "time"]
    scanner = Scanner(scene, sensor, columns=columns, coordinates="sensor")
    clouds = [scanner.sweep(Pose((2.0 * k, 0, HEIGHT_M))) for k in range(3)]
    poses = np.repeat(np.eye(4)[None], 3, axis=0)
    poses[:, 0, 3] = [0, 2, 4]
    recording = recording_of(clouds, read_poses=lambda: poses, compensated=None)
    insertion = Insertion(CAR, 12, -3)
    augmenter = Augmenter(recording, Effects(insertions=(insertion,)), sensor)
    centers = [augmenter.sweep(number).boxes.rows[0, 0] for number in range(3)]
    np.testing.assert_allclose(centers, [12, 10, 8], atol=1e-3)


@pytest.mark.parametrize("is_stamped", [True, False])
def test_cars_move_during_a_sweep(clear, sensor, is_stamped):
    """Sweeps without timestamps last as long as a revolution of the sensor."""
    clear = clear if is_stamped else changed_recording(clear, read_stamps=None)
    speed = 20.0
    track = Track([0.0, 1.0], [[10, -3, -HEIGHT_M], [10 + speed, -3, -HEIGHT_M]], yaw_deg=0.0)
    augmenter = Augmenter(clear, Effects(actors=(Actor(CAR, track),)), sensor)
    first, second = (augmenter.sweep(number).boxes.rows[0, 0] for number in (0, 1))
    assert second - first == pytest.approx(0.1 * speed, abs=1e-3)


def test_added_points_have_the_times_of_their_firings(clear, sensor):
    """About half of the pulses have no recorded return, whose time they could copy."""
    result = Augmenter(clear, Effects(weather=Weather(visibility_km=0.05)), sensor).sweep(0)
    recorded = clear[0]

    def turned(points, channel):
        """Return the rotation of the head in turns."""
        azimuth = np.arctan2(points[:, 1], points[:, 0]) - sensor.beams.azimuth[channel]
        return -azimuth / (2 * np.pi)

    offset = recorded.columns["time"] / 0.1 - turned(recorded.points, recorded.columns["channel"])
    start = np.angle(np.exp(2j * np.pi * offset).mean()) / (2 * np.pi)
    added = ~result.is_recorded
    channel = result.sweep.columns["channel"][added]
    expected = turned(result.sweep.points[added], channel) + start
    late = result.sweep.columns["time"][added] / 0.1 - expected
    late -= np.rint(late)
    assert added.sum() > 5000
    assert np.quantile(np.abs(late), 0.99) < 1 / 512
    assert abs(np.median(late)) < 0.3 / 512


@pytest.mark.parametrize("marker", [0.0, np.nan])
def test_pulses_without_a_return_are_no_points(clear, sensor, marker):
    """Organized sweeps contain them, in other rows than the returns."""

    def read(number):
        sweep = clear.load(number)
        rows = np.arange(len(sweep)).repeat(1 + (np.arange(len(sweep)) % 5 == 0))
        is_lost = np.append(False, np.diff(rows) == 0)
        organized = sweep.select(rows)
        points = organized.points.copy()
        points[is_lost] = marker
        return organized.replace(points=points)

    organized = changed_recording(clear, read=read)
    effects = Effects(weather=Weather(snow_mm_h=3.0))
    expected = Augmenter(clear, effects, sensor).sweep(0)
    result = Augmenter(organized, effects, sensor).sweep(0)
    returned = result.sweep.has_return
    np.testing.assert_allclose(result.sweep.points[returned], expected.sweep.points)
    np.testing.assert_array_equal(result.is_recorded[returned], expected.is_recorded)
    recorded_rows = np.flatnonzero(read(0).has_return)
    np.testing.assert_array_equal(result.template[returned], recorded_rows[expected.template])


def test_constant_times_are_kept(clear, sensor):
    def read(number):
        sweep = clear.load(number)
        return sweep.replace(columns={**sweep.columns, "time": np.full(len(sweep), 7.0)})

    constant = changed_recording(clear, read=read, read_stamps=None)
    result = Augmenter(constant, Effects(weather=Weather(visibility_km=0.1)), sensor).sweep(0)
    assert (~result.is_recorded).any()
    assert (result.sweep.columns["time"] == 7).all()


def test_a_car_keeps_its_place_far_away_while_the_sensor_turns(scene, sensor):
    columns = ["range", "intensity", "cause", "time"]
    scanner = Scanner(scene, sensor, columns=columns, coordinates="sensor")
    places = [Pose((2.0 * k, -0.7 * k, HEIGHT_M), yaw_deg=20.0 + 15 * k) for k in range(3)]
    clouds = [scanner.sweep(place) for place in places]
    poses = np.repeat(np.eye(4)[None], 3, axis=0)
    for pose, place in zip(poses, places, strict=True):
        pose[:3, :3] = place.rotation_matrix
        pose[:3, 3] = np.add(place.position, [500_000.25, 5_400_000.5, 40])
    recording = recording_of(clouds, read_poses=lambda: poses, compensated=None)
    effects = Effects(insertions=(Insertion(CAR, 9, -3, -HEIGHT_M, heading_deg=35),))
    augmenter = Augmenter(recording, effects, sensor)
    first = np.eye(4)
    heading = np.radians(35)
    first[:2, :2] = [[np.cos(heading), -np.sin(heading)], [np.sin(heading), np.cos(heading)]]
    first[:3, 3] = [9, -3, -HEIGHT_M]
    middle = np.array([*CAR.vertices.mean(axis=0), 1.0])
    for number in range(3):
        result = augmenter.sweep(number)
        in_sensor = np.linalg.inv(poses[number]) @ poses[0] @ first
        boxes = result.boxes
        np.testing.assert_allclose(boxes.centers[0], (in_sensor @ middle)[:3], atol=1e-3)
        forward = matrices(boxes.quaternions)[0][:, 0]
        np.testing.assert_allclose(forward, in_sensor[:3, 0], atol=1e-6)
        added = result.sweep.points[~result.is_recorded]
        local = (added - boxes.centers[0]) @ matrices(boxes.quaternions)[0]
        assert len(added) > 50
        assert (np.abs(local) <= boxes.sizes[0] / 2 + 0.05).mean() > 0.98


def test_later_sweeps_without_intensities_are_named(clear, sensor):
    def read(number):
        sweep = clear.load(number % len(clear))
        names = {*sweep.columns} - ({"intensity", "reflectivity"} if number == 2 else set())
        return sweep.replace(columns={name: sweep.columns[name] for name in names})

    mix = made_recording("mix", 21, read)
    augmenter = Augmenter(mix, Effects(weather=Weather(rain_mm_h=5)), sensor)
    with pytest.raises(
        LidarError, match=r"Unlike other sweeps, sweep 2 in mix has no column '\w+', "
    ):
        augmenter.sweep(2)
    assert len(augmenter.sweep(4).sweep) > 0


@pytest.mark.parametrize(
    ("x_m", "z_m", "relation"),
    [(0, -0.5, "contains"), (0, -5, "is below"), (0, 5, "is above"), (12, -0.5, None)],
)
def test_objects_around_the_sensor_are_noted(clear, sensor, x_m, z_m, relation):
    crate = Insertion(box("crate", (1, 1, 1)), x_m, 0, z_m)
    notes = Augmenter(clear, Effects(insertions=(crate,)), sensor).notes
    noted = [note for note in notes if note.startswith("The inserted object")]
    if relation is None:
        assert not noted
    else:
        assert len(noted) == 1
        assert noted[0].startswith(f"The inserted object 'crate' {relation} the sensor")


def test_unknown_rings_are_noted(clear, sensor):
    def without_rings(number):
        sweep = clear.load(number)
        rows = np.random.default_rng(number).permutation(len(sweep))
        columns = {"intensity": sweep.columns["intensity"][rows]}
        noise = 0.02 * np.random.default_rng(number).normal(size=(len(rows), 3))
        return Sweep(sweep.points[rows] + noise, columns)

    recording = made_recording("drive", SWEEPS, without_rings, energy_unit=1.0)
    augmenter = Augmenter(recording, Effects(weather=Weather(visibility_km=0.1)), sensor)
    assert any("pulses without a return are unknown" in note for note in augmenter.notes)
    result = augmenter.sweep(0)
    recorded = clear[0].points
    assert len(result.sweep) <= len(recorded)


@pytest.mark.parametrize("kind", ["frozen", "time_jump"])
def test_faults_of_timestamps_are_refused(kind, clear, sensor):
    fault = Fault(kind, 0.2) if kind == "frozen" else Fault(kind, 0.2, by_s=1.0)
    with pytest.raises(LidarError, match="cannot be simulated on a recording"):
        Augmenter(clear, Effects(faults=(fault,)), sensor)


def test_clouds_and_recordings_without_sweeps_are_refused(tmp_path, sensor):
    with pytest.raises(LidarError, match="empty contains no sweeps"):
        Augmenter(made_recording("empty", 0, None), Effects(), sensor)
    (tmp_path / "cloud.xyz").write_text("1 2 3\n")
    for cloud in (tmp_path / "cloud.xyz", open_recording(tmp_path / "cloud.xyz")):
        with pytest.raises(LidarError, match=r"cloud\.xyz contains no sweeps"):
            augment(cloud)


def test_a_sweep_without_points_stays_empty(scene, sensor):
    clouds = scan(scene, sensor, 2)
    full = recording_of(clouds)

    def read(number):
        return full.load(number) if number else full.load(0).select(slice(0))

    recording = changed_recording(full, read=read)
    result = Augmenter(recording, Effects(weather=Weather(snow_mm_h=2.0)), sensor).sweep(0)
    assert len(result.sweep) == 0
    assert result.sweep.columns["cause"].shape == (0,)


@pytest.mark.extended
def test_results_do_not_depend_on_how_pulses_are_divided(clear, sensor, monkeypatch):
    track = Track([0, 1], [[-10, 3, 0.7], [10, 3, 0.7]])
    effects = {
        "weather": Weather(snow_mm_h=2.0),
        "insertions": (Insertion(CAR, 8, -3),),
        "actors": (Actor(replace(CAR, name="Moving"), track),),
    }
    whole = augmented(clear, sensor, **effects)
    monkeypatch.setattr("lidarsim.pulses.pulses.CHUNK_RAYS", 1 << 11)
    for one, other in zip(whole, augmented(clear, sensor, **effects), strict=True):
        assert np.array_equal(one.sweep.points, other.sweep.points)
        assert one.sweep.columns.keys() == other.sweep.columns.keys()
        for name, values in one.sweep.columns.items():
            assert np.array_equal(values, other.sweep.columns[name])


@pytest.mark.parametrize("seed", range(4))
def test_points_are_sorted_by_the_closest_return_of_their_channel(seed):
    from lidarreal.augmentation.grid_loops import sort_points

    rng = np.random.default_rng(seed)
    firings, channels = 40, 8
    cell = np.sort(rng.choice(firings * channels, 60, replace=False))
    silent = [(3,), (0, 2, 3, 7)][seed % 2]  # channels without returns
    cell = cell[~np.isin(cell % channels, silent)]
    row = rng.permutation(len(cell))
    added = rng.choice(firings * channels, 50, replace=False)
    ray = np.concatenate([cell, added])
    source = np.concatenate([np.arange(len(cell)), np.full(len(added), -1)]).astype(np.int32)
    by_ray = np.argsort(ray, kind="stable")
    ray, source = ray[by_ray], source[by_ray]
    nearest, order = np.empty((2, len(ray)), np.int64)
    sort_points(ray, source, cell, row, (firings, channels), nearest, order)
    assert np.array_equal(np.sort(order), np.arange(len(ray)))
    is_added = source[order] < 0
    assert np.array_equal(nearest[~is_added], source[order][~is_added])
    keys = 2 * row[nearest] + is_added
    assert (np.diff(keys) >= 0).all()
    for ray_k, nearest_k in zip(ray[order][is_added], nearest[is_added], strict=True):
        channels_apart = np.abs(cell % channels - ray_k % channels)
        assert channels_apart[nearest_k] == channels_apart.min()
        if ray_k % channels not in silent:
            own = cell % channels == ray_k % channels
            firings_apart = np.abs(cell // channels - ray_k // channels)
            assert firings_apart[nearest_k] == firings_apart[own].min()


def test_a_recording_in_snow_is_noted(scene, sensor):
    """In clear air, there is no such note."""
    effects = Effects(weather=Weather(visibility_km=0.5))
    snowy = recording_of(scan(scene, sensor, snow_mm_h=1.0))
    assert any("are isolated, as in rain" in n for n in Augmenter(snowy, effects, sensor).notes)
    clear = recording_of(scan(scene, sensor))
    assert not any("isolated" in note for note in Augmenter(clear, effects, sensor).notes)


def test_a_model_with_fewer_channels_is_refused(clear):
    effects = Effects(weather=Weather(snow_mm_h=1.0))
    with pytest.raises(LidarError, match="rings, but Velodyne VLP-16 has 16 channels"):
        Augmenter(clear, effects, load_sensor("velodyne/vlp16"))


def test_classes_have_the_numbers_of_the_recording(clear, sensor):
    def read(number):
        sweep = clear.load(number)
        return sweep.replace(columns={**sweep.columns, "class": np.zeros(len(sweep), np.uint16)})

    named = changed_recording(clear, read=read, read_classes=lambda: {10: "car", 40: "road"})
    car = Effects(insertions=(Insertion(CAR, 12, -3, class_name="car"),))
    result = Augmenter(named, car, sensor).sweep(0)
    assert {*result.sweep.columns["class"][~result.is_recorded].tolist()} == {10}
    lorry = Effects(insertions=(Insertion(CAR, 12, -3, class_name="lorry"),))
    with pytest.raises(LidarError, match="Unknown class 'lorry'"):
        Augmenter(named, lorry, sensor)
    unnamed = changed_recording(clear, read=read)
    notes = Augmenter(unnamed, car, sensor).notes
    assert any("does not state the numbers of its classes" in note for note in notes)


SEMANTIC_KITTI = {10: "car", 30: "person", 31: "bicyclist", 252: "moving-car", 254: "moving-person"}
LIDARSEG = {2: "human.pedestrian.adult", 17: "vehicle.car", 18: "vehicle.emergency.police"}


@pytest.mark.parametrize(
    ("names", "kind", "expected"),
    [
        (SEMANTIC_KITTI, "pedestrian", "person"),
        (SEMANTIC_KITTI, "cyclist", "bicyclist"),
        (SEMANTIC_KITTI, "Car", "car"),
        (SEMANTIC_KITTI, "moving_person", "moving-person"),
        (LIDARSEG, "person", "human.pedestrian.adult"),
        (LIDARSEG, "car", "vehicle.car"),
        (LIDARSEG, "police", "vehicle.emergency.police"),
        ({1: "Pedestrian", 2: "person"}, "person", "person"),
        ({1: "Pedestrian", 2: "person"}, "pedestrian", "Pedestrian"),
        ({1: "Walker"}, "human", "Walker"),
        (SEMANTIC_KITTI, "boat", None),
        (LIDARSEG, "adult", "human.pedestrian.adult"),
    ],
)
def test_classes_of_data_sets_have_synonyms(names, kind, expected):
    assert find_class(kind, names.values()) == expected


def test_objects_of_the_same_shape_are_numbered(clear, sensor):
    """Two pedestrians, a third with a name, and an actor whose name the second would have."""

    def read(number):
        sweep = clear.load(number)
        return sweep.replace(columns={**sweep.columns, "class": np.zeros(len(sweep), np.uint16)})

    named = changed_recording(clear, read=read, read_classes=lambda: SEMANTIC_KITTI)
    places = [(6.0, -3.0), (7.0, 4.0), (-5.0, 5.0)]
    people = tuple(
        Insertion(load_insertion("pedestrian"), x, y, class_name="pedestrian", name=name)
        for (x, y), name in zip(places, ("", "", "Anna"), strict=True)
    )
    track = Track([0, 1], [[-10, 3, 0.7], [10, 3, 0.7]])
    actor = Actor(replace(CAR, name="pedestrian_2"), track)
    augmenter = Augmenter(named, Effects(insertions=people, actors=(actor,)), sensor)
    assert augmenter.objects.names == ("pedestrian", "pedestrian_3", "Anna", "pedestrian_2")
    assert augmenter.objects.types[:3] == ("pedestrian",) * 3
    result = augmenter.sweep(0)
    added = ~result.is_recorded
    points, objects = result.sweep.points[added], result.sweep.columns["object"][added]
    numbers = np.unique(objects)[:3]
    for number, (x, y) in zip(numbers, places, strict=True):
        distance = np.hypot(*(points[objects == number, :2] - [x, y]).T)
        assert len(distance) > 10 and distance.max() < 0.6
    is_person = np.isin(objects, numbers)
    assert {*result.sweep.columns["class"][added][is_person].tolist()} == {30}


def test_actors_of_the_same_name_are_refused(clear, sensor):
    track = Track([0, 1], [[-10, 3, 0.7], [10, 3, 0.7]])
    actor = Actor(replace(CAR, name="Moving"), track)
    with pytest.raises(LidarError, match="Two inserted objects are named 'Moving'"):
        Augmenter(clear, Effects(actors=(actor, actor)), sensor)


def test_sweeps_of_different_sensors_are_refused(scene, sensor):
    other = load_sensor("velodyne/vlp16")
    clouds = [
        cloud
        for pair in zip(scan(scene, sensor, 2), scan(scene, other, 2), strict=True)
        for cloud in pair
    ]
    with pytest.raises(LidarError, match="the sweeps come from different sensors"):
        Augmenter(recording_of(clouds), Effects(weather=Weather(snow_mm_h=1.0)))


@pytest.mark.parametrize("model", ["livox/mid360", "livox/avia"])
@pytest.mark.parametrize("coordinates", ["world", "sensor"])
def test_lines_of_a_moving_livox_need_not_be_cones(model, coordinates):
    """The surfaces that a line hits differ from sweep to sweep."""
    sizes = {"Floor": (60, 40, 0.1), "Wall": (1, 20, 6), "Side": (30, 1, 5)}
    hall = Scene.from_meshes([box(name, size) for name, size in sizes.items()])
    survey = Survey(
        load_sensor(model),
        trajectory=Track([0, 1], [[-9, -6, HEIGHT_M], [7, -6, HEIGHT_M]]),
        steps=36 * SWEEPS,
        columns=["time", "intensity"],
        coordinates=coordinates,
    )
    recording = open_recording(simulated_drive(hall, survey), name="drive")
    augmenter = Augmenter(recording, Effects(weather=Weather(visibility_km=0.02)))
    assert any("pulses without a return are unknown" in note for note in augmenter.notes)
    results = [augmenter.sweep(number) for number in range(SWEEPS)]
    assert all(result.is_recorded.any() for result in results)
    assert any((~result.is_recorded).any() for result in results)
