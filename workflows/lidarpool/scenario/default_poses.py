"""Default poses of a sensor in a scene: above the floor or ground, or around an object."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import yaml
from numpy.typing import ArrayLike

from lidarscenes.procedural.floor import floor_and_ceiling, surface_heights, triangles_in_box
from lidarscenes.procedural.surroundings import PlacementChecker, is_obstructed, is_open
from lidarsim.media.materials import match_names
from lidarsim.motion.trajectory import Pose
from lidarsim.numerics.arrays import Floats
from lidarsim.scene.scene import Scene
from lidarsim.scene.simplified import SimplifiedScene
from lidarsim.sensor import Sensor
from lidarsim.survey.survey import Mounted
from lidarsim.words import plural

# Heights above a floor; and the smallest distance from the ceiling.
_HEIGHTS_M = (1.0, 2.0, 3.0)
_BELOW_M = 0.2

# Distances from the middle, tried in this order if an object or a building is in the way there.
_ASIDE_M = (2.0, 4.0, 8.0, 16.0, 32.0, 64.0)

# Poses around an object: azimuths that show two sides of a box, elevation above its
# middle, and limits of the distance from its middle, in its diagonals.
_AZIMUTHS_DEG = (45, 135, 225, 315)
_ABOVE_DEG = 20.0
_DIAGONALS = (1.5, 3.0)
_MAX_FIRINGS = 1000  # firings that sample a sensor's field of view
_FACING_DEG = 45.0  # azimuth of the rays of that field, to either side

# Points of a grid around an object, and its largest number of rays, of all poses. A trial grid has
# rows of `_TRIAL_RAYS` rays; the field of view is `_MARGIN` times wider than the object.
_POINTS = 100_000
_MAX_RAYS = 5_000_000
_TRIAL_RAYS = 64
_MARGIN = 1.02

# Larger scenes are not examined, nor sheets such as terrains of more triangles than the second,
# and instances are simplified to it: a tree takes 300 bytes and some microseconds a triangle.
_MAX_TRIANGLES = 2_000_000
_MAX_SHEET_TRIANGLES = 200_000


@dataclass(frozen=True)
class Placing:
    """Poses of a sensor in a scene."""

    poses: tuple[Pose, ...]  # poses in world coordinates
    note: str = ""  # note for users, on poses that they may not expect
    surrounds_object: bool = False  # whether the poses are around an object
    grid: Mapping[str, Any] = field(default_factory=dict)  # arguments of `Sensor.grid`, if narrowed

    @property
    def entries(self) -> list[list[float] | dict[str, object]]:
        """Poses in the form of a scenario, rounded to millimeters unless they surround an object.

        Positions around an object are already rounded, with more digits if the object is small.
        """
        if self.surrounds_object:
            return [as_entry(pose) for pose in self.poses]
        x_y_z = [np.round(pose.position, 3).tolist() for pose in self.poses]
        return [as_entry(replace(p, position=at)) for p, at in zip(self.poses, x_y_z, strict=True)]

    @property
    def notes(self) -> list[str]:
        """The note, and a note that lists the poses, if there are any."""
        if not self.poses:
            return [self.note]
        return [
            self.note,
            f"no poses are set, so the default poses are {on_one_line(self.entries)}",
        ]


def place_sensor(
    scene: Scene,
    carried: Mounted,
    *,
    landscape: bool = False,
    buildings: Sequence[str] = (),
    roads: Sequence[str] = (),
    narrow: bool = False,
) -> Placing:
    """Choose poses in a scene from mesh files.

    A landscape is not taken for an object.

    In a room or a landscape the poses are in the middle, or beside an object in the middle such as
    a tree; 1, 2 and 3 m above the floor or ground, or at a quarter, half and three quarters of the
    height of a lower room. Around an object they are on four sides and above; with `narrow`, the
    sensor is a grid that is as wide as the object. Objects whose names fit a pattern of
    `buildings` are not entered: poses are on ground beside the buildings, or around all of them.
    If a landscape has a hole in the middle, poses are on the nearest object that fits a pattern of
    `roads`, or on the nearest ground.
    """
    lower_m, upper_m = scene.bounds + scene.origin
    middle = (lower_m + upper_m) / 2
    drawn = _draw_instances(scene, middle - scene.origin)
    if landscape and not len(surface_heights(drawn, middle[0], middle[1])):  # a hole
        ground_scene = _select_objects(drawn, roads) or drawn
        ground = ground_scene.vertices[ground_scene.faces].mean(axis=1) + drawn.origin
        middle = ground[np.argmin(np.hypot(*(ground - middle)[:, :2].T))]
    standing = _poses_above_floor(drawn, middle)
    surroundings = None if landscape else _surroundings(drawn)
    building_scene = _select_objects(drawn, buildings)
    if building_scene and len(surface_heights(building_scene, middle[0], middle[1])):
        standing = _poses_beside(drawn, middle, buildings)
        is_object = not standing
    else:
        is_object = surroundings is not None and surroundings.is_object(
            surroundings.cast_around(_local_positions(standing, scene))
        )
    if not is_object:
        if is_obstructed(drawn, _local_positions(standing, scene)):
            standing = _poses_beside(drawn, middle, buildings) or standing
        positions = _local_positions(standing, scene)
        return Placing(standing, _inside_note(surroundings, positions, scene, carried))
    poses = poses_around(scene, carried)
    grid = _narrow_grid(drawn, surroundings, poses) if narrow and surroundings else {}
    return Placing(poses, _object_note(scene, poses, grid), surrounds_object=True, grid=grid)


def _object_note(scene: Scene, poses: Sequence[Pose], grid: Mapping[str, Any]) -> str:
    """Return a note on poses around an object, and on the sensor's grid, if any."""
    lower_m, upper_m = scene.bounds + scene.origin
    distance_m = np.linalg.norm(poses[-1].position - (lower_m + upper_m) / 2)
    lengths_m = (*(upper_m - lower_m), distance_m)
    *sides, distance = (f"{float(f'{length:.3g}'):,g}" for length in lengths_m)
    note = (
        f"the scene was recognized as an object of {' x '.join(sides)} m, so the default is "
        f"{plural(len(poses), 'pose')} around and above it, {distance} m from its center"
    )
    if grid:
        width = grid["horizontal_fov_deg"]
        height = grid["vertical_fov_deg"]
        note += (
            f". The default sensor is a grid of {grid['rays_per_revolution']:,} x "
            f"{grid['layers']:,} rays that covers {width:g} x {height:g} degrees"
        )
    return note


