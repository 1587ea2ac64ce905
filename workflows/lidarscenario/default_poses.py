"""Default poses of a sensor, which are above the floor or ground, or around an object."""

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

_HEIGHTS_M = (1.0, 2.0, 3.0)  # above the floor
_CEILING_CLEARANCE_M = 0.2  # minimum distance from the ceiling

# Distances from the center, which are tried in this order if the center is occupied.
_OFFSETS_M = (2.0, 4.0, 8.0, 16.0, 32.0, 64.0)

# Poses around an object. From these azimuths, two sides of a box are visible. The elevation is seen
# from the center of the object, and the distance from it is limited in units of its diagonal.
_AZIMUTHS_DEG = (45, 135, 225, 315)
_ELEVATION_DEG = 20.0
_DIAGONALS = (1.5, 3.0)
_MAX_FIRINGS = 1000  # number of firings that sample the field of view of a sensor
_FORWARD_DEG = 45.0  # maximum azimuth of forward rays on either side

# Desired number of points on an object, and maximum number of rays from all poses. The hit rate is
# measured with a trial grid of `_TRIAL_RAYS` x `_TRIAL_RAYS` rays. The field of view is `_MARGIN`
# times wider than the object.
_POINTS = 100_000
_MAX_RAYS = 5_000_000
_TRIAL_RAYS = 64
_MARGIN = 1.02

# Scenes with more triangles are not examined. Open surfaces, such as terrain, have a lower limit,
# to which instances are also simplified. A search tree takes 300 bytes and a few microseconds per
# triangle.
_MAX_TRIANGLES = 2_000_000
_MAX_SHEET_TRIANGLES = 200_000


@dataclass(frozen=True)
class SensorPlacement:
    """Default poses of a sensor in a scene."""

    poses: tuple[Pose, ...]  # in world coordinates
    note: str = ""  # note for the user about unexpected poses
    surrounds_object: bool = False  # whether the poses are around an object
    # Arguments of `Sensor.grid` if the sensor is a grid that is as wide as the object.
    grid: Mapping[str, Any] = field(default_factory=dict)

    @property
    def entries(self) -> list[list[float] | dict[str, object]]:
        """Poses as entries of a scenario, rounded to millimeters.

        Poses around an object are not rounded here, because they have been rounded depending on the
        size of the object.
        """
        if self.surrounds_object:
            return [pose_entry(pose) for pose in self.poses]
        x_y_z = [np.round(pose.position, 3).tolist() for pose in self.poses]
        return [
            pose_entry(replace(p, position=at)) for p, at in zip(self.poses, x_y_z, strict=True)
        ]

    @property
    def notes(self) -> list[str]:
        """Notes for the user about the default poses, including the poses themselves."""
        if not self.poses:
            return [self.note]
        return [
            self.note,
            f"no poses are set, so the default poses are {as_yaml_line(self.entries)}",
        ]


def place_sensor(
    scene: Scene,
    mounted: Mounted,
    *,
    landscape: bool = False,
    buildings: Sequence[str] = (),
    roads: Sequence[str] = (),
    narrow: bool = False,
) -> SensorPlacement:
    """Choose the poses of a sensor in a scene that was read from mesh files.

    In a room or landscape, the poses are at the center, or beside an object at the center, such as
    a tree. They are 1, 2 and 3 m above the floor or ground. If the room is too low, they are at a
    quarter, half and three quarters of its height. If the scene is a single object, the poses are
    on four sides of the object and above it.

    Parameters
    ----------
    scene
        Scene of the survey.
    mounted
        The sensor with its mount.
    landscape
        Whether the scene is a landscape, which is never treated as a single object. If it has a
        hole at the center, the poses are on the nearest road, or else on the nearest ground.
    buildings
        Name patterns of buildings. The poses are not inside buildings, but on the ground beside
        them, or around all of them.
    roads
        Name patterns of road surfaces.
    narrow
        Whether to replace the sensor by a grid that is as wide as the object.
    """
    lower_m, upper_m = scene.bounds + scene.origin
    center = (lower_m + upper_m) / 2
    drawn = _instances_to_meshes(scene, center - scene.origin)
    if landscape and not len(surface_heights(drawn, center[0], center[1])):  # there is a hole
        ground_scene = _select_objects(drawn, roads) or drawn
        ground = ground_scene.vertices[ground_scene.faces].mean(axis=1) + drawn.origin
        center = ground[np.argmin(np.hypot(*(ground - center)[:, :2].T))]
    floor_poses = _poses_above_floor(drawn, center)
    surroundings = None if landscape else _build_placement_checker(drawn)
    building_scene = _select_objects(drawn, buildings)
    if building_scene and len(surface_heights(building_scene, center[0], center[1])):
        floor_poses = _poses_beside(drawn, center, buildings)
        is_object = not floor_poses
    else:
        is_object = surroundings is not None and surroundings.is_object(
            surroundings.cast_around(_local_positions(floor_poses, scene))
        )
    if not is_object:
        if is_obstructed(drawn, _local_positions(floor_poses, scene)):
            floor_poses = _poses_beside(drawn, center, buildings) or floor_poses
        positions = _local_positions(floor_poses, scene)
        return SensorPlacement(floor_poses, _inside_note(surroundings, positions, scene, mounted))
    poses = poses_around(scene, mounted)
    grid = _narrow_grid(drawn, surroundings, poses) if narrow and surroundings else {}
    return SensorPlacement(
        poses, _object_note(scene, poses, grid), surrounds_object=True, grid=grid
    )


