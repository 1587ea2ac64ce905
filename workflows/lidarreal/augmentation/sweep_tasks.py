"""Augment and encode sweeps in worker processes.

The files of a sweep depend only on the recording and the effects, so they are the same in all
processes.
"""

from __future__ import annotations

import json
import socket
import threading
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from lidarfiles.clouds.recording import METERS, DerivedRecording, LastRead, Recording
from lidarfiles.clouds.recording_ref import RecordingRef
from lidarfiles.clouds.writing import ExportSpec
from lidarfiles.recordings.opening import close_recordings, open_ref
from lidarfiles.work.mapping import describe_sweeps
from lidarsim.columns.sweep import Sweep
from lidarsim.columns.table import CAUSES
from lidarsim.errors import LidarError, prefix_errors
from lidarsim.numerics.random_numbers import named_seed
from lidarsim.sensor import Sensor

from .augmented_sweep import AugmentedSweep
from .augmenter import Augmenter
from .conversion import FormatConverter
from .effects import Effects
from .resampling import SensorResampler
from .rewriting.opening import open_rewriter
from .rewriting.rewriter import Rewriter, sweep_folder


@dataclass(frozen=True, eq=False)
class AugmentationPlan:
    """Augmentation of a recording with one or several variants of effects.

    Attributes
    ----------
    files
        Reference to the recording, once for each of its sensors.
    variants
        Mapping of variant numbers to effects.
    model
        Model of the recording's sensor, or None if it is unknown.
    numbers
        Numbers of the sweeps to augment. Other sweeps are not changed.
    output
        Format of the output, or None for the format of the recording.
    resampled
        Sensor to which the sweeps are resampled, or None.
    reflectance
        Reflectance of all recorded surfaces if the recording has no intensities.
    partial
        Whether to omit pulses of `resampled` that the recorded sensor does not observe.
    """

    files: Sequence[RecordingRef]
    variants: Mapping[int, Effects]
    model: Sensor | None = None
    numbers: range | None = None
    output: ExportSpec | None = None
    resampled: Sensor | None = None
    reflectance: float | None = None
    partial: bool = False


class PlannedSweep(NamedTuple):
    """A sweep to augment."""

    variant: int
    part: int  # index of the sensor in `AugmentationPlan.files`
    number: int

    @property
    def key(self) -> str:
        """Relative path under which the encoded sweep is stored."""
        return f"{encoded_folder(self.variant, self.part)}/{sweep_folder(self.number)}"

    @property
    def label(self) -> str:
        """Name of the sweep in messages."""
        return describe_sweeps(self.number, self.number)


def encoded_folder(variant: int, part: int) -> str:
    """Return the relative path under which the sweeps of a variant of one sensor are stored."""
    return f"{variant:04}/{part:04}"


SUMMARY_FILE = ".summary.json"  # point counts and notes, stored with the files of each sweep


class SweepEncoder:
    """Function that augments and encodes sweeps in any process.

    Each thread opens the recordings of the plan once, and keeps them as long as this object exists.

    Parameters
    ----------
    plan
        The augmentation.
    """

    def __init__(self, plan: AugmentationPlan) -> None:
        self.plan = plan
        self._local = threading.local()

    def __reduce__(self) -> tuple[Any, ...]:
        return _received_encoder, (self.plan,)

    @property
    def process(self) -> PlanProcess:
        """Recordings of the plan in this thread."""
        if not hasattr(self._local, "process"):
            self._local.process = PlanProcess(self.plan)
        process: PlanProcess = self._local.process
        return process

    def __call__(self, sweep: PlannedSweep) -> dict[str, bytes]:
        """Return the files of an augmented sweep.

        Raises
        ------
        LidarError
            If the recording cannot be read, or if the format cannot store the points.
        """
        part = self.process.part(sweep.part)
        files, counts = part.files(sweep.number, sweep.variant)
        notes = part.notes() if sweep.part < CHECKED_SENSORS else ()
        summary = counts.to_json() | {"notes": notes}
        return files | {SUMMARY_FILE: json.dumps(summary).encode()}