def _narrow_grid(
    scene: Scene, surroundings: PlacementChecker, poses: Sequence[Pose]
) -> dict[str, Any]:
    """Return arguments of `Sensor.grid` for about `_POINTS` points on an object."""
    placed = [
        *zip(_local_positions(poses, scene), [pose.rotation_matrix for pose in poses], strict=True)
    ]
    sides = np.zeros(2)  # the largest angles to either side, and up or down, radians
    for position, rotation in placed:
        x, y, z = ((scene.vertices - position) @ rotation).T
        angles = np.abs([np.arctan2(y, x), np.arctan2(z, np.hypot(x, y))])
        sides = np.maximum(sides, angles.max(axis=1))
    width, height = np.clip(np.ceil(np.degrees(sides) * 20 * _MARGIN) / 10, 0.1, 179.0).tolist()
    trial = Sensor.grid(_TRIAL_RAYS, _TRIAL_RAYS, height, horizontal_fov_deg=width)
    rays = trial.directions(np.arange(_TRIAL_RAYS)).reshape(-1, 3)
    distances = [
        surroundings.cast(np.tile(position, (len(rays), 1)), rays @ rotation.T).distance
        for position, rotation in placed
    ]
    count = min(_POINTS / max(np.mean(np.isfinite(distances)).item(), 1e-6), _MAX_RAYS)
    rays_per_degree = (count / (len(poses) * width * height)) ** 0.5
    azimuths, layers = (int(side * rays_per_degree / 10) * 10 for side in (width, height))
    return {
        "rays_per_revolution": max(40, azimuths),  # at least one ray a time step
        "layers": max(10, layers),
        "vertical_fov_deg": height,
        "horizontal_fov_deg": width,
    }


