"""Augment all sweeps of a recording in worker processes, and write the augmented copy.

Sweeps are encoded independently of each other, and stored in a folder next to the output until it
is complete. An interrupted run continues with the missing sweeps, and its output has the same
bytes.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterable
from contextlib import ExitStack, closing, suppress
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lidarfiles.clouds.folder import result_folder
from lidarfiles.clouds.format_table import format_of_path, formats_of_endings
from lidarfiles.clouds.recording_ref import RecordingRef
from lidarfiles.clouds.writing import ExportSpec
from lidarfiles.recordings.opening import close_recordings, open_ref, sensor_refs
from lidarfiles.work.mapping import MapFunction, parallel_map
from lidarfiles.work.work import ONCE, FileStep, Inputs, Work
from lidarsim.errors import LidarError
from lidarsim.io.storage import Storage
from lidarsim.sensor import Sensor
from lidarsim.words import join_names, plural

from .rewriting.data_set_copy import MARK_FILE, check_target
from .rewriting.opening import check_sweeps
from .sweep_tasks import (
    CHECKED_SENSORS,
    MAX_VARIANTS,
    SUMMARY_FILE,
    AugmentationPlan,
    PlannedSweep,
    PlanProcess,
    PointCounts,
    SweepEncoder,
    encoded_folder,
)
from .variants import TABLE_FILE, Variants, outputs_in_table, variants_table

if TYPE_CHECKING:
    from lidarfiles.work.mapping import Client

_WORKER_BYTES = 2 << 30  # memory per process for a sensor with 128 channels
_WORKER_SWEEPS = 32  # starting a process takes about as long as augmenting this many sweeps
_TASK_SWEEPS = 8  # maximum number of consecutive sweeps that a process receives together
_MIN_TASKS = 64  # so that all workers are busy until the end, if there are enough sweeps
WORK_SUFFIX = ".augment"  # end of the name of the folder with the encoded sweeps
_ENCODE = FileStep("encode")
_BEGIN = FileStep("begin")  # an item for each copy that is being written
_FINISH = FileStep("finish")  # a summary of each copy that is complete
_REMOVE = FileStep("remove")  # copies of an earlier campaign that are not replaced

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

    file: RecordingRef
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
        restart: bool = False,
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
            Whether to continue an unfinished augmentation.
        restart
            Whether to remove an unfinished augmentation.
        overwrite
            Whether to replace existing copies.
        progress
            Function that is called with the numbers of finished and of all sweeps.

        Raises
        ------
        LidarError
            If the recording cannot be read or augmented, if the output exists or cannot be
            written, or if the unfinished augmentation has different inputs.
        """
        if resume and restart:
            raise LidarError("`resume` and `restart` cannot be combined.")
        out = Path(out)
        try:
            files = sensor_refs(replace(self.file, keep_noise=True))
            if len(files) == 1:
                check_sweeps(self.file.path, open_ref(files[0]))
            output = self._output()
            targets = self._targets(out, output)
            with ExitStack() as stack:
                if targets[0] != out:
                    stack.enter_context(result_folder(out))
                folder = out.with_name(f"{out.name}{WORK_SUFFIX}")
                stack.enter_context(result_folder(folder, shown=out))
                stack.callback(_remove_empty, folder)
                if not overwrite and not Work.is_unfinished(folder):
                    for target in targets:  # before the recording is hashed
                        check_target(target, self.file.path, overwrite=False)
                work = stack.enter_context(
                    Work.open(
                        folder,
                        self._inputs(),
                        noun="augmentation",
                        resume=resume,
                        restart=restart,
                        overwrite=overwrite,
                    )
                )
                run = _Run(self, files, output, work, targets, progress)
                return run.augment(out, client, workers)
        finally:
            close_recordings()

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

    def _inputs(self) -> Inputs:
        numbers = self.numbers
        options = (
            str(self.file.folder / self.file.path),
            self.file.sensor,
            self.file.intensity,
            None if numbers is None else [numbers.start, numbers.stop],
            self.output_format,
            self.reflectance,
            self.partial,
        )
        values = {
            "effects": self.variants.identity,
            "model": self.model,
            "sensor": self.resampled,
            "options": options,
        }
        return Inputs({"recording": self.file.path}, values)


