"""Plan the stations of a terrestrial scan so that they cover as much surface as possible."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lidarfiles.open3d_access.neighbors import nearest_neighbors
from lidarfiles.work.mapping import MapFunction, parallel_map
from lidarfiles.work.work import Step, Work
from lidarscenes.procedural.floor import SLAB_M
from lidarsim.errors import LidarError
from lidarsim.media.materials import match_names
from lidarsim.numerics.arrays import Bools, Floats, Ints
from lidarsim.scene.scene import Scene
from lidarsim.scene.scene_mesh import triangle_areas
from lidarsim.scene.simplified import SimplifiedScene
from lidarsim.schema.checks import check_list, check_number
from lidarsim.sensor import Sensor, Spin
from lidarsim.words import name_hint
from raybeam import RayCaster

if TYPE_CHECKING:
    from lidarfiles.work.mapping import Client

MAX_STATIONS = 100
MIN_GAIN = 0.01  # minimum fraction of the reachable area per station by default
_CANDIDATES = 600  # approximate number of candidates in a scene without obstacles
_MAX_CANDIDATES = 50_000
_MIN_SPACING_M = 0.5
# Number of surface samples, which are distributed by area, and minimum number for each object.
_POINTS = 20_000
_OBJECT_POINTS = 60
_CLEARANCE_M = 0.3  # minimum distance of the instrument from any surface
_STEP_M = 0.2  # maximum height of surfaces that an operator can step on
_FOOT_M = 0.01  # a ray that starts at this height above the floor does not hit the floor
_SPHERE_RAYS = 128  # number of rays in all directions from each candidate
_CHUNK = 32  # number of candidates that a process receives together
_PROCESS_CHUNKS = 32  # starting a process takes as long as this number of chunks
_WORKER_BYTES = 1 << 30
_SECTORS = 36  # azimuth sectors, all of which contain rays if the sensor scans the full circle


class StationVisibility:
    """Visibility of surfaces from a sensor at a station.

    A surface is visible if it is within the sensor's range and field of view, and not occluded. The
    field of view extends from the lowest to the highest ray of the sensor. `slant_deg` is the
    maximum angle of incidence, measured from the surface normal. Actors are ignored. Rays are cast
    by `threads` threads, or one for each core. Raises LidarError if the sensor does not scan the
    full circle.
    """

    def __init__(
        self, scene: Scene, sensor: Sensor, slant_deg: float, threads: int | None = None
    ) -> None:
        self.scene = scene
        self.sensor = sensor
        self.slant_deg = slant_deg
        self.caster = RayCaster(scene.vertices, scene.faces, threads=threads)
        # Tolerance for the single precision of the ray caster and of points in pictures.
        self._slack = max(2e-3, 2e-5 * float(np.linalg.norm(np.ptp(scene.bounds, axis=0))))
        lowest, highest = sensor_elevations(sensor)
        self._lowest = lowest - 1e-9
        self._highest = highest + 1e-9

    def __reduce__(self) -> tuple[Any, ...]:
        # Processes share the cores.
        return StationVisibility, (self.scene, self.sensor, self.slant_deg, 1)

    def visible_sides(self, station: Floats, points: Floats, normals: Floats) -> NDArray[np.int8]:
        """Determine which side of the surface at each point is visible from a station.

        `station` has shape (3,), `points` and the unit vectors `normals` have shape (n, 3).
        Positions are local, in meters, and points lie on triangles of the scene. The result has
        shape (n,). It is 1 for the side that the normal points to, -1 for the opposite side, and 0
        if the point is not visible.
        """
        offsets = points - station
        distance_m = np.sqrt(np.einsum("ij,ij->i", offsets, offsets))
        facing = -np.einsum("ij,ij->i", offsets, normals)
        facing_points = np.flatnonzero(
            (distance_m >= max(self.sensor.min_range_m, self._slack))
            & (distance_m <= self.sensor.max_range_m)
            & (np.abs(facing) >= np.cos(np.radians(self.slant_deg)) * distance_m)
            & (offsets[:, 2] >= self._lowest * distance_m)
            & (offsets[:, 2] <= self._highest * distance_m)
        )
        hit_distance_m = self.caster.cast(station, offsets[facing_points]).distance
        facing_points = facing_points[hit_distance_m >= distance_m[facing_points] - self._slack]
        sides = np.zeros(len(points), np.int8)
        sides[facing_points] = np.sign(facing[facing_points])
        return sides


def sensor_elevations(sensor: Sensor) -> tuple[float, float]:
    """Return the sines of the elevations of a sensor's lowest and highest rays.

    Raises
    ------
    LidarError
        If the sensor does not scan the full circle.
    """
    head = sensor.head
    revolution = math.ceil(head.firings_per_turn) if isinstance(head, Spin) else sensor.period
    revolution = revolution or 20_000  # number of firings if the scan pattern never repeats
    count = min(revolution, max(4 * _SECTORS, 20_000 // sensor.channels))
    firings = np.linspace(0, revolution, count, endpoint=False).astype(np.int64)
    x, y, z = sensor.directions(firings).reshape(-1, 3).T
    sectors = np.floor(np.arctan2(y, x) / (2 * np.pi) * _SECTORS).astype(int) % _SECTORS
    if len(np.unique(sectors)) < min(_SECTORS, revolution):
        raise LidarError(
            f"{sensor.model} does not scan the full circle, which is required at a scan "
            "station. Use another sensor, such as terrestrial/riegl-vz400."
        )
    return float(z.min()), float(z.max())


@dataclass(frozen=True, eq=False)
class StationPlan:
    """Stations in the order in which they were selected, and the area that they cover.

    The reachable area consists of all sides of target surfaces that at least one candidate sees
    within the range, the field of view and the maximum angle of incidence. Coverage is the fraction
    of the reachable area that the stations see.
    """

    stations: Floats  # (s, 3) world meters
    coverage: Floats  # (s,) fraction of the reachable area after each station, 0 to 1
    candidates: Floats  # (c, 3) world meters
    spacing_m: float  # spacing of the candidates
    targets: Bools  # (objects,) whether an object should be covered; other objects only occlude
    area_m2: Floats  # (objects,) area of targets; twice this is reachable if both sides are
    reachable_m2: Floats  # (objects,) area of targets that candidates see
    covered_m2: Floats  # (objects,) area of targets that the stations see
    scene: Scene  # the planned scene: all triangles, without instances and actors
    sight: StationVisibility


@dataclass(frozen=True, eq=False)
class SurveyCoverage:
    """Area visible from the stations, and the part of this area in which a cloud has points.

    Areas count the sides of target surfaces. The two sides of a thin wall count separately.
    """

    targets: Bools  # (objects,) whether the area of an object counts
    area_m2: Floats  # (objects,) area of targets; twice this is reachable if both sides are
    reachable_m2: Floats  # (objects,) area that the stations see
    covered_m2: Floats  # (objects,) part of this area that has a point of the cloud nearby


def plan_stations(
    scene: Scene,
    sensor: Sensor,
    *,
    targets: Sequence[str] = (),
    count: int | None = None,
    coverage: float | None = None,
    height_m: float = 1.7,
    spacing_m: float | None = None,
    slant_deg: float = 80.0,
    client: Client | None = None,
    workers: int | None = None,
    work: Work | None = None,
) -> StationPlan:
    """Choose stations for a terrestrial scan.

    Candidates are positions on a horizontal grid above the lowest floor, where the instrument has
    enough space (see `candidates`). In each step, the candidate that adds the largest visible area
    is chosen.

    Parameters
    ----------
    scene
        Scene to scan. Actors are ignored.
    sensor
        The instrument, in upright position. Its range and field of view are taken into account.
    targets
        Names of the objects to cover, or patterns with * and ?. Other objects only occlude. By
        default, all objects are covered.
    count
        Maximum number of stations. Fewer are chosen if they cover the entire reachable area.
    coverage
        Fraction of the reachable area to cover, in (0, 1]. It cannot be combined with `count`. If
        neither is given, stations are added as long as each one adds at least 1 %. The maximum
        number of stations is 100.
    height_m
        Height of the instrument above the floor in meters.
    spacing_m
        Spacing of the candidates in meters. By default, there are about 600 candidates.
    slant_deg
        Maximum angle of incidence, in degrees from the surface normal, in (0, 90].
    client
        Client of a cluster whose OTHER workers compute the visibility from the candidates. By
        default, it is computed on this machine.
    workers
        Number of processes on this machine. The plan does not depend on it. By default, processes
        are only started for a large number of candidates.
    work
        Unfinished work that keeps the visibility from the candidates, and provides that of an
        earlier run.

    Raises
    ------
    LidarError
        If a value is out of range, if a target matches no object, if the sensor does not scan the
        full circle, if no candidate position exists or sees a target, or if the cluster is lost.

    Examples
    --------
    >>> from lidarpool import Sensor, box
    >>> room = Scene.from_meshes([box("Room", (8, 6, 3))])
    >>> plan = plan_stations(room, Sensor.grid(vertical_fov_deg=180), slant_deg=90)
    >>> len(plan.stations), plan.reachable_m2.round().tolist()
    (1, [180.0])
    """
    if count is not None and coverage is not None:
        raise LidarError("`count` and `coverage` cannot be combined.")
    check_list("targets", targets)
    if count is not None:
        check_number("count", count, whole=True, ge=1, le=MAX_STATIONS)
    if coverage is not None:
        check_number("coverage", coverage, gt=0, le=1)
    if spacing_m is not None:
        check_number("spacing_m", spacing_m, gt=0, le=1e6)
    check_number("height_m", height_m, gt=0, le=1e6)
    check_number("slant_deg", slant_deg, gt=0, le=90)
    is_target = _target_mask(scene.names, targets)  # first, to report wrong names immediately
    scene = replace(SimplifiedScene.from_scene(scene).scene, actors=())
    sight = StationVisibility(scene, sensor, slant_deg)
    if spacing_m is None:
        spacing_m = _default_spacing_m(scene)
    positions = candidates(scene, sight.caster, height_m, spacing_m)
    chunks = -(-len(positions) // _CHUNK)
    processes = chunks if workers is not None else chunks // _PROCESS_CHUNKS
    with parallel_map(client, processes, _WORKER_BYTES, workers) as run:
        samples = _sample_surfaces(scene, is_target)
        visibility = _visibility(samples, sight, positions, run, work)
    if not len(visibility.area_m2):
        raise LidarError(
            f"{'No target' if targets else 'Nothing'} is reachable from the {len(positions):,} "
            f"candidate positions at a height of {height_m:g} m. Check the unit of the scene, "
            "the range of the sensor and the slant."
        )
    min_gain = MIN_GAIN if count is None and coverage is None else 0.0
    choice = _choose_rows(visibility, count or MAX_STATIONS, coverage or 1.0, min_gain)
    owner = visibility.owner
    objects = len(scene.names)
    covered_m2 = visibility.area_m2 * choice.covered
    return StationPlan(
        stations=positions[choice.row_indices] + scene.origin,
        coverage=np.array(choice.shares),
        candidates=positions + scene.origin,
        spacing_m=spacing_m,
        targets=is_target,
        area_m2=_object_areas(scene, is_target),
        reachable_m2=np.bincount(owner, visibility.area_m2, objects).astype(np.float64),
        covered_m2=np.bincount(owner, covered_m2, objects).astype(np.float64),
        scene=scene,
        sight=sight,
    )


def survey_coverage(
    scene: Scene,
    sensor: Sensor,
    positions: Floats,
    clouds: Iterable[Floats],
    *,
    targets: Sequence[str] = (),
    within_m: float = 0.1,
    slant_deg: float = 80.0,
) -> SurveyCoverage:
    """Compare the area visible from stations with the points of a cloud.

    Parameters
    ----------
    scene
        The scanned scene. Actors are ignored.
    sensor
        The instrument, in upright position. Its range and field of view are taken into account.
    positions
        Positions of the stations in world coordinates, in meters. Shape (s, 3).
    clouds
        Points in world coordinates, in meters. Each array has shape (n, 3), and only one is in
        memory at a time.
    targets
        Names of the objects whose area counts, or patterns with * and ?. By default, all objects
        count.
    within_m
        Maximum distance in meters between a surface sample and a point that covers it.
    slant_deg
        Maximum angle of incidence at which a surface counts as visible, in degrees from its normal.

    Raises
    ------
    LidarError
        If a target matches no object, or if the sensor does not scan the full circle.

    Examples
    --------
    >>> import numpy as np
    >>> from lidarpool import Sensor, box
    >>> room = Scene.from_meshes([box("Room", (8, 6, 3))])
    >>> floor = np.mgrid[-4:4.1:0.1, -3:3.1:0.1, 0:1].reshape(3, -1).T
    >>> found = survey_coverage(
    ...     room, Sensor.grid(vertical_fov_deg=180), np.array([[0, 0, 1.5]]), [floor], slant_deg=90
    ... )
    >>> found.reachable_m2.round().tolist(), bool(48 <= found.covered_m2[0] < 54)
    ([180.0], True)
    """
    is_target = _target_mask(scene.names, targets)
    scene = SimplifiedScene.from_scene(scene).scene
    sight = StationVisibility(scene, sensor, slant_deg)
    samples = _sample_surfaces(scene, is_target)
    has_point = np.zeros(len(samples.points), np.bool_)
    for points in clouds:
        missing = np.flatnonzero(~has_point)
        if len(points) and len(missing):
            distance_m, _ = nearest_neighbors(samples.points[missing], points - scene.origin)
            has_point[missing] = distance_m <= within_m
    sides = np.stack(
        [sight.visible_sides(p, samples.points, samples.normals) for p in positions - scene.origin]
    )
    reachable_m2 = samples.area_m2 * ((sides > 0).any(axis=0) + (sides < 0).any(axis=0).astype(int))
    objects = len(scene.names)
    return SurveyCoverage(
        is_target,
        _object_areas(scene, is_target),
        np.bincount(samples.owner, reachable_m2, objects).astype(np.float64),
        np.bincount(samples.owner, reachable_m2 * has_point, objects).astype(np.float64),
    )


def _target_mask(names: Sequence[str], targets: Sequence[str]) -> Bools:
    """Return a mask of the objects that match a target.

    Without targets, all objects match.
    """
    mask = np.full(len(names), not targets)
    for pattern in targets:
        rows = match_names(pattern, names)
        if not len(rows):
            raise LidarError(
                f"The target {pattern!r} does not match any object.{name_hint(pattern, names)}"
            )
        mask[rows] = True
    return mask


class _Visibility(NamedTuple):
    """Surface sides that are visible from at least one candidate."""

    visible: Bools  # (c, n), whether a candidate sees a side
    owner: Ints  # (n,), objects of the sides
    area_m2: Floats  # (n,), area that a side represents


class _Chunk(NamedTuple):
    """Consecutive candidates."""

    first: int
    positions: Floats  # (c, 3), local meters

    @property
    def label(self) -> str:
        """Candidates of the chunk, for messages."""
        return f"candidates {self.first + 1:,} to {self.first + len(self.positions):,}"


class _VisibleSides(NamedTuple):
    """Sides of surface samples that are visible from each candidate of a chunk.

    The two sides of a surface count separately, because they can be in different rooms.
    """

    bits: NDArray[np.uint8]  # (c, ceil(2n / 8)): the side of each normal, then the opposite sides


_VISIBILITY = Step("visibility", (_VisibleSides,))


@dataclass(frozen=True)
class _FindVisibleSides:
    """Function that determines which sides of surface samples are visible from candidates."""

    sight: StationVisibility
    samples: _SurfaceSamples

    def __call__(self, chunk: _Chunk) -> tuple[_VisibleSides]:
        points, normals = self.samples.points, self.samples.normals
        sides = np.stack([self.sight.visible_sides(p, points, normals) for p in chunk.positions])
        visible = np.concatenate([sides > 0, sides < 0], axis=1)
        return (_VisibleSides(np.packbits(visible, axis=1)),)


def _visibility(
    samples: _SurfaceSamples,
    sight: StationVisibility,
    positions: Floats,
    run: MapFunction,
    work: Work | None,
) -> _Visibility:
    """Return the sides of surface samples that are visible from local `positions`."""
    function = _FindVisibleSides(sight, samples)
    chunks = [
        _Chunk(first, positions[first : first + _CHUNK])
        for first in range(0, len(positions), _CHUNK)
    ]
    results = (
        run(function, chunks) if work is None else work.each(_VISIBILITY, run, function, chunks)
    )
    bits = np.concatenate([found.bits for (found,) in results])
    count = 2 * len(samples.points)
    columns = np.flatnonzero(np.unpackbits(np.bitwise_or.reduce(bits), count=count))
    visible = np.unpackbits(bits, axis=1, count=count)[:, columns].view(np.bool_)
    owner = np.tile(samples.owner, 2)[columns]
    return _Visibility(visible, owner, np.tile(samples.area_m2, 2)[columns])


class _Choice(NamedTuple):
    """Selected candidates, in the order of their selection.

    The indices are rows of `_Visibility`.
    """

    row_indices: list[int]
    shares: list[float]  # fraction of the area that is covered after each row
    covered: Bools  # (n,)


def _choose_rows(
    visibility: _Visibility, max_rows: int, max_share: float, min_gain: float
) -> _Choice:
    """Select candidates greedily by the area that each of them adds.

    Stops after `max_rows` candidates, when the fraction `max_share` of the area is covered, or when
    the next candidate would add less than the fraction `min_gain`.
    """
    visible = visibility.visible
    area = visibility.area_m2 / visibility.area_m2.sum()
    covered = np.zeros(len(area), np.bool_)
    gain = np.array([area[row].sum() for row in visible])
    chosen: list[int] = []
    fractions: list[float] = []
    while len(chosen) < max_rows and not covered.all():
        best = int(gain.argmax())
        if chosen and gain[best] < min_gain:
            break
        new = np.flatnonzero(visible[best] & ~covered)
        covered[new] = True
        gain -= np.array([area[new[row[new]]].sum() for row in visible])
        gain[best] = -np.inf
        chosen.append(best)
        fractions.append(1.0 if covered.all() else float(area[covered].sum()))
        if fractions[-1] >= max_share:
            break
    return _Choice(chosen, fractions, covered)


def _default_spacing_m(scene: Scene) -> float:
    """Return the distance between candidates in meters, as a round number.

    The distance suits the size of the scene.
    """
    width_m, depth_m, _ = np.ptp(scene.bounds, axis=0)
    spacing = max(math.sqrt(width_m * depth_m / _CANDIDATES), _MIN_SPACING_M)
    power = 10.0 ** math.floor(math.log10(spacing))
    return round(spacing / power, 1) * power


def candidates(scene: Scene, caster: RayCaster, height_m: float, spacing_m: float) -> Floats:
    """Return grid positions at which an instrument can be set up, in local meters.

    The result has shape (c, 3). The floor is the lowest surface. If the lowest surface is the
    underside of a slab, the floor is the top of the slab. Excluded are floors that can be reached
    only by a slope of more than 45°, such as eaves without ground below, positions with a surface
    within 0.3 m of the instrument or between the instrument and the floor, and positions inside
    objects.

    Raises
    ------
    LidarError
        If no position is suitable, or if the grid has too many positions.
    """
    positions, shape = _grid_positions(scene, spacing_m)
    floor = _floor_heights(scene, caster, positions)
    walkable = _largest_level(floor.reshape(shape), spacing_m).ravel()
    rows = np.flatnonzero(walkable)
    positions[rows, 2] = floor[rows] + _FOOT_M
    up = np.tile([0.0, 0.0, 1.0], (len(rows), 1))
    room = caster.cast(positions[rows], up).distance
    rows = rows[room > height_m + _CLEARANCE_M - _FOOT_M]
    positions = positions[rows]
    positions[:, 2] = floor[rows] + height_m
    positions = positions[_free_positions(scene, caster, positions)]
    if not len(positions):
        fault = (
            "No floor was found" if not walkable.any() else ("No free space was found on the floor")
        )
        raise LidarError(
            f"{fault} for an instrument at a height of {height_m:g} m on a grid of "
            f"{spacing_m:g} m. Check the unit and the up axis of the scene, use another "
            "height or spacing, or set `scene.ground`."
        )
    return positions


def _grid_positions(scene: Scene, spacing_m: float) -> tuple[Floats, tuple[int, int]]:
    """Return local positions on a grid over the scene, and their number along x and y."""
    lower, upper = scene.bounds
    columns, rows = np.maximum((upper - lower)[:2] / spacing_m, 1).astype(int).tolist()
    if columns * rows > _MAX_CANDIDATES:
        raise LidarError(
            f"A grid of {spacing_m:g} m has {columns * rows:,} positions, but the limit is "
            f"{_MAX_CANDIDATES:,}. Use a larger spacing."
        )
    x, y = np.meshgrid(
        (np.arange(columns) - (columns - 1) / 2) * spacing_m,
        (np.arange(rows) - (rows - 1) / 2) * spacing_m,
        indexing="ij",
    )
    positions = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1) + (lower + upper) / 2
    return positions, (columns, rows)


def _floor_heights(scene: Scene, caster: RayCaster, positions: Floats) -> Floats:
    """Return the floor height at each position, or infinity where there is no floor."""
    origins = positions.copy()
    up = np.tile([0.0, 0.0, 1.0], (len(origins), 1))
    origins[:, 2] = scene.bounds[0, 2] - 1
    lowest = caster.cast(origins, up)
    floor: Floats = origins[:, 2] + lowest.distance
    hit_rays = np.flatnonzero(lowest.hit)
    # A surface that faces down is the underside of a slab if there is another surface just above.
    a, b, c = scene.vertices[scene.faces[lowest.triangle[hit_rays]]].swapaxes(0, 1)
    undersides = hit_rays[np.cross(b - a, c - a)[:, 2] < 0]
    origins[:, 2] = floor
    above = caster.cast(origins[undersides], up[undersides], t_min=_FOOT_M, t_max=SLAB_M).distance
    floor[undersides] += np.where(np.isfinite(above), above, 0.0)
    # Instruments can be set up on low steps such as curbs and sidewalks.
    origins[hit_rays, 2] = floor[hit_rays] + _STEP_M
    below = caster.cast(origins[hit_rays], -up[hit_rays], t_max=_STEP_M).distance
    floor[hit_rays] += np.where(np.isfinite(below), _STEP_M - below, 0.0)
    return floor


def _largest_level(floor: Floats, spacing_m: float) -> Bools:
    """Return a mask of the largest connected part of the floor without steep slopes.

    `floor` contains the height of each grid position, which is infinite if there is no floor.
    """
    group = np.full(floor.shape, -1)
    sizes: list[int] = []
    for first_cell in zip(*np.nonzero(np.isfinite(floor)), strict=True):
        if group[first_cell] >= 0:
            continue
        group[first_cell] = len(sizes)
        sizes.append(0)
        to_visit = [first_cell]
        while to_visit:
            i, j = cell = to_visit.pop()
            sizes[-1] += 1
            for neighbor in ((i - 1, j), (i + 1, j), (i, j - 1), (i, j + 1)):
                within = 0 <= neighbor[0] < floor.shape[0] and 0 <= neighbor[1] < floor.shape[1]
                if (
                    within
                    and group[neighbor] < 0
                    and abs(floor[neighbor] - floor[cell]) <= spacing_m
                ):
                    group[neighbor] = len(sizes) - 1
                    to_visit.append(neighbor)
    return group == int(np.argmax(sizes)) if sizes else group >= 0


def _free_positions(scene: Scene, caster: RayCaster, positions: Floats) -> Ints:
    """Return the indices of positions that have free space around them and are outside all objects.

    A position is considered to be inside an object if most of its rays above the horizon hit back
    faces of the object. This does not apply to objects that contain most positions, such as a hall
    that is modeled by its outer surface.
    """
    n = np.arange(_SPHERE_RAYS)
    # Directions are evenly distributed over the sphere by the golden angle.
    z = 1 - (2 * n + 1) / _SPHERE_RAYS
    azimuths = np.pi * (3 - 5**0.5) * n
    level = np.sqrt(1 - z * z)
    rays = np.stack([level * np.cos(azimuths), level * np.sin(azimuths), z], axis=1)
    directions = np.tile(rays, (len(positions), 1))
    hits = caster.cast(np.repeat(positions, _SPHERE_RAYS, axis=0), directions)
    free = hits.distance.reshape(-1, _SPHERE_RAYS).min(axis=1, initial=np.inf) >= _CLEARANCE_M
    corners = scene.vertices[scene.faces[hits.triangle]]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    back = hits.hit & (np.einsum("ij,ij->i", normals, directions) > 0)
    upper = back.reshape(-1, _SPHERE_RAYS)[:, : _SPHERE_RAYS // 2]
    owner = scene.face_object[hits.triangle].reshape(-1, _SPHERE_RAYS)[:, : _SPHERE_RAYS // 2]
    inside = np.full(len(positions), -1)
    for index in np.flatnonzero(upper.mean(axis=1) > 0.5):
        inside[index] = np.bincount(owner[index, upper[index]]).argmax()
    counts = np.bincount(inside + 1, minlength=len(scene.names) + 1)
    counts[0] = len(positions)
    return np.flatnonzero(free & (counts[inside + 1] > len(positions) / 2))


def _object_areas(scene: Scene, is_target: Bools) -> Floats:
    """Return the area of each object, or 0 for objects that are not targets."""
    areas = triangle_areas(scene.vertices[scene.faces])
    return np.where(is_target, np.bincount(scene.face_object, areas, len(scene.names)), 0.0)


class _SurfaceSamples(NamedTuple):
    """Sample points on the surfaces of a scene."""

    points: Floats  # (n, 3), local meters
    normals: Floats  # (n, 3), unit vectors
    owner: Ints  # (n,), objects
    area_m2: Floats  # (n,), area that a point represents


def _sample_surfaces(scene: Scene, is_target: Bools) -> _SurfaceSamples:
    """Return sample points that are evenly distributed over the area of each target.

    The samples are reproducible. `is_target` is a mask of the objects.
    """
    order = np.argsort(scene.face_object, kind="stable")
    order = order[is_target[scene.face_object[order]]]
    corners = scene.vertices[scene.faces[order]]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    doubled = np.linalg.norm(normals, axis=1)
    areas = np.bincount(scene.face_object[order], doubled / 2, len(scene.names)).astype(np.float64)
    min_count = max(1, min(_OBJECT_POINTS, _POINTS // int(is_target.sum())))
    counts = np.round(_POINTS * areas / areas.sum()).astype(int)
    counts = np.maximum(counts, np.where(areas > 0, min_count, 0))
    rng = np.random.default_rng(0)
    triangle = _sample_triangles(rng, doubled / 2, areas, counts)
    a, b = np.sort(rng.random((2, len(triangle))), axis=0)[..., None]
    sides = corners[triangle].swapaxes(0, 1)
    points = a * sides[0] + (b - a) * sides[1] + (1 - b) * sides[2]
    # Due to rounding, a point may lie on the last triangle of the previous object, or on a triangle
    # without area.
    owner = scene.face_object[order][triangle].astype(np.int64)
    units = normals[triangle] / np.where(doubled > 0, doubled, 1.0)[triangle, None]
    return _SurfaceSamples(points, units, owner, (areas / np.maximum(counts, 1))[owner])


def _sample_triangles(
    rng: np.random.Generator, face_areas: Floats, areas: Floats, counts: Ints
) -> Ints:
    """Draw triangles of each object with probabilities proportional to area, sorted by object."""
    owner = np.repeat(np.arange(len(counts)), counts)
    nth = np.arange(len(owner)) - np.repeat(np.cumsum(counts) - counts, counts)
    offsets = (nth + rng.random(len(owner))) / counts[owner] * areas[owner]
    stops = np.cumsum(face_areas)
    starts = np.cumsum(areas) - areas
    return np.searchsorted(stops, starts[owner] + offsets, side="right").clip(0, len(stops) - 1)
