"""Stations of a terrestrial scan: places on the floor from which a sensor sees most surfaces."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from lidarscenes.procedural.floor import SLAB_M
from lidarsim.base.arrays import Bools, Floats, Ints
from lidarsim.base.errors import LidarError
from lidarsim.base.validation import checked
from lidarsim.scene.scene import Scene
from lidarsim.scene.simplified import SimplifiedScene
from lidarsim.sensor import Sensor, Spin
from raybeam import RayCaster

STATIONS_MOST = 100
LEAST_GAIN = 0.01  # of what can be seen, that each adds if no number and no coverage is given
_PLACES = 600  # about so many candidates, in a scene without obstacles
_PLACES_MOST = 50_000
_LEAST_SPACING_M = 0.5
# samples by area; at least so many of each object, if few
_POINTS = 20_000
_OBJECT_POINTS = 60
_CLEAR_M = 0.3  # nothing is nearer to the instrument, nor this close above it
_STEP_M = 0.2  # what is lower than this is stepped on
_FOOT_M = 0.01  # a ray that starts so far above the floor does not hit it
_AROUND = 128  # rays that look around a candidate
_SECTORS = 36  # in all of which a sensor that turns has rays


class Sight:
    """What a sensor sees from a station: surfaces in its range and field of view, not hidden.

    Its lowest and highest rays limit the field of view, `slant_deg` the angle of incidence, from
    the normal of a surface. Actors are left out. LidarError if it does not look all around.
    """

    def __init__(self, scene: Scene, sensor: Sensor, slant_deg: float) -> None:
        self.sensor = sensor
        self.slant_deg = slant_deg
        self.caster = RayCaster(scene.vertices, scene.faces)
        # Single precision of ray casters, and of points in pictures.
        self._slack = max(2e-3, 2e-5 * float(np.linalg.norm(np.ptp(scene.bounds, axis=0))))
        head = sensor.head
        turn = math.ceil(head.firings_per_turn) if isinstance(head, Spin) else sensor.period
        turn = turn or 20_000  # firings of a head that never repeats
        count = min(turn, max(4 * _SECTORS, 20_000 // sensor.channels))
        firings = np.linspace(0, turn, count, endpoint=False).astype(np.int64)
        x, y, z = sensor.directions(firings).reshape(-1, 3).T
        sectors = np.floor(np.arctan2(y, x) / (2 * np.pi) * _SECTORS).astype(int) % _SECTORS
        if len(np.unique(sectors)) < min(_SECTORS, turn):
            raise LidarError(
                f"{sensor.model} does not look all around, as it has to on a station: give "
                "another sensor, such as terrestrial/riegl-vz400."
            )
        self._lowest = float(z.min()) - 1e-9
        self._highest = float(z.max()) + 1e-9

    def sides(self, station: Floats, points: Floats, normals: Floats) -> NDArray[np.int8]:
        """Return which side of surfaces a station (3,) sees at points (n, 3): int8 (n,).

        In local metres. The points are on triangles of the scene, with unit normals (n, 3). 1 is
        the side that the normal points to, -1 the other, 0 a point that is not seen.
        """
        ways = points - station
        far = np.sqrt(np.einsum("ij,ij->i", ways, ways))
        facing = -np.einsum("ij,ij->i", ways, normals)
        some = np.flatnonzero(
            (far >= max(self.sensor.min_range_m, self._slack))
            & (far <= self.sensor.max_range_m)
            & (np.abs(facing) >= np.cos(np.radians(self.slant_deg)) * far)
            & (ways[:, 2] >= self._lowest * far)
            & (ways[:, 2] <= self._highest * far)
        )
        met = self.caster.cast(station, ways[some]).distance
        some = some[met >= far[some] - self._slack]
        out = np.zeros(len(points), np.int8)
        out[some] = np.sign(facing[some])
        return out


@dataclass(frozen=True, eq=False)
class StationPlan:
    """Stations in the order in which they were chosen, and what they cover.

    Coverage is by area, of the sides of surfaces that at least one candidate sees.
    """

    stations: Floats  # (s, 3) world metres
    coverage: Floats  # (s,) share in 0 to 1, after each station
    candidates: Floats  # (c, 3) world metres
    spacing_m: float  # of the candidates
    visible_m2: Floats  # (objects,) area that some candidate sees
    covered_m2: Floats  # (objects,) area that the stations see
    sight: Sight


@checked
def plan_stations(
    scene: Scene,
    sensor: Sensor,
    *,
    count: Annotated[int | None, Field(ge=1, le=STATIONS_MOST)] = None,
    coverage: Annotated[float | None, Field(gt=0, le=1)] = None,
    height_m: Annotated[float, Field(gt=0, le=1e6)] = 1.7,
    spacing_m: Annotated[float | None, Field(gt=0, le=1e6)] = None,
    slant_deg: Annotated[float, Field(gt=0, le=90)] = 80.0,
) -> StationPlan:
    """Choose stations for a terrestrial scan.

    Candidates stand on a grid, on the lowest floor, where there is room for the instrument; see
    `candidates`. Whichever adds most area comes next.

    Parameters
    ----------
    scene
        What to scan; actors are ignored.
    sensor
        The instrument, upright. Its range and field of view count.
    count
        Number of stations; fewer if these already see everything.
    coverage
        Instead of `count`: share of the area that any candidate sees, in (0, 1]. With neither,
        stations are chosen for as long as each adds 1 %. There are at most 100 stations.
    height_m
        Of the instrument above the floor, metres.
    spacing_m
        Of the candidates, metres; by default such that there are about 600.
    slant_deg
        Largest angle of incidence, degrees from the normal, in (0, 90].

    Raises
    ------
    LidarError
        If a value is out of range, the sensor does not look all around, or there is nowhere to
        stand, or nothing to see.

    Examples
    --------
    >>> from lidarpool import Sensor
    >>> from lidarsim.scene.actors import box
    >>> room = Scene.from_meshes([box("Room", (8, 6, 3))])
    >>> plan = plan_stations(room, Sensor.grid(vertical_fov_deg=180), slant_deg=90)
    >>> len(plan.stations), plan.visible_m2.round().tolist()
    (1, [180.0])
    """
    if count is not None and coverage is not None:
        raise LidarError("count and coverage both say when to stop: give one of them.")
    scene = SimplifiedScene.from_scene(scene).scene
    sight = Sight(scene, sensor, slant_deg)
    if spacing_m is None:
        spacing_m = _spacing(scene)
    places = candidates(scene, sight.caster, height_m, spacing_m)
    points, normals, owner, area = _samples(scene)
    sides = np.stack([sight.sides(place, points, normals) for place in places])
    # Each side of a surface counts by itself: of a thin wall, that in each room.
    seen = np.concatenate([sides > 0, sides < 0], axis=1)
    visible = np.flatnonzero(seen.any(axis=0))
    if not len(visible):
        raise LidarError(
            f"Nothing is visible from {len(places):,} places at {height_m:g} m: check the unit of "
            "the scene, the range of the sensor, and the slant."
        )
    seen = seen[:, visible]
    owner = np.tile(owner, 2)[visible]
    area = np.tile(area, 2)[visible]
    least = LEAST_GAIN if count is None and coverage is None else 0.0
    chosen, shares, covered = _greedy(seen, area, count or STATIONS_MOST, coverage or 1.0, least)
    objects = len(scene.names)
    return StationPlan(
        stations=places[chosen] + scene.origin,
        coverage=np.array(shares),
        candidates=places + scene.origin,
        spacing_m=spacing_m,
        visible_m2=np.bincount(owner, area, objects).astype(np.float64),
        covered_m2=np.bincount(owner, area * covered, objects).astype(np.float64),
        sight=sight,
    )


def _greedy(
    seen: Bools, area: Floats, most: int, enough: float, least: float
) -> tuple[list[int], list[float], Bools]:
    """Choose rows of `seen` (c, n) by the area (n,) they add; with the shares after each.

    It ends with `most` rows, when a share of `enough` is covered, or before a row adds less than
    the share `least`.
    """
    area = area / area.sum()
    covered = np.zeros(len(area), np.bool_)
    gain = np.array([area[row].sum() for row in seen])
    chosen: list[int] = []
    shares: list[float] = []
    while len(chosen) < most and not covered.all():
        best = int(gain.argmax())
        if chosen and gain[best] < least:
            break
        new = np.flatnonzero(seen[best] & ~covered)
        covered[new] = True
        gain -= np.array([area[new[row[new]]].sum() for row in seen])
        gain[best] = -np.inf
        chosen.append(best)
        shares.append(1.0 if covered.all() else float(area[covered].sum()))
        if shares[-1] >= enough:
            break
    return chosen, shares, covered


def _spacing(scene: Scene) -> float:
    """Return a round spacing of candidates for the scene's ground."""
    wide, deep, _ = np.ptp(scene.bounds, axis=0)
    spacing = max(math.sqrt(wide * deep / _PLACES), _LEAST_SPACING_M)
    digit = 10.0 ** math.floor(math.log10(spacing))
    return round(spacing / digit, 1) * digit


