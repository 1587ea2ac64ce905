"""Create the node that follows a simulator, given the files of its world and its sensors."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from lidarfiles.clouds.frame_names import frame_names
from lidarfiles.clouds.writing import ExportSpec
from lidarscenario.sensors_file import SensorOnFrame, SensorsFile
from lidarsim.errors import LidarError

from .followed_sensor import FollowedSensor
from .node import FollowNode, FollowOptions, MessageSink, MessageSource
from .world_files import FollowedWorld, ModelFolder, load_followed_world


class FollowSources(NamedTuple):
    """Files of a world and its sensors, and the layout of the messages."""

    world: Path
    sensors: Path | None  # None for the sensors of a scenario
    models: Path | None = None  # folder of the models that can be spawned
    assets: Path | None = None  # additional folder with files of the world
    layout: str = "velodyne"
    organized: bool = False


def create_node(
    sources: FollowSources,
    connections: tuple[MessageSink, MessageSource],
    options: FollowOptions,
    note: Callable[[str], None],
) -> FollowNode:
    """Read the files, and return the node.

    Parameters
    ----------
    sources
        Files and layout.
    connections
        Connections through which messages are published and received.
    options
        Options of the node.
    note
        Function that shows a notice.

    Raises
    ------
    LidarError
        If a file cannot be read.
    """
    followed = load_followed_world(sources.world, sources.assets, note)
    models = ModelFolder(sources.models, note)
    spec = ExportSpec("mcap", sources.layout, organized=sources.organized)
    sensors = _open_sensors(sources, followed, spec, note)
    return FollowNode(followed, models, sensors, *connections, note, options)


def _open_sensors(
    sources: FollowSources,
    followed: FollowedWorld,
    spec: ExportSpec,
    note: Callable[[str], None],
) -> list[FollowedSensor]:
    """Return the sensors of the sensor file or of the scenario."""
    if sources.sensors is not None:
        file = SensorsFile.load(sources.sensors)
    elif followed.sensors is not None:
        file = followed.sensors
        if file.unused:
            note(
                f"{sources.world}: These fields are not used: {', '.join(file.unused)}. To move "
                "the sensors with a frame of the simulator, set `link` in `mount`."
            )
    else:
        raise LidarError(
            f"{sources.world} contains no sensors of lidarpool. Pass a file with sensors as "
            "`--sensors`."
        )
    sensors = [_with_materials(sensor, followed) for sensor in file.sensors_on_frames()]
    frames = frame_names([sensor.mounted.name for sensor in sensors], ())
    return [
        FollowedSensor(sensor, frame, followed.world, spec)
        for sensor, frame in zip(sensors, frames, strict=False)
    ]


def _with_materials(sensor: SensorOnFrame, followed: FollowedWorld) -> SensorOnFrame:
    """Return a sensor whose materials are followed by those of the world."""
    own = sensor.options["materials"]
    materials = own if own == followed.materials else (*own, *followed.materials)
    return sensor._replace(options={**sensor.options, "materials": materials})
