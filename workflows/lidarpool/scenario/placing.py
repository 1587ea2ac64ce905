"""Where a sensor goes if nobody says: on the floor of a place, or around an object."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import yaml
from numpy.typing import ArrayLike

from lidarscenes.procedural.floor import heights_at, room_at, triangles_reaching
from lidarscenes.procedural.surroundings import Surroundings, in_the_way, is_open
from lidarsim.base.arrays import Floats
from lidarsim.base.words import plural
from lidarsim.scene.scene import Scene
from lidarsim.scene.simplified import SimplifiedScene
from lidarsim.sensor import Mounted, Pose, Sensor
from lidarsim.sensor.materials import rows_named

# Heights above a floor; and the least distance from the ceiling.
_HEIGHTS_M = (1.0, 2.0, 3.0)
_BELOW_M = 0.2

# Distances from the middle that are tried in turn if something is in the way there, or a building.
_ASIDE_M = (2.0, 4.0, 8.0, 16.0, 32.0, 64.0)

# Poses around an object: azimuths, which see two sides of a box each; degrees above its middle; and
# distance from its middle, in its diagonals, the least and the most.
_AZIMUTHS_DEG = (45, 135, 225, 315)
_ABOVE_DEG = 20.0
_FAR = (1.5, 3.0)
_LOOKED_AT = 1000  # firings that tell a sensor's field of view
_FACING_DEG = 45.0  # rays of that field

# A grid around an object has about so many points, but not more rays; of all poses. Rays that are
# tried are so many in a row, and the field of view is so much wider than the object.
_POINTS = 100_000
_RAYS_MOST = 5_000_000
_TRIED = 64
_MARGIN = 1.02

# Larger scenes are not looked at, nor sheets such as terrains of more triangles than the second,
# and instances have no more: a tree takes 300 bytes and some microseconds a triangle.
_TRIANGLES_MOST = 2_000_000
_SHEETS_MOST = 200_000


@dataclass(frozen=True)
class Placing:
    """Poses of a sensor in a scene."""

    poses: tuple[Pose, ...]  # in world coordinates
    note: str = ""  # for users, on poses that they may not expect
    around: bool = False  # whether the poses are around an object
    grid: Mapping[str, Any] = field(default_factory=dict)  # of `Sensor.grid`, if narrowed to it


def place(
    scene: Scene,
    carried: Mounted,
    *,
    landscape: bool = False,
    buildings: Sequence[str] = (),
    narrow: bool = False,
) -> Placing:
    """Choose poses in a scene from mesh files; a landscape is not taken for an object.

    In a room or a landscape they are in the middle, or beside what stands there, such as a tree; 1,
    2 and 3 m above the floor or ground, or at a quarter, half and three quarters of the height of
    a lower room. Around an object they are on four sides and above it; a grid to `narrow` is
    narrowed to it. Objects whose names fit a pattern of `buildings` are not entered: poses are on
    ground beside the buildings, or around all of them.
    """
    low, high = scene.bounds + scene.origin
    middle = (low + high) / 2
    drawn = _simple(scene, middle - scene.origin)
    if landscape and not len(heights_at(drawn, middle[0], middle[1])):  # a hole
        ground = drawn.vertices[drawn.faces].mean(axis=1) + drawn.origin
        middle = ground[np.argmin(np.hypot(*(ground - middle)[:, :2].T))]
    standing = _standing(drawn, middle)
    looker = None if landscape else _looker(drawn)
    if buildings and len(heights_at(_named(drawn, buildings), middle[0], middle[1])):
        standing = _aside(drawn, middle, buildings)
        is_object = not standing
    else:
        is_object = looker is not None and looker.is_object(looker.views(_local(standing, scene)))
    if not is_object:
        if in_the_way(drawn, _local(standing, scene)):
            standing = _aside(drawn, middle, buildings) or standing
        return Placing(standing, _inside(looker, _local(standing, scene), scene, carried))
    poses = poses_around(scene, carried)
    far = np.linalg.norm(poses[-1].position - (low + high) / 2)
    *sides, away = (f"{float(f'{length:.3g}'):,g}" for length in (*(high - low), far))
    note = (
        f"this looks like an object of {' x '.join(sides)} m, not a place to stand in: "
        f"{plural(len(poses), 'pose')} around and above it, {away} m from its middle"
    )
    grid = _narrowed(drawn, looker, poses) if narrow and looker else {}
    if grid:
        width = grid["horizontal_fov_deg"]
        height = grid["vertical_fov_deg"]
        note += (
            f"; as no sensor is given, a grid of {grid['rays_per_revolution']:,} x "
            f"{grid['layers']:,} rays from each, over {width:g} x {height:g} degrees around it"
        )
    return Placing(poses, note, around=True, grid=grid)


def _narrowed(scene: Scene, looker: Surroundings, poses: Sequence[Pose]) -> dict[str, Any]:
    """Return what `Sensor.grid` takes to see an object from poses, with about `_POINTS` points."""
    placed = [*zip(_local(poses, scene), [pose.rotation_matrix for pose in poses], strict=True)]
    sides = np.zeros(2)  # the widest angles to either side, and up or down
    for at, turn in placed:
        x, y, z = ((scene.vertices - at) @ turn).T
        angles = np.abs([np.arctan2(y, x), np.arctan2(z, np.hypot(x, y))])
        sides = np.maximum(sides, angles.max(axis=1))
    width, height = np.clip(np.ceil(np.degrees(sides) * 20 * _MARGIN) / 10, 0.1, 179.0).tolist()
    tried = Sensor.grid(_TRIED, _TRIED, height, horizontal_fov_deg=width)
    rays = tried.directions(np.arange(_TRIED)).reshape(-1, 3)
    met = [looker.cast(np.tile(at, (len(rays), 1)), rays @ turn.T).distance for at, turn in placed]
    count = min(_POINTS / max(np.mean(np.isfinite(met)).item(), 1e-6), _RAYS_MOST)
    a_degree = (count / (len(poses) * width * height)) ** 0.5
    azimuths, layers = (int(side * a_degree / 10) * 10 for side in (width, height))
    return {
        "rays_per_revolution": max(40, azimuths),  # a time step has one at least
        "layers": max(10, layers),
        "vertical_fov_deg": height,
        "horizontal_fov_deg": width,
    }


def _standing(scene: Scene, at: Floats) -> tuple[Pose, ...]:
    """Poses above the floor at a place (3,), of which x and y count, in world coordinates."""
    x, y, _ = at.tolist()
    floor, ceiling = room_at(scene, x, y)
    heights = [*_HEIGHTS_M]
    if floor + heights[-1] > ceiling - _BELOW_M:
        heights = [(ceiling - floor) * share for share in (0.25, 0.5, 0.75)]
    return tuple(Pose((x, y, float(floor + height))) for height in heights)


def _named(scene: Scene, patterns: Sequence[str]) -> Scene:
    """Return the triangles of the objects whose names fit one of some patterns."""
    objects = np.concatenate([rows_named(pattern, scene.names) for pattern in patterns])
    selected = np.isin(scene.face_object, objects)
    return replace(scene, faces=scene.faces[selected], face_object=scene.face_object[selected])


def _aside(scene: Scene, middle: Floats, buildings: Sequence[str] = ()) -> tuple[Pose, ...]:
    """Return free poses beside the middle (3,) of a scene, world coordinates; perhaps none.

    In a scene with `buildings`, patterns of names, poses are outdoors: above some surface, and
    neither in a building nor on a building.
    """
    half = np.ptp(scene.bounds, axis=0) / 2
    reach = np.minimum(half, [max(_ASIDE_M) + 1.0] * 2 + [np.inf])
    local = middle - scene.origin
    near = triangles_reaching(scene, local - reach, local + reach)
    around = replace(scene, faces=scene.faces[near], face_object=scene.face_object[near])
    built = _named(around, buildings) if buildings else None
    for far in _ASIDE_M:
        for angle in np.arange(8) * np.pi / 4:
            step = far * np.array([np.cos(angle), np.sin(angle), 0.0])
            if (np.abs(step[:2]) < half[:2]).all():
                x, y, _ = middle + step
                if built and (len(heights_at(built, x, y)) or not len(heights_at(around, x, y))):
                    continue
                poses = _standing(around, middle + step)
                if not in_the_way(around, _local(poses, scene)):
                    return poses
    return ()


def _local(poses: Sequence[Pose], scene: Scene) -> Floats:
    """Positions in a scene's coordinates, (k, 3)."""
    return np.array([pose.position for pose in poses]) - scene.origin


