"""Scans as a worker casts them, against rays that are made one by one and cast by themselves."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tests.shapes import Cart, cast_between, tally_of

from lidarfiles.parts.parts import pack
from lidarsim import Actor, Beams, Column, Mounted, Pose, Scene, Sensor, Spin, Survey, Track, box
from lidarsim.casting import static_bodies
from lidarsim.scene.shapes import seed_objects
from lidarsim.simulator.points.batch_columns import columns_of
from lidarsim.simulator.rig import Rig
from raybeam import RayCaster

ELEVATIONS = np.radians([-20, -5, 0, 12])
BEAMS = Beams(
    ELEVATIONS,
    azimuth=np.radians([0, 1.5, 0, -1.5]),
    time_ns=[0, 50_000, 100_000, 150_000],
    origin=[[0.1, 0, 0], [0.1, 0.02, 0], [0.1, -0.02, 0], [0.1, 0, 0.05]],
)
TURNED = (Pose((0, 0, 1), 10, 5, -3), Pose((3, -2, 2)))


def grazing(returns):
    """A column of one's own: how flat a ray meets its triangle, degrees."""
    return 90 - np.degrees(np.arccos(returns.cosine))


# No rays along the edges of triangles, which two ways to round tell apart.
CART = Cart(height=1.003)
OWN = Column("grazing", "float32", "deg", "angle between ray and triangle", grazing)
COLUMNS = ("ray", "time", "azimuth", "elevation", "range", "intensity", "triangle", OWN)


def survey(beams=BEAMS, per_turn=90, **options):
    sensor = Sensor(beams, Spin(per_turn, step_deg=30, rate_hz=10), 0.5, 40)
    return Survey(sensor, steps=14, keep_every=3, columns=COLUMNS, **options)


SURVEYS = {
    "beams without offsets": survey(Beams(ELEVATIONS), poses=TURNED),
    "beams with offsets": survey(poses=TURNED),
    "turns of no whole number": survey(per_turn=90.449, poses=TURNED),
    "on the move": survey(trajectory=CART),
    "on the move, no whole number": survey(
        per_turn=90.449, trajectory=replace(CART, yaw_rate_deg=-700)
    ),
}

MOUNT = Pose((0.4, -0.2, 0.3), 30, -8, 3)
SURVEYS |= {
    f"{name}, mounted": replace(survey, sensors=[Mounted(survey.sensor, MOUNT)])
    for name, survey in SURVEYS.items()
    if name in ("beams without offsets", "on the move")
}


@pytest.fixture(scope="module")
def scene():
    return Scene.from_meshes(seed_objects(rings=8, segments=12))


def about_z(angle):
    c = np.cos(angle)
    s = np.sin(angle)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])


def rays_of_scan(survey, scan):
    """Origins, directions in the scene and in the sensor, and times of a scan's rays."""
    spec = survey.scan(scan)
    carried = survey.mounted_sensors[spec.sensor]
    head = carried.sensor.head
    beams = carried.sensor.beams
    mount = carried.mount
    seat = np.eye(3) if mount.rotation is None else mount.rotation
    rows = []
    for firing in range(*spec.firings):
        azimuth = 2 * np.pi * firing / head.firings_per_turn
        begun = firing * 1e9 / (head.rate_hz * head.firings_per_turn)
        for k, elevation in enumerate(beams.elevation):
            pose = survey.path.pose(spec.station, begun + beams.time_ns[k])
            rotation = np.eye(3) if pose.rotation is None else pose.rotation
            about = about_z(azimuth + beams.azimuth[k])
            looks = about @ [np.cos(elevation), 0, np.sin(elevation)]
            start = mount.position + seat @ about_z(azimuth) @ beams.origin[k]
            origin = pose.position + rotation @ start
            time = spec.start_ns + begun + beams.time_ns[k]
            rows.append((origin, rotation @ seat @ looks, looks, time, k))
    return [np.array(column) for column in zip(*rows, strict=True)]


