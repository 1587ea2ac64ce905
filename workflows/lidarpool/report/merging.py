"""Merge shards that ran separately into a single data set or result."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import asdict, dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

from lidarfiles.clouds.folder import LAST_FILE, check_exists, output_destination, result_folder
from lidarfiles.datasets.dataset import INDEX_FILE, DataSet, manifest_file, read_ahead
from lidarfiles.datasets.job_seconds import known_seconds, read_seconds
from lidarfiles.datasets.job_table import JobRow
from lidarfiles.identity.field_words import describe_changes
from lidarfiles.identity.fingerprint import fingerprint
from lidarfiles.identity.versions import software
from lidarfiles.open3d_access.open3d_module import load_open3d
from lidarfiles.parts.parts import part_name
from lidarscenario.empty_cloud import NO_POINTS, empty_jobs_warning
from lidarscenario.plan import Trial
from lidarscenario.prepare import prepare
from lidarscenario.scenario import Scenario
from lidarscenario.shard import ALL, Shard
from lidarsim.errors import LidarError, MissingFileError, Mistakes, as_sentence, explain_os_errors
from lidarsim.io.storage import Storage
from lidarsim.schema.checks import check_list, check_type
from lidarsim.words import list_names

from ..run.committed import CommittedRun
from ..run.job_source import SingleJob
from ..run.options import RunOptions
from ..run.pipeline.committed_results import CommittedResults
from ..run.pipeline.stage_messages import Receipt
from ..run.progress import Screen
from ..run.run_result import CampaignRun
from ..run.runner import open_store
from ..run.store.database import FILE, DamagedError, RunDatabase
from ..run.store.remote import fetch_database
from ..run.store.run_store import RUN_FOLDER, RunStore, add_sensors, parts_of, remove_run
from .campaign_output import (
    CAMPAIGN_FILE,
    list_dataset_files,
    read_notes,
    read_record,
    write_record,
    write_shared_files,
)
from .output import SurveyOutput

MAX_NAMED = 20  # maximum number of shards or files listed in a message
_BATCH_ROWS = 1000  # job rows per transaction
_MISSING_NOTE = "these shards are missing: "  # start of a note


@dataclass(frozen=True)
class _ShardFolder:
    """Folder with one or more shards of a run.

    For a data set, `record` is the content of CAMPAIGN_FILE. For a survey, it contains the
    corresponding metadata of the run. `run_size` is the number of jobs or scans in the whole run,
    and `notes` are the notes of the shard's report. Only surveys have `parts` and `trials`.
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
        return [self.numbers(shard) for shard in self.shards]

    def has(self, number: int) -> bool:
        return any(number in numbers for numbers in self.ranges)

    @property
    def common(self) -> dict[str, Any]:
        """Properties that must be equal in all shard folders, as {name: value}."""
        record = self.record
        properties = {"kind": [*record["identity"]]} | record["identity"]
        properties |= {f"the file {name}": digest for name, digest in record["files"]}
        # The versions on the workers are not recorded for a shard without rays.
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

    The checksums of all files are verified. If the merge is interrupted, call this function again
    with the same arguments to resume it.

    Parameters
    ----------
    shards
        Folders or URLs of the shards of a campaign or survey.
    out
        Folder or URL of the merged data set or result. It must not be inside a shard or contain a
        shard. More shards can be added to a merged data set later.
    partial
        Whether to merge the available shards if others are missing. A note lists the missing
        shards.
    scenario
        Scenario or mesh file of the survey, if it has been moved since the shards were run.
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
    _check_separate(Storage.at(target), shard_storages)
    is_survey_shard = False
    with suppress(LidarError):  # the result would overwrite the points of the shard
        is_survey_shard = "scenario_source" in _read_folder(Storage.at(target)).record
    if is_survey_shard:
        raise LidarError(
            f"{target} contains a shard of a survey. Specify another folder with `--out`."
        )
    shard_folders = list[_ShardFolder]()
    mistakes = Mistakes()
    for storage in shard_storages.values():
        with mistakes.collect():
            shard_folders.append(_read_folder(storage))
    if not shard_storages:
        mistakes.lines = ["There are no shards to merge. Specify the folders of the shards."]
    if not (partial and shard_folders):
        mistakes.raise_if_any()
    if "scenario_source" in shard_folders[0].record:
        return _merge_survey(shard_folders, target, partial, scenario, screen)
    with result_folder(target), screen.status("merging the data set"):
        return _merge_dataset(shard_folders, Storage.at(target), partial, screen)


