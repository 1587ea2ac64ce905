"""Cast rays against the static bodies of a scene, which are its faces and instances.

Bodies that a sensor cannot see are omitted, and so are bodies far beyond the range of all sensors.
Triangles that extend far beyond the range are clipped (`clipping`). Triangle numbers do not change.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from raybeam import Instance, Mesh, Opacity, RayCaster, ScanReturns
from raybeam.registry import choose_backend

from ..numerics.arrays import Bools, Floats, Indices, Integers, Ints, Ints32
from ..scene.scene import Scene
from ..scene.scene_instances import Instances, MeshPart
from ..survey.survey import Survey
from .clipping import ClippedMesh, box_planes, clip_triangles

_log = logging.getLogger(__name__)

# Half the longest side of a scene, in meters, above which bodies beyond the range are omitted. In
# smaller scenes, the size does not slow down casting.
MAX_REACH_M = 50_000.0
# Triangles are clipped at twice the range of the sensors plus this distance in meters. Sensors may
# move this far before trees are rebuilt.
MARGIN_M = 10_000.0
_NO_ROWS = np.zeros(0, np.int64)
_SLACK_M = 200.0  # part of the margin reserved for sensors mounted away from their platform


def largest_range_m(survey: Survey) -> float:
    """Return the maximum range of the survey's sensors, in meters."""
    return max(carried.sensor.max_range_m for carried in survey.mounted_sensors)


def warn_of_reach(scene: Scene, survey: Survey) -> None:
    """Log a warning if part of the scene is omitted because no sensor can reach it."""
    range_m = largest_range_m(survey)
    reach_m = _half_side(scene.bounds)
    if reach_m > MAX_REACH_M and _is_short(range_m):
        _log.warning(
            "the scene is %s km wide, but the sensor measures up to %.6g m. Objects more than %s "
            "km from the sensor are excluded to speed up ray casting. No points are lost.",
            f"{2 * reach_m / 1e3:,.0f}",
            range_m,
            f"{(2 * range_m + MARGIN_M) / 1e3:.3g}",
        )


def _half_side(bounds: Floats) -> float:
    """Return half the length of the longest side of a box."""
    return float(np.ptp(bounds, axis=0).max(initial=0.0)) / 2


def _is_short(range_m: float) -> bool:
    """Return whether the range of sensors is so short that the region beyond it can be omitted."""
    return 2 * (2 * range_m + MARGIN_M) <= MAX_REACH_M


class _Trees(NamedTuple):
    """Caster of the static bodies, and the mapping from its triangles to those of the scene.

    If `region` is set, the caster only has the bodies within this region.
    """

    caster: RayCaster
    region: Floats | None  # (2, 3), meters; None for the whole scene
    # (b,): first triangle of each instance of the caster; None for a caster of faces alone
    first_triangles: Ints32 | None
    # (r,): rows of the scene's instances that are the last r instances of the caster, ascending
    instance_indices: Ints
    # {instance of the caster: original triangle of which each clipped triangle is part}
    origins: dict[int, Indices]

    @property
    def face_bodies(self) -> int:
        """Number of caster instances that represent the scene's faces, either 0 or 1."""
        return self.caster.instance_count - len(self.instance_indices)

    def to_scene_triangles(self, hits: ScanReturns) -> Ints32:
        """Convert the triangles of hits to the scene's triangle numbers."""
        triangle = hits.triangle
        if self.origins:
            triangle = triangle.copy()
            for instance, origin in self.origins.items():
                on_instance = (
                    slice(None) if self.first_triangles is None else hits.instance == instance
                )
                triangle[on_instance] = origin[triangle[on_instance]]
        if self.first_triangles is not None:
            triangle = triangle + self.first_triangles[hits.instance]
        return triangle


