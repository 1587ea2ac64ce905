"""Sections of the GPU benchmark that check the exact results of kernels, using only raybeam."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from raybeam import Instance, Mesh, Pattern, PoseMotion, RayCaster, available_backends, pattern_rays
from raybeam.scan import Scan, check_scan

from .gpu_clock import Session, Sizes
from .gpu_rays import MIDDLE, Rows, forest, name_of
from .gpu_scenes import Float, ball, city, flat_ground, joined, revolution, six_objects, soup
from .gpu_scenes import Mesh as Faces
from .seams import count_escaped

_SOUPS = ("random", "sliver", "huge", "tiny")  # kinds of unconnected triangles
_FAR_M = 5e5  # coordinates of a map projection


Placed = tuple[str, list[Instance], Float]  # name, instances of a scene, origin of the rays


def placed(name: str, mesh: Faces, origin: Any = (0, 0, 0)) -> Placed:
    """Return the scene of a mesh, with the origin of its rays."""
    return name, [Instance(Mesh(*mesh))], np.asarray(origin, np.float64)


def scenes(sizes: Sizes) -> Iterator[Placed]:
    """Yield 20 scenes, which include nested, masked, remote and degenerate meshes."""
    vertices, faces = six_objects()
    center = np.array([0, 0, 2.0])
    yield placed("six objects", (vertices, faces), center)
    yield placed("six objects in millimeters", (1e-3 * vertices, faces), 1e-3 * center)
    yield placed("six objects in kilometers", (1e3 * vertices, faces), 1e3 * center)
    yield placed("six objects on a map", (vertices + _FAR_M, faces), center + _FAR_M)
    for kind in _SOUPS:
        yield placed(f"{kind} triangles", soup(kind))
    points, sides = ball(5.0)
    yield placed("inside a ball", (points, sides), [1, 0.5, -2])
    yield placed("inside a ball on a map", (points + _FAR_M, sides), [_FAR_M + 1] * 3)
    ground, cells = flat_ground(9, 5.0)
    yield placed("ground that lies double", joined([(ground, cells), (ground, cells)]), center)
    yield placed("in the plane of the ground", (ground, cells))
    for kind, shear in {"turned": 0.0, "sheared": 0.5}.items():
        yield f"instances, {kind}", list(scattered_instances(shear)), center
    crown = np.array([0.3, 0.2, 6.0])
    for words, masked in {"": False, ", masked": True}.items():
        yield f"forest{words}", forest(25, 2000, masked), crown
        yield f"one tree{words}", forest(1, 2000, masked)[1:], crown
    for count in (sizes.smallest, sizes.cities[-1]):
        yield placed(name_of(count), city(count), MIDDLE)


def scattered_instances(shear: float) -> Iterator[Instance]:
    """Yield 40 instances of a ball that are rotated, sheared and scaled unevenly."""
    rng = np.random.default_rng(4)
    mesh = Mesh(*ball(2.0, 20, 30))
    for _ in range(40):
        rotation, _ = np.linalg.qr(rng.normal(size=(3, 3)))
        linear = rotation * rng.uniform(0.3, 3, 3) + shear * rng.normal(size=(3, 3))
        yield Instance(mesh, np.column_stack([linear, rng.uniform(-20, 20, 3)]))


def bits(session: Session) -> Rows:
    """Count values of sample rays that differ from those of NumPy or tiles (0 is expected)."""
    step = max(1, session.sizes.rays // session.sizes.sample)
    sample = revolution(session.sizes.rays)[::step]
    other = "numpy" if available_backends()["tiles"] else "tiles"
    for name, scene, origin in scenes(session.sizes):
        casters = [RayCaster.from_instances(scene, backend) for backend in ("cuda", "numpy")]
        row = _count_differences(casters, sample, origin)
        casters[1] = RayCaster.from_instances(scene, other)
        row |= {
            f"{count}, {other}": differences
            for count, differences in _count_differences(casters, sample, origin).items()
            if count.startswith("different")
        }
        yield name, row


def _count_differences(casters: list[RayCaster], sample: Float, origin: Float) -> dict[str, int]:
    device_hits, host_hits = (caster.cast(origin, sample) for caster in casters)
    counts = {"rays": len(sample), "hits": int(host_hits.hit.sum())}
    for name in ("distance", "triangle", "u", "v", "instance"):
        differs = getattr(device_hits, name) != getattr(host_hits, name)
        counts[f"different {name}"] = int(differs.sum())
    rotation, _ = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))
    pattern = Pattern(sample, 0.01 * sample)
    still = check_scan(pattern, origin, rotation)
    moving = _moving_scan(pattern, origin, rotation)
    for name, scan in {"scan": still, "moving scan": moving}.items():
        device_scan, host_scan = (caster.engine.scan(scan) for caster in casters)
        counts[f"different {name}"] = _count_different_hits(device_scan, host_scan)
    counts["different tally"] = int((device_scan.tally != host_scan.tally).sum())  # type: ignore[operator]
    expected = pattern_rays(pattern, host_scan.ray, moving.poses)
    counts["different rays"] = _count_different_rays(casters[0], moving, expected)
    return counts


def _moving_scan(pattern: Pattern, origin: Float, rotation: Float) -> Scan:
    """Make a scan with a separate pose for each ray, 1 mm apart, and with motion within poses."""
    positions = origin + 1e-3 * np.arange(len(pattern))[:, None]
    rotations = np.broadcast_to(rotation, (len(positions), 3, 3))
    rates = np.full_like(positions, 0.3)
    motion = PoseMotion(np.zeros(1) + 2e-5, rates, rates)
    return check_scan(pattern, positions, rotations, rays_per_pose=1, motion=motion, tally=True)


def _count_different_hits(device_scan: Any, host_scan: Any) -> int:
    """Count hits that differ in distance or triangle.

    Return 1 if the rays that hit are not the same.
    """
    if not np.array_equal(device_scan.ray, host_scan.ray):
        return 1
    differs = device_scan.distance != host_scan.distance
    differs |= device_scan.triangle != host_scan.triangle
    return int(np.sum(differs))


def _count_different_rays(caster: RayCaster, scan: Scan, expected: tuple[Float, Float]) -> int:
    """Count ray coordinates computed on the device that differ from the expected ones."""
    parts: list[tuple[Float, Float]] = []
    caster.scan_on_device(scan, lambda hits: parts.append(tuple(a.get() for a in hits.rays())))
    return int(
        sum(
            (rays != np.concatenate(arrays, axis=1).T).sum()
            for arrays, rays in zip(zip(*parts, strict=True), expected, strict=True)
        )
    )


def leaks(session: Session) -> Rows:
    """Count rays that start inside a closed mesh and escape at its edges or corners."""
    vertices, faces = six_objects()
    faces = faces[: len(faces) // 6]
    vertices = vertices[: faces.max() + 1] + 5e5
    caster = RayCaster(vertices, faces, backend="cuda")
    inside = np.array([-20, -20, 1.5]) + 5e5
    yield (
        "edges and corners",
        count_escaped(caster, (vertices, faces), inside, 0.1, session.sizes.leaks),
    )
