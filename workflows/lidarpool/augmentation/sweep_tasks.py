"""Tasks of worker processes, which augment and encode sweeps.

The files of a sweep depend only on the recording and the effects, so they are the same in all
processes.
"""

from __future__ import annotations

import json
import pickle
import socket
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from lidarsim.columns.sweep import Sweep
from lidarsim.columns.table import CAUSES
from lidarsim.errors import LidarError
from lidarsim.sensor import Sensor

from ..clouds.recording import METERS, Recording
from ..processes.per_process import PerProcess
from ..recordings.opening import open_recording
from .augmented_sweep import AugmentedSweep
from .augmenter import Augmenter
from .effects import Effects
from .resampling import SensorResampler
from .rewriting.opening import open_rewriter
from .rewriting.rewriter import Rewriter
from .work_folder import WorkFolder, counts_name


@dataclass(frozen=True)
class RecordingFile:
    """File or folder of a recording, with the sensor and the column that the user chose.

    Attributes
    ----------
    path
        Path, which may be relative to `folder`.
    sensor
        Sensor or topic, if there are several.
    intensity
        Column that contains the intensities, if it is not ``intensity``.
    folder
        Working directory of the process that created this object.
    """

    path: Path
    sensor: str | None = None
    intensity: str | None = None
    folder: Path = field(default_factory=Path.cwd)

    @property
    def located(self) -> Path:
        """Path that is valid in this process. It is the given path if possible, for messages."""
        return self.path if Path.cwd() == self.folder else self.folder / self.path

    def open(self) -> Recording:
        """Open the recording with all points of its file.

        The last sweep stays in memory, so variants and rewriters do not read it again. A bag would
        even be read from its start.
        """
        recording = open_recording(self.located, self.sensor, self.intensity, keep_noise=True)
        return replace(recording, read=_LastSweep(recording))


class _LastSweep:
    """Function that reads a sweep of a recording, and keeps the last one in memory."""

    def __init__(self, recording: Recording) -> None:
        self._read = recording.read
        self._number = -1
        self._sweep: Sweep | None = None

    def __call__(self, number: int) -> Sweep:
        if self._sweep is None or self._number != number:
            self._sweep = None  # frees its memory before the next sweep is read
            self._sweep = self._read(number)
            self._number = number
        return self._sweep


@dataclass(frozen=True, eq=False)
class AugmentationPlan:
    """Augmentation of a recording with one or several variants of effects.

    Attributes
    ----------
    file
        File of the recording.
    variants
        Effects by the number of their variant.
    model
        Model of the recording's sensor, or None if it is unknown.
    numbers
        Numbers of the sweeps to augment. Other sweeps are not changed.
    output_format
        Name of the output format, or None for the format of the recording.
    resampled
        Sensor to which the sweeps are resampled, or None.
    reflectance
        Reflectance of all recorded surfaces if the recording has no intensities.
    """

    file: RecordingFile
    variants: Mapping[int, Effects]
    model: Sensor | None = None
    numbers: range | None = None
    output_format: str | None = None
    resampled: Sensor | None = None
    reflectance: float | None = None

    def open_rewriter(self, recording: Recording) -> Rewriter:
        """Return the rewriter for the output format."""
        if self.output_format is not None:
            raise LidarError(
                f"The output format {self.output_format!r} is not supported. Omit `--format` to "
                "write the format of the recording."
            )
        return open_rewriter(self.file.located, recording, self.file.sensor)


@dataclass(frozen=True, eq=False)
class SharedPlan:
    """A plan as bytes, which each process unpickles once.

    Attributes
    ----------
    key
        Identifies the plan.
    work
        Work folder for the encoded sweeps.
    content
        The pickled plan.
    """

    key: str
    work: WorkFolder
    content: bytes

    @classmethod
    def from_plan(cls, key: str, work: WorkFolder, plan: AugmentationPlan) -> SharedPlan:
        """Pickle a plan."""
        return cls(key, work, pickle.dumps(plan))


