"""Scenario files: all of a survey as data, checked before anything runs."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field, PrivateAttr, Strict, ValidationError, model_validator

from ..base.errors import LidarpoolError
from ..base.words import did_you_mean
from ..plan import Planning
from ..scene.floor import floor_under
from ..scene.mesh import Mesh
from ..scene.meshfile import SUFFIXES, UNITLESS, load_meshes
from ..scene.scene import Scene
from ..scene.shapes import seed_objects
from ..sensor import Pose, Survey
from .sections import (
    CloudSection,
    Ground,
    MeshFile,
    PlanningSection,
    PoolSection,
    PoseEntry,
    SceneSection,
    Section,
    SensorSection,
    may_be_empty,
    scene_in_short,
)
from .validation_errors import validation_error
from .yamlfile import read_yaml

# Of the objects, those lower than this are floors and markings, which a path may cross.
FLAT_M = 0.2

# Halls and parts are smaller than the one and larger than the other in metres.
LARGE_M, SMALL_M = 500.0, 0.2

SEED_START = (25.0, 25.0)
SEED_TARGET = (-30.0, -20.0)
_HEIGHTS_M = (1.0, 2.0, 3.0)  # of the sensor, where no poses are given


class Scenario(Section):
    """A survey, and the path planned beside it, as a scenario file describes them.

    Without arguments it is the default survey: six objects, 108 scans from three poses.

    Parameters
    ----------
    scene, sensor, cloud, planning, pool
        See `lidarpool.scenario.sections`.
    poses
        Where the sensor scans from, in world coordinates. Where none are given it stands at
        the origin (default objects) or in the middle of the scene (mesh files), 1, 2 and 3
        metres above the ground or floor there; see `floor_under`.
    steps
        Time steps from each pose.

    Raises
    ------
    pydantic.ValidationError
        If a value is out of range; `load` and `from_data` raise LidarpoolError.
    """

    scene: Annotated[SceneSection, scene_in_short] = SceneSection()
    sensor: Annotated[SensorSection, may_be_empty(SensorSection)] = SensorSection()
    poses: Annotated[
        tuple[PoseEntry, ...] | None,
        Strict(False),
        Field(
            min_length=1,
            max_length=1_000_000,
            description="where the sensor stands, world metres, Z-up; by default 1, 2 and 3 m "
            "above the origin (default objects) or the middle of the floor (files)",
            examples=[[[0, 0, 1], [0, 0, 2], {"position": [0, 0, 3], "yaw_deg": 90}]],
        ),
    ] = None
    steps: Annotated[
        int, Field(ge=1, le=1_000_000, description="time steps (scans) from each pose")
    ] = 36
    cloud: Annotated[CloudSection, may_be_empty(CloudSection)] = CloudSection()
    planning: Annotated[PlanningSection, may_be_empty(PlanningSection)] = PlanningSection()
    pool: Annotated[PoolSection, may_be_empty(PoolSection)] = PoolSection()

    _folder: Path = PrivateAttr(default=Path())  # that relative file names start from
    _source: str = PrivateAttr(default="scenario")  # for messages
    _notes: list[str] = PrivateAttr(default_factory=list)  # of what was left out of the scene

    @model_validator(mode="after")
    def _both_ends(self) -> Scenario:
        missing = [self.planning.start, self.planning.target].count(None)
        if self.planning.enabled and not self.scene.has_seed and missing:
            raise ValueError("planning is enabled: give planning.start and planning.target.")
        if self.planning.enabled is None and not self.scene.has_seed and missing == 1:
            raise ValueError(
                "planning has one end: give both planning.start and planning.target, or neither."
            )
        return self

    @classmethod
    def load(cls, path: str | Path) -> Scenario:
        """Read a scenario file (YAML), or take a mesh file as a scenario of it alone.

        Raises
        ------
        LidarpoolError
            With the file, the field, what was given and what is allowed.
        """
        path = Path(path)
        if path.suffix.lower() in SUFFIXES:
            data = {"scene": {"files": [path.name]}}
            return cls.from_data(data, source=str(path), folder=path.parent)
        return cls.from_data(read_yaml(path), source=str(path), folder=path.parent)

    @classmethod
    def from_data(
        cls, data: dict[str, Any], *, source: str = "scenario", folder: str | Path = "."
    ) -> Scenario:
        """Check the content of a scenario file.

        Parameters
        ----------
        data
            Sections as YAML gives them.
        source
            Name for messages.
        folder
            Where relative file names start from.

        Raises
        ------
        LidarpoolError
            As `load`.
        """
        try:
            scenario = cls.model_validate(data)
        except ValidationError as error:
            raise LidarpoolError(validation_error(error, _field_names(), source)) from error
        scenario._folder, scenario._source = Path(folder), source
        with scenario._named():
            if scenario.sensor.calibration is None:  # files are read when they are needed
                scenario.sensor.sensor(scenario._folder)
        return scenario

    def advice(self, scene: Scene) -> list[str]:
        """Return notes on what looks like a mistake: a size that speaks of another unit.

        Also on objects that `build_scene` left out.
        """
        unitless = [
            entry.file
            for entry in self.scene.files
            if entry.unit is None and Path(entry.file).suffix.lower() in UNITLESS
        ]
        side = float(np.ptp(scene.bounds, axis=0).max())
        if not unitless or SMALL_M <= side <= LARGE_M:
            return list(self._notes)
        return [
            *self._notes,
            f"{unitless[0]} states no unit, and in metres the scene is {side:,.5g} m long: if that "
            f"is wrong, give the file's unit ({'mm' if side > LARGE_M else 'km'}?) in scene.files",
        ]

    def build_scene(self) -> Scene:
        """Read the mesh files and put the scene together.

        Raises
        ------
        LidarpoolError
            If a mesh file cannot be read.
        """
        self._notes.clear()
        meshes: list[Mesh] = list(seed_objects()) if self.scene.has_seed else []
        for entry in self.scene.files:
            meshes += self._read(entry)
        scene = Scene.from_meshes(meshes)
        if self.scene.ground is not None:
            scene = Scene.from_meshes([*meshes, _ground(self.scene.ground, scene)])
        return scene

    def survey(self, scene: Scene) -> Survey:
        """Return the survey, its poses in the local coordinates of `scene`.

        Raises
        ------
        LidarpoolError
            If fields that are good by themselves do not fit together.
        """
        x0, y0, z0 = scene.origin
        poses = [
            Pose((x - x0, y - y0, z - z0), yaw, pitch, roll)
            for (x, y, z), yaw, pitch, roll in self._world_poses(scene)
        ]
        with self._named():
            return Survey(
                sensor=self.sensor.sensor(self._folder),
                poses=poses,
                steps=self.steps,
                keep_every=self.cloud.keep_every,
                precision_m=self.cloud.precision_m,
                columns=self.cloud.columns,
            )

    def plan(self, scene: Scene) -> Planning | None:
        """Return what is to be planned, in the local coordinates of `scene`; None for nothing.

        Raises
        ------
        LidarpoolError
            If an obstacle names no object, or an end of the path lies within an obstacle.
        """
        section = self.planning
        ends = (section.start, section.target)
        if self.scene.has_seed:
            ends = (section.start or SEED_START, section.target or SEED_TARGET)
        start, target = ends
        if section.enabled is False or start is None or target is None:
            return None
        x0, y0, _ = scene.origin
        with self._named():
            discs, labels = self._discs(scene)
            discs[:, 2] += section.clearance_m
            wide = np.flatnonzero(discs[:, 2])  # upright lines, without area, bar nothing
            discs, labels = discs[wide], [labels[i] for i in wide]
            local = [(x - x0, y - y0) for x, y in (start, target)]
            _check_free({"start": local[0], "target": local[1]}, discs, labels)
            return Planning(
                start=local[0],
                target=local[1],
                centres=discs[:, :2],
                radii=discs[:, 2],
                trials=section.trials,
                particles=section.particles,
                iterations=section.iterations,
                waypoints=section.waypoints,
                seed=section.seed,
            )

    def _read(self, entry: MeshFile) -> tuple[Mesh, ...]:
        with self._named():
            try:
                path = self._folder / Path(entry.file).expanduser()
            except RuntimeError as error:  # of a user who is not known
                raise LidarpoolError(f"the file {entry.file!r} has no place: {error}") from error
            transform = entry.transform()
        return load_meshes(
            path,
            unit=entry.unit,
            up_axis=entry.up_axis,
            transform=transform,
            tell=self._notes.append,
        )

    def _world_poses(
        self, scene: Scene
    ) -> Iterator[tuple[tuple[float, float, float], float, float, float]]:
        """Position and angles of each pose, in world coordinates."""
        if self.poses is not None:
            for pose in self.poses:
                yield pose.position, pose.yaw_deg, pose.pitch_deg, pose.roll_deg
            return
        x, y, floor = 0.0, 0.0, 0.0
        if not self.scene.has_seed:
            low, high = scene.bounds + scene.origin
            x, y = (low[:2] + high[:2]) / 2
            floor = floor_under(scene, x, y)
        for height in _HEIGHTS_M:
            yield (float(x), float(y), float(floor + height)), 0.0, 0.0, 0.0

    def _discs(self, scene: Scene) -> tuple[np.ndarray[Any, np.dtype[np.float64]], list[str]]:
        """Obstacles as local x, y, radius of (m, 3), and what each stands for."""
        tall = np.ptp(scene.object_bounds[..., 2], axis=1) >= FLAT_M
        if self.planning.obstacles is None:
            picked = [i for i in range(len(scene.names)) if tall[i]]
            return scene.footprints[picked], [scene.names[i] for i in picked]
        rows: dict[str, list[float]] = {}  # {what it stands for: x, y, radius}
        for number, entry in enumerate(self.planning.obstacles):
            if entry.object is None:
                assert entry.centre and entry.radius_m, "either of the two kinds is given"
                place = np.subtract(entry.centre, scene.origin[:2])
                rows[f"planning.obstacles[{number}]"] = [*place, entry.radius_m]
                continue
            # Brackets and all, a name is that object; else it is a pattern.
            found = [i for i, name in enumerate(scene.names) if name == entry.object] or [
                i for i, name in enumerate(scene.names) if fnmatchcase(name, entry.object)
            ]
            if not found:
                hint = did_you_mean(entry.object, scene.names)
                raise LidarpoolError(
                    f"planning.obstacles names {entry.object!r}, and no object is called so."
                    + (hint or f" The scene has {', '.join(scene.names[:5])}, …")
                )
            rows |= {scene.names[i]: list(scene.footprints[i]) for i in found}
        return np.array(list(rows.values()), dtype=np.float64).reshape(-1, 3), list(rows)

    @contextmanager
    def _named(self) -> Iterator[None]:
        """Name the scenario's file in errors."""
        try:
            yield
        except LidarpoolError as error:
            raise LidarpoolError(f"{self._source}: {error}") from error


