"""Bodies that move: hits are those of each ray on each body, where that is at the ray's time."""

from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from raybeam import (
    DeformingMesh,
    Instance,
    Mesh,
    MovingBodies,
    Opacity,
    Pattern,
    PoseMotion,
    RayCaster,
    triangle,
)
from raybeam import moving as module
from raybeam.moving import nearest_body_hits
from raybeam.pattern_rays import compute_rays
from raybeam.scan import check_scan

pytestmark = pytest.mark.skipif(find_spec("numba") is None, reason="numba is not installed")

RAYS = 3_000
PERIOD = 0.1
FLAT = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]), [[0, 1, 2], [0, 2, 3]]


def ball(rings=12):
    """Vertices and faces of a ball of 1 m, and of two triangles a square."""
    v, u = np.meshgrid(np.linspace(0, np.pi, rings), np.linspace(0, 2 * np.pi, 2 * rings))
    points = np.stack([np.sin(v) * np.cos(u), np.sin(v) * np.sin(u), np.cos(v)], -1).reshape(-1, 3)
    a = (np.arange(2 * rings - 1)[:, None] * rings + np.arange(rings - 1)).ravel()
    faces = [[a, a + 1, a + rings], [a + 1, a + rings + 1, a + rings]]
    return points * [2, 1, 0.7], np.concatenate([np.stack(face, axis=1) for face in faces])


class Bodies:
    """Bodies on curves that turn about any axis; some appear late or leave early."""

    def __init__(self, count, seed, around=(0.0, 0, 0), speed=20.0):
        random = np.random.default_rng(seed)
        self.start = random.uniform(-12, 12, (count, 3)) + around
        self.speed = random.uniform(-speed, speed, (count, 3))
        self.axis = random.normal(size=(count, 3))
        self.axis /= np.linalg.norm(self.axis, axis=1)[:, None]
        self.rate = random.uniform(-10, 10, count)
        self.presence = np.tile([-np.inf, np.inf], (count, 1))
        self.presence[::3] = [0.3 * PERIOD, 0.7 * PERIOD]
        self.shape = random.integers(0, 3, count)

    def poses(self, body, times):
        assert (self.presence[body, 0] <= times).all() and (times <= self.presence[body, 1]).all()
        places = self.start[body] + times[:, None] * self.speed[body]
        places[:, 2] += np.sin(30 * times)
        angle = self.rate[body] * times
        axis = self.axis[body]
        cross = np.cross(np.eye(3), axis[:, None])
        spin = np.sin(angle)[:, None, None] * cross
        turns = np.eye(3) + spin + (1 - np.cos(angle))[:, None, None] * (cross @ cross)
        return table(places, turns)

    def moving(self, backend):
        mask = np.array([[False, True], [True, False]])
        uv = np.array([[0, 0], [1, 0], [1, 1], [0, 0], [1, 1], [0, 1]], np.float32).reshape(2, 3, 2)
        shapes = [Mesh(*ball()), Mesh(*FLAT, Opacity(mask, uv)), Mesh(*FLAT)]
        casters = [
            RayCaster.from_instances([Instance(mesh)], backend, threads=1) for mesh in shapes
        ]
        boxes = np.array([[[-2, -1, -0.7], [2, 1, 0.7]], *2 * [[[-1.0, -1, 0], [1, 1, 0]]]])
        return MovingBodies(tuple(casters), boxes, self.shape, self.presence, self.poses)


def table(places, turns):
    """Poses as `MovingBodies.poses` gives them."""
    return np.concatenate([places.T, turns.transpose(1, 2, 0).reshape(9, -1)])