@pytest.mark.extended
@pytest.mark.parametrize("name", SURVEYS)
def test_what_is_cast_is_what_each_ray_by_itself_meets(name, scene):
    survey = SURVEYS[name]
    caster = RayCaster(scene.vertices, scene.faces, backend="numpy")
    batches = list(Rig(scene, survey, "numpy").cast(0, survey.scan_count))
    assert [len(batch.specs) for batch in batches] == [14, 14], "a batch for each station"
    scans = 0
    for batch in batches:
        made = {c.name: c.make(batch) for c in survey.stored_columns}
        tally = np.zeros(len(scene.faces), int)
        for spec, stop in zip(batch.specs, np.cumsum(batch.counts), strict=True):
            origins, directions, looks, times, channels = rays_of_scan(survey, spec.scan)
            found = caster.cast(origins, directions, 0.5, 40)
            tally += np.bincount(found.triangle[found.hit], minlength=len(tally))
            kept = np.flatnonzero(found.hit)[::3]
            mine = slice(stop - len(kept), stop)
            assert np.array_equal(made["ray"][mine], kept)
            assert np.array_equal(made["channel"][mine], channels[kept])
            assert np.array_equal(made["triangle"][mine], found.triangle[kept])
            assert np.array_equal(made["object"][mine], scene.face_object[found.triangle[kept]])
            assert np.abs(made["time"][mine] - times[kept]).max(initial=0) <= 1
            assert np.allclose(made["range"][mine], found.distance[kept], atol=1e-5)
            ends = origins[kept] + directions[kept] * found.distance[kept, None]
            cells = np.stack([made[axis][mine] for axis in "xyz"], axis=1)
            assert np.abs(cells * 0.01 - ends).max(initial=0) <= 0.005 + 1e-6
            assert np.allclose(batch.positions[mine], ends, atol=1e-6)
            x, y, z = looks[kept].T
            turned = (made["azimuth"][mine] - np.degrees(np.arctan2(y, x)) + 180) % 360 - 180
            assert np.allclose(turned, 0, atol=1e-3)
            assert np.allclose(made["elevation"][mine], np.degrees(np.arcsin(z)), atol=1e-4)
            corners = scene.vertices[scene.faces[found.triangle[kept]]]
            normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
            normals /= np.linalg.norm(normals, axis=1, keepdims=True)
            cosines = np.abs((normals * directions[kept]).sum(axis=1))
            assert np.allclose(batch.cosine[mine], cosines, atol=1e-6)
            angles = 90 - np.degrees(np.arccos(cosines))
            assert np.allclose(made["grazing"][mine], angles, atol=0.05)
            scans += 1
        assert np.array_equal(tally_of([batch]), tally), "all hits, and not only those kept"
        assert np.array_equal(batch.scan, np.repeat([s.scan for s in batch.specs], batch.counts))
        assert len(batch) == batch.counts.sum() > 0
    assert scans == survey.scan_count


@pytest.mark.extended
@pytest.mark.parametrize("name", SURVEYS)
def test_however_scans_are_batched_their_columns_have_the_same_bits(name, scene):
    survey = SURVEYS[name]
    rig = Rig(scene, survey, "numpy")
    whole = cast_between(rig, survey, [0, 28])
    assert cast_between(rig, survey, [0, 1, 5, 14, 17, 28]) == whole
    assert cast_between(rig, survey, list(range(29))) == whole


def test_a_rig_of_another_survey_shares_the_trees_and_casts_the_same(monkeypatch):
    built = []

    class Counted(RayCaster):
        def __init__(self, vertices, faces, **options):
            built.append(len(faces))
            super().__init__(vertices, faces, **options)

    monkeypatch.setattr(static_bodies, "RayCaster", Counted)
    scene = Scene.from_meshes(seed_objects(rings=8, segments=12))
    car = Actor(box("Car", (4.5, 1.8, 1.5)), Track([0, 2], [[6, -3, 0.5], [6, 7, 0.5]]))
    surveys = [survey(poses=TURNED), survey(trajectory=CART)]
    rig = Rig(scene, surveys[0], "numpy")
    other = rig.with_survey(scene.with_actors([car]), surveys[1])
    assert built == [len(scene.faces)]
    fresh = Rig(scene.with_actors([car]), surveys[1], "numpy")
    for one, two in ((other, fresh), (rig, Rig(scene, surveys[0], "numpy"))):
        assert pack(columns_of(list(one.cast(0, 14)))) == pack(columns_of(list(two.cast(0, 14))))
    assert other.scene.actors == (car,) and rig.scene.actors == ()


def test_patterns_know_the_rays_from_one_firing_of_a_channel_to_its_next(scene):
    """Also patterns of a single firing, from which it cannot be guessed."""
    rig = Rig(scene, SURVEYS["beams with offsets"], "numpy")
    assert [rig.pattern(0, 0, stop).step for stop in (1, 90)] == [4, 4]