def _real_path(storage: Storage) -> str:
    """Return a remote storage's URL, or a local folder's absolute path without symbolic links."""
    scheme, separator, path = storage.url.partition("://")
    if separator and scheme not in ("file", "local"):
        return storage.url
    return str(Path(path or storage.url).resolve())


def _check_separate(target: Storage, shard_storages: Mapping[str, Storage]) -> None:
    """Raise LidarError if `target` is a shard, or is inside a shard or contains one.

    `shard_storages` maps the result of `_real_path` to the storage.
    """
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
    """Read a finished shard, or a data set that consists of several shards.

    Raise LidarError if the folder contains no finished shard.
    """
    check_exists(storage, "specify the output folder of `lidarpool run --shard`")
    with explain_os_errors(f"{storage} cannot be read"):
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
    """Read a data set that consists of shards.

    A complete data set counts as `shard_count` shards.
    """
    record = read_record(storage)
    shards = [Shard.parse(text) for text in record["shards"]]
    if shards == [ALL]:
        shards = [Shard(number, shard_count) for number in range(1, shard_count + 1)]
    notes = read_notes(storage) if LAST_FILE in storage.sizes() else []
    notes = [note for note in notes if not note.startswith(_MISSING_NOTE) and NO_POINTS not in note]
    return _ShardFolder(storage, record, shards, record["campaign"]["count"], notes)


