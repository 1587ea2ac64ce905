"""Options of export formats, as values."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, Literal

from lidarsim.schema.declared import FileSection, about

from .built_in_formats import EXPORTS, FORMATS, LAYOUTS

_FILES = ", ".join(f"{name} ({FORMATS[name].file})" for name in EXPORTS)
_NAMES: dict[str, Any] = {"anyOf": [{"enum": [*FORMATS]}, {"type": "string"}]}  # schema for editors


@dataclass(frozen=True)
class FormatOptions(FileSection):
    """Name of an export format, and its options."""

    format: Annotated[
        str,
        about(
            f"format, with the name of its file or folder in parentheses: {_FILES}, or a format "
            "of a plug-in",
            json_schema_extra=_NAMES,
        ),
    ]
    layout: Annotated[
        Literal[tuple(LAYOUTS)],  # type: ignore[valid-type]
        about("point layout in mcap and rosbag2"),
    ] = "velodyne"
    compensated: Annotated[
        bool,
        about(
            "whether points in mcap, rosbag2 and pcd are motion-compensated to the start of the "
            "sweep and have no times; otherwise, each point is in the sensor frame at the time of "
            "its firing, as published by drivers"
        ),
    ] = False
    compensated_actors: Annotated[
        bool,
        about(
            "whether points of actors are moved to the pose of the actor at the start of the "
            "sweep, so that they are inside its box; otherwise, they are at the pose at the time "
            "of their firing (formats of single sweeps only)"
        ),
    ] = False
    pose_rate_hz: Annotated[
        float | None,
        about(
            "poses per second on /tf in mcap and rosbag2 (default: one pose at the start of "
            "each sweep)",
            gt=0,
            le=10_000,
        ),
    ] = None
    organized: Annotated[
        bool,
        about(
            "whether clouds in mcap and rosbag2 contain one point per ray, with NaN for rays "
            "without a return, in the row order of the driver (layouts velodyne, ouster, images "
            "and robosense only)"
        ),
    ] = False
    intensity_full_scale: Annotated[
        float | None,
        about(
            "intensity that las and laz store as 65,535 (default: chosen from the cloud, so "
            "that at most 1 % of the points reach it)",
            gt=0,
            le=1e9,
        ),
    ] = None
