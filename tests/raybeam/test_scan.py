"""Scans against rays that are made one by one and cast: many poses, windows, thinning, counts."""

from types import SimpleNamespace

import numpy as np
import pytest

from raybeam import Pattern, PoseMotion, RayCaster, pattern_rays
from raybeam.rays import Rays, unit_directions

TRIANGLE = [[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]]


def rotations(count, seed=0):
    return np.linalg.qr(np.random.default_rng(seed).normal(size=(count, 3, 3)))[0]


def made(case, window):
    """Origins and directions of a scan's rays, ray by ray as the interface tells it."""
    directions = unit_directions(case["directions"])
    origins = case["origins"]
    at = []
    to = []
    for number in range(window[1] - window[0]):
        row = (window[0] + number) % len(directions)
        pose = number // case["each"] if len(case["positions"]) > 1 else 0
        d = directions[row]
        o = None if origins is None else origins[row]
        if case["rotations"] is not None:
            turn = case["rotations"][pose]
            d, o = (
                v if v is None else [(v[0] * r[0] + v[1] * r[1]) + v[2] * r[2] for r in turn]
                for v in (d, o)
            )
        at_pose = place = case["positions"][pose]
        if (motion := case["motion"]) is not None:
            late = motion.delays[number % case["each"]]
            rate = motion.rates[pose]
            d, o = (v if v is None else drifted(v, late, rate) for v in (d, o))
            place = at_pose + late * motion.velocities[pose]
        if o is not None:
            place = np.array(o) + at_pose
            place = place if motion is None else place + late * motion.velocities[pose]
        at.append(place)
        to.append(d)
    return np.array(at).reshape(-1, 3), np.array(to).reshape(-1, 3)


def drifted(v, late, w):
    cross = (w[1] * v[2] - w[2] * v[1], w[2] * v[0] - w[0] * v[2], w[0] * v[1] - w[1] * v[0])
    return [a + late * b for a, b in zip(v, cross, strict=True)]


# {name: (poses, rays of a pose, turned, lever arms)}
CASES = {
    "one pose": (1, None, True, False),
    "one pose, not turned": (1, None, False, False),
    "one pose, lever arms": (1, None, True, True),
    "a pose each ray": (2500, 1, True, False),
    "firings": (60, 40, True, False),
    "firings, not turned": (60, 40, False, False),
    "firings, lever arms": (60, 40, True, True),
    "firings, lever arms, not turned": (60, 40, False, True),
    "long poses": (3, 900, True, False),
    "on the move": (60, 40, True, False),
    "on the move, lever arms": (60, 40, True, True),
    "on the move, not turned": (60, 40, False, False),
    "on the move, long poses": (3, 900, True, True),
}


def motion_of(rng, poses, rays):
    speeds, rates = rng.normal(size=(2, poses, 3))
    return PoseMotion(rng.uniform(0, 1e-3, rays), 50 * speeds, rates)


def case_of(name, scale=1.0):
    count, each, turned, shifted = CASES[name]
    rng = np.random.default_rng(len(name))
    return {
        "directions": rng.normal(size=(1000, 3)),
        "origins": 0.1 * rng.normal(size=(1000, 3)) if shifted else None,
        "positions": scale * np.array([0.3, -0.2, 0.1]) + 0.2 * rng.normal(size=(count, 3)),
        "rotations": rotations(count) if turned else None,
        "each": each,
        "motion": motion_of(rng, count, each) if "move" in name else None,
    }


def scanned(caster, case, window, **more):
    pattern = Pattern(case["directions"], case["origins"])
    return caster.scan(
        pattern, case["positions"], case["rotations"],
        window=window, rays_per_pose=case["each"], motion=case["motion"], **more,
    )  # fmt: skip


def hits_of(caster, origins, directions, *limits):
    """What `cast` finds of rays, as a scan gives it."""
    if len(directions) and np.abs((directions**2).sum(axis=1) - 1).max() > 1e-14:
        # Those that drift: not quite of unit length, which `cast` would make them.
        found = caster.engine.closest_hits(Rays(origins, directions, *(limits or (0.0, np.inf))))
        ray = found.ray.astype(np.uint32)
        # The scale is private: it is about the engines' arithmetic, and hits come in meters.
        distance = found.t / caster._scene.frame.scale
        return SimpleNamespace(ray=ray, distance=distance, triangle=found.triangle)
    hits = caster.cast(origins, directions, *limits)
    ray = np.flatnonzero(hits.hit).astype(np.uint32)
    return SimpleNamespace(ray=ray, distance=hits.distance[ray], triangle=hits.triangle[ray])