def candidates(scene: Scene, caster: RayCaster, height_m: float, spacing_m: float) -> Floats:
    """Return places (c, 3), local metres, where an instrument can stand, on a grid.

    The floor is the lowest surface, or the top of a slab if that is lowest. Floors that are
    reached only by a climb of more than 45 degrees, such as eaves where there is no ground, are
    left out; so are places with something within 0.3 m of the instrument, or between it and the
    floor, and those inside objects.

    Raises
    ------
    LidarError
        If there is none, or the grid is too fine.
    """
    low, high = scene.bounds
    across, along = np.maximum((high - low)[:2] / spacing_m, 1).astype(int).tolist()
    if across * along > _PLACES_MOST:
        raise LidarError(
            f"A grid of {spacing_m:g} m has {across * along:,} places, more than "
            f"{_PLACES_MOST:,}: give a larger spacing."
        )
    x, y = np.meshgrid(
        (np.arange(across) - (across - 1) / 2) * spacing_m,
        (np.arange(along) - (along - 1) / 2) * spacing_m,
        indexing="ij",
    )
    places = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1) + (low + high) / 2
    up = np.tile([0.0, 0.0, 1.0], (len(places), 1))
    places[:, 2] = low[2] - 1
    lowest = caster.cast(places, up)
    floor = places[:, 2] + lowest.distance  # infinite where there is none
    there = np.flatnonzero(lowest.hit)
    # A surface that faces down is the underside of a slab, if something is close above it.
    a, b, c = scene.vertices[scene.faces[lowest.triangle[there]]].swapaxes(0, 1)
    under = there[np.cross(b - a, c - a)[:, 2] < 0]
    places[:, 2] = floor
    above = caster.cast(places[under], up[under], t_min=_FOOT_M, t_max=SLAB_M).distance
    floor[under] += np.where(np.isfinite(above), above, 0.0)
    # Kerbs and pavements are stepped on.
    places[there, 2] = floor[there] + _STEP_M
    down = caster.cast(places[there], -up[there], t_max=_STEP_M).distance
    floor[there] += np.where(np.isfinite(down), _STEP_M - down, 0.0)
    walkable = _largest_level(floor.reshape(across, along), spacing_m).ravel()
    kept = np.flatnonzero(walkable)
    places[kept, 2] = floor[kept] + _FOOT_M
    room = caster.cast(places[kept], up[kept]).distance
    kept = kept[room > height_m + _CLEAR_M - _FOOT_M]
    places = places[kept]
    places[:, 2] = floor[kept] + height_m
    places = places[_clear(scene, caster, places)]
    if not len(places):
        what = "The scene has no floor" if not walkable.any() else "There is no room on the floor"
        raise LidarError(
            f"{what} for an instrument at {height_m:g} m, on a grid of {spacing_m:g} m: check the "
            "scene's unit and up axis, give another height or spacing, or add scene.ground."
        )
    return places