def fan(count):
    """Firings of 16 beams around."""
    azimuth = np.repeat(np.linspace(0, 2 * np.pi, count // 16), 16)
    elevation = np.tile(np.linspace(-0.4, 0.4, 16), count // 16)
    flat = np.cos(elevation)
    return np.stack([np.cos(azimuth) * flat, np.sin(azimuth) * flat, np.sin(elevation)], axis=1)


def scans(kind, rays=RAYS):
    """Scan, times of its rays, and where its bodies are."""
    random = np.random.default_rng(5)
    far = np.zeros(3)
    directions = random.normal(size=(rays, 3))
    each = {}
    origins = None
    places = far
    if kind == "far":
        far = np.array([690_000.0, 5_335_000, 500])
    if kind in ("fan", "far", "moving", "paused"):
        directions = fan(rays)
        places = far
    if kind == "apart":
        origins = random.uniform(-20, 20, (rays, 3))
    if kind == "moving":
        firings = len(directions) // 16
        angle = 0.02 * np.arange(firings)
        turns = np.tile(np.eye(3), (firings, 1, 1))
        turns[:, 0, 0] = turns[:, 1, 1] = np.cos(angle)
        turns[:, 1, 0] = np.sin(angle)
        turns[:, 0, 1] = -np.sin(angle)
        places = np.linspace([-5, 0, 0], [5, 1, 0], firings)
        velocity = np.tile([5.0, 0, 0], (firings, 1))
        rate = np.tile([0, 0, 0.5], (firings, 1))
        motion = PoseMotion(np.linspace(0, 1e-4, 16), velocity, rate)
        each = {"rotations": turns, "rays_per_pose": 16, "motion": motion}
    pattern = Pattern(directions, origins)
    scan = check_scan(pattern, places, t_min=0.5, t_max=200, **each)
    times = np.sort(random.uniform(0, PERIOD, len(pattern))) if kind != "fan" else np.repeat(
        PERIOD * np.arange(len(pattern) // 16) / (len(pattern) // 16), 16)  # fmt: skip
    if kind == "paused":  # within a cell
        times[rays // 3 :] += 0.4
    return scan, times, far


def by_all(moving, scan, times):
    """Nearest hits, of each ray cast by itself at every body that is there."""
    origins, directions = compute_rays(scan.pattern, scan.first, np.arange(len(scan)), scan.poses)
    best = {}
    for body, (first, last) in enumerate(moving.presence):
        rows = np.flatnonzero((first <= times) & (times <= last))
        poses = moving.poses(np.full(len(rows), body), times[rows])
        places = poses[:3].T
        turns = poses[3:].reshape(3, 3, -1).transpose(2, 0, 1)
        starts = np.broadcast_to(origins, directions.shape)[rows] - places
        local = [
            np.stack([(x * a + y * b) + z * c for a, b, c in turns.transpose(2, 1, 0)], axis=1)
            for x, y, z in (starts.T, directions[rows].T)
        ]
        hits = moving.shapes[moving.shape[body]].cast(*local, scan.t_min, scan.t_max)
        x, y, z = local[1].T
        distance = hits.distance / np.sqrt((x * x + y * y) + z * z)
        for row in np.flatnonzero(hits.hit):
            found = (distance[row], body, hits.triangle[row])
            best[rows[row]] = min(best.get(rows[row], found), found)
    return [(ray, *best[ray]) for ray in sorted(best)]


def rays_of(hits):
    return np.flatnonzero(hits.body >= 0)


def listed(hits):
    columns = np.arange(len(hits.body)), hits.distance, hits.body, hits.triangle
    return [*zip(*(column[rays_of(hits)].tolist() for column in columns), strict=True)]


@pytest.mark.slow
@pytest.mark.slow(every=5)
@pytest.mark.parametrize("kind", ["fan", "any", "apart", "moving", "far", "paused"])
def test_hits_are_those_of_every_ray_on_every_body(kind, backend, monkeypatch):
    scan, times, around = scans(kind)
    moving = Bodies(70, 1, around).moving(backend)
    hits = nearest_body_hits(moving, scan, lambda ray: times[ray])
    expected = by_all(moving, scan, times)
    assert len(expected) > 80 and listed(hits) == expected
    assert len({body for _, _, body, _ in expected}) > 10
    monkeypatch.setattr(module, "CHUNK_RAYS", 650)
    monkeypatch.setattr(module, "CHUNK_PAIRS", 7)
    monkeypatch.setattr(module, "CHUNK_POSES", 999)
    assert listed(nearest_body_hits(moving, scan, lambda ray: times[ray])) == expected


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["fan", "any", "apart", "moving", "far"])
def test_hits_of_a_million_rays(kind):
    scan, times, around = scans(kind, 1_000_000)
    moving = Bodies(30, 2, around).moving("tiles")
    hits = nearest_body_hits(moving, scan, lambda ray: times[ray])
    assert listed(hits) == by_all(moving, scan, times)


@pytest.mark.extended(every=3)
def test_only_hits_before_what_stands_there_count(backend):
    scan, times, _ = scans("fan")
    moving = Bodies(24, 1).moving(backend)
    hits = nearest_body_hits(moving, scan, lambda ray: times[ray])
    ray = rays_of(hits)
    ends = hits.distance.copy()
    third = ray[::3]
    ends[third] = np.nextafter(hits.distance[third], np.inf)
    ends[ray[2::3]] /= 2
    before = nearest_body_hits(moving, scan, lambda ray: times[ray], ends)
    assert rays_of(before).tolist() == third.tolist()
    assert before.distance[third].tolist() == hits.distance[third].tolist()


def test_of_equal_distances_the_first_body_counts(backend):
    bodies = Bodies(4, 1)
    bodies.start[:] = [5, 0, 0]
    bodies.speed[:] = 0
    bodies.rate[:] = 0
    bodies.presence[:] = [-np.inf, np.inf]
    bodies.shape[:] = 0
    scan, times, _ = scans("fan")
    hits = nearest_body_hits(bodies.moving(backend), scan, lambda ray: times[ray])
    assert len(rays_of(hits)) > 50 and hits.body.max() == 0


def test_most_rays_are_not_looked_at(monkeypatch):
    """As many as pass through boxes, of 24 bodies."""
    scan, times, _ = scans("fan")
    moving = Bodies(24, 1).moving("numpy")
    asked = []
    cast_pairs = RayCaster.cast_pairs

    def noted(caster, pairs, nearest):
        asked.append(len(pairs.row))
        cast_pairs(caster, pairs, nearest)

    monkeypatch.setattr(RayCaster, "cast_pairs", noted)
    hits = nearest_body_hits(moving, scan, lambda ray: times[ray])
    assert len(rays_of(hits)) <= sum(asked) < 12 * len(rays_of(hits))


@pytest.mark.parametrize("there", [(2.0, 5.0), (0.0, 1.0)])
@pytest.mark.parametrize("backend", ["tiles", "numpy"])
def test_rays_beside_the_moment_when_a_body_is_there_miss_it(backend, there):
    """Also where they are compared together with rays of that very moment."""

    def below(bodies, times):
        return table(
            np.tile([0.0, 0, -3], (len(bodies), 1)), np.tile(np.eye(3), (len(bodies), 1, 1))
        )

    floor = RayCaster(FLAT[0] * 50, FLAT[1], backend, threads=1)
    boxes = np.array([[[-50.0, -50, 0], [50, 50, 0]]])
    moving = MovingBodies((floor,), boxes, np.zeros(1, int), np.array([there]), below)
    directions = np.tile([0.0, 0.01, -1], (128, 1))
    directions[:, 0] = np.linspace(-0.1, 0.1, 128)
    times = np.repeat([1.0, 2.0], [80, 48])
    found = nearest_body_hits(
        moving, check_scan(Pattern(directions), [0, 0, 0]), lambda ray: times[ray]
    )
    assert np.array_equal(found.body >= 0, (there[0] <= times) & (times <= there[1]))


def test_no_loop_is_compiled_with_fast_mathematics():
    """Functions that such a loop calls would inherit that, and round otherwise."""
    sources = [path.read_text() for path in Path(module.__file__).parent.glob("*.py")]
    assert len(sources) > 20 and not any("fastmath" in source for source in sources)


@pytest.mark.slow
def test_bodies_that_deform_are_hit_where_they_are_at_the_time_of_each_ray():
    """Each ray, body and triangle compared by itself: the same bits, and of ties the lowest."""
    bodies = Bodies(9, seed=4, around=(6.0, 0, 3), speed=3.0)
    random = np.random.default_rng(5)
    points, faces = ball()
    frames = points * random.uniform(0.6, 1.4, (6, 1, 3)) + random.normal(0, 0.05, (6, 1, 3))
    frames[:, :, 2] += 0.3 * np.sin(3 * points[:, 0] + np.arange(6)[:, None])
    doubled = np.concatenate([faces, faces])  # each triangle twice: the first is hit
    shape = DeformingMesh(frames, doubled)
    offsets = random.uniform(0, 5, 9)

    def frame(body, times):
        return (offsets[body] + 60 * times) % 5

    kinds = np.zeros(9, np.intp)
    moving = MovingBodies((shape,), shape.box[None], kinds, bodies.presence, bodies.poses, frame)
    rays = RAYS // 2
    directions = bodies.start[random.integers(0, 9, rays)] + random.normal(0, 1.5, (rays, 3))
    directions += [9, -0.2, 0]
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    times = np.sort(random.uniform(0, PERIOD, rays))
    scan = check_scan(Pattern(directions), [-9, 0.2, 0], t_min=0.3, t_max=30)
    found = nearest_body_hits(moving, scan, lambda ray: times[ray])
    expected = np.full(rays, np.inf), np.full(rays, -1), np.zeros(rays)
    for body in range(9):
        first, last = bodies.presence[body]
        own = np.flatnonzero((first <= times) & (times <= last))
        pose = bodies.poses(np.full(len(own), body), times[own])
        turns = pose[3:].reshape(3, 3, -1).transpose(1, 0, 2)
        start = np.array([[-9], [0.2], [0]]) - pose[:3]
        ahead = directions[own].T
        start, ahead = (
            np.stack([(x * a + y * b) + z * c for a, b, c in turns]).T for x, y, z in (start, ahead)
        )
        for number, ray in enumerate(own.tolist()):
            at = frame(body, times[ray])
            share = at - int(at)
            corners = ((1 - share) * frames[int(at)] + share * frames[int(at) + 1])[doubled]
            sheared = triangle.shear_rays(start[[number]], ahead[[number]])
            count = len(doubled)
            a, b, c, det, t = triangle.intersect(
                sheared, np.zeros(count, int), corners, np.arange(count)
            )
            hit = triangle.is_inside(a, b, c, det) & (t >= 0.3) & (t <= 30)
            nearest = np.where(hit, t, np.inf)
            if nearest.min() < expected[0][ray]:
                expected[0][ray] = nearest.min()
                expected[1][ray] = body
                expected[2][ray] = nearest.argmin()
    hit = np.isfinite(expected[0])
    assert 300 < hit.sum() < rays and len({*expected[1].tolist()}) > 5
    assert np.array_equal(found.body, expected[1])
    assert np.array_equal(found.distance[hit], expected[0][hit])
    assert np.array_equal(found.triangle[hit], expected[2][hit])


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.extended)])
def test_rays_aimed_at_bodies_from_anywhere(backend, seed):
    """Scattered rays that start inside bodies, or up to 10,000 of their sizes away."""
    random = np.random.default_rng(seed)
    bodies = Bodies(30, seed)
    times = np.sort(random.uniform(0, PERIOD, RAYS))
    aimed = random.choice(np.flatnonzero(np.isinf(bodies.presence[:, 1])), RAYS)
    centers = bodies.poses(aimed, times)[:3].T
    outward = random.choice([-1.0, 1], (RAYS, 3)) * random.uniform(0.5, 1, (RAYS, 3))
    origins = centers + outward * 10 ** random.uniform(-0.5, 4, (RAYS, 1))
    targets = centers + random.uniform(-0.1, 0.1, (RAYS, 3))
    scan = check_scan(Pattern(targets - origins, origins), np.zeros(3), t_min=0, t_max=1e6)
    expected = by_all(bodies.moving("numpy"), scan, times)
    at_balls = np.flatnonzero(bodies.shape[aimed] == 0)  # others may pass through holes or beside
    assert len(at_balls) > 200 and {*at_balls} <= {ray for ray, *_ in expected}
    assert (
        listed(nearest_body_hits(bodies.moving(backend), scan, lambda ray: times[ray])) == expected
    )
