"""References to recordings, which say how to open them in any process."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from lidarsim.errors import LidarError
from lidarsim.numerics.arrays import Floats
from lidarsim.scene.files.stated_system import Meters, StatedSystem, stated_meters
from lidarsim.words import did_you_mean, join_names

from .recording import METERS, RecordingInfo

Value = TypeVar("Value")


class SeveralSensorsError(LidarError):
    """Error raised if a recording has several sensors or topics and none was chosen.

    `contents` is a sentence that lists them, and `option` is the option that chooses one of them.
    """

    def __init__(self, contents: str, names: Sequence[str], option: str = "--sensor") -> None:
        super().__init__(f"{contents} Choose one of them with `{option}`.")
        self.contents = contents
        self.names = names


@dataclass(frozen=True)
class RecordingRef:
    """A file or folder to open as a recording, with the options that the user chose.

    The reference can be sent to other processes. Formats receive it to open their files.

    Attributes
    ----------
    path
        Path, which may be relative to `folder`.
    sensor
        Sensor or topic, if there are several.
    intensity
        Column that contains the intensities, if it is not ``intensity``.
    unit
        Unit of the positions, which overrides the file.
    keep_noise
        Whether to include withheld points and points that are classified as noise.
    as_stored
        Whether positions are returned in the units and the coordinate system of the file, without
        checks, and each scan in the file is an item.
    folder
        Working directory of the process that created the reference.
    name
        Name in messages. By default, it is the path.
    """

    path: Path
    sensor: str | None = None
    intensity: str | None = None
    unit: str | None = None
    keep_noise: bool = False
    as_stored: bool = False
    folder: Path = field(default_factory=Path.cwd)
    name: str = ""

    def __post_init__(self) -> None:
        if not self.name:
            object.__setattr__(self, "name", str(self.path))

    @property
    def located(self) -> RecordingRef:
        """Reference with the same name, whose path is valid in this process."""
        if self.path.is_absolute() or Path.cwd() == self.folder:
            return self
        return replace(self, path=self.folder / self.path)

    def info(self, **fields: Any) -> RecordingInfo:
        """Describe the recording. `fields` are passed to `RecordingInfo`."""
        return RecordingInfo(self.name, intensity_column=self.intensity, **fields)

    def choose(self, kind: str, names: Iterable[str]) -> str:
        """Return the sensor or topic that the user chose (see the function `choose`).

        The format sets `RecordingInfo.sensor` to this name.
        """
        return choose(self.name, kind, names, self.sensor)

    def choose_sensor(self, sensors: Mapping[str, Value]) -> tuple[str, Value]:
        """Return the name of the sensor that the user chose, and its value.

        A single sensor may have an empty name.
        """
        name = self.choose("sensors", sensors)
        return name, sensors[name]

    def prefix_notes(self, clauses: Iterable[str]) -> tuple[str, ...]:
        """Turn clauses into notes by prepending the name of the recording."""
        return tuple(f"{self.name} {clause}" for clause in clauses)

    def chosen_meters(self) -> Meters:
        """Return the units of x, y and z in meters, for a format that does not define them."""
        return stated_meters(None, np.zeros((0, 3)), self.unit)[0]

    def stated_meters(
        self, system: StatedSystem | None, positions: Floats
    ) -> tuple[Meters, tuple[str, ...]]:
        """Return the units of x, y and z in meters, and notes for the user.

        `positions` contains points in the file, or a sample of them, in the units of the file.
        Raises LidarError in the same cases as `lidarsim.scene.files.stated_system.stated_meters`.
        """
        if self.as_stored:
            return METERS, ()
        meters, clauses = stated_meters(system, positions, self.unit)
        return meters, self.prefix_notes(clauses)

    def epsg_in_meters(self, system: StatedSystem | None, meters: Meters) -> int | None:
        """Return the EPSG code of a coordinate system, or None if its unit is not the meter."""
        if system is None or self.unit is not None or meters != METERS:
            return None
        return system.epsg


def choose(name: str, kind: str, names: Iterable[str], chosen: str | None) -> str:
    """Return the chosen sensor or topic, or the only one if none was chosen.

    Parameters
    ----------
    name
        Name of the recording, for error messages.
    kind
        What is chosen, in the plural, for error messages. For example "sensors".
    names
        Names of the available sensors or topics.
    chosen
        Name that the user chose, or None.

    Raises
    ------
    LidarError
        If there are several and none was chosen, or if the chosen one does not exist.
    """
    available = list(names)
    if chosen is None and len(available) == 1:
        return available[0]
    if chosen is not None and chosen in available:
        return chosen
    contents = f"It contains the {kind} {join_names(available)}." if available else ""
    if available == [""]:
        contents = f"Its {kind} have no names and cannot be selected."
    if not available:
        raise LidarError(f"{name} contains no {kind}. Record at least one.")
    if chosen is None:
        raise SeveralSensorsError(f"{name} contains the {kind} {join_names(available)}.", available)
    hint = did_you_mean(chosen, available)
    raise LidarError(f"{name} does not contain {chosen!r}.{hint} {contents}")
