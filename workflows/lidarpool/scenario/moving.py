"""Sections of a scenario about what moves: trajectories, and where sensors sit on their carrier."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, Strict, model_validator

from ..base.errors import LidarpoolError
from ..sensor import Mounted, Pose, Track, load_trajectory
from ..sensor.survey import STEPS_MOST
from ..sensor.trajectory_files import FORMATS, quaternions_from_degrees
from .sections import (
    Angle,
    MeshEntry,
    PoseSection,
    Section,
    SensorSection,
    Text,
    Triple,
    _is_text,
    _short,
)

Seconds = Annotated[float, Field(ge=-1e11, le=1e11)]
Duration = Annotated[float, Field(gt=0, le=1e9)]


class MountSection(Section):
    """Where a sensor sits on its carrier, and how it is turned, in the carrier's axes."""

    position: Annotated[Triple, Field(description="x, y and z, metres")] = (0, 0, 0)
    yaw_deg: Annotated[Angle, Field(description="turned about z, first")] = 0.0
    pitch_deg: Annotated[Angle, Field(description="turned about the new y, then")] = 0.0
    roll_deg: Annotated[Angle, Field(description="turned about the new x, last")] = 0.0

    def pose(self) -> Pose:
        """Return it as a pose."""
        return Pose(self.position, self.yaw_deg, self.pitch_deg, self.roll_deg)


class CarriedSection(SensorSection):
    """One of several sensors, where it sits, and when it scans."""

    mount: MountSection = MountSection()
    start_s: Annotated[
        float,
        Field(ge=0, le=1e9, description="when it starts, seconds after the survey, or its station"),
    ] = 0.0
    steps: Annotated[
        Annotated[int, Field(ge=1, le=STEPS_MOST)] | None,
        Field(description="its time steps (scans), in place of the survey's", examples=[120]),
    ] = None

    def mounted(self, folder: Path, name: str) -> Mounted:
        """Return it on its carrier; LidarpoolError if its files cannot be used."""
        sensor = replace(self.sensor(folder), start_ns=self.start_s * 1e9)
        return Mounted(sensor, self.mount.pose(), name, self.steps)


class TimedPose(PoseSection):
    """A pose at a time; a carrier faces its way if no point of a trajectory has an angle."""

    time_s: Annotated[Seconds, Field(description="seconds, by the trajectory's clock")]


class TrajectorySection(Section):
    """A way through time: from a file, or from points; in YAML the file's name alone will do."""

    file: Annotated[
        Text | None,
        Field(description="TUM, KITTI or .csv, from the scenario's folder", examples=["drive.tum"]),
    ] = None
    format: Annotated[
        Literal[FORMATS] | None,  # type: ignore[valid-type]
        Field(description="by default kitti with times, csv for a .csv, else tum"),
    ] = None
    times: Annotated[Text | None, Field(description="of KITTI's poses: the file of times")] = None
    columns: Annotated[
        dict[str, str] | None,
        Field(
            description="of a table: {time_s, x, y, z, qx, …, yaw_deg, …: name in the file}",
            examples=[{"time_s": "stamp"}],
        ),
    ] = None
    camera_axes: Annotated[
        bool | None, Field(description="poses are a camera's, z ahead; by default KITTI's are")
    ] = None
    points: Annotated[
        tuple[TimedPose, ...],
        Strict(False),
        Field(description="in place of a file: time_s, position and angles, world metres"),
    ] = ()
    interpolation: Annotated[
        Literal["linear", "smooth"], Field(description="of positions; rotations turn evenly")
    ] = "linear"
    offset_s: Annotated[Seconds, Field(description="added to all times")] = 0.0
    start_s: Annotated[
        Seconds | None, Field(description="when the survey begins; by default at the first time")
    ] = None
    duration_s: Annotated[
        Duration | None, Field(description="how long it lasts; by default to the end")
    ] = None

    @model_validator(mode="after")
    def _one_source(self) -> TrajectorySection:
        if (self.file is None) != bool(self.points):
            raise ValueError("give either file or points.")
        return self

    def track(
        self, folder: Path, origin: NDArray[np.float64], start_s: float | None = None
    ) -> Track:
        """Return it in a scene's local coordinates; LidarpoolError if it cannot be used.

        `start_s` is that of a survey, of whose clock it is.
        """
        start_s = self.start_s if start_s is None else start_s
        smooth = self.interpolation == "smooth"
        if self.file is not None:
            track = load_trajectory(
                folder / Path(self.file).expanduser(),
                format=self.format,
                times=None if self.times is None else folder / Path(self.times).expanduser(),
                columns=self.columns,
                camera_axes=self.camera_axes,
                offset_s=self.offset_s,
                smooth=smooth,
                start_s=start_s,
                duration_s=self.duration_s,
            )
            return replace(track, positions=track.positions - origin)
        angles = [[p.yaw_deg, p.pitch_deg, p.roll_deg] for p in self.points]
        turned = any({"yaw_deg", "pitch_deg", "roll_deg"} & p.model_fields_set for p in self.points)
        return Track(
            np.array([p.time_s + self.offset_s for p in self.points]),
            np.array([p.position for p in self.points]) - origin,
            quaternions_from_degrees(np.array(angles)) if turned else None,
            smooth,
            start_s,
            self.duration_s,
        )


TrajectoryEntry = Annotated[
    TrajectorySection,
    _short(_is_text, lambda v: {"file": v}, Text | TrajectorySection),
]
Length = Annotated[float, Field(gt=0, le=1e4)]


class ActorSection(Section):
    """Something that moves while the scene stands; its axes have x ahead and z up."""

    name: Annotated[Text, Field(description="of the object")]
    file: Annotated[
        MeshEntry | None,
        Field(description="its mesh in its own axes, as in scene.files", examples=["car.glb"]),
    ] = None
    box: Annotated[
        Annotated[tuple[Length, Length, Length], Strict(False)] | None,
        Field(description="in place of a file: length, width and height of a box, metres"),
    ] = None
    trajectory: Annotated[
        TrajectoryEntry, Field(description="its way, by the clock of the survey's trajectory")
    ]
    semantic_class: Annotated[
        Annotated[int, Field(ge=0, le=65_535)] | None,
        Field(alias="class", description="of its points; by default that of its material"),
    ] = None

    @model_validator(mode="after")
    def _one_shape(self) -> ActorSection:
        if (self.file is None) == (self.box is None):
            raise ValueError("give either file or box.")
        if self.trajectory.start_s is not None or self.trajectory.duration_s is not None:
            raise ValueError("an actor begins with the survey: give offset_s, not start_s.")
        return self

    def way(self, folder: Path, origin: NDArray[np.float64], start_s: float) -> Track:
        """Return its trajectory from the survey's start on."""
        try:
            return self.trajectory.track(folder, origin, start_s)
        except LidarpoolError as error:
            raise LidarpoolError(f"actor {self.name!r}: {error}") from error