def same(got, want):
    for name in ("ray", "triangle", "distance"):
        mine = getattr(got, name)
        other = getattr(want, name)
        assert mine.dtype == other.dtype
        np.testing.assert_array_equal(mine, other, err_msg=name)


def check(caster, case, windows, limits):
    """A scan's hits are those of its rays, and `pattern_rays` makes the same rays."""
    pattern = Pattern(case["directions"], case["origins"])
    for window in windows:
        origins, directions = made(case, window)
        want = hits_of(caster, origins, directions, *limits)
        got = scanned(caster, case, window, t_min=limits[0], t_max=limits[1])
        same(got, want)
        assert got.hit_counts.tolist() == [len(want.ray)]
        assert got.tally is None
        assert len(want.ray) > len(origins) / 10 or not len(origins)
        some = np.random.default_rng(1).integers(0, max(len(origins), 1), 50)[: len(origins)]
        pose = {"start": window[0], "rays_per_pose": case["each"], "motion": case["motion"]}
        at, to = pattern_rays(pattern, some, case["positions"], case["rotations"], **pose)
        np.testing.assert_array_equal(np.broadcast_to(at, to.shape), origins[some])
        np.testing.assert_array_equal(to, directions[some])


@pytest.mark.extended
@pytest.mark.slow(every=3)
@pytest.mark.parametrize("name", CASES)
def test_rays_are_those_of_the_interface(caster, shapes, name):
    """Windows past the pattern's end, with and without limits, from near and from far."""
    vase = caster(*shapes["vase"]())
    case = case_of(name)
    check(vase, case, [(0, 2400), (123, 123)], (0.0, np.inf))
    check(vase, case, [(937, 1003), (2999, 5000)], (0.5, 1.5))
    case = case_of(name, 3e3)
    case["directions"] -= case["positions"][0]  # aimed at the mesh
    if case["rotations"] is not None:
        case["rotations"][:] = case["rotations"][0]
        case["directions"] = case["directions"] @ case["rotations"][0]
    check(vase, case, [(937, 1003)], (np.linalg.norm(case["positions"][0]), np.inf))


CUT = ["one pose", "a pose each ray", "firings, lever arms", "on the move, lever arms"]


@pytest.mark.extended
@pytest.mark.slow(every=3)
@pytest.mark.parametrize("name", CUT)
def test_scans_may_be_cut_anywhere(caster, shapes, name, monkeypatch):
    case = case_of(name)
    whole = scanned(caster(*shapes["vase"]()), case, (700, 2700), t_min=0.5, t_max=2)
    assert len(whole) > 400
    for chunk in (97, 1000, 1 << 17):
        vase = caster(*shapes["vase"]())
        monkeypatch.setattr(type(vase.engine), "chunk", chunk)
        same(scanned(vase, case, (700, 2700), t_min=0.5, t_max=2), whole)


@pytest.mark.extended
def test_positions_and_rotations_may_be_one_for_all(caster, shapes):
    vase = caster(*shapes["vase"]())
    case = case_of("firings")
    pattern = Pattern(case["directions"])
    place = case["positions"]
    turn = case["rotations"]
    for positions, turns in ((place, turn[3]), (place[3], turn), (place[3:4], turn)):
        got = vase.scan(pattern, positions, turns, window=(0, 2400), rays_per_pose=40)
        full = np.broadcast_to(positions, (60, 3)), np.broadcast_to(turns, (60, 3, 3))
        same(got, vase.scan(pattern, *full, window=(0, 2400), rays_per_pose=40))