def _poses_above_floor(scene: Scene, position: Floats) -> tuple[Pose, ...]:
    """Return poses above the floor at x and y of a position (3,), world coordinates."""
    x, y, _ = position.tolist()
    floor, ceiling = floor_and_ceiling(scene, x, y)
    heights = [*_HEIGHTS_M]
    if floor + heights[-1] > ceiling - _BELOW_M:
        heights = [(ceiling - floor) * share for share in (0.25, 0.5, 0.75)]
    return tuple(Pose((x, y, float(floor + height))) for height in heights)


def _select_objects(scene: Scene, patterns: Sequence[str]) -> Scene | None:
    """Return the triangles of the objects whose names fit a pattern, or None without any."""
    if not patterns:
        return None
    objects = np.concatenate([match_names(pattern, scene.names) for pattern in patterns])
    selected = np.isin(scene.face_object, objects)
    if not selected.any():
        return None
    return replace(scene, faces=scene.faces[selected], face_object=scene.face_object[selected])


def _poses_beside(scene: Scene, middle: Floats, buildings: Sequence[str] = ()) -> tuple[Pose, ...]:
    """Return free poses beside the middle (3,) of a scene, world coordinates, perhaps none.

    In a scene with `buildings`, patterns of names, poses are outdoors: above a surface, and
    neither in a building nor on a building.
    """
    half = np.ptp(scene.bounds, axis=0) / 2
    reach = np.minimum(half, [max(_ASIDE_M) + 1.0] * 2 + [np.inf])
    local = middle - scene.origin
    in_reach = triangles_in_box(scene, local - reach, local + reach)
    surroundings = replace(
        scene, faces=scene.faces[in_reach], face_object=scene.face_object[in_reach]
    )
    building_scene = _select_objects(surroundings, buildings)
    for distance_m in _ASIDE_M:
        for angle in np.arange(8) * np.pi / 4:
            step = distance_m * np.array([np.cos(angle), np.sin(angle), 0.0])
            if (np.abs(step[:2]) < half[:2]).all():
                x, y, _ = middle + step
                if building_scene and (
                    len(surface_heights(building_scene, x, y))
                    or not len(surface_heights(surroundings, x, y))
                ):
                    continue
                poses = _poses_above_floor(surroundings, middle + step)
                if not is_obstructed(surroundings, _local_positions(poses, scene)):
                    return poses
    return ()


def _local_positions(poses: Sequence[Pose], scene: Scene) -> Floats:
    """Return the positions of poses in a scene's local coordinates, (k, 3)."""
    return np.array([pose.position for pose in poses]) - scene.origin


def surroundings_of(scene: Scene, positions: ArrayLike) -> PlacementChecker | None:
    """Return the surroundings of local positions (k, 3), or None if the scene is too large."""
    return _surroundings(_draw_instances(scene, positions))


def _inside_note(
    surroundings: PlacementChecker | None, positions: ArrayLike, scene: Scene, carried: Mounted
) -> str:
    """Return a note if a local position (k, 3) lies inside a closed body, else an empty string."""
    if surroundings is None or not surroundings.cast_around(positions).is_inside_body:
        return ""
    return (
        "the sensor is inside a closed body. It hits only the back faces of surfaces. "
        f"{seen_from(scene, carried)}"
    )


def free_above(scene: Scene, surroundings: PlacementChecker, position: Floats) -> Floats | None:
    """Return the lowest free local position (3,) above a surface at x and y of a position, or None.

    It is as high above the surface as the second of the default poses.
    """
    x, y, _ = position + scene.origin
    for height in (
        np.sort(surface_heights(_draw_instances(scene, position), x, y)) - scene.origin[2]
    ):
        above = np.array([*position[:2], height + _HEIGHTS_M[1]])
        if surroundings.is_free(above):
            return above
    return None


def seen_from(scene: Scene, carried: Mounted) -> str:
    """Return a sentence, without its period, with two poses that see a scene from outside."""
    poses = [as_entry(pose) for pose in poses_around(scene, carried)[0:4:2]]
    return f"To view the scene from outside, use poses: {on_one_line(poses)}"


def on_one_line(value: Any) -> str:
    """Return a value as YAML."""
    text = yaml.safe_dump(value, default_flow_style=True, sort_keys=False, width=10_000)
    return text.removesuffix("\n").removesuffix("...").removesuffix("\n")