class StaticBodies:
    """Ray caster of the faces and instances of a scene.

    Parameters
    ----------
    scene
        Scene with the faces and instances.
    vertices
        (v, 3): vertices of the scene's faces in meters.
    range_m
        Largest range of the sensors in meters. If it is inf, no body is omitted because of its
        distance.
    options
        Arguments of `RayCaster`.
    unseen
        (objects,): True for the static objects to omit. None if no object is omitted.
    """

    def __init__(
        self,
        scene: Scene,
        vertices: Floats,
        range_m: float,
        options: dict[str, Any],
        unseen: Bools | None = None,
    ) -> None:
        self._faces: Integers = scene.faces
        self._vertices = vertices
        self._instances = scene.instances
        self._has_faces = len(scene.faces) > 0
        self._sees_all_faces = unseen is None
        # (n,): whether each instance is visible; None if all are.
        self._instance_is_seen: Bools | None = None
        if unseen is not None:
            # A degenerate triangle is never hit, and the other triangles keep their numbers.
            self._faces = np.where(unseen[scene.face_object, None], 0, scene.faces)
            self._has_faces = _have_area(vertices, self._faces)
            if scene.instances is not None:
                self._instance_is_seen = ~unseen[scene.instances.owner]
        self._options = options
        self._lock = threading.Lock()
        self._center = scene.bounds.mean(axis=0)
        on_device = choose_backend(options.get("backend", "auto")).on_device
        # Whether bodies may be omitted in a large scene, and whether this scene is large.
        self._can_cut = _is_short(range_m) and not on_device
        self._may_cut = self._can_cut and _half_side(scene.bounds) > MAX_REACH_M
        self._trees: _Trees | None = None
        if not self._may_cut:
            self._trees = self._build(None)

    @property
    def trees(self) -> _Trees:
        """Trees of the whole scene, or of the most recent region."""
        if self._trees is None:
            with self._lock:
                self._trees = self._trees or self._build(None)
        return self._trees

    @property
    def backend(self) -> str:
        """Name of the backend in use."""
        if self._trees is None:
            return choose_backend(self._options.get("backend", "auto")).name
        return self._trees.caster.backend

    @property
    def on_device(self) -> bool:
        """Whether hits can remain in the memory of a CUDA device."""
        return not self._may_cut and self.trees.caster.on_device

    def ensure_trees(self, positions: Floats, range_m: float) -> None:
        """Build the trees of all bodies within range of sensors at the given positions, if needed.

        Casts in progress can continue to use the trees of an earlier region.
        """
        if not self._may_cut:
            return
        points = positions.reshape(-1, 3)
        sensors = np.stack([points.min(axis=0), points.max(axis=0)])
        outwards = np.array([[-1.0], [1.0]])
        with self._lock:
            trees = self._trees
            if trees is not None:
                needed = sensors + outwards * (2 * range_m + _SLACK_M)
                region = trees.region
                if region is None or ((region[0] <= needed[0]) & (needed[1] <= region[1])).all():
                    return
            region = sensors + outwards * (2 * range_m + MARGIN_M)
            if trees is not None and trees.region is not None:
                lower = np.minimum(region[0], trees.region[0])
                region = np.stack([lower, np.maximum(region[1], trees.region[1])])
            self._trees = self._build(None if _half_side(region) > MAX_REACH_M else region)

    def move_instances(self, instances: Instances, instance_indices: Indices) -> None:
        """Apply the new transforms of the given instances.

        The transforms are those in `instances`. No cast may be in progress. Trees are rebuilt if an
        instance enters or leaves the region that sensors can reach, as a body that falls forever
        does, or if it was clipped.
        """
        self._instances = instances
        if self._instance_is_seen is not None:
            instance_indices = instance_indices[self._instance_is_seen[instance_indices]]
        trees = self._trees
        if trees is None or not len(instance_indices):
            return
        offsets = instances.transforms[instance_indices, :, 3] - self._center
        is_remote = np.any(np.abs(offsets) > MAX_REACH_M, axis=1)
        if trees.region is None and is_remote.any() and self._can_cut:
            self._may_cut = True
            self._trees = None  # `ensure_trees` builds them
            return
        first = trees.face_bodies
        if trees.region is None and self._instance_is_seen is None:  # the tree has all instances
            trees.caster.set_transforms(
                first + instance_indices, instances.transforms[instance_indices]
            )
            return
        numbers = first + np.searchsorted(trees.instance_indices, instance_indices)
        if trees.region is None:
            trees.caster.set_transforms(numbers, instances.transforms[instance_indices])
            return
        has_tree = np.isin(instance_indices, trees.instance_indices)
        is_cut = has_tree & np.isin(numbers, list(trees.origins))
        comes = ~has_tree & _is_near(instances, trees.region)[instance_indices]
        if (is_cut | comes | (has_tree & is_remote)).any():
            self._trees = self._build(trees.region)
            return
        trees.caster.set_transforms(
            numbers[has_tree], instances.transforms[instance_indices[has_tree]]
        )

    def _build(self, region: Floats | None) -> _Trees:
        """Build the trees of the bodies within a region.

        If `region` is None or contains no body, the trees contain all bodies.
        """
        faces = None if region is None else self._cut_faces(region)
        if self._instances is not None:
            return self._build_nested(self._instances, region, faces)
        if not self._has_faces:
            return self._build_transparent()
        if faces is None:
            caster = RayCaster(self._vertices, self._faces, **self._options)
            return _Trees(caster, region, None, _NO_ROWS, {})
        if not len(faces.faces):
            return self._build(None)
        caster = RayCaster(faces.vertices, faces.faces, **self._options)
        return _Trees(caster, region, None, _NO_ROWS, {0: faces.origin})

    def _cut_faces(self, region: Floats) -> ClippedMesh | None:
        """Clip the visible faces to a region. Return None if all faces are inside it."""
        cut_mesh = clip_triangles(self._vertices, self._faces, box_planes(region))
        if cut_mesh is None or self._sees_all_faces:
            return cut_mesh
        seen = np.flatnonzero((cut_mesh.faces != cut_mesh.faces[:, :1]).any(axis=1))
        return cut_mesh._replace(faces=cut_mesh.faces[seen], origin=cut_mesh.origin[seen])

    def _build_transparent(self) -> _Trees:
        """Build a tree that lets all rays pass, for sensors that see no static bodies.

        A caster requires a triangle with a nonzero area. The other triangles are degenerate and
        make up the number of faces in the scene.
        """
        count = max(1, len(self._faces))
        faces = np.zeros((count, 3), np.int64)
        faces[0] = 0, 1, 2
        opacity = Opacity(np.zeros((1, 1), np.bool_), np.zeros((count, 3, 2), np.float32))
        mesh = Mesh(np.eye(3), faces, opacity)
        caster = RayCaster.from_instances([Instance(mesh)], **self._options)
        return _Trees(caster, None, None, _NO_ROWS, {})

    def _build_nested(
        self, instances: Instances, region: Floats | None, faces: ClippedMesh | None
    ) -> _Trees:
        """Build the trees of the instances and of the faces, which may be clipped."""
        bodies: list[Instance] = []
        origins: dict[int, Indices] = {}
        if faces is None and self._has_faces:
            bodies.append(Instance(Mesh(self._vertices, self._faces)))
        elif faces is not None and len(faces.faces):
            origins[0] = faces.origin
            bodies.append(Instance(Mesh(faces.vertices, faces.faces)))
        face_bodies = len(bodies)
        meshes: dict[int, Mesh] = {}  # {index of the part: mesh}
        instance_indices = []
        for row, cut_part in _parts_in(instances, region, self._instance_is_seen):
            index = int(instances.part[row])
            if cut_part is None:
                if index not in meshes:
                    meshes[index] = mesh_of(instances.mesh_parts[index])
                mesh = meshes[index]
            else:
                origins[len(bodies)] = cut_part.origin
                mesh = Mesh(cut_part.vertices, cut_part.faces)
            bodies.append(Instance(mesh, instances.transforms[row]))
            instance_indices.append(row)
        if not bodies:
            return self._build_transparent() if region is None else self._build(None)
        caster = RayCaster.from_instances(bodies, **self._options)
        starts = len(self._faces) + np.cumsum(instances.sizes) - instances.sizes
        first_triangles = np.append(np.zeros(face_bodies, np.int64), starts[instance_indices])
        return _Trees(
            caster,
            region,
            first_triangles.astype(np.int32),
            np.array(instance_indices, np.int64),
            origins,
        )


