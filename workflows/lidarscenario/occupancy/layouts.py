"""File layouts of occupancy grids in Occ3D-nuScenes and SemanticKITTI."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import ClassVar

import numpy as np

from lidarfiles.clouds.job_reader import Entry
from lidarfiles.clouds.kitti import MAX_INSTANCES, first_sequence, sequence_names
from lidarfiles.clouds.nuscenes import sample_tokens
from lidarsim.errors import LidarError
from lidarsim.io.archives import pack_arrays
from lidarsim.numerics.arrays import Bools, Integers
from lidarsim.simulator.occupancy import GridFrame, Occupancy, VoxelGrid
from lidarsim.sweeps.sweeps import Sweeps
from lidarsim.words import list_names

from .class_names import OCC3D_CLASSES, occ3d_class

FREE_OCC3D = 17
_ENDINGS = ("bin", "label", "occluded", "invalid", "instance")
# Patterns of the names of files and folders.
_SWEEP = "[0-9]" * 6
_TOKEN = "[0-9a-f]" * 32
OTHER_OBJECT = 99  # SemanticKITTI class that evaluations ignore


class GridLayout(ABC):
    """Names and content of the files for a job.

    Parameters
    ----------
    sweeps
        Sweeps of the job.
    entry
        Job of a campaign, or None for a single scenario.
    sensor
        Number of the sensor whose sweeps are written.

    Raises
    ------
    LidarError
        If the layout cannot store the sweeps.
    """

    grid: ClassVar[VoxelGrid]  # default grid
    frame: ClassVar[GridFrame]  # default frame of the grid

    def __init__(self, sweeps: Sweeps, entry: Entry | None, sensor: int) -> None:
        objects = len(sweeps.objects) + len(sweeps.actors)
        if objects > MAX_INSTANCES:
            raise LidarError(
                f"Occupancy grids support at most {MAX_INSTANCES:,} objects, but the scene has "
                f"{objects:,}."
            )
        self.sweeps = sweeps
        self.sensor = sensor
        self.count = int((sweeps.sensor == sensor).sum())

    @classmethod
    def first_path(cls, job: int | None) -> str | None:
        """Return the path of a file of the first sweep of the first sensor.

        `job` is the number of a job in a campaign, or None for a single scenario. Returns None if
        the path depends on the survey.
        """
        return None

    @abstractmethod
    def paths(self, number: int) -> tuple[str, ...]:
        """Return the paths of the files of a sweep of the sensor."""

    @abstractmethod
    def existing_paths(self, folder: Path) -> Iterator[str]:
        """Yield the paths of the files in a folder that belong to the job and sensor.

        They may belong to more sweeps than the job has.
        """

    @abstractmethod
    def contents(self, occupancy: Occupancy) -> tuple[bytes, ...]:
        """Return the contents of the files of a sweep, in the order of `paths`."""

    def notes(self) -> list[str]:
        """Return notes for the user."""
        return []


class Occ3d(GridLayout):
    """Layout of Occ3D-nuScenes: `gts/SCENE/FRAME_TOKEN/labels.npz`.

    The archive contains `semantics` (uint8; 17 is free), `mask_lidar` and `mask_camera` (uint8; 1
    is observed). Both masks are equal, because no camera is simulated. `instances` (uint16), which
    is not part of Occ3D, contains the object number + 1, or 0 for free voxels. The frame token is
    the sample token that the format `nuscenes` writes.

    Tian et al., Occ3D, 2023.
    """

    grid = VoxelGrid((-40.0, -40.0, -1.0), (40.0, 40.0, 5.4), 0.4)
    frame: ClassVar[GridFrame] = "platform"

    def __init__(self, sweeps: Sweeps, entry: Entry | None, sensor: int) -> None:
        super().__init__(sweeps, entry, sensor)
        if sensor:
            raise LidarError(
                "Occ3D requires the first sensor, because each of its sweeps is a sample. Remove "
                "`--sensor`, or use `--layout semantickitti`."
            )
        self._scene, self._tokens = sample_tokens(sweeps, entry)
        self._labels = np.zeros(1 << 16, np.uint8)
        for number, name in sweeps.classes.items():
            self._labels[number] = occ3d_class(name) or 0

    def paths(self, number: int) -> tuple[str, ...]:
        """Return the path of `labels.npz`."""
        return (f"gts/{self._scene}/{self._tokens[number]}/labels.npz",)

    def existing_paths(self, folder: Path) -> Iterator[str]:
        """Yield the paths of `labels.npz` for all frame tokens of the scene."""
        for path in folder.glob(f"gts/{self._scene}/{_TOKEN}/labels.npz"):
            yield path.relative_to(folder).as_posix()

    def contents(self, occupancy: Occupancy) -> tuple[bytes, ...]:
        """Return the content of `labels.npz`."""
        semantics = np.where(occupancy.occupied, self._labels[occupancy.classes], FREE_OCC3D)
        observed = occupancy.observed.astype(np.uint8)
        arrays = {
            "semantics": semantics.astype(np.uint8),
            "mask_lidar": observed,
            "mask_camera": observed,
            "instances": (occupancy.instances + 1).astype(np.uint16),
        }
        return (pack_arrays(arrays),)

    def notes(self) -> list[str]:
        """Return a note about classes that Occ3D does not have."""
        named = sorted(self.sweeps.classes.items())
        others = [name for number, name in named if number and occ3d_class(name) is None]
        if not others:
            return []
        return [
            f"Occ3D has no equivalent of these classes, which are stored as {OCC3D_CLASSES[0]!r}: "
            f"{list_names(others)}. Its classes are {', '.join(OCC3D_CLASSES)}"
        ]


class SemanticKitti(GridLayout):
    """Layout of SemanticKITTI: `sequences/00/voxels/000000.bin`, `.label` and so on.

    - `.bin`: bits of the voxels in which a ray of the sweep hits a surface.
    - `.label`: class of each voxel (uint16), or 0 for free voxels. Surfaces without a class have
      the class 99, other-object, which evaluations ignore.
    - `.occluded`: bits of the voxels that no ray of the sweep observes.
    - `.invalid`: bits of the voxels that no ray of the sweep or of the following sweeps observes.
    - `.instance`: object number + 1 of each voxel (uint16), or 0. It is not part of SemanticKITTI.

    Voxels are sorted by x, y and z, and z changes fastest. The first voxel in a byte is the most
    significant bit.

    Behley et al., SemanticKITTI, 2019.
    """

    grid = VoxelGrid((0.0, -25.6, -2.0), (51.2, 25.6, 4.4), 0.2)
    frame: ClassVar[GridFrame] = "sensor"

    def __init__(self, sweeps: Sweeps, entry: Entry | None, sensor: int) -> None:
        super().__init__(sweeps, entry, sensor)
        self._sequence = sequence_names(sweeps, entry)[sensor]

    @classmethod
    def first_path(cls, job: int | None) -> str:
        """Return the path of the `.bin` file of the first sweep of the first sensor."""
        return _voxel_files(first_sequence(job), 0)[0]

    def paths(self, number: int) -> tuple[str, ...]:
        """Return the paths of the five files of a sweep."""
        return _voxel_files(self._sequence, number)

    def existing_paths(self, folder: Path) -> Iterator[str]:
        """Yield the paths of the files of all sweeps in the sequence."""
        for ending in _ENDINGS:
            for path in folder.glob(f"sequences/{self._sequence}/voxels/{_SWEEP}.{ending}"):
                yield path.relative_to(folder).as_posix()

    def contents(self, occupancy: Occupancy) -> tuple[bytes, ...]:
        """Return the contents of the five files of a sweep."""
        classes = occupancy.classes
        labels = np.where(occupancy.occupied & (classes == 0), OTHER_OBJECT, classes)
        return (
            _packed(occupancy.hit),
            _as_uint16(labels),
            _packed(~occupancy.observed),
            _packed(~occupancy.observed_later),
            _as_uint16(occupancy.instances + 1),
        )


def _voxel_files(sequence: str, number: int) -> tuple[str, ...]:
    """Return the paths of the files of a sweep in the layout of SemanticKITTI."""
    return tuple(f"sequences/{sequence}/voxels/{number:06}.{ending}" for ending in _ENDINGS)


def _packed(voxels: Bools) -> bytes:
    return np.packbits(voxels.ravel()).tobytes()


def _as_uint16(voxels: Integers) -> bytes:
    return voxels.astype("<u2").tobytes()


LAYOUTS: Mapping[str, type[GridLayout]] = MappingProxyType(
    {"occ3d": Occ3d, "semantickitti": SemanticKitti}
)