def _object_note(scene: Scene, poses: Sequence[Pose], grid: Mapping[str, Any]) -> str:
    """Return a note about the default poses around an object.

    If the default sensor is a grid, the note also describes the grid.
    """
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
    """Return arguments of `Sensor.grid` such that about `_POINTS` points are on an object."""
    placed = [
        *zip(_local_positions(poses, scene), [pose.rotation_matrix for pose in poses], strict=True)
    ]
    sides = np.zeros(2)  # maximum horizontal and vertical angle from the forward axis, in radians
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
        "rays_per_revolution": max(40, azimuths),  # at least one ray per time step
        "layers": max(10, layers),
        "vertical_fov_deg": height,
        "horizontal_fov_deg": width,
    }


def _poses_above_floor(scene: Scene, position: Floats) -> tuple[Pose, ...]:
    """Return poses above the floor at a horizontal position.

    The position and the poses are in world coordinates.
    """
    x, y, _ = position.tolist()
    floor, ceiling = floor_and_ceiling(scene, x, y)
    heights = [*_HEIGHTS_M]
    if floor + heights[-1] > ceiling - _CEILING_CLEARANCE_M:
        heights = [(ceiling - floor) * fraction for fraction in (0.25, 0.5, 0.75)]
    return tuple(Pose((x, y, float(floor + height))) for height in heights)


def _select_objects(scene: Scene, patterns: Sequence[str]) -> Scene | None:
    """Return a scene that contains only the objects whose names match a pattern.

    Return None if there are no such objects.
    """
    if not patterns:
        return None
    objects = np.concatenate([match_names(pattern, scene.names) for pattern in patterns])
    selected = np.isin(scene.face_object, objects)
    if not selected.any():
        return None
    return replace(scene, faces=scene.faces[selected], face_object=scene.face_object[selected])


def _poses_beside(scene: Scene, center: Floats, buildings: Sequence[str] = ()) -> tuple[Pose, ...]:
    """Return unobstructed poses near the center of a scene, or an empty tuple.

    The center, which has shape (3,), and the poses are in world coordinates. If objects match the
    name patterns in `buildings`, the poses are outdoors, which means above a surface and neither
    inside nor on top of a building.
    """
    half = np.ptp(scene.bounds, axis=0) / 2
    reach = np.minimum(half, [max(_OFFSETS_M) + 1.0] * 2 + [np.inf])
    local = center - scene.origin
    in_reach = triangles_in_box(scene, local - reach, local + reach)
    surroundings = replace(
        scene, faces=scene.faces[in_reach], face_object=scene.face_object[in_reach]
    )
    building_scene = _select_objects(surroundings, buildings)
    for distance_m in _OFFSETS_M:
        for angle in np.arange(8) * np.pi / 4:
            step = distance_m * np.array([np.cos(angle), np.sin(angle), 0.0])
            if (np.abs(step[:2]) < half[:2]).all():
                x, y, _ = center + step
                if building_scene and (
                    len(surface_heights(building_scene, x, y))
                    or not len(surface_heights(surroundings, x, y))
                ):
                    continue
                poses = _poses_above_floor(surroundings, center + step)
                if not is_obstructed(surroundings, _local_positions(poses, scene)):
                    return poses
    return ()


def _local_positions(poses: Sequence[Pose], scene: Scene) -> Floats:
    return np.array([pose.position for pose in poses]) - scene.origin


def build_placement_checker(scene: Scene, positions: ArrayLike) -> PlacementChecker | None:
    """Return a checker for sensor positions, or None if the scene has too many triangles.

    `positions` has shape (k, 3) and is in local coordinates.
    """
    return _build_placement_checker(_instances_to_meshes(scene, positions))


def _inside_note(
    surroundings: PlacementChecker | None, positions: ArrayLike, scene: Scene, mounted: Mounted
) -> str:
    """Return a note if a position is inside a closed body, or an empty string otherwise.

    `positions` has shape (k, 3) and is in local coordinates.
    """
    if surroundings is None or not surroundings.cast_around(positions).is_inside_body:
        return ""
    return (
        "the sensor is inside a closed body. It hits only the back faces of surfaces. "
        f"{outside_view_hint(scene, mounted)}"
    )


def find_free_position_above(
    scene: Scene, surroundings: PlacementChecker, position: Floats
) -> Floats | None:
    """Return the lowest free position above a surface at a horizontal position.

    The result is as high above the surface as the second default pose. Return None if there is no
    free position. Positions have shape (3,) and are in local coordinates.
    """
    x, y, _ = position + scene.origin
    drawn = _instances_to_meshes(scene, position)
    for height in np.sort(surface_heights(drawn, x, y)) - scene.origin[2]:
        above = np.array([*position[:2], height + _HEIGHTS_M[1]])
        if surroundings.is_free(above):
            return above
    return None