def surroundings_of(scene: Scene, positions: ArrayLike) -> Surroundings | None:
    """Return what looks around from local positions (k, 3); None if the scene is too large."""
    return _looker(_simple(scene, positions))


def _inside(
    looker: Surroundings | None, positions: ArrayLike, scene: Scene, carried: Mounted
) -> str:
    if looker is None or not looker.views(positions).in_a_body:
        return ""
    return (
        "the sensor is inside a closed body, and hits only the backs of its surfaces; "
        f"{seen_from(scene, carried)}"
    )


def seen_from(scene: Scene, carried: Mounted) -> str:
    """Name two poses that see a scene from outside, as a scenario has them."""
    poses = [as_entry(pose) for pose in poses_around(scene, carried)[0:4:2]]
    return f"from outside it is seen by poses: {on_one_line(poses)}"


def on_one_line(value: Any) -> str:
    """Return a value as YAML."""
    text = yaml.safe_dump(value, default_flow_style=True, sort_keys=False, width=10_000)
    return text.removesuffix("\n").removesuffix("...").removesuffix("\n")


def as_entry(pose: Pose) -> list[float] | dict[str, object]:
    """Return a level or pitched pose as a scenario has it, in short if it has no angles."""
    if pose.rotation is None:
        return [*pose.position]
    return {"position": [*pose.position], "yaw_deg": pose.yaw_deg, "pitch_deg": pose.pitch_deg}