def _largest_level(floor: Floats, spacing_m: float) -> Bools:
    """Of floors (k, m) on a grid, infinite for none, the largest part without steep climbs."""
    group = np.full(floor.shape, -1)
    sizes: list[int] = []
    for start in zip(*np.nonzero(np.isfinite(floor)), strict=True):
        if group[start] >= 0:
            continue
        group[start] = len(sizes)
        sizes.append(0)
        ahead = [start]
        while ahead:
            i, j = here = ahead.pop()
            sizes[-1] += 1
            for beside in ((i - 1, j), (i + 1, j), (i, j - 1), (i, j + 1)):
                within = 0 <= beside[0] < floor.shape[0] and 0 <= beside[1] < floor.shape[1]
                if within and group[beside] < 0 and abs(floor[beside] - floor[here]) <= spacing_m:
                    group[beside] = len(sizes) - 1
                    ahead.append(beside)
    return group == int(np.argmax(sizes)) if sizes else group >= 0


def _clear(scene: Scene, caster: RayCaster, places: Floats) -> Ints:
    """Which places (c, 3) have room around them and are not inside an object.

    Inside an object most rays above the horizon meet back faces. A hall that is modelled by its
    outside is no such object: most places are in it.
    """
    n = np.arange(_AROUND)
    z = 1 - (2 * n + 1) / _AROUND  # evenly spread over the sphere, by the golden angle
    turn = np.pi * (3 - 5**0.5) * n
    level = np.sqrt(1 - z * z)
    rays = np.stack([level * np.cos(turn), level * np.sin(turn), z], axis=1)
    ways = np.tile(rays, (len(places), 1))
    hits = caster.cast(np.repeat(places, _AROUND, axis=0), ways)
    free = hits.distance.reshape(-1, _AROUND).min(axis=1, initial=np.inf) >= _CLEAR_M
    corners = scene.vertices[scene.faces[hits.triangle]]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    back = hits.hit & (np.einsum("ij,ij->i", normals, ways) > 0)
    upper = back.reshape(-1, _AROUND)[:, : _AROUND // 2]
    owner = scene.face_object[hits.triangle].reshape(-1, _AROUND)[:, : _AROUND // 2]
    inside = np.full(len(places), -1)
    for place in np.flatnonzero(upper.mean(axis=1) > 0.5):
        inside[place] = np.bincount(owner[place, upper[place]]).argmax()
    counts = np.bincount(inside + 1, minlength=len(scene.names) + 1)
    counts[0] = len(places)
    return np.flatnonzero(free & (counts[inside + 1] > len(places) / 2))


def _samples(scene: Scene) -> tuple[Floats, Floats, Ints, Floats]:
    """Points on the surfaces, evenly spread by area within each object, always the same.

    Returns points (n, 3) in local metres, unit normals there (n, 3), the number of the object (n,),
    and the m² that a point stands for (n,).
    """
    order = np.argsort(scene.face_object, kind="stable")
    corners = scene.vertices[scene.faces[order]]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    doubled = np.linalg.norm(normals, axis=1)
    objects = len(scene.names)
    areas = np.bincount(scene.face_object[order], doubled / 2, objects)
    least = np.where(areas > 0, max(1, min(_OBJECT_POINTS, _POINTS // objects)), 0)
    number = np.maximum(np.round(_POINTS * areas / areas.sum()).astype(int), least)
    owner = np.repeat(np.arange(objects), number)
    rng = np.random.default_rng(0)
    nth = np.arange(len(owner)) - np.repeat(np.cumsum(number) - number, number)
    along = (nth + rng.random(len(owner))) / number[owner] * areas[owner]
    ends = np.cumsum(doubled / 2)
    starts = np.cumsum(areas) - areas
    triangle = np.searchsorted(ends, starts[owner] + along, side="right").clip(0, len(ends) - 1)
    a, b = np.sort(rng.random((2, len(owner))), axis=0)[..., None]
    sides = corners[triangle].swapaxes(0, 1)
    points = a * sides[0] + (b - a) * sides[1] + (1 - b) * sides[2]
    # Rounding may give a point to the last triangle of the object before, or one without area.
    owner = scene.face_object[order][triangle].astype(np.int64)
    length = np.where(doubled > 0, doubled, 1.0)[triangle, None]
    weights = (areas / np.maximum(number, 1))[owner]
    return points, normals[triangle] / length, owner, weights