@pytest.mark.extended
@pytest.mark.slow(every=5)
@pytest.mark.parametrize(("rays", "first"), [(7, 5), (40, 0), (40, 80), (40, 7)])
@pytest.mark.parametrize("name", ["firings, lever arms", "on the move, lever arms"])
def test_pattern_shorter_than_a_chunk(caster, shapes, name, rays, first):
    """A pattern of one firing, over and over; also that of each pose."""
    vase = caster(*shapes["vase"]())
    case = case_of(name)
    case["directions"], case["origins"] = case["directions"][:rays], case["origins"][:rays]
    got = scanned(vase, case, (first, 2100))
    assert len(got) > 900
    same(got, hits_of(vase, *made(case, (first, 2100))))


GROUPS = [[0], [0, 1000, 2000], [0, 0, 13, 13, 14, 1999, 2390, 2400]]


def thinned(want, groups, every, rays):
    """Hits of each group, and rows of those to keep, group by group."""
    hits = []
    keep = []
    for begin, end in zip(groups, [*groups[1:], rays], strict=True):
        rows = np.flatnonzero((want.ray >= begin) & (want.ray < end))
        hits.append(len(rows))
        keep.extend(rows[::every])
    return hits, keep


@pytest.mark.extended
@pytest.mark.slow(every=3)
@pytest.mark.parametrize(
    ("name", "limits"),
    [
        ("one pose", (0, np.inf)),
        ("firings, lever arms", (0.5, 1.5)),
        ("one pose", (1, 1.0001)),
        ("firings, lever arms", (50, 60)),
    ],
)
def test_thinning_keeps_what_the_whole_has(caster, shapes, name, limits, monkeypatch):
    vase = caster(*shapes["vase"]())
    case = case_of(name)
    given = {"window": (300, 2700), "t_min": limits[0], "t_max": limits[1]}
    whole = scanned(vase, case, **given)
    want_tally = np.bincount(whole.triangle, minlength=vase.face_count)
    for chunk, every in ((1 << 16, 1), (1 << 16, 5), (111, 2), (111, 10_000)):
        monkeypatch.setattr(type(vase.engine), "chunk", chunk)
        for groups in GROUPS:
            got = scanned(vase, case, **given, keep_every=every, groups=groups, tally=True)
            hits, keep = thinned(whole, groups, every, 2400)
            assert got.hit_counts.tolist() == hits
            np.testing.assert_array_equal(got.ray, whole.ray[keep])
            np.testing.assert_array_equal(got.distance, whole.distance[keep])
            np.testing.assert_array_equal(got.triangle, whole.triangle[keep])
            np.testing.assert_array_equal(got.tally, want_tally)
            assert got.hit_counts.dtype == got.tally.dtype == np.int64


@pytest.mark.extended
def test_thinning_where_rays_graze(caster):
    """A plane met at all angles, limits within it: rough distances are worst there."""
    plane = np.array([[-50.0, -50, 0], [50, -50, 0], [50, 50, 0], [-50, 50, 0]])
    floor = caster(plane, [[0, 1, 2], [0, 2, 3]])
    rng = np.random.default_rng(3)
    slope = -(10.0 ** rng.uniform(-7, 0, 20_000))
    angle = rng.uniform(0, 2 * np.pi, 20_000)
    pattern = Pattern(np.column_stack([np.cos(angle), np.sin(angle), slope]))
    for height in (1e-5, 1e-3, 1.0):
        for limits in ((0.0, np.inf), (2.0, 30.0), (0.0, 10.0)):
            given = {"t_min": limits[0], "t_max": limits[1]}
            whole = floor.scan(pattern, [0.1, 0.2, height], **given)
            assert len(whole) > 100
            assert whole.distance.min() >= limits[0]
            assert whole.distance.max() <= limits[1]
            got = floor.scan(pattern, [0.1, 0.2, height], keep_every=3, **given)
            assert got.hit_counts.tolist() == [len(whole)]
            np.testing.assert_array_equal(got.ray, whole.ray[::3])
            np.testing.assert_array_equal(got.distance, whole.distance[::3])