def outside_view_hint(scene: Scene, mounted: Mounted) -> str:
    """Return a sentence, without its period, that suggests two poses outside a scene."""
    poses = [pose_entry(pose) for pose in poses_around(scene, mounted)[0:4:2]]
    return f"To view the scene from outside, use poses: {as_yaml_line(poses)}"


def as_yaml_line(value: Any) -> str:
    """Format a value as YAML on a single line."""
    text = yaml.safe_dump(value, default_flow_style=True, sort_keys=False, width=10_000)
    return text.removesuffix("\n").removesuffix("...").removesuffix("\n")


def pose_entry(pose: Pose) -> list[float] | dict[str, object]:
    """Convert a pose without roll to an entry of a scenario.

    If all angles are 0, the entry is the position alone.
    """
    if pose.rotation is None:
        return [*pose.position]
    return {"position": [*pose.position], "yaw_deg": pose.yaw_deg, "pitch_deg": pose.pitch_deg}


def poses_around(scene: Scene, mounted: Mounted) -> tuple[Pose, ...]:
    """Return poses on four sides of a scene and above it, facing the center of the scene.

    The distance from the center is 1.5 times the diagonal of the scene. The poses are farther away
    if the field of view of the sensor is too narrow for the scene, and closer if they would be out
    of its range. The poses are in world coordinates.
    """
    lower_m, upper_m = scene.bounds + scene.origin
    center = (lower_m + upper_m) / 2
    extent_m = upper_m - lower_m
    diagonal_m = float(np.linalg.norm(extent_m))
    down_deg, up_deg = _forward_elevations_deg(mounted)
    distance_m = _viewing_distance_m(mounted, diagonal_m, up_deg - down_deg)
    digits = max(0, 3 - int(np.floor(np.log10(diagonal_m))))
    # From above, the azimuth of the sensor runs along the longer side of the scene.
    azimuth_above = 270 if extent_m[0] > extent_m[1] else 180
    poses = []
    for azimuth, above in (*((a, _ELEVATION_DEG) for a in _AZIMUTHS_DEG), (azimuth_above, 90.0)):
        position = np.round(center + distance_m * _direction(azimuth, above), digits) + 0.0
        pitch = round(above + (down_deg + up_deg) / 2, 1)
        poses.append(Pose(tuple(position.tolist()), (azimuth + 180.0) % 360.0, pitch))
    return tuple(poses)


def _direction(azimuth_deg: float, elevation_deg: float) -> Floats:
    """Return the unit vector with the given azimuth and elevation.

    The array has shape (3,).
    """
    angles = np.radians([azimuth_deg, elevation_deg])
    cosines = np.cos(angles)
    sines = np.sin(angles)
    return np.array([cosines[0] * cosines[1], sines[0] * cosines[1], sines[1]])


def _viewing_distance_m(mounted: Mounted, diagonal_m: float, field_deg: float) -> float:
    """Return the distance at which an object of the given diagonal fills the field of view."""
    sensor = mounted.sensor
    half = np.radians(max(field_deg, 1e-3) / 2)
    diagonals = float(np.clip(0.5 / np.sin(half), *_DIAGONALS))
    distance_m = max(diagonal_m * diagonals, sensor.min_range_m + diagonal_m)
    return min(distance_m, max(0.9 * sensor.max_range_m, 0.6 * diagonal_m))  # outside and in range


def _forward_elevations_deg(mounted: Mounted) -> tuple[float, float]:
    """Return the elevation limits of rays that point forward in the platform frame."""
    sensor = mounted.sensor
    count = min(sensor.period or _MAX_FIRINGS, _MAX_FIRINGS)
    firings = np.linspace(0, sensor.period or count, count, endpoint=False).astype(np.int64)
    rays: Floats = sensor.directions(firings).reshape(-1, 3) @ mounted.mount.rotation_matrix.T
    facing = np.abs(np.degrees(np.arctan2(rays[:, 1], rays[:, 0]))) <= _FORWARD_DEG
    if not facing.any():
        return -90.0, -90.0  # airborne scanners look down
    elevations = np.degrees(np.arcsin(np.clip(rays[facing, 2], -1, 1)))
    return float(elevations.min()), float(elevations.max())


def _instances_to_meshes(scene: Scene, positions: ArrayLike) -> Scene:
    """Replace the instances of a scene with meshes, simplifying those far from `positions`.

    `positions` has shape (k, 3) and is in local coordinates.
    """
    return SimplifiedScene.from_scene(
        scene, _MAX_SHEET_TRIANGLES, [np.reshape(positions, (-1, 3))]
    ).scene


def _build_placement_checker(scene: Scene) -> PlacementChecker | None:
    """Return a checker for sensor positions, or None if the scene has too many triangles."""
    count = len(scene.faces)
    if count > _MAX_TRIANGLES or (count > _MAX_SHEET_TRIANGLES and is_open(scene)):
        return None
    return PlacementChecker(scene)
