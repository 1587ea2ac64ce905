"""Hits that stay on a device, against those that a scan returns."""

import re
from pathlib import Path

import numpy as np
import pytest
from tests.cuda_on_host import played_cuda  # noqa: F401 - a fixture
from tests.raybeam.test_scan import case_of

from raybeam import BackendUnavailable, Instance, Mesh, Pattern, RayCaster, pattern_rays
from raybeam.device import ExternalHits
from raybeam.scan import check_scan

CASE = case_of("on the move, lever arms")
PATTERN = Pattern(CASE["directions"], CASE["origins"])


def scan_of(**more):
    return check_scan(
        PATTERN, CASE["positions"], CASE["rotations"],
        window=(700, 2700), rays_per_pose=CASE["each"], motion=CASE["motion"], **more,
    )  # fmt: skip


@pytest.fixture(params=["plain", "instances"])
def vase(request, kernels, shapes, monkeypatch):
    mesh = Mesh(*shapes["vase"]())
    apart = np.eye(4)[:3].copy()
    apart[:, 3] = 0.5, 0.2, -0.3
    placed = [Instance(mesh)] if request.param == "plain" else [Instance(mesh, apart)] * 3
    caster = RayCaster.from_instances(placed, kernels)
    monkeypatch.setattr(type(caster.engine), "chunk", 333)
    return caster


def visited(caster, scan, counters=None, others=None):
    """Rays, distances, triangles and instances, and origins and directions, by the device."""
    found = []
    rays = []

    def use(hits):
        found.append(hits.get())
        rays.append([np.asarray(a.get()) for a in hits.rays()])
        assert len(hits) == len(found[-1][0])

    counted = caster.scan_on_device(scan, use, counters, others)
    joined = [np.concatenate(parts, axis=-1) for parts in zip(*found, strict=True)]
    return joined, [np.concatenate(parts, axis=1) for parts in zip(*rays, strict=True)], *counted


@pytest.mark.extended(every=5)
@pytest.mark.parametrize("every", [1, 3, 10**12])
def test_a_visit_sees_what_a_scan_returns(vase, every):
    given = {"keep_every": every, "groups": [0, 0, 13, 1990], "tally": True}
    scan = scan_of(**given)
    hits, (origins, directions), counts, (rows, counted) = visited(vase, scan)
    want = vase.engine.scan(scan)
    assert vase.on_device
    for got, name in zip(hits, ("ray", "distance", "triangle", "instance"), strict=True):
        np.testing.assert_array_equal(got, getattr(want, name))
    assert counts.tolist() == want.hit_counts.tolist()
    assert rows.tolist() == np.flatnonzero(want.tally).tolist()
    assert counted.tolist() == want.tally[rows].tolist()
    pose = {"start": 700, "rays_per_pose": CASE["each"], "motion": CASE["motion"]}
    at, to = pattern_rays(PATTERN, want.ray, CASE["positions"], CASE["rotations"], **pose)
    np.testing.assert_array_equal(origins.T, at)
    np.testing.assert_array_equal(directions.T, to)


@pytest.mark.extended
def test_instances_may_be_counted_as_a_whole(vase):
    one = np.stack([np.arange(vase.instance_count), np.zeros(vase.instance_count)], axis=1)
    counters = one.astype(np.int64), vase.instance_count
    hits, _, counts, (rows, counted) = visited(vase, scan_of(tally=True), counters)
    assert counted.tolist() == np.bincount(hits[3])[rows].tolist()
    assert counts.tolist() == [counted.sum()] == [len(hits[0])]


@pytest.mark.extended
def test_nearer_hits_of_other_surfaces_replace_those_of_the_caster(vase):
    rng = np.random.default_rng(5)
    ray = np.flatnonzero(rng.random(2000) < 0.3).astype(np.uint32)
    others = ExternalHits(ray, rng.uniform(0, 3, len(ray)), rng.integers(0, 9, len(ray), np.int32))
    many = vase.instance_count
    table = np.array([[0, 1]] * many + [[vase.face_count, 1]])
    scan = scan_of(tally=True, keep_every=2)
    counters = table, vase.face_count + 9
    hits, _, counts, (met, counted) = visited(vase, scan, counters, others)
    ray, distance, triangle, instance = hits
    own = vase.engine.scan(scan_of())
    found = {r: (d, t, i) for r, d, t, i in zip(*(a.tolist() for a in (
        own.ray, own.distance, own.triangle, own.instance)), strict=True)}  # fmt: skip
    for r, d, t in zip(others.ray, others.distance, others.triangle, strict=True):
        found[int(r)] = min(found.get(r, (np.inf, 0, 0)), (d, t, many), key=lambda hit: hit[0])
    want = [(r, *found[r]) for r in sorted(found)]
    assert counts.tolist() == [len(want)]
    assert [*zip(ray, distance, triangle, instance, strict=True)] == want[::2]
    assert 100 < sum(i == many for *_, i in want) < len(want) - 100
    rows = [t + vase.face_count * (i == many) for _, _, t, i in want]
    assert counted.tolist() == np.bincount(rows)[met].tolist() and counted.sum() == len(want)


def test_other_backends_have_no_device(shapes):
    caster = RayCaster(*shapes["cube"](), backend="numpy")
    assert not caster.on_device
    with pytest.raises(BackendUnavailable, match="Use scan"):
        caster.scan_on_device(scan_of(), print)


def test_the_example_of_the_page(played_cuda, capsys):  # noqa: F811
    page = Path(__file__).parents[2].joinpath("docs/how-to/gpus.md").read_text("utf-8")
    [code] = re.findall(r"^```python\n(.*?)^```$", page, re.M | re.S)
    exec(code, {})
    assert capsys.readouterr().out.splitlines() == re.findall(r"print\(.*\)  # (.*)", code)