def test_nothing_to_scan(caster, shapes):
    vase = caster(*shapes["vase"]())
    for pattern in (Pattern(np.empty((0, 3))), Pattern(np.eye(3))):
        assert pattern_rays(pattern, np.zeros(0, int), [1, 2, 3])[1].shape == (0, 3)
        found = vase.scan(pattern, [0, 0, 1], window=(0, 0), keep_every=3, groups=[0, 0])
        assert len(found) == 0
        assert found.hit_counts.tolist() == [0, 0]
    away = vase.scan(Pattern([[0, 0, 1]] * 5), [0, 0, 50], keep_every=2, tally=True)
    assert (len(away), away.hit_counts.tolist(), away.tally.sum()) == (0, [0], 0)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"window": (2, 1)}, "0 <= start <= stop, but is .2, 1. for a pattern with 3 rows"),
        ({"window": (-1, 2)}, "is .-1, 2."),
        ({"window": (5, 2**32 + 6)}, "4,294,967,297 rays, but the limit is 4,294,967,296"),
        (
            {"pattern": Pattern(np.empty((0, 3))), "window": (0, 2)},
            "is .0, 2. for a pattern with 0",
        ),
        ({"rotations": 2 * np.eye(3)}, r"Rotation 0 must be an orthonormal.*1 of 1"),
        (
            {"rotations": [np.eye(3), np.eye(3)[::-1] * 1.1]},
            r"Rotation 1 must be an orthonormal.*1 of 2",
        ),
        ({"rotations": np.diag([1, -1, 1])}, r"rotation 0 must be 1, .* reflection.*1 of 1"),
        ({"rotations": [np.eye(3), -np.eye(3)]}, r"rotation 1 must be 1, .* reflection.*1 of 2"),
        ({"rotations": np.eye(2)}, r"rotations must be .* \(n, 3, 3\), .* float64 .* \(2, 2\)"),
        ({"rotations": np.full((3, 3), np.nan)}, "orthonormal"),
        ({"rotations": np.zeros((0, 3, 3))}, "lengths are 1 and 0"),
        ({"positions": [[0, 0, 0], [0, np.inf, 1]]}, "Position 1 must .*inf"),
        ({"positions": np.zeros((0, 3))}, "lengths are 0 and 0"),
        ({"positions": np.zeros((2, 3))}, "rays_per_pose is required, because there are 2"),
        (
            {"positions": np.zeros((2, 3)), "rotations": rotations(3), "rays_per_pose": 1},
            "lengths are 2 and 3",
        ),
        (
            {"positions": np.zeros((2, 3)), "rays_per_pose": 1},
            "2 poses with 1 rays each do not cover 3",
        ),
        ({"t_min": 2, "t_max": 1}, "t_min is 2.0 and t_max is 1.0"),
        ({"keep_every": 0}, "keep_every must be at least 1, but is 0"),
    ],
)
def test_scan_refused(change, words):
    caster = RayCaster(*TRIANGLE, "numpy")
    with pytest.raises(ValueError, match=words):
        caster.scan(**{"pattern": Pattern(np.eye(3)), "positions": [0, 0, 0], **change})


def test_pattern_refused():
    with pytest.raises(ValueError, match="Direction 2 must"):
        Pattern([[0, 0, 1], [0, 1, 0], [0, 0, 0]])
    with pytest.raises(ValueError, match=r"Origin 1 must .*nan"):
        Pattern(np.eye(3), [[0, 0, 0], [0, np.nan, 0], [0, 0, 0]])
    with pytest.raises(ValueError, match="directions, which is 3, but has length 2"):
        Pattern(np.eye(3), np.zeros((2, 3)))
    for table in ("directions", "origins"):
        with pytest.raises(ValueError, match="read-only"):
            getattr(Pattern(np.eye(3), np.eye(3)), table)[0] = 1


@pytest.mark.parametrize(
    ("change", "error", "words"),
    [
        ({"numbers": [0.5]}, TypeError, "float64"),
        ({"numbers": [3, -1]}, ValueError, "Rays -1 to 4 from row 0"),
        ({"start": -1}, ValueError, "Rays 0 to 2 from row -1"),
        ({"positions": np.zeros((2, 3))}, ValueError, "rays_per_pose is required"),
        ({"numbers": [4], "rays_per_pose": 4}, ValueError, "do not cover 5 rays"),
    ],
)
def test_rays_refused(change, error, words):
    with pytest.raises(error, match=words):
        pattern_rays(Pattern(np.eye(3)), **{"numbers": [0, 1], "positions": [0, 0, 0], **change})