class SweepTask(NamedTuple):
    """Task of augmenting sweeps."""

    shared: SharedPlan
    sweeps: tuple[tuple[int, tuple[int, ...]], ...]  # numbers of sweeps, with their variants


class EncodedFiles(NamedTuple):
    """Files of the sweeps of a task."""

    count: int  # number of sweeps, which are counted once for each variant
    notes: tuple[str, ...]
    # {name: content} of the files in the order in which they must be written, unless the worker has
    # written them
    files: dict[str, bytes] | None


def augment_sweeps(task: SweepTask) -> EncodedFiles:
    """Augment and encode sweeps, and write their files if the work folder is accessible.

    Raises
    ------
    LidarError
        If the recording cannot be read, or if the format cannot store the points.
    """
    process = open_plan(task.shared)
    work = task.shared.work
    is_accessible = work.is_accessible()
    unwritten: dict[str, bytes] = {}
    count = 0
    for number, variants in task.sweeps:
        for variant in variants:
            files = process.files(number, variant)
            if is_accessible:
                work.write(files)
            else:
                unwritten |= files
            count += 1
    return EncodedFiles(count, process.notes(), None if is_accessible else unwritten)


@dataclass(eq=False)
class PlanProcess:
    """Recording, rewriter and augmenters of a plan in one process, opened on first use."""

    key: str
    plan: AugmentationPlan
    work: WorkFolder
    _augmenters: dict[int, Augmenter] = field(default_factory=dict)  # {variant: augmenter}

    @cached_property
    def recording(self) -> Recording:
        """The recording."""
        path = self.plan.file.located
        if path.is_absolute() and not path.exists():
            raise LidarError(
                f"{path} does not exist on {socket.gethostname()}. Use a path that all workers "
                "can access."
            )
        return self.plan.file.open()

    @cached_property
    def rewriter(self) -> Rewriter:
        """Rewriter for the output format."""
        return self.plan.open_rewriter(self.recording)

    @cached_property
    def resampler(self) -> Resampler | None:
        """Resampler of the sweeps, or None if they keep the rays of the recorded sensor."""
        sensor = self.plan.resampled
        if sensor is None:
            return None
        return Resampler(SensorResampler(self.recording, sensor, recorded_sensor=self.plan.model))

    @cached_property
    def source(self) -> Recording:
        """The resampled recording, which is the recording itself without a resampler."""
        if self.resampler is None:
            return self.recording
        # The resampled sweeps have standard names and units.
        return replace(
            self.recording,
            read=lambda number: self.resampler(number).sweep,
            fired=None,
            meters=METERS,
            intensity_column=None,
        )

    def prepare(self, variant: int) -> None:
        """Raise LidarError if the recording cannot be augmented."""
        if self.resampler is None or not self.plan.variants[variant].is_empty:
            self.augmenter(variant)

    def augmented(self, number: int, variant: int) -> AugmentedSweep:
        """Return an augmented sweep, whose templates are rows of the recorded sweep."""
        resampled = None if self.resampler is None else self.resampler(number)
        if resampled is None:
            return self.augmenter(variant).sweep(number)
        if self.plan.variants[variant].is_empty:
            return resampled
        augmented = self.augmenter(variant).sweep(number)
        return replace(augmented, template=resampled.template[augmented.template])

    def augmenter(self, variant: int) -> Augmenter:
        """Return the augmenter of a variant. Up to `MAX_VARIANTS` augmenters are kept."""
        if variant not in self._augmenters:
            while len(self._augmenters) >= MAX_VARIANTS:
                del self._augmenters[next(iter(self._augmenters))]
            effects = self.plan.variants[variant]
            self._augmenters[variant] = Augmenter(
                self.source, effects, self.plan.model, self.plan.reflectance
            )
        return self._augmenters[variant]

    def notes(self) -> tuple[str, ...]:
        """Return the notes of the resampler and of all augmenters."""
        notes = [note for augmenter in self._augmenters.values() for note in augmenter.notes]
        if self.resampler is not None:
            notes = [*self.resampler.notes, *notes]
        return tuple(dict.fromkeys(notes))

    def files(self, number: int, variant: int) -> dict[str, bytes]:
        """Return the files of a sweep in the order in which they must be written."""
        numbers = self.plan.numbers
        if numbers is None or number in numbers:
            augmented = self.augmented(number, variant)
        else:
            augmented = unchanged_sweep(self.recording[number])
        encoded = self.rewriter.sweep_files(number, augmented)
        counts = count_points(self.recording[number], augmented)
        folder = self.work.encoded(variant).name
        return {
            counts_name(variant, number): json.dumps(counts).encode(),
            **{f"{folder}/{name}": content for name, content in encoded.items()},
        }