def as_entry(pose: Pose) -> list[float] | dict[str, object]:
    """Return a level or pitched pose in the form of a scenario, short if all angles are 0."""
    if pose.rotation is None:
        return [*pose.position]
    return {"position": [*pose.position], "yaw_deg": pose.yaw_deg, "pitch_deg": pose.pitch_deg}


def poses_around(scene: Scene, carried: Mounted) -> tuple[Pose, ...]:
    """Return poses on four sides of a scene and above, facing its middle, world coordinates.

    The poses are at 1.5 times the diagonal from the middle, farther if the sensor's field of view
    is too narrow for the scene, nearer if that is out of its range.
    """
    lower_m, upper_m = scene.bounds + scene.origin
    middle = (lower_m + upper_m) / 2
    extent_m = upper_m - lower_m
    diagonal_m = float(np.linalg.norm(extent_m))
    down_deg, up_deg = _field_deg(carried)
    distance_m = _viewing_distance_m(carried, diagonal_m, up_deg - down_deg)
    digits = max(0, 3 - int(np.floor(np.log10(diagonal_m))))
    # A revolution sweeps the longer side, seen from above.
    azimuth_above = 270 if extent_m[0] > extent_m[1] else 180
    poses = []
    for azimuth, above in (*((a, _ABOVE_DEG) for a in _AZIMUTHS_DEG), (azimuth_above, 90.0)):
        position = np.round(middle + distance_m * _direction(azimuth, above), digits) + 0.0
        pitch = round(above + (down_deg + up_deg) / 2, 1)
        poses.append(Pose(tuple(position.tolist()), (azimuth + 180.0) % 360.0, pitch))
    return tuple(poses)


def _direction(azimuth_deg: float, elevation_deg: float) -> Floats:
    """Return the unit vector (3,) of an azimuth and an elevation."""
    angles = np.radians([azimuth_deg, elevation_deg])
    cosines = np.cos(angles)
    sines = np.sin(angles)
    return np.array([cosines[0] * cosines[1], sines[0] * cosines[1], sines[1]])


def _viewing_distance_m(carried: Mounted, diagonal_m: float, field_deg: float) -> float:
    """Return the distance in meters where an object with a diagonal fills the view."""
    sensor = carried.sensor
    half = np.radians(max(field_deg, 1e-3) / 2)
    diagonals = float(np.clip(0.5 / np.sin(half), *_DIAGONALS))
    distance_m = max(diagonal_m * diagonals, sensor.min_range_m + diagonal_m)
    return min(distance_m, max(0.9 * sensor.max_range_m, 0.6 * diagonal_m))  # outside, in range


def _field_deg(carried: Mounted) -> tuple[float, float]:
    """Return the lowest and highest elevation of the forward rays, degrees in the carrier frame."""
    sensor = carried.sensor
    count = min(sensor.period or _MAX_FIRINGS, _MAX_FIRINGS)
    firings = np.linspace(0, sensor.period or count, count, endpoint=False).astype(np.int64)
    rays: Floats = sensor.directions(firings).reshape(-1, 3) @ carried.mount.rotation_matrix.T
    facing = np.abs(np.degrees(np.arctan2(rays[:, 1], rays[:, 0]))) <= _FACING_DEG
    if not facing.any():
        return -90.0, -90.0  # an airborne scanner, which looks down
    elevations = np.degrees(np.arcsin(np.clip(rays[facing, 2], -1, 1)))
    return float(elevations.min()), float(elevations.max())


def _draw_instances(scene: Scene, positions: ArrayLike) -> Scene:
    """Draw instances as meshes, with fewer triangles far from local positions (k, 3)."""
    return SimplifiedScene.from_scene(
        scene, _MAX_SHEET_TRIANGLES, [np.reshape(positions, (-1, 3))]
    ).scene


def _surroundings(scene: Scene) -> PlacementChecker | None:
    """Return the surroundings in a scene, or None if the scene has too many triangles."""
    count = len(scene.faces)
    if count > _MAX_TRIANGLES or (count > _MAX_SHEET_TRIANGLES and is_open(scene)):
        return None
    return PlacementChecker(scene)