def _read_survey(storage: Storage, run: Storage) -> _ShardFolder:
    """Read a shard of a survey.

    Raises
    ------
    LookupError
        If the shard is unfinished, or if the folder contains a different kind of run.
    LidarError
        If the database is damaged.
    """
    with tempfile.TemporaryDirectory(prefix="lidarpool-") as folder:
        path = Path(folder, FILE)
        fetch_database(run, path)
        try:
            with closing(RunDatabase(path, durable=False)) as db:
                meta = {"casting": "{}", "fields": "{}"} | db.meta
                texts = ("identity", "fields", "casting", "scenario_source")
                record = {**meta, "files": [], **{name: json.loads(meta[name]) for name in texts}}
                shard = Shard.parse(record["identity"].pop("shard"))
                scan_count = record["scenario_source"]["scans"]
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
    """Raise LidarError unless all folders contain different shards of the same run.

    The message lists the folders that do not match. Shards that the `earlier` data set already
    contains may be passed again.
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
    mistakes.raise_if_any()


def _collect_notes(shard_folders: Sequence[_ShardFolder], *, partial: bool) -> list[str]:
    """Return the notes of all folders, with a note about missing shards if there are any.

    Raise LidarError if shards are missing and `partial` is False.
    """
    notes = [*dict.fromkeys(note for folder in shard_folders for note in folder.notes)]
    if not (missing := _missing_shards(shard_folders)):
        return notes
    message = f"{_MISSING_NOTE}{list_names([*map(str, missing)], MAX_NAMED)}"
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
        f"These files are missing or damaged: {list_names(names, MAX_NAMED)}. Run their shards "
        "again with `--resume`, or campaigns with `--verify`, and merge again."
    )


def _missing_shards(shard_folders: Sequence[_ShardFolder]) -> list[Shard]:
    """Return the shards that are missing, or that lack jobs because the campaign has grown."""
    shard_count = shard_folders[-1].shards[0].total
    folders = sorted(shard_folders, key=lambda folder: folder.run_size)
    have = {
        shard.number: len(folder.numbers(shard)) for folder in folders for shard in folder.shards
    }
    have.setdefault(1, -1)  # shard 1 is always required, because it plans the path
    every = (Shard(number, shard_count) for number in range(1, shard_count + 1))
    return [shard for shard in every if have.get(shard.number, 0) < len(folders[-1].numbers(shard))]


def _merge_dataset(
    shard_folders: Sequence[_ShardFolder], target: Storage, partial: bool, screen: Screen
) -> dict[str, Any]:
    begun = CAMPAIGN_FILE in target.sizes()
    list_dataset_files(target, begun=begun)
    earlier = _read_dataset(target, shard_count=shard_folders[0].shards[0].total) if begun else None
    all_folders = [earlier, *shard_folders] if earlier else shard_folders
    _check_same_run(all_folders, earlier)
    notes = _collect_notes(all_folders, partial=partial)
    record = _merged_record(all_folders, shard_folders[0])
    dataset = DataSet(replace(target, durable=False), **record["campaign"]["keep"])
    dataset.check_installed()
    if earlier is None:  # marks the folder as a data set of this campaign
        write_record(target, record | {"shards": []})
    with (
        tempfile.TemporaryDirectory(prefix="lidarpool-") as folder,
        closing(RunDatabase(Path(folder, FILE), durable=False)) as db,
    ):

        def rows() -> Iterator[JobRow]:
            return map(JobRow.from_json, db.job_rows())

        damaged = list[str]()
        with explain_os_errors(f"{target} cannot be merged"):
            seconds = dict[int, float]()
            if earlier:  # casting times may be missing after an interrupted merge
                seconds |= known_seconds(target)
                earlier_rows = (row for row, _ in dataset.rows() if earlier.has(row.number))
                _add_rows(db, earlier, earlier_rows, seconds)
            for shard_folder in shard_folders:
                taken = _copy_jobs(shard_folder, dataset, damaged)
                seconds |= _read_casting_times(shard_folder, notes)
                _add_rows(db, shard_folder, taken, seconds)
        damaged = damaged or _missing_manifests(all_folders, db)
        if damaged:
            raise LidarError(_missing_or_damaged(damaged))
        lacking = _missing_shards(all_folders)
        shards = {shard for shard_folder in all_folders for shard in shard_folder.shards}
        record["shards"] = [*map(str, sorted(shards.difference(lacking)) if lacking else [ALL])]
        if empty := [row for row in rows() if row.done and not row.points]:
            notes.append(empty_jobs_warning(empty, ""))
            screen.warn(notes[-1])
        sensors = record["sensors"]
        run = CampaignRun.from_rows(rows(), 0.0, 0, sensors=sensors, notes=tuple(notes))
        report = write_shared_files(dataset, record, run, rows)[1]
    if earlier:  # the store of a run with failed jobs is now out of date
        remove_run(target.below(RUN_FOLDER))
    return report


def _merged_record(shard_folders: Sequence[_ShardFolder], fallback: _ShardFolder) -> dict[str, Any]:
    """Return the content of CAMPAIGN_FILE for the merged data set.

    The software versions are taken from the first shard folder that records them, or from
    `fallback`.
    """
    sensors = dict[str, str]()
    for folder in shard_folders:
        sensors = add_sensors(sensors, folder.record["sensors"].items())
    cast = next((folder for folder in shard_folders if folder.record["casting"]), fallback)
    campaign = max(shard_folders, key=lambda folder: folder.run_size).record["campaign"]
    return {**cast.record, "sensors": sensors, "campaign": campaign}


def _add_rows(
    db: RunDatabase,
    shard_folder: _ShardFolder,
    rows: Iterable[JobRow],
    seconds: Mapping[int, float],
) -> None:
    """Add a shard folder's job rows and casting times to the database.

    `seconds` maps job numbers to casting times. A failed job does not replace a row that already
    exists. Raise LidarError if a job does not belong to the shards in the folder, or if two
    manifests belong to the same job.
    """
    added = set[int]()
    batch = list[tuple[int, bool, dict[str, Any]]]()  # a transaction for each row would be slow
    for row in rows:
        number = row.number
        path = shard_folder.storage.path(manifest_file(row.name))
        if not shard_folder.has(number):
            raise LidarError(
                f"{path} belongs to job {number}, which is not in shard "
                f"{list_names([*map(str, shard_folder.shards)])} of {shard_folder.run_size:,} "
                "jobs. Move the file elsewhere, and merge again."
            )
        if number in added:
            raise LidarError(
                f"{path} belongs to job {number}, which has another manifest. Move one of the "
                "manifests elsewhere, and merge again."
            )
        added.add(number)
        if row.done or not db.has_ended(number):
            row = replace(row, seconds=seconds.get(number))
            batch.append((number, bool(row.error), asdict(row)))
        if len(batch) == _BATCH_ROWS:
            db.end_jobs(batch)
            batch.clear()
    db.end_jobs(batch)


def _copy_jobs(
    shard_folder: _ShardFolder, dataset: DataSet, damaged: list[str]
) -> Iterator[JobRow]:
    """Copy the jobs of a shard folder, and yield their rows.

    The names of missing or damaged files are appended to `damaged`.
    """
    for _, row, wrong in dataset.copy_jobs(
        shard_folder.storage, fingerprint(dict(shard_folder.record["identity"]))
    ):
        damaged += [wrong] if wrong else []
        if row is not None:
            yield row


def _read_casting_times(shard_folder: _ShardFolder, notes: list[str]) -> Mapping[int, float]:
    """Return the casting times of jobs as {job number: seconds}.

    If they cannot be read, append a note to `notes` and return an empty mapping.
    """
    if not shard_folder.shards:
        return {}
    try:
        return read_seconds(shard_folder.storage)
    except LidarError as error:
        notes.append(str(error).rstrip("."))
    return {}


def _missing_manifests(shard_folders: Sequence[_ShardFolder], db: RunDatabase) -> list[str]:
    """Describe the missing manifests.

    The jobs of these manifests have no row in the database.
    """
    return [
        f"the manifest of job {number} in {folder.storage}"
        for folder in shard_folders
        for numbers in folder.ranges
        for number in numbers
        if not db.has_ended(number)
    ]


def _merge_survey(
    shard_folders: Sequence[_ShardFolder],
    out: Path | Storage,
    partial: bool,
    scenario: str | Path | None,
    screen: Screen,
) -> dict[str, Any]:
    """Load the scenario of a survey, and write its result from the points in all folders."""
    _check_same_run(shard_folders)
    notes = _collect_notes(shard_folders, partial=partial)
    record = shard_folders[0].record
    scenario_source = record["scenario_source"]
    path = Path(scenario or scenario_source["path"])
    if not path.exists():
        raise MissingFileError(
            f"{path}, the scenario of these shards, does not exist. Specify its new path with "
            "`--scenario`."
        )
    with screen.status("reading the scene"):
        prepared = prepare(Scenario.load(path, scenario_source["options"]))
        job = prepared.job
        jobs = SingleJob(job)
        identity = jobs.identity
    if differs := [name for name in identity if identity[name] != record["identity"][name]]:
        changed = describe_changes(record["fields"], jobs.fields)
        raise LidarError(
            f"{path} does not match these shards, because its {differs[0]} is "
            f"different{f' ({changed})' * bool(changed)}. Specify the scenario of the shards "
            "with `--scenario`."
        )
    output = SurveyOutput(
        out, job.survey, job.outputs, scenario_source["extent"], prepared.scenario
    )
    options = RunOptions(folder=Storage.at(out).below(RUN_FOLDER), resume=True)
    with output.lock() as folder:
        if not options.continues_run:
            output.check_existing(jobs)
        with open_store(jobs, options, screen) as store:
            _copy_points(store, shard_folders, notes)
            load_open3d()
            result = CommittedRun(store).result(screen)
            return output.publish(folder, result, store, screen)[1]


def _copy_points(
    store: RunStore, shard_folders: Sequence[_ShardFolder], notes: Sequence[str]
) -> None:
    """Copy the points from all folders to a store.

    Raise LidarError if files are missing or damaged.
    """
    damaged = list[str]()
    only = store.only_job
    mark = store.db.meta["mark"]
    assert only is not None, "the store of a survey has a single job"

    def copy_part(source: Storage, part_file: Receipt) -> Receipt | None:
        """Copy a part and return its receipt, or return None if the part is missing or damaged."""
        name = part_name(mark, 0, part_file.first, part_file.stop)
        with (
            explain_os_errors(f"{source.path(part_file.name)} cannot be copied"),
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
        for expected, receipt in read_ahead(partial(copy_part, source), missing):
            if receipt is None or not store.db.commit([(only.committed, receipt)]):
                damaged.append(source.path(expected.name))
    if damaged:
        raise LidarError(_missing_or_damaged(damaged))
    # If there are no trials, the first shard, which plans the path, is missing.
    store.reassign_points(only.job if only.trials else replace(only.job, planning=None))
    store.notes = [*notes]
