"""Merges shards, done by several clusters, into the data set or result of one run."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import asdict, dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

from lidarsim.errors import LidarError, MissingFileError, Mistakes, as_sentence, explained
from lidarsim.io.storage import Storage
from lidarsim.schema.checks import check_list, check_type
from lidarsim.words import listed

from ..clouds.folder import LAST_FILE, check_exists, output_destination, result_folder
from ..columns.parts import part_name
from ..datasets.dataset import INDEX_FILE, DataSet, manifest_file, read_ahead
from ..datasets.job_seconds import known_seconds, read_seconds
from ..datasets.job_table import JobRow
from ..identity.field_words import describe_changes
from ..identity.fingerprint import fingerprint
from ..identity.shard import ALL, Shard
from ..identity.software import software
from ..open3d_access.open3d_module import load_open3d
from ..plan import Trial
from ..run.committed import Committed
from ..run.job_source import OneJob
from ..run.options import RunOptions
from ..run.pipeline.committed_results import CommittedResults
from ..run.pipeline.stage_messages import Receipt
from ..run.progress import Screen
from ..run.run_result import CampaignRun
from ..run.runner import open_store
from ..run.store.database import FILE, DamagedError, RunDatabase
from ..run.store.remote import fetch_database
from ..run.store.run_store import RUN_FOLDER, RunStore, parts_of, remove_run, with_sensors
from ..scenario.empty_cloud import NO_POINTS, empty_jobs_warning
from ..scenario.prepare import prepare
from ..scenario.scenario import Scenario
from .campaign_output import (
    CAMPAIGN_FILE,
    dataset_files,
    read_notes,
    read_record,
    write_record,
    write_shared,
)
from .output import SurveyOutput

MAX_NAMED = 20  # shards or files in a message
_BATCH_ROWS = 1000  # rows of jobs in a transaction
_MISSING = "these shards are missing: "  # begins a note


@dataclass(frozen=True)
class _ShardFolder:
    """Shards of a run in a folder.

    `record` is the content of CAMPAIGN_FILE of a data set, and `run_size` the number of all jobs or
    scans of the run. `notes` are the notes of its report. Only surveys have parts and trials.
    """

    storage: Storage
    record: Mapping[str, Any]
    shards: Sequence[Shard]
    run_size: int
    notes: Sequence[str]
    parts: Sequence[Receipt] = ()
    trials: Sequence[Trial] = ()

    def numbers(self, shard: Shard) -> range:
        return (shard.jobs if "campaign" in self.record else shard.scans)(self.run_size)

    @cached_property
    def ranges(self) -> Sequence[range]:
        """Numbers of the jobs or scans of each shard."""
        return [self.numbers(shard) for shard in self.shards]

    def has(self, number: int) -> bool:
        """Return True if a job or scan is in one of the shards."""
        return any(number in numbers for numbers in self.ranges)

    @property
    def common(self) -> dict[str, Any]:
        """Properties that all shard folders must have in common, {name: value}."""
        record = self.record
        properties = {"kind": [*record["identity"]]} | record["identity"]
        properties |= {f"the file {name}": digest for name, digest in record["files"]}
        # No software is recorded if the shard has cast no rays.
        properties |= {
            f"the {name} of the workers": value for name, value in record["casting"].items()
        }
        return properties | ({"the number of shards": self.shards[0].total} if self.shards else {})


def merge(
    shards: Sequence[str | Path | Storage],
    out: str | Path | Storage,
    *,
    partial: bool = False,
    scenario: str | Path | None = None,
    screen: Screen | None = None,
) -> dict[str, Any]:
    """Merge shards into the data set or result that a single run would have written.

    Every byte is verified with the checksums of its shard. The rows of the jobs are read from the
    manifests of the jobs, which also have checksums. If the merge is interrupted, the same call
    resumes it.

    Parameters
    ----------
    shards, out
        Folders or URLs of the shards of one campaign or survey, and of the merged data set or
        result. Shards can be added to a data set later. `out` must not be inside a shard or contain
        a shard.
    partial
        Whether to merge the available shards if others are missing. A note lists the missing
        shards.
    scenario
        Scenario or mesh file of a survey, if it has been moved since the shards were run.
    screen
        Object that shows the progress. By default, the progress is logged.

    Returns
    -------
    The contents of report.json.

    Raises
    ------
    LidarError
        If shards are missing, damaged, passed twice or unfinished, or come from different runs or
        software versions. The message names the shards.
    """
    check_list("shards", shards)
    check_type("out", out, str, Path, Storage)
    target = output_destination(str(out))
    screen = screen or Screen()
    shard_storages = {_real_path(storage): storage for storage in map(Storage.at, shards)}
    _check_apart(Storage.at(target), shard_storages)
    is_survey_shard = False
    with suppress(LidarError):  # the result would have the place of the shard's points
        is_survey_shard = "made_of" in _read_folder(Storage.at(target)).record
    if is_survey_shard:
        raise LidarError(
            f"{target} contains a shard of a survey. Specify another folder with `--out`."
        )
    shard_folders = list[_ShardFolder]()
    mistakes = Mistakes()
    for storage in shard_storages.values():
        with mistakes.noted():
            shard_folders.append(_read_folder(storage))
    if not shard_storages:
        mistakes.lines = ["There are no shards to merge. Specify the folders of the shards."]
    if not (partial and shard_folders):
        mistakes.tell()
    if "made_of" in shard_folders[0].record:
        return _merge_survey(shard_folders, target, partial, scenario, screen)
    with result_folder(target), screen.status("merging the data set"):
        return _merge_dataset(shard_folders, Storage.at(target), partial, screen)


def _real_path(storage: Storage) -> str:
    """Return the same path for a folder by any path or URL, which may lead through links."""
    scheme, separator, path = storage.url.partition("://")
    if separator and scheme not in ("file", "local"):
        return storage.url
    return str(Path(path or storage.url).resolve())


def _check_apart(target: Storage, shard_storages: Mapping[str, Storage]) -> None:
    """Check that `target` is apart from all places of shards, {`_real_path`: place}."""
    path = _real_path(target)
    for real, storage in shard_storages.items():
        relation = ""
        if path == real:
            relation = "is one of the shards"
        elif f"{path}/".startswith(f"{real.rstrip('/')}/"):
            relation = f"is inside the shard {storage}"
        elif f"{real}/".startswith(f"{path.rstrip('/')}/"):
            relation = f"contains the shard {storage}"
        if relation:
            raise LidarError(
                f"The output folder {target} {relation}, which must not be changed. Specify "
                "another folder with `--out`, or omit that shard."
            )


def _read_folder(storage: Storage) -> _ShardFolder:
    """Read a finished shard or a data set of several shards, or raise LidarError."""
    check_exists(storage, "specify the output folder of `lidarpool run --shard`")
    with explained(f"{storage} cannot be read"):
        files = storage.sizes()
        run = storage.below(RUN_FOLDER)
        if {CAMPAIGN_FILE, INDEX_FILE, LAST_FILE} <= files.keys():
            return _read_dataset(storage)
        if FILE in run.sizes():
            with suppress(LookupError):
                return _read_survey(storage, run)
    raise LidarError(
        f"{storage} contains no finished shard. Specify the output folder of `lidarpool run "
        "--shard`, and finish an unfinished shard with `--resume`."
    )


def _read_dataset(storage: Storage, shard_count: int = 1) -> _ShardFolder:
    """Read a data set of shards, which are `shard_count` shards if it is complete."""
    record = read_record(storage)
    shards = [Shard.parse(text) for text in record["shards"]]
    if shards == [ALL]:
        shards = [Shard(number, shard_count) for number in range(1, shard_count + 1)]
    notes = read_notes(storage) if LAST_FILE in storage.sizes() else []
    notes = [note for note in notes if not note.startswith(_MISSING) and NO_POINTS not in note]
    return _ShardFolder(storage, record, shards, record["campaign"]["count"], notes)


def _read_survey(storage: Storage, run: Storage) -> _ShardFolder:
    """Read a shard of a survey.

    Raises LookupError for an unfinished shard or another run.

    LidarError if the database is damaged.
    """
    with tempfile.TemporaryDirectory(prefix="lidarpool-") as folder:
        path = Path(folder, FILE)
        fetch_database(run, path)
        try:
            with closing(RunDatabase(path, durable=False)) as db:
                meta = {"casting": "{}", "fields": "{}"} | db.meta
                texts = ("identity", "fields", "casting", "made_of")
                record = {**meta, "files": [], **{name: json.loads(meta[name]) for name in texts}}
                shard = Shard.parse(record["identity"].pop("shard"))
                scan_count = record["made_of"]["scans"]
                job = CommittedResults(0, shard.scans(scan_count))
                db.read(job)
                if job.missing_count:
                    raise LookupError("scans are missing")
                notes = json.loads(meta["notes"])
                parts = job.parts.ordered
                return _ShardFolder(storage, record, [shard], scan_count, notes, parts, job.trials)
        except DamagedError as error:
            raise LidarError(
                f"{run.path(FILE)} is damaged. Run its shard again with `--resume`, which "
                "recreates the file from the points, and merge again."
            ) from error


def _check_same_run(
    shard_folders: Sequence[_ShardFolder], earlier: _ShardFolder | None = None
) -> None:
    """Raise LidarError, which names wrong folders, unless folders have shards of the same run.

    Shards of the `earlier` data set may be in further folders, too.
    """
    mistakes = Mistakes()
    expected = software()
    first = "the installed software"
    first_fields: Mapping[str, str] = {}
    folders_by_shard = dict[int, _ShardFolder]()
    for folder in sorted(shard_folders, key=lambda folder: not folder.record["casting"]):
        is_alone = len(shard_folders) == 1 + bool(earlier)
        if folder.shards == [ALL] and folder is not earlier and not is_alone:
            mistakes.lines.append(
                f"{folder.storage} is a complete run. Specify it alone, or omit it."
            )
            continue
        common = folder.common
        fields = folder.record["fields"]
        differs = [name for name in expected if common.get(name, expected[name]) != expected[name]]
        if differs:
            changed = describe_changes(first_fields, fields) if first_fields else ""
            mistakes.lines.append(
                f"{folder.storage} and {first} differ in "
                f"{differs[0]}{f' ({changed})' * bool(changed)}. Merge only shards of a single run "
                "that used the same software."
            )
        elif len(common) > len(expected):
            expected = common
            first = str(folder.storage)
            first_fields = fields
        for shard in folder.shards if folder is not earlier else ():
            other = folders_by_shard.setdefault(shard.number, folder)
            if other is not folder:
                mistakes.lines.append(
                    f"Shard {shard} is in both {other.storage} and {folder.storage}. Specify only "
                    "one of these folders."
                )
    mistakes.tell()


def _notes(shard_folders: Sequence[_ShardFolder], *, partial: bool) -> list[str]:
    """Return the notes of all folders and on missing shards, which need `partial`."""
    notes = [*dict.fromkeys(note for folder in shard_folders for note in folder.notes)]
    if not (missing := _missing(shard_folders)):
        return notes
    message = f"{_MISSING}{listed([*map(str, missing)], MAX_NAMED)}"
    if partial:
        return [*notes, message]
    advice = "Specify their folders as well"
    if any(shard in folder.shards for folder in shard_folders for shard in missing):
        advice = "Run them again with the larger count and `--resume`"
    raise LidarError(
        f"{as_sentence(message)} {advice}, or merge only the existing shards with `--partial`."
    )


def _missing_or_damaged(names: Sequence[str]) -> str:
    return (
        f"These files are missing or damaged: {listed(names, MAX_NAMED)}. Run their shards "
        "again with `--resume`, or campaigns with `--verify`, and merge again."
    )


def _missing(shard_folders: Sequence[_ShardFolder]) -> list[Shard]:
    """List the shards that are missing, or lack jobs that the campaign has gained."""
    shard_count = shard_folders[-1].shards[0].total
    folders = sorted(shard_folders, key=lambda folder: folder.run_size)
    have = {
        shard.number: len(folder.numbers(shard)) for folder in folders for shard in folder.shards
    }
    have.setdefault(1, -1)  # which plans the path, even if it has no scans
    every = (Shard(number, shard_count) for number in range(1, shard_count + 1))
    return [shard for shard in every if have.get(shard.number, 0) < len(folders[-1].numbers(shard))]


def _merge_dataset(
    shard_folders: Sequence[_ShardFolder], target: Storage, partial: bool, screen: Screen
) -> dict[str, Any]:
    begun = CAMPAIGN_FILE in target.sizes()
    dataset_files(target, begun=begun)
    earlier = _read_dataset(target, shard_count=shard_folders[0].shards[0].total) if begun else None
    all_folders = [earlier, *shard_folders] if earlier else shard_folders
    _check_same_run(all_folders, earlier)
    notes = _notes(all_folders, partial=partial)
    record = _merged_record(all_folders, shard_folders[0])
    dataset = DataSet(replace(target, durable=False), **record["campaign"]["keep"])
    dataset.check_installed()
    if earlier is None:  # the files belong to the campaign now
        write_record(target, record | {"shards": []})
    with (
        tempfile.TemporaryDirectory(prefix="lidarpool-") as folder,
        closing(RunDatabase(Path(folder, FILE), durable=False)) as db,
    ):

        def rows() -> Iterator[JobRow]:
            return map(JobRow.from_json, db.job_rows())

        damaged = list[str]()
        with explained(f"{target} cannot be merged"):
            seconds = dict[int, float]()
            if earlier:  # after a killed merge without casting times: no note
                seconds |= known_seconds(target)
                earlier_rows = (row for row, _ in dataset.rows() if earlier.has(row.number))
                _add_rows(db, earlier, earlier_rows, seconds)
            for shard_folder in shard_folders:
                taken = _take_jobs(shard_folder, dataset, damaged)
                seconds |= _seconds(shard_folder, notes)
                _add_rows(db, shard_folder, taken, seconds)
        damaged = damaged or _lacking(all_folders, db)
        if damaged:
            raise LidarError(_missing_or_damaged(damaged))
        lacking = _missing(all_folders)
        shards = {shard for shard_folder in all_folders for shard in shard_folder.shards}
        record["shards"] = [*map(str, sorted(shards.difference(lacking)) if lacking else [ALL])]
        if empty := [row for row in rows() if row.done and not row.points]:
            notes.append(empty_jobs_warning(empty, ""))
            screen.warn(notes[-1])
        sensors = record["sensors"]
        run = CampaignRun.from_rows(rows(), 0.0, 0, sensors=sensors, notes=tuple(notes))
        report = write_shared(dataset, record, run, rows)[1]
    if earlier:  # a run with failed jobs would continue with its knowledge of these jobs
        remove_run(target.below(RUN_FOLDER))
    return report


def _merged_record(shard_folders: Sequence[_ShardFolder], fallback: _ShardFolder) -> dict[str, Any]:
    """Return the content of CAMPAIGN_FILE for a data set of shard folders.

    The software is the software of a shard folder with cast rays, else of the fallback.
    """
    sensors = dict[str, str]()
    for folder in shard_folders:
        sensors = with_sensors(sensors, folder.record["sensors"].items())
    cast = next((folder for folder in shard_folders if folder.record["casting"]), fallback)
    campaign = max(shard_folders, key=lambda folder: folder.run_size).record["campaign"]
    return {**cast.record, "sensors": sensors, "campaign": campaign}


def _add_rows(
    db: RunDatabase,
    shard_folder: _ShardFolder,
    rows: Iterable[JobRow],
    seconds: Mapping[int, float],
) -> None:
    """Add the rows of a shard folder, with casting times {number: seconds}, to those of all jobs.

    A job that has failed there stays as it is. LidarError if the shard folder cannot have such a
    job, or two manifests are of one job.
    """
    added = set[int]()
    batch = list[tuple[int, bool, dict[str, Any]]]()  # a transaction for each row would be slow
    for row in rows:
        number = row.number
        path = shard_folder.storage.path(manifest_file(row.name))
        if not shard_folder.has(number):
            raise LidarError(
                f"{path} belongs to job {number}, which is not in shard "
                f"{listed([*map(str, shard_folder.shards)])} of {shard_folder.run_size:,} jobs. "
                "Move the file elsewhere, and merge again."
            )
        if number in added:
            raise LidarError(
                f"{path} belongs to job {number}, which has another manifest. Move one of the "
                "manifests elsewhere, and merge again."
            )
        added.add(number)
        if row.done or not db.ended(number):
            row = replace(row, seconds=seconds.get(number))
            batch.append((number, bool(row.error), asdict(row)))
        if len(batch) == _BATCH_ROWS:
            db.end_jobs(batch)
            batch.clear()
    db.end_jobs(batch)


def _take_jobs(
    shard_folder: _ShardFolder, dataset: DataSet, damaged: list[str]
) -> Iterator[JobRow]:
    """Copy the jobs of a shard folder, yield their rows, and add files to `damaged`."""
    for _, row, wrong in dataset.copy_jobs(
        shard_folder.storage, fingerprint(dict(shard_folder.record["identity"]))
    ):
        damaged += [wrong] if wrong else []
        if row is not None:
            yield row


def _seconds(shard_folder: _ShardFolder, notes: list[str]) -> Mapping[int, float]:
    """Return the casting times of jobs, {number: seconds}, or add a note that they are lost."""
    if not shard_folder.shards:
        return {}
    try:
        return read_seconds(shard_folder.storage)
    except LidarError as error:
        notes.append(str(error).rstrip("."))
    return {}


def _lacking(shard_folders: Sequence[_ShardFolder], db: RunDatabase) -> list[str]:
    """List the jobs of shard folders that have no row, as a folder and a number."""
    return [
        f"the manifest of job {number} in {folder.storage}"
        for folder in shard_folders
        for numbers in folder.ranges
        for number in numbers
        if not db.ended(number)
    ]


def _merge_survey(
    shard_folders: Sequence[_ShardFolder],
    out: Path | Storage,
    partial: bool,
    scenario: str | Path | None,
    screen: Screen,
) -> dict[str, Any]:
    """Build the survey again, and write its result from the points of all folders."""
    _check_same_run(shard_folders)
    notes = _notes(shard_folders, partial=partial)
    record = shard_folders[0].record
    made_of = record["made_of"]
    path = Path(scenario or made_of["path"])
    if not path.exists():
        raise MissingFileError(
            f"{path}, the scenario of these shards, does not exist. Specify its new path with "
            "`--scenario`."
        )
    with screen.status("reading the scene"):
        prepared = prepare(Scenario.load(path, made_of["options"]))
        job = prepared.job
        jobs = OneJob(job)
        identity = jobs.identity
    if differs := [name for name in identity if identity[name] != record["identity"][name]]:
        changed = describe_changes(record["fields"], jobs.fields)
        raise LidarError(
            f"{path} does not match these shards, because its {differs[0]} is "
            f"different{f' ({changed})' * bool(changed)}. Specify the scenario of the shards "
            "with `--scenario`."
        )
    output = SurveyOutput(out, job.survey, job.outputs, made_of["extent"], prepared.scenario)
    options = RunOptions(folder=Storage.at(out).below(RUN_FOLDER), resume=True)
    with output.lock() as folder:
        if not options.continues_run:
            output.check_existing(jobs)
        with open_store(jobs, options, screen) as store:
            _take_points(store, shard_folders, notes)
            load_open3d()
            result = Committed(store).result(screen)
            return output.publish(folder, result, store, screen)[1]


def _take_points(
    store: RunStore, shard_folders: Sequence[_ShardFolder], notes: Sequence[str]
) -> None:
    """Take the points of all folders into a store, or raise LidarError for damaged files."""
    damaged = list[str]()
    only = store.only_job
    mark = store.db.meta["mark"]
    assert only is not None, "of a survey"

    def take(source: Storage, part_file: Receipt) -> Receipt | None:
        """Take a file and return its receipt, or None if the file is missing or damaged."""
        name = part_name(mark, 0, part_file.first, part_file.stop)
        with (
            explained(f"{source.path(part_file.name)} cannot be copied"),
            suppress(FileNotFoundError),
        ):
            store.storage.copy_from(source, part_file.name, name)
            receipt = only.receipt(name)
            if receipt and replace(receipt, name=part_file.name, summaries=b"") == part_file:
                return receipt
            store.storage.remove([name])
        return None

    for shard_folder in shard_folders:
        if casting := shard_folder.record["casting"]:
            store.cast_with(shard_folder.record["backend"], casting)
        if shard_folder.trials and not only.trials:
            store.db.add_trials(only.committed, shard_folder.trials)
        source = parts_of(shard_folder.storage.below(RUN_FOLDER), shard_folder.record["parts"])
        missing = (
            receipt
            for receipt in shard_folder.parts
            if only.parts.missing(receipt.first, receipt.stop)
        )
        for expected, receipt in read_ahead(partial(take, source), missing):
            if receipt is None or not store.db.commit([(only.committed, receipt)]):
                damaged.append(source.path(expected.name))
    if damaged:
        raise LidarError(_missing_or_damaged(damaged))
    # Without trials, the first shard, which plans, is missing.
    store.take_over(only.job if only.trials else replace(only.job, planning=None))
    store.notes = [*notes]