def _received_encoder(plan: AugmentationPlan) -> SweepEncoder:
    close_recordings()  # they may have changed since an earlier augmentation in this process
    return SweepEncoder(plan)


@dataclass(eq=False)
class PartProcess:
    """Recording of one sensor with its rewriter and augmenters, which are opened on first use."""

    plan: AugmentationPlan
    file: RecordingRef
    _augmenters: dict[int, Augmenter] = field(default_factory=dict)  # {variant: augmenter}

    @cached_property
    def recording(self) -> LastRead:
        """Recording whose last sweep stays in memory.

        Variants and rewriters therefore do not read it again. A bag would even be read from its
        start.
        """
        path = self.file.located.path
        if path.is_absolute() and not path.exists():
            raise LidarError(
                f"{path} does not exist on {socket.gethostname()}. Use a path that all workers "
                "can access."
            )
        recording = open_ref(self.file)
        assert isinstance(recording, Recording)  # the run has refused clouds
        return LastRead(recording)

    @cached_property
    def rewriter(self) -> Rewriter:
        """Rewriter for the output format."""
        ref = self.file.located
        if self.plan.output is None:
            return open_rewriter(ref, self.recording)
        return FormatConverter(ref, self.recording, self.plan.output)

    @cached_property
    def resampler(self) -> Resampler | None:
        """Resampler of the sweeps, or None if they keep the rays of the recorded sensor."""
        sensor = self.plan.resampled
        if sensor is None:
            return None
        plan = self.plan
        return Resampler(
            SensorResampler(
                self.recording, sensor, recorded_sensor=plan.model, partial=plan.partial
            )
        )

    @cached_property
    def source(self) -> Recording:
        """The resampled recording, which is the recording itself without a resampler."""
        resampler = self.resampler
        if resampler is None:
            return self.recording
        return ResampledRecording(self.recording, resampler)

    def prepare(self, variant: int) -> None:
        """Raise LidarError if the recording cannot be augmented."""
        if self.resampler is None or not self.plan.variants[variant].is_empty:
            self.augmenter(variant)

    def augmenter(self, variant: int) -> Augmenter:
        """Return the augmenter of a variant. Up to `MAX_VARIANTS` augmenters are kept."""
        if variant not in self._augmenters:
            while len(self._augmenters) >= MAX_VARIANTS:
                del self._augmenters[next(iter(self._augmenters))]
            effects = self.plan.variants[variant]
            if len(self.rewriter.sensors()) > 1:  # sensors have different random numbers
                effects = replace(effects, seed=named_seed(effects.seed, self.rewriter.sensor))
            plan = self.plan
            with nullcontext() if len(plan.files) == 1 else prefix_errors(self.file.sensor):
                augmenter = Augmenter(self.source, effects, plan.model, plan.reflectance)
            self._augmenters[variant] = augmenter
        return self._augmenters[variant]

    def notes(self) -> tuple[str, ...]:
        """Return the notes of the recording, the resampler and all augmenters."""
        notes = [note for augmenter in self._augmenters.values() for note in augmenter.notes]
        if self.resampler is not None:
            notes = [*self.resampler.notes, *notes]
        if len(self.plan.files) > 1:
            notes = [f"{self.file.sensor}: {note}" for note in notes]
        recorded = [f"{note}." for note in self.recording.notes]
        return tuple(dict.fromkeys([*recorded, *notes]))

    def augmented(self, number: int, variant: int) -> AugmentedSweep:
        """Return an augmented sweep, whose templates are rows of the recorded sweep."""
        if not self._is_chosen(number):
            return unchanged_sweep(self.recording[number])
        if self.resampler is None:
            return self.augmenter(variant).sweep(number)
        resampled = self.resampler(number)
        if self.plan.variants[variant].is_empty:
            return resampled
        augmented = self.augmenter(variant).sweep(number)
        return replace(augmented, template=resampled.template[augmented.template])

    def _is_chosen(self, number: int) -> bool:
        return self.plan.numbers is None or number in self.plan.numbers

    def files(self, number: int, variant: int) -> tuple[dict[str, bytes], PointCounts]:
        """Return the files and the point counts of an augmented sweep."""
        augmented = self.augmented(number, variant)
        counts = PointCounts()
        if self._is_chosen(number):
            counts = PointCounts.from_sweep(self.recording[number], augmented)
        return self.rewriter.sweep_files(number, augmented), counts

    def release(self) -> None:
        """Release the augmenters and the last sweep."""
        self._augmenters.clear()
        self.recording.release()
        self.__dict__.pop("resampler", None)
        self.__dict__.pop("source", None)


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


