"""Instruments of a platform other than its lidars: an IMU and a GNSS receiver."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass, field, replace
from io import TextIOWrapper
from pathlib import Path
from typing import Any

from ..io.input_files import open_input
from ..motion.rotations import quaternions_of
from ..motion.trajectory import Pose
from ..survey.survey import Survey

IMU_FILE = "imu.csv"
GNSS_FILE = "gnss.csv"
TRAJECTORY_FILE = "trajectory.csv"  # measured trajectory
INSTRUMENT_FILES = (IMU_FILE, GNSS_FILE, TRAJECTORY_FILE)


@dataclass(frozen=True)
class Instrument:
    """Mount and noise of an instrument, which bags store together with its samples."""

    position: list[float]  # position in the platform frame, meters
    quaternion: list[float]  # x, y, z, w
    # For an IMU, the white noise variances of the angular velocity and the specific force. For a
    # GNSS receiver, the variances of the east, north and up positions, including drift.
    variances: list[float]


@dataclass(frozen=True)
class Instruments:
    """Instruments of a survey and the folder that contains their files."""

    imu: Instrument | None
    gnss: Instrument | None
    folder: Path | None = None  # None until the files are written
    # Whether points are georeferenced by the measured trajectory.
    trajectory: bool = field(default=False, kw_only=True)

    @classmethod
    def from_survey(cls, survey: Survey) -> Instruments | None:
        """Return the instruments of a survey, or None if the survey has none."""
        navigation = survey.navigation
        measured = survey.measured is not None
        if navigation is None or not (navigation.imu or navigation.gnss or measured):
            return None
        imu = gnss = None
        if navigation.imu is not None:
            model = navigation.imu
            densities = (model.gyroscope_noise_density, model.accelerometer_noise_density)
            imu = _instrument(model.mount, [model.rate_hz * density**2 for density in densities])
        if navigation.gnss is not None:
            receiver = navigation.gnss
            horizontal = receiver.horizontal_m**2 + receiver.drift_horizontal_m**2
            vertical = receiver.vertical_m**2 + receiver.drift_vertical_m**2
            gnss = _instrument(receiver.mount, [horizontal, horizontal, vertical])
        return cls(imu, gnss, trajectory=measured)

    @property
    def files(self) -> list[str]:
        """Names of the files that the instruments write."""
        written = (self.imu is not None, self.gnss is not None, self.trajectory)
        return [name for name, exists in zip(INSTRUMENT_FILES, written, strict=True) if exists]

    def to_json(self) -> dict[str, Any]:
        """Convert the instruments to a JSON-serializable dictionary, without the folder."""
        instruments = {"imu": self.imu, "gnss": self.gnss}
        values: dict[str, Any] = {
            name: instrument and asdict(instrument) for name, instrument in instruments.items()
        }
        return values | ({"trajectory": True} if self.trajectory else {})

    @classmethod
    def from_json(cls, values: dict[str, Any], folder: Path) -> Instruments:
        """Create the instruments from a dictionary that `to_json` returned.

        `folder` is stored only if it contains the files of all instruments.
        """
        imu = values["imu"] and Instrument(**values["imu"])
        gnss = values["gnss"] and Instrument(**values["gnss"])
        instruments = cls(imu, gnss, folder, trajectory=values.get("trajectory", False))
        if all((folder / name).exists() for name in instruments.files):
            return instruments
        return replace(instruments, folder=None)

    def rows(self, name: str) -> Iterator[list[str]]:
        """Yield the rows of a file after its header.

        If the file has not been written, there are no rows.
        """
        if self.folder is None or name not in self.files:
            return
        with TextIOWrapper(open_input(self.folder / name), encoding="ascii") as file:
            next(file)
            for line in file:
                yield line.rstrip("\n").split(",")


def _instrument(mount: Pose, variances: list[float]) -> Instrument:
    """Create an instrument at a mount whose quaternion has a nonnegative w component."""
    quaternion = quaternions_of(mount.rotation_matrix[None])[0]
    quaternion *= -1 if quaternion[3] < 0 else 1
    return Instrument([*mount.position], quaternion.tolist(), variances)