def _parts_in(
    instances: Instances, region: Floats | None, is_seen: Bools | None
) -> Iterator[tuple[int, ClippedMesh | None]]:
    """Yield the row of each visible instance in a region, and its clipped mesh.

    The mesh is None if the instance is not clipped.

    `is_seen` (n,) is a mask of the visible instances, or None if all are visible. Parts with an
    opacity mask are not clipped, because rounding their texture coordinates to single precision
    would shift the mask.
    """
    if region is None:
        instance_indices = (
            range(len(instances)) if is_seen is None else np.flatnonzero(is_seen).tolist()
        )
        yield from ((row, None) for row in instance_indices)
        return
    lower, upper = instances.bounds.transpose(1, 0, 2)
    is_whole = ((region[0] <= lower) & (upper <= region[1])).all(axis=1)
    is_near = _is_near(instances, region)
    if is_seen is not None:
        is_near &= is_seen
    for row in np.flatnonzero(is_near).tolist():
        cut_part = None
        part = instances.mesh_parts[instances.part[row]]
        if not is_whole[row] and part.mask is None:
            planes = box_planes(region, instances.transforms[row])
            cut_part = clip_triangles(part.vertices, part.faces, planes)
        if cut_part is None or len(cut_part.faces):
            yield row, cut_part


def _have_area(vertices: Floats, faces: Integers) -> bool:
    a, b, c = vertices[faces[(faces != faces[:, :1]).any(axis=1)]].transpose(1, 0, 2)
    return bool(np.cross(b - a, c - a).any())


def _is_near(instances: Instances, region: Floats) -> Bools:
    lower, upper = instances.bounds.transpose(1, 0, 2)
    return np.asarray(((lower <= region[1]) & (region[0] <= upper)).all(axis=1))


def mesh_of(part: MeshPart) -> Mesh:
    """Return the mesh of a part, including the opacity mask of its texture if it has one."""
    opacity = None if part.mask is None or part.uv is None else Opacity(part.mask, part.uv)
    return Mesh(part.vertices, part.faces, opacity)