def poses_around(scene: Scene, carried: Mounted) -> tuple[Pose, ...]:
    """Poses on four sides of a scene and above it that look at its middle, world coordinates.

    They are at 1.5 times the diagonal from the middle, farther if the sensor's field of view is
    too narrow for the whole scene, nearer if that is out of its range.
    """
    low, high = scene.bounds + scene.origin
    middle = (low + high) / 2
    diagonal = float(np.linalg.norm(high - low))
    sensor, (down, up) = carried.sensor, _field_deg(carried)
    half = np.radians(max(up - down, 1e-3) / 2)
    far = max(diagonal * float(np.clip(0.5 / np.sin(half), *_FAR)), sensor.min_range_m + diagonal)
    far = min(far, max(0.9 * sensor.max_range_m, 0.6 * diagonal))  # outside, and in range
    digits = max(0, 3 - int(np.floor(np.log10(diagonal))))
    poses = []
    wide = high[0] - low[0] > high[1] - low[1]  # a turn sweeps the longer side, seen from above
    for azimuth, above in (*((a, _ABOVE_DEG) for a in _AZIMUTHS_DEG), (270 if wide else 180, 90.0)):
        angles = np.radians([azimuth, above])
        (ca, ce), (sa, se) = np.cos(angles), np.sin(angles)
        at = np.round(middle + far * np.array([ca * ce, sa * ce, se]), digits) + 0.0
        x, y, z = at.tolist()
        pitch = round(above + (down + up) / 2, 1)
        poses.append(Pose((x, y, z), (azimuth + 180.0) % 360.0, pitch))
    return tuple(poses)


def _field_deg(carried: Mounted) -> tuple[float, float]:
    """Lowest and highest elevation of the rays that go forward, in the carrier's axes."""
    sensor = carried.sensor
    count = min(sensor.period or _LOOKED_AT, _LOOKED_AT)
    firings = np.linspace(0, sensor.period or count, count, endpoint=False).astype(np.int64)
    rays: Floats = sensor.directions(firings).reshape(-1, 3) @ carried.mount.rotation_matrix.T
    facing = np.abs(np.degrees(np.arctan2(rays[:, 1], rays[:, 0]))) <= _FACING_DEG
    if not facing.any():
        return -90.0, -90.0  # an airborne scanner, which looks down
    elevations = np.degrees(np.arcsin(np.clip(rays[facing, 2], -1, 1)))
    return float(elevations.min()), float(elevations.max())


def _simple(scene: Scene, near: ArrayLike) -> Scene:
    """Copy instances to their places, with fewer triangles far from local positions (k, 3)."""
    return SimplifiedScene.from_scene(scene, _SHEETS_MOST, [np.reshape(near, (-1, 3))]).scene


def _looker(scene: Scene) -> Surroundings | None:
    """Return what looks around in a scene; None if that takes too long."""
    count = len(scene.faces)
    if count > _TRIANGLES_MOST or (count > _SHEETS_MOST and is_open(scene)):
        return None
    return Surroundings(scene)