class ResampledRecording(DerivedRecording):
    """A recording whose sweeps are resampled, and have standard names and units.

    Parameters
    ----------
    source
        Recording to resample.
    resampler
        Function that returns a resampled sweep.
    """

    def __init__(self, source: Recording, resampler: Resampler) -> None:
        super().__init__(
            source,
            replace(source.info, has_firing_poses=False, meters=METERS, intensity_column=None),
        )
        self._resampler = resampler

    def load(self, number: int) -> Sweep:
        """Return a resampled sweep."""
        return self._resampler(number).sweep


# Number of sensors that are checked before the first sweep is augmented, and whose notes are shown.
CHECKED_SENSORS = 4
MAX_VARIANTS = 8  # maximum number of variants whose augmenters are in memory


class PlanProcess:
    """Recordings of a plan. Only the sweeps of one recording are in memory."""

    def __init__(self, plan: AugmentationPlan) -> None:
        self.plan = plan
        self._parts: dict[int, PartProcess] = {}
        self._current = -1

    def part(self, index: int) -> PartProcess:
        """Return the recording of a sensor."""
        if index not in self._parts:
            self._parts[index] = PartProcess(self.plan, self.plan.files[index])
        if index != self._current and self._current in self._parts:
            self._parts[self._current].release()
        self._current = index
        return self._parts[index]

    def all_parts(self) -> list[PartProcess]:
        """Return the recordings of all sensors."""
        return [self.part(index) for index in range(len(self.plan.files))]


def unchanged_sweep(sweep: Sweep) -> AugmentedSweep:
    """Return a sweep without effects as an augmented sweep."""
    count = len(sweep)
    columns = {**sweep.columns, "cause": np.zeros(count, np.uint8)}
    return AugmentedSweep(
        sweep.replace(columns=columns), np.arange(count), np.ones(count, np.bool_)
    )


@dataclass(frozen=True)
class PointCounts:
    """Point counts of augmented sweeps.

    Attributes
    ----------
    returns
        Number of recorded returns.
    kept
        Number of recorded returns that remain.
    added
        Numbers of added returns by cause.
    """

    returns: int = 0
    kept: int = 0
    added: Mapping[str, int] = field(default_factory=dict)

    @classmethod
    def from_sweep(cls, recorded: Sweep, augmented: AugmentedSweep) -> PointCounts:
        """Count the points of a sweep."""
        has_return = augmented.sweep.has_return
        added = has_return & ~augmented.is_recorded
        causes = np.asarray(augmented.sweep.columns.get("cause", np.zeros(len(added), np.uint8)))
        numbers, counts = np.unique(causes[added], return_counts=True)
        names = [CAUSES[int(number)] for number in numbers]
        return cls(
            int(recorded.has_return.sum()),
            int((has_return & augmented.is_recorded).sum()),
            dict(zip(names, counts.tolist(), strict=True)),
        )

    @classmethod
    def total(cls, counts: Iterable[Mapping[str, Any]]) -> PointCounts:
        """Add counts that were converted with `to_json`."""
        returns = kept = 0
        added: Counter[str] = Counter()
        for entry in counts:
            returns += entry["returns"]
            kept += entry["kept"]
            added.update(entry["added"])
        return cls(returns, kept, dict(sorted(added.items())))

    def to_json(self) -> dict[str, Any]:
        """Return the counts as a dictionary for JSON."""
        return {"returns": self.returns, "kept": self.kept, "added": dict(self.added)}

    @property
    def points(self) -> int:
        """Number of points after the augmentation."""
        return self.kept + sum(self.added.values())