class Resampler:
    """Function that resamples a sweep to another sensor, and keeps the last one in memory."""

    def __init__(self, resampler: SensorResampler) -> None:
        self._resampler = resampler
        self._last: tuple[int, AugmentedSweep] | None = None

    def __call__(self, number: int) -> AugmentedSweep:
        """Return a resampled sweep."""
        if self._last is None or self._last[0] != number:
            self._last = None
            self._last = number, self._resampler.sweep(number)
        return self._last[1]

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes for the user."""
        return tuple(self._resampler.notes)


MAX_VARIANTS = 8  # maximum number of variants of a task, whose augmenters are in memory

_processes = PerProcess[dict[str, PlanProcess]](dict)


def open_plan(shared: SharedPlan) -> PlanProcess:
    """Return the state of a plan in this process, which keeps only the most recent plan."""
    states = _processes()
    if shared.key not in states:
        states.clear()
        plan = pickle.loads(shared.content)  # noqa: S301 - from the driver of the command
        states[shared.key] = PlanProcess(shared.key, plan, shared.work)
    return states[shared.key]


def close_plans() -> None:
    """Release the recordings and augmenters that this process keeps."""
    _processes().clear()


def unchanged_sweep(sweep: Sweep) -> AugmentedSweep:
    """Return a sweep without effects as an augmented sweep."""
    count = len(sweep)
    columns = {**sweep.columns, "cause": np.zeros(count, np.uint8)}
    return AugmentedSweep(
        sweep.replace(columns=columns), np.arange(count), np.ones(count, np.bool_)
    )


def count_points(recorded: Sweep, augmented: AugmentedSweep) -> dict[str, Any]:
    """Return point counts of an augmented sweep.

    `returns` is the number of recorded returns, `kept` is the number of those that remain, and
    `added` contains the numbers of added returns by cause.
    """
    has_return = augmented.sweep.has_return
    added = has_return & ~augmented.is_recorded
    causes = np.asarray(augmented.sweep.columns.get("cause", np.zeros(len(added), np.uint8)))
    numbers, counts = np.unique(causes[added], return_counts=True)
    names = [CAUSES[int(number)] for number in numbers]
    return {
        "returns": int(recorded.has_return.sum()),
        "kept": int((has_return & augmented.is_recorded).sum()),
        "added": dict(zip(names, counts.tolist(), strict=True)),
    }


@dataclass(frozen=True)
class PointCounts:
    """Point counts of several sweeps (see `count_points`)."""

    returns: int = 0
    kept: int = 0
    added: Mapping[str, int] = field(default_factory=dict)

    @classmethod
    def total(cls, counts: Iterable[Mapping[str, Any]]) -> PointCounts:
        """Add the counts of sweeps."""
        returns = kept = 0
        added: Counter[str] = Counter()
        for entry in counts:
            returns += entry["returns"]
            kept += entry["kept"]
            added.update(entry["added"])
        return cls(returns, kept, dict(sorted(added.items())))

    @property
    def points(self) -> int:
        """Number of points after the augmentation."""
        return self.kept + sum(self.added.values())
