"""Augment all sweeps of a recording in worker processes, and write the augmented copy.

Sweeps are encoded independently of each other and collected in a work folder. A run that was
stopped at any time continues with the missing sweeps, and its output has the same bytes.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lidarsim.errors import LidarError
from lidarsim.io.storage import Storage
from lidarsim.sensor import Sensor
from lidarsim.words import join_names, plural

from ..clouds.folder import result_folder
from ..clouds.format_table import format_of_path, formats_of_endings
from ..clouds.writing import ExportSpec
from ..identity.fingerprint import fingerprint
from ..identity.versions import software
from ..work.mapping import MapFunction, parallel_map
from ..work.work import fingerprint_files
from .rewriting.data_set_copy import check_target
from .rewriting.opening import check_sweeps
from .sweep_tasks import (
    CHECKED_SENSORS,
    MAX_VARIANTS,
    AugmentationPlan,
    EncodedFiles,
    PartProcess,
    PlannedSweep,
    PlanProcess,
    PointCounts,
    RecordingFile,
    SharedPlan,
    SweepTask,
    augment_sweeps,
    close_plans,
    open_plan,
)
from .variants import TABLE_FILE, Variants, variants_table
from .work_folder import WorkFolder

if TYPE_CHECKING:
    from distributed import Client

_WORKER_BYTES = 2 << 30  # memory per process for a sensor with 128 channels
_WORKER_SWEEPS = 32  # starting a process takes about as long as augmenting this many sweeps
_TASK_SWEEPS = 8  # maximum number of sweeps in a task
_MIN_TASKS = 64  # so that all workers are busy until the end, if there are enough sweeps

ShowProgress = Callable[[int, int], None]  # called with the numbers of finished and of all sweeps


@dataclass(frozen=True, eq=False)
class AugmentedRecording:
    """Summary of an augmented recording.

    Attributes
    ----------
    outputs
        Augmented copies of the recording, one for each variant.
    table
        Table with the values of the variants, or None if there is a single variant.
    sweeps
        Number of augmented sweeps in each output, of all sensors together.
    counts
        Point counts of the augmented sweeps in all outputs.
    seconds
        Duration of the augmentation in seconds.
    notes
        Notes for the user.
    """

    outputs: tuple[Path, ...]
    table: Path | None
    sweeps: int
    counts: PointCounts
    seconds: float
    notes: tuple[str, ...]

    def __repr__(self) -> str:
        counts = self.counts
        copies = f" in each of {len(self.outputs):,} variants" if self.table else ""
        share = 100 * (1 - counts.kept / counts.returns) if counts.returns else 0.0
        added = ", ".join(f"{count:,} from {cause}" for cause, count in counts.added.items())
        return (
            f"{plural(self.sweeps, 'sweep')} augmented{copies}: {share:.1f} % of "
            f"{counts.returns:,} returns are lost or hidden, "
            f"{sum(counts.added.values()):,} returns are added{f' ({added})' if added else ''} "
            f"({self.seconds:.1f} s)"
        )

    @property
    def figures(self) -> dict[str, Any]:
        """Values for JSON."""
        counts = self.counts
        return {
            "outputs": [str(path) for path in self.outputs],
            "table": None if self.table is None else str(self.table),
            "sweeps": self.sweeps,
            **counts.to_json(),
            "seconds": self.seconds,
            "notes": list(self.notes),
        }


@dataclass(frozen=True, eq=False)
class Augmentation:
    """Augmentation of a recording, which writes an augmented copy for each variant.

    Attributes
    ----------
    file
        File or folder of the recording. If it has several sensors or sequences and none is chosen,
        all of them are augmented.
    variants
        Variants of effects.
    model
        Model of the recording's sensor, or None if it is unknown.
    numbers
        Numbers of the sweeps to augment, or None for all. Other sweeps are not changed.
    output_format
        Name of the output format, or None for the format of the recording.
    resampled
        Sensor to which the sweeps are resampled, or None to keep the rays of the recorded sensor.
    reflectance
        Reflectance of all recorded surfaces if the recording has no intensities.
    partial
        Whether to omit pulses of `resampled` that the recorded sensor does not observe.
    """

    file: RecordingFile
    variants: Variants
    model: Sensor | None = None
    numbers: range | None = None
    output_format: str | None = None
    resampled: Sensor | None = None
    reflectance: float | None = None
    partial: bool = False

    def __post_init__(self) -> None:
        if self.numbers is not None and self.resampled is not None:
            raise LidarError(
                "`--sweeps` and `--sensor` cannot be combined, because the other sweeps would "
                "keep the rays of the recorded sensor."
            )

    def run(
        self,
        out: Path,
        *,
        client: Client | None = None,
        workers: int | None = None,
        resume: bool = False,
        overwrite: bool = False,
        progress: ShowProgress = lambda done, total: None,
    ) -> AugmentedRecording:
        """Augment the recording, and write the copies.

        Parameters
        ----------
        out
            Output file or folder. If there are several variants, or if the output is a file and
            `out` has another extension, the copies are written to this folder.
        client
            Client of a cluster whose OTHER workers can read the recording at the same path. By
            default, processes on this machine augment the sweeps.
        workers
            Number of processes on this machine. By default, it depends on the number of cores and
            the memory. The output does not depend on it.
        resume
            Whether to continue with the sweeps of an earlier run that was stopped.
        overwrite
            Whether to discard an unfinished run, and to replace existing copies.
        progress
            Function that is called with the numbers of finished and of all sweeps.

        Raises
        ------
        LidarError
            If the recording cannot be read or augmented, if the output exists or cannot be
            written, or if the unfinished run has other inputs.
        """
        out = Path(out)
        try:
            files = self.file.each_sensor()
            if len(files) == 1:
                check_sweeps(self.file.path, files[0].open())
            output = self._output()
            targets = self._targets(out, output)
            with ExitStack() as stack:
                if targets[0] != out:
                    stack.enter_context(result_folder(out))
                stack.enter_context(result_folder(WorkFolder.for_output(out), shown=out))
                if not overwrite and not WorkFolder.is_unfinished(out):
                    for target in targets:  # before the recording is hashed
                        check_target(target, self.file.path, overwrite=False)
                identity = self._identity()
                work = WorkFolder.create_or_resume(
                    out, identity, resume=resume, overwrite=overwrite
                )
                run = _Run(self, files, output, work, targets, progress)
                with _KeptFolder(work):
                    return run.augment(out, client, workers)
        finally:
            close_plans()

    def _output(self) -> ExportSpec | None:
        """Return the output format, or None if it is the format of the recording."""
        if self.output_format is None:
            return None
        path = self.file.path
        spec = ExportSpec(self.output_format)
        recorded = format_of_path(path, str(path))
        return None if recorded is spec.cloud_format else spec

    def _targets(self, out: Path, output: ExportSpec | None) -> tuple[Path, ...]:
        """Return the path of the copy for each variant."""
        path = self.file.path
        suffix = path.suffix if path.is_file() else ""
        if output is not None:
            suffix = Path(output.row.file).suffix
        self._check_ending(out, suffix)
        if self.variants.is_campaign:
            return tuple(out / f"{number:04}{suffix}" for number in range(self.variants.count))
        if suffix and out.suffix.lower() != suffix.lower():
            return (out / f"{path.stem}{suffix}",)
        return (out,)

    def _check_ending(self, out: Path, suffix: str) -> None:
        """Raise LidarError if a folder would have the extension of a file or of another format."""
        ending = out.suffix.lower()
        formats = formats_of_endings()
        if ending not in formats or out.is_dir():
            return
        if self.variants.is_campaign:
            raise LidarError(
                f"{out} ends in {ending}, but a campaign writes a folder with a copy for each "
                "variant. Specify a path without this ending with `--out`."
            )
        if ending == suffix.lower():
            return
        kind = f"{suffix} file" if suffix else "folder"
        name = formats[ending]
        remedy = f"Use `--format {name}`, or an output folder." if name else "Use an output folder."
        raise LidarError(f"{out} ends in {ending}, but the copy is a {kind}. {remedy}")

    def _identity(self) -> dict[str, str]:
        """Return hashes of the inputs, keyed by a noun for messages."""
        return {
            "recording": fingerprint_files(self.file.path),
            "effects": self.variants.identity,
            "options": fingerprint(
                str(self.file.folder / self.file.path),
                self.file.sensor,
                self.file.intensity,
                self.model,
                None if self.numbers is None else [self.numbers.start, self.numbers.stop],
                self.output_format,
                self.resampled,
                self.reflectance,
                self.partial,
            ),
            "version of lidarpool": software()["lidarpool"],
        }


@dataclass(eq=False)
class _Run:
    """Run of an augmentation, whose sweeps are collected in a work folder."""

    augmentation: Augmentation
    files: tuple[RecordingFile, ...]  # the recording, once for each sensor
    output: ExportSpec | None
    work: WorkFolder
    targets: tuple[Path, ...]
    progress: ShowProgress
    _notes: dict[str, None] = field(default_factory=dict)  # in the order of their discovery
    _done: int = 0  # number of finished sweeps of all variants
    _counts: tuple[int, ...] = ()  # number of sweeps of each sensor
    _started: float = field(default_factory=time.monotonic)

    def augment(self, out: Path, client: Client | None, workers: int | None) -> AugmentedRecording:
        """Augment the missing sweeps, and write the copies that are not complete."""
        groups = self._groups()
        plan = open_plan(self._shared_plan(groups[0]))
        self._counts = tuple(len(part.recording) for part in plan.all_parts())
        self._check(plan)
        useful_workers = max(self._total // (_WORKER_SWEEPS if workers is None else 1), 1)
        with parallel_map(client, useful_workers, _WORKER_BYTES, workers) as run:
            for group in groups:
                self._augment_group(group, run)
        return self._summary(out)

    @property
    def _count(self) -> int:
        """Number of sweeps in a copy."""
        return sum(self._counts)

    @property
    def _total(self) -> int:
        """Number of sweeps in all copies."""
        return self._count * self.augmentation.variants.count

    def _groups(self) -> list[range]:
        """Return the variants in groups, whose sweeps are read only once."""
        count = self.augmentation.variants.count
        return [
            range(start, min(start + MAX_VARIANTS, count))
            for start in range(0, count, MAX_VARIANTS)
        ]

    def _check(self, plan: PlanProcess) -> None:
        """Raise LidarError if the recording cannot be augmented, before anything is written."""
        numbers = self.augmentation.numbers
        longest = max(self._counts)
        if numbers is not None and numbers.start >= longest:
            raise LidarError(
                f"{self.augmentation.file.path} has {plural(longest, 'sweep')}, so `--sweeps` must "
                f"start before {longest}, but starts at {numbers.start}."
            )
        parts = plan.all_parts()
        for part in parts:  # reports formats that cannot be written
            rewriter = part.rewriter
        for variant, target in enumerate(self.targets):
            if self.work.summary(variant) is None:
                rewriter.check_target(target, overwrite=self.work.may_replace(variant))
        if len(parts) > 1:
            self._check_several(plan)
        for index in range(min(len(parts), CHECKED_SENSORS)):
            part = plan.part(index)
            part.prepare(0)
            self._add_notes(part.notes())
        if len(parts) > CHECKED_SENSORS:
            others = plural(
                len(parts) - CHECKED_SENSORS,
                "further sensor or sequence",
                "further sensors or sequences",
            )
            self._add_notes([f"The notes of {others} are not shown."])

    def _check_several(self, plan: PlanProcess) -> None:
        """Raise LidarError if several sensors of the recording cannot be augmented together."""
        names = join_names([str(file.sensor) for file in self.files])
        path = self.augmentation.file.path
        if self.output is not None:
            raise LidarError(
                f"{path} contains {names}, but only one of them can be written in another format. "
                "Choose it with `--topic`."
            )
        has_insertions = any(effects.insertions for effects in plan.plan.variants.values())
        if has_insertions and not all(part.recording.sequence for part in plan.all_parts()):
            raise LidarError(
                f"{path} contains {names}, so the sensor to which `--at` refers is ambiguous. "
                "Choose it with `--topic`, or use `actors` in an effects file."
            )

    def _shared_plan(self, group: range) -> SharedPlan:
        augmentation = self.augmentation
        effects = {number: augmentation.variants.effects(number) for number in group}
        self._add_notes(note for one in effects.values() for note in one.notes)
        plan = AugmentationPlan(
            self.files,
            effects,
            augmentation.model,
            augmentation.numbers,
            self.output,
            augmentation.resampled,
            augmentation.reflectance,
            augmentation.partial,
        )
        key = fingerprint(dict(self.work.identity), str(self.work.folder), group.start)
        return SharedPlan.from_plan(key, self.work, plan)

    def _add_notes(self, notes: Iterable[str]) -> None:
        self._notes |= dict.fromkeys(notes)

    def _augment_group(self, group: range, run: MapFunction) -> None:
        """Augment the missing sweeps of some variants, and write their copies."""
        variants = [number for number in group if self.work.summary(number) is None]
        self._done += self._count * (len(group) - len(variants))
        if not variants:
            return
        shared = self._shared_plan(group)
        missing = [*self._missing(variants, open_plan(shared).all_parts())]
        pending = sum(len(sweep.variants) for sweep in missing)
        self._done += self._count * len(variants) - pending
        self._show_progress()
        results = run(augment_sweeps, self._tasks(shared, missing))
        for encoded in _closed_iteration(results):
            if encoded.files is not None:
                self.work.write(encoded.files)
            self._add_notes(encoded.notes)
            self._done += encoded.finished
            self._show_progress()
        self._check_unchanged()
        for variant in variants:
            self._write_copy(variant, open_plan(shared).all_parts())

    def _show_progress(self) -> None:
        self.progress(self._done, self._total)

    def _missing(
        self, variants: Sequence[int], parts: Sequence[PartProcess]
    ) -> Iterator[PlannedSweep]:
        """Yield the sweeps that are not encoded, with their variants."""
        work = self.work
        for index, part in enumerate(parts):
            rewriter = part.rewriter
            folders = [(variant, work.encoded(variant, index)) for variant in variants]
            for number in range(self._counts[index]):
                missing = [v for v, folder in folders if not rewriter.is_written(folder, number)]
                if missing:
                    yield PlannedSweep(index, number, tuple(missing))

    def _tasks(self, shared: SharedPlan, missing: Sequence[PlannedSweep]) -> Iterator[SweepTask]:
        """Yield tasks of consecutive sweeps, which are read in a single pass."""
        size = min(len(missing) // _MIN_TASKS + 1, _TASK_SWEEPS)
        for start in range(0, len(missing), size):
            yield SweepTask(shared, tuple(missing[start : start + size]))

    def _check_unchanged(self) -> None:
        """Raise LidarError if the recording has changed since the run began."""
        path = self.augmentation.file.path
        if fingerprint_files(path) != self.work.identity["recording"]:
            raise LidarError(
                f"{path} was changed while it was augmented. Start again with `--overwrite`."
            )

    def _write_copy(self, variant: int, parts: Sequence[PartProcess]) -> None:
        """Write the copy of a variant, and remove its encoded sweeps."""
        work = self.work
        counts = PointCounts.total(
            work.counts(variant, index, number)
            for index, count in enumerate(self._counts)
            for number in range(count)
        )
        overwrite = work.begin_output(variant)
        (first, folder), *others = (
            (part.rewriter, work.encoded(variant, index)) for index, part in enumerate(parts)
        )
        notes = first.finish(self.targets[variant], folder, overwrite=overwrite, others=others)
        work.end_output(variant, counts.to_json() | {"notes": list(notes)})

    def _summary(self, out: Path) -> AugmentedRecording:
        """Write the table of a campaign, remove the work folder, and return a summary."""
        variants = self.augmentation.variants
        summaries = [self.work.summary(number) or {} for number in range(variants.count)]
        self._add_notes(chain.from_iterable(summary["notes"] for summary in summaries))
        table = None
        if variants.is_campaign:
            table = out / TABLE_FILE
            columns = [
                {
                    "returns": summary["returns"],
                    "kept": summary["kept"],
                    "added": sum(summary["added"].values()),
                }
                for summary in summaries
            ]
            names = [target.name for target in self.targets]
            Storage(str(out)).write(TABLE_FILE, variants_table(variants, names, columns))
        self.work.remove()
        numbers = self.augmentation.numbers
        return AugmentedRecording(
            self.targets,
            table,
            sum(count if numbers is None else _overlap(numbers, count) for count in self._counts),
            PointCounts.total(summaries),
            time.monotonic() - self._started,
            tuple(self._notes),
        )


def _overlap(numbers: range, count: int) -> int:
    """Return how many of the first `count` sweeps are in a range."""
    return max(0, min(numbers.stop, count) - numbers.start)


@dataclass(frozen=True)
class _KeptFolder:
    """Context that keeps a work folder with sweeps if the body fails, or else removes it."""

    work: WorkFolder

    def __enter__(self) -> None:
        pass

    def __exit__(self, kind: Any, error: BaseException | None, traceback: Any) -> None:
        if error is None:
            return
        if self.work.has_sweeps:
            error.add_note(
                f"Finished sweeps are stored in {self.work.folder}. Continue with `--resume`."
            )
        else:
            self.work.remove()


def _closed_iteration(results: Iterable[EncodedFiles]) -> Iterator[EncodedFiles]:
    """Iterate over the results of a map, and cancel waiting tasks if the iteration stops early."""
    try:
        yield from results
    finally:
        close = getattr(results, "close", None)
        if close is not None:
            close()