def _field_names() -> set[str]:
    """Names of the fields of all sections."""
    return {name for section in Section.__subclasses__() for name in section.model_fields}


def _ground(section: Ground, scene: Scene) -> Mesh:
    """Return two triangles under everything."""
    (x0, y0, _), (x1, y1, _) = scene.bounds + scene.origin
    x0, y0, x1, y1 = np.array([x0, y0, x1, y1]) + section.margin_m * np.array([-1, -1, 1, 1])
    z = section.height_m
    corners = np.array([[x0, y0, z], [x1, y0, z], [x1, y1, z], [x0, y1, z]])
    return Mesh("Ground", corners, np.array([[0, 1, 2], [0, 2, 3]]))


def _check_free(
    ends: dict[str, tuple[float, float]],
    discs: np.ndarray[Any, np.dtype[np.float64]],
    labels: list[str],
) -> None:
    """Refuse a path that begins or ends in an obstacle, naming what is there."""
    for end, point in ends.items():
        inside = np.hypot(*(discs[:, :2] - point).T) < discs[:, 2]
        if inside.any():
            first = int(inside.argmax())
            raise LidarpoolError(
                f"planning.{end} lies {discs[first, 2]:.2f} m or less from the middle of "
                f"{labels[first]}, within its circle: move it, or list other planning.obstacles."
            )
