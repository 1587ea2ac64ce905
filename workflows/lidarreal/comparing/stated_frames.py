"""Coordinate systems and vertical datums that the two sides of a comparison state."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from lidarfiles.clouds.recording import PointCloud, Recording
from lidarsim.errors import LidarError
from lidarsim.scene.files.coordinate_systems import describe_heights, same_vertical_datum
from lidarsim.scene.files.stated_system import StatedSystem


@dataclass(frozen=True)
class StatedFrame:
    """The frame of a cloud, a mesh or a scene, as far as its file states it."""

    name: str  # of the file, for messages
    epsg: int | None = None  # code of the coordinate system
    system_name: str | None = None  # name of the coordinate system, None if it is not stated
    vertical_datum: str = ""  # name of the datum of heights, empty if it is not stated
    system: StatedSystem | None = None

    @classmethod
    def from_recording(cls, recording: Recording | PointCloud, name: str) -> StatedFrame:
        """Return the frame that a recording states."""
        system = recording.info.system
        if system is None:
            return cls.from_epsg(recording.info.epsg, name)
        system_name = f"EPSG:{system.epsg}" if system.epsg is not None else system.name
        return cls(name, system.epsg, system_name, system.vertical_datum, system)

    @classmethod
    def from_epsg(cls, epsg: int | None, name: str, vertical_datum: str = "") -> StatedFrame:
        """Return the frame with an EPSG code, which may contain a vertical datum."""
        if epsg is None:
            return cls(name, vertical_datum=vertical_datum)
        code = f"EPSG:{epsg}"
        return cls(name, epsg, code, vertical_datum or StatedSystem(code).vertical_datum)

    def is_same_system(self, other: StatedFrame) -> bool:
        """Return whether two frames state the same coordinate system."""
        if self.epsg is not None and other.epsg is not None:
            return self.epsg == other.epsg
        return self.system == other.system or self.system_name == other.system_name


def check_same_systems(frames: Sequence[StatedFrame]) -> list[str]:
    """Raise LidarError if frames state different coordinate systems or vertical datums.

    Returns notes about frames that do not state what others do.
    """
    first, *others = frames
    for other in others:
        if first.system_name and other.system_name and not first.is_same_system(other):
            raise LidarError(
                f"{first.name} has the coordinate system {first.system_name}, but {other.name} has "
                f"{other.system_name}. Transform one of them first, for example with "
                "filters.reprojection of PDAL."
            )
    stated = sorted({frame.system_name for frame in frames if frame.system_name})
    notes = _height_notes(frames)
    if stated:
        notes += [
            f"{frame.name} does not specify a coordinate system and is assumed to be in {stated[0]}"
            for frame in frames
            if frame.system_name is None
        ]
    return notes


def _height_notes(frames: Sequence[StatedFrame]) -> list[str]:
    """Return notes about frames that do not specify a vertical datum although others do.

    Raise LidarError if frames state different vertical datums.
    """
    stated = [frame for frame in frames if frame.vertical_datum]
    if not stated:
        return []
    first, *others = stated
    heights = describe_heights(first.vertical_datum)
    for other in others:
        if not same_vertical_datum(first.vertical_datum, other.vertical_datum):
            raise LidarError(
                f"{first.name} has {heights}, but {other.name} has "
                f"{describe_heights(other.vertical_datum)}. Transform one of them first, for "
                "example with filters.reprojection of PDAL and a geoid grid."
            )
    return [
        f"{frame.name} does not specify a vertical datum, and its heights are assumed to be "
        f"{heights}"
        for frame in frames
        if not frame.vertical_datum
    ]