@dataclass(eq=False)
class _Run:
    """Run of an augmentation, which stores encoded sweeps until its copies are complete."""

    augmentation: Augmentation
    files: tuple[RecordingRef, ...]  # the recording, once for each sensor
    output: ExportSpec | None
    work: Work
    targets: tuple[Path, ...]
    progress: ShowProgress
    _notes: dict[str, None] = field(default_factory=dict)  # in the order of their discovery
    _done: int = 0  # number of finished sweeps of all variants
    _counts: tuple[int, ...] = ()  # number of sweeps of each sensor
    _started: float = field(default_factory=time.monotonic)

    def augment(self, out: Path, client: Client | None, workers: int | None) -> AugmentedRecording:
        """Augment the missing sweeps, and write the copies that are not complete."""
        groups = self._groups()
        encoder = self._encoder(groups[0])
        self._counts = tuple(len(part.recording) for part in encoder.process.all_parts())
        self._check(encoder.process)
        useful_workers = max(self._total // (_WORKER_SWEEPS if workers is None else 1), 1)
        with parallel_map(client, useful_workers, _WORKER_BYTES, workers) as run:
            for group in groups:
                if group.start:
                    encoder = self._encoder(group)
                self._augment_group(group, encoder, run)
        return self._end(out)

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
            if self._summary(variant) is None:
                rewriter.check_target(target, overwrite=self._may_replace(variant))
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
        if has_insertions and not all(part.recording.info.sequence for part in plan.all_parts()):
            raise LidarError(
                f"{path} contains {names}, so the sensor to which `--at` refers is ambiguous. "
                "Choose it with `--topic`, or use `actors` in an effects file."
            )

    def _encoder(self, group: range) -> SweepEncoder:
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
        return SweepEncoder(plan)

    def _summary(self, variant: int) -> dict[str, Any] | None:
        """Return the summary of a variant whose copy is complete, or None."""
        files = self.work.find(_FINISH, f"{variant:04}")
        return None if files is None else _read_json(files[SUMMARY_FILE])

    def _may_replace(self, variant: int) -> bool:
        """Return whether the copy of a variant may be replaced if it exists.

        This is the case if the user has asked for it, or if this run was stopped while it wrote the
        copy.
        """
        return self.work.overwrites or self.work.find(_BEGIN, f"{variant:04}") is not None

    def _add_notes(self, notes: Iterable[str]) -> None:
        self._notes |= dict.fromkeys(notes)

    def _augment_group(self, group: range, encoder: SweepEncoder, run: MapFunction) -> None:
        """Augment the missing sweeps of some variants, and write their copies."""
        variants = [number for number in group if self._summary(number) is None]
        self._done += self._count * (len(group) - len(variants))
        if not variants:
            return
        sweeps = [
            PlannedSweep(variant, part, number)
            for part, count in enumerate(self._counts)
            for number in range(count)
            for variant in variants  # the sweep is read once
        ]
        keys = [sweep.key for sweep in sweeps]
        stored = self.work.count(_ENCODE, keys)
        missing = (len(sweeps) - stored) // len(variants)
        chunk = min(missing // _MIN_TASKS + 1, _TASK_SWEEPS) * len(variants)
        self._show_progress(stored)
        counts: dict[int, list[dict[str, Any]]] = {variant: [] for variant in variants}
        with closing(self.work.each(_ENCODE, run, encoder, sweeps, keys, chunk)) as results:
            for done, (sweep, files) in enumerate(zip(sweeps, results, strict=True), 1):
                summary = _read_json(files[SUMMARY_FILE])
                self._add_notes(summary.pop("notes"))
                counts[sweep.variant].append(summary)
                if done > stored:
                    self._show_progress(done)
        self._done += len(sweeps)
        for variant in variants:
            self._write_copy(variant, encoder.process, PointCounts.total(counts[variant]))

    def _show_progress(self, done: int) -> None:
        """Report the number of finished sweeps, including those of a group."""
        self.progress(self._done + done, self._total)

    def _write_copy(self, variant: int, process: PlanProcess, counts: PointCounts) -> None:
        """Write the copy of a variant, and remove its encoded sweeps."""
        work = self.work
        (first, folder), *others = (
            (part.rewriter, work.folder(_ENCODE) / encoded_folder(variant, index))
            for index, part in enumerate(process.all_parts())
        )
        target = self.targets[variant]
        first.check_target(target, overwrite=self._may_replace(variant))
        is_campaign = self.augmentation.variants.is_campaign
        # The table of an earlier campaign would not belong to the new copy.
        with work.publishing_whole(target, [TABLE_FILE] if is_campaign else []) as staged:
            notes = first.finish(staged, folder, others)
            work.once(_BEGIN, dict, f"{variant:04}")
            if is_campaign:
                work.once(_REMOVE, partial(self._find_earlier, target.parent))
        summary = counts.to_json() | {"notes": notes}
        content = {SUMMARY_FILE: json.dumps(summary).encode()}
        work.once(_FINISH, lambda: content, f"{variant:04}")
        work.forget(_ENCODE, f"{variant:04}")

    def _find_earlier(self, out: Path) -> dict[str, bytes]:
        """Return the names of the copies of an earlier campaign that are not replaced."""
        kept = {target.name for target in self.targets}
        return {
            name: b""
            for name in outputs_in_table(out / TABLE_FILE)
            if name not in kept and ((out / name).is_file() or (out / name / MARK_FILE).exists())
        }

    def _remove_earlier(self, out: Path) -> None:
        """Remove the copies of an earlier campaign that are not replaced."""
        for name in self.work.find(_REMOVE, ONCE) or ():
            Storage.at(out).discard(name)

    def _end(self, out: Path) -> AugmentedRecording:
        """Write the table of a campaign, remove the stored results, and return a summary."""
        variants = self.augmentation.variants
        summaries = [self._summary(number) or {} for number in range(variants.count)]
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
            self._remove_earlier(out)
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


def _remove_empty(folder: Path) -> None:
    with suppress(OSError):
        folder.rmdir()


def _read_json(path: Path) -> dict[str, Any]:
    content: dict[str, Any] = json.loads(path.read_bytes())
    return content
