"""Validate and write the data set of a campaign.

This module validates the files of an existing data set and writes the files that all jobs share.
The files of single jobs are written by `lidarfiles.datasets`.
"""

from __future__ import annotations

import json
import re
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

from lidarfiles.clouds.built_in_formats import DATA_SETS
from lidarfiles.clouds.folder import LAST_FILE, check_exists, result_folder
from lidarfiles.clouds.format_table import load_format
from lidarfiles.datasets.dataset import INDEX_FILE, JOB_FILES, DataSet, manifest_file
from lidarfiles.datasets.job_seconds import known_seconds
from lidarfiles.datasets.job_table import TABLE_FILE, JobRow, read_table, write_table
from lidarfiles.datasets.loader import read_index, sweeps
from lidarfiles.identity.field_words import describe_changes
from lidarfiles.identity.sealed import seal_json, unseal_json
from lidarfiles.identity.versions import software
from lidarscenario.campaign.campaign import CampaignSpec
from lidarscenario.campaign.campaign_jobs import file_hashes
from lidarscenario.empty_cloud import empty_cloud_reason, empty_jobs_warning
from lidarscenario.shard import ALL, Shard, describe_shard
from lidarsim.errors import LidarError, explain_os_errors, message_of
from lidarsim.io.storage import Storage
from lidarsim.words import list_names, plural

from ..identity.job_errors import summarize_errors
from ..identity.software import describe_difference
from ..run.cluster.cluster import ClusterConnection
from ..run.committed import CommittedRun
from ..run.listener import Listener
from ..run.options import RunOptions
from ..run.progress import Screen
from ..run.run_page import RunPage
from ..run.run_result import CampaignRun
from ..run.runner import cast, open_store
from ..run.store.database import FILE
from ..run.store.run_store import RUN_FOLDER, RunStore, remove_run

CAMPAIGN_FILE = "campaign.json"  # campaign and software that produced the data set
# Required entries of CAMPAIGN_FILE and their types.
_RECORDED: dict[str, type] = {
    "identity": dict,
    "fields": dict,
    "casting": dict,
    "backend": str,
    "sensors": dict,
    "files": list,
    "campaign": dict,
    "shards": list,
}

# Matches the files of jobs and the files that `write_shared_files` writes.
_FINISHED = re.compile(
    JOB_FILES.pattern
    + r"|(campaign|dataset|report)\.json|README\.md|report\.(html|csv)|pictures/\w+\.png|"
    r"jobs\.(csv|parquet)|splits/[^/]+\.txt"
)
# Matches files that may exist beside the data set: the run store, the results of single jobs, and
# temporary files of writers that have not stopped yet.
_BESIDE = re.compile(r"(run|job-[^/]+)/.*|(.*/)?\.lidarpool-(tmp|writing)-.*")


def run_campaign(
    target: Path | Storage,
    campaign: CampaignSpec,
    options: RunOptions,
    screen: Screen,
    page: RunPage,
) -> CampaignRun:
    """Run the jobs of a campaign, write the data set, and return a summary."""
    storage = replace(Storage.at(target), durable=False)
    dataset = DataSet(storage, **asdict(campaign.keep))
    output = DataSetOutput(dataset, campaign, options, screen, page)
    dataset.check_installed()
    with result_folder(target):
        earlier = output.check_existing()
        if earlier.is_complete:
            return output.report_complete(earlier)
        with (
            ClusterConnection(campaign, options, screen) as connection,
            open_store(campaign, options, screen) as store,
        ):
            output.compare_with_store(earlier, store)
            committed = cast(store, connection, Listener(page), dataset)
            return output.publish(committed)


class FinishedDataSet(NamedTuple):
    """Finished data set that a run extends or repairs.

    `record` is the content of CAMPAIGN_FILE. It is empty if there is no finished data set or if the
    file is damaged, in which case `note` says so. `wrong` maps the numbers of invalid jobs to a
    clause that describes the problem.
    """

    record: Mapping[str, Any] = MappingProxyType({})
    rows: Sequence[JobRow] = ()
    wrong: Mapping[int, str] = MappingProxyType({})
    is_complete: bool = False
    note: str = ""


@dataclass(eq=False)
class DataSetOutput:
    """Output of a run that creates a campaign's data set."""

    dataset: DataSet
    campaign: CampaignSpec
    options: RunOptions
    screen: Screen
    page: RunPage
    begun_at: float = field(default_factory=time.monotonic)  # monotonic clock, seconds

    def check_existing(self) -> FinishedDataSet:
        """Check the existing data set, and return it if this run continues it.

        With `restart` or `overwrite`, the existing data set is removed. Raise LidarError if the
        data set is finished and may not be replaced, or if it belongs to a different campaign.
        """
        storage = self.dataset.storage
        options = self.options
        run_folder = storage.below(RUN_FOLDER)
        entries = storage.entries()
        unfinished = FILE in run_folder.sizes()
        starts_anew = options.restart or options.overwrite
        if not options.may_continue and (starts_anew or not unfinished):
            if INDEX_FILE in entries and not options.overwrite:
                raise LidarError(
                    f"{storage} contains a finished data set, but each data set requires a "
                    "separate folder. Specify another folder with `--out`, or replace the "
                    "data set with `--overwrite` (`overwrite=True` in Python)."
                )
            if starts_anew:
                _remove_dataset(storage, run_folder)
        if not options.may_continue or CAMPAIGN_FILE not in entries or unfinished:
            return FinishedDataSet()
        try:
            record = check_same_campaign(storage, self.campaign)
        except DamagedRecordError:  # the manifests also identify the campaign
            return FinishedDataSet(note=f"{CAMPAIGN_FILE} was damaged and has been recreated")
        shard = str(self.campaign.shard)
        if record["shards"] != [shard]:
            held = list_names([*map(describe_shard, record["shards"])]) or "no shards"
            raise LidarError(
                f"{storage} contains {held}, but this run is {describe_shard(shard)}. Specify "
                "another folder with `--out`."
            )
        finished = self._check_finished(record)
        if finished.is_complete:
            if RUN_FOLDER in entries:  # a killed run may leave files behind
                remove_run(run_folder)
            if (files := file_hashes(self.campaign.files)) != [*map(tuple, record["files"])]:
                # `_check_jobs` has verified that no job used a previous version of a file.
                write_record(storage, {**record, "files": files})
        return finished

    def _check_finished(self, record: Mapping[str, Any]) -> FinishedDataSet:
        """Read the job rows of a finished data set, and validate its jobs."""
        storage = self.dataset.storage
        with explain_os_errors(f"{storage} cannot be read"):
            seconds = known_seconds(storage)
            rows = sorted(
                (replace(row, seconds=seconds.get(row.number)) for row, _ in self.dataset.rows()),
                key=lambda row: row.number,
            )
        wrong = _check_jobs(self.dataset, rows, self.options.verify, self.campaign)
        numbers = {row.number for row in rows}
        for number in self.campaign.shard.jobs(record["campaign"]["count"]):
            if number not in numbers:
                name = self.campaign.name(number)
                wrong[number] = f"job {name} ({manifest_file(name)} is missing or damaged)"
        has_all = not wrong and len(rows) == len(self.campaign.numbers)
        return FinishedDataSet(record, rows, wrong, has_all and _has_shared_files(storage, rows))

    def report_complete(self, complete: FinishedDataSet) -> CampaignRun:
        """Report that the data set is complete, and return its totals."""
        self.screen.report(f"{self.dataset.storage} is already complete")
        for row in complete.rows:
            self.page.on_job_end(row)
        notes = (*self._warn_of_empty_jobs(complete.rows),)
        sums = CampaignRun.from_rows(complete.rows, time.monotonic() - self.begun_at, notes=notes)
        self.page.finish(sums.seconds)
        return sums

    def _warn_of_empty_jobs(self, rows: Iterable[JobRow]) -> list[str]:
        """Warn about jobs without points. Return a list with the warning, or an empty list."""
        empty = [row for row in rows if row.done and not row.points]
        if not empty:
            return []
        reason = ""
        with suppress(LidarError):  # an input file of the job may have been deleted
            job = self.campaign.job(empty[0].number)
            reason = empty_cloud_reason(job.scene, job.survey)
        warning = empty_jobs_warning(empty, reason)
        self.screen.warn(warning)
        return [warning]

    def compare_with_store(self, earlier: FinishedDataSet, store: RunStore) -> None:
        """Compare existing jobs with the run store, and add any jobs that the store lacks.

        Jobs that are invalid, or that have failed and should be retried, are removed from the
        store, so that they run again.
        """
        options = self.options
        if record := earlier.record:
            store.cast_with(record["backend"], record["casting"])
            rows = [row for row in earlier.rows if row.number in self.campaign.numbers]
            store.add_finished(rows, sensors=json.dumps(record["sensors"]))
        elif options.may_continue:
            store.notes += [earlier.note] * bool(earlier.note)
            self._adopt_finished_jobs(store)
        # Finished jobs may have been added to the store above.
        begun = store.begun or bool(store.committed_text)
        list_dataset_files(self.dataset.storage, begun=begun)
        wrong = earlier.wrong
        if not record:
            wrong = _check_jobs(self.dataset, store.rows(), options.verify, self.campaign)
        if not store.committed_text:
            self.campaign.check_files()
        retried = store.db.failed_jobs() if options.retry_failed else ()
        store.reset_jobs([*wrong, *retried])
        if wrong:
            store.notes.append(f"these jobs are run again: {list_names([*wrong.values()])}")
        for row in store.rows():
            self.page.on_job_end(row)

    def _adopt_finished_jobs(self, store: RunStore) -> None:
        """Add finished jobs to a run store whose database was lost."""
        names = {row.name for row in store.rows()}
        rows: list[JobRow] = []
        seconds = known_seconds(self.dataset.storage)  # available if only the record was damaged
        with explain_os_errors(f"{self.dataset.storage} cannot be read"):
            for row, made_with in self.dataset.rows(names):
                if made_with.get("identity") != store.made_with["identity"]:
                    continue
                if not store.backend:
                    store.cast_with(made_with["backend"], made_with["casting"])
                if made_with == store.made_with:
                    rows.append(replace(row, seconds=seconds.get(row.number)))
        store.add_finished(rows)

    def publish(self, committed: CommittedRun) -> CampaignRun:
        """Write the shared files, and remove the run store unless a job has failed."""
        store = committed.store
        seconds = time.monotonic() - self.begun_at
        notes = committed.notes
        warnings = self._warn_of_empty_jobs(store.rows())
        if self.campaign.shard == ALL:  # otherwise, the merged data set gets this note
            notes += (*warnings,)
        if untimed := [row.name for row in store.rows() if row.done and row.seconds is None]:
            notes += (
                "the casting times of these jobs are unknown, because a run was interrupted before "
                f"their results were recorded: {list_names(untimed)}",
            )
        sums = CampaignRun.from_rows(
            store.rows(),
            seconds,
            store.resumed,
            sensors=store.sensors,
            stages=committed.stages,
            replayed=committed.replayed,
            notes=notes,
        )
        record: dict[str, Any] = {
            "identity": dict(store.identity),
            "casting": store.casting,
            "fields": dict(store.fields),
            "backend": store.backend,
            "sensors": sums.sensors,
            "files": file_hashes(self.campaign.files),
            "campaign": self.campaign.card_content,
            "shards": [str(self.campaign.shard)],
        }
        # The record is written first, because it associates the other files with a campaign.
        write_record(self.dataset.storage, record)
        replace(self.dataset, made_with=store.made_with).write_failed(store.rows())
        sums, _ = write_shared_files(self.dataset, record, sums, store.rows)
        if sums.failed:
            store.save(force=True)
            store.db.close()
        else:
            store.remove()
        self.page.finish(sums.seconds)
        return sums


class DamagedRecordError(LidarError):
    """Raised if CAMPAIGN_FILE is damaged or was edited."""


def write_record(storage: Storage, record: Mapping[str, Any]) -> None:
    """Write CAMPAIGN_FILE with a checksum."""
    with explain_os_errors(f"{storage} cannot be written"):
        storage.write(CAMPAIGN_FILE, seal_json(record))


def read_record(storage: Storage) -> dict[str, Any]:
    """Read CAMPAIGN_FILE and verify its checksum.

    Raises
    ------
    DamagedRecordError
        If the file is damaged or has been edited.
    LidarError
        If the file is missing or cannot be read.
    """
    check_exists(storage, "specify the output folder of a campaign")
    try:
        record = unseal_json(storage.read(CAMPAIGN_FILE))
        for name, kind in _RECORDED.items():
            if not isinstance(record.get(name), kind):
                raise ValueError(f"its entry `{name}` is missing or has the wrong type")
        for shard in record["shards"]:
            Shard.parse(str(shard))
    except OSError as error:
        raise LidarError(
            f"{storage} does not contain a finished data set, because {CAMPAIGN_FILE} cannot be "
            f"read: {error}."
        ) from error
    except (ValueError, LidarError) as error:
        raise DamagedRecordError(
            f"{storage.path(CAMPAIGN_FILE)} is damaged or has been edited: {error}. Run the "
            "campaign again with `--resume` to rewrite the file."
        ) from error
    return record


def _has_shared_files(storage: Storage, rows: Sequence[JobRow]) -> bool:
    """Return True if the job table contains exactly these rows and the index has the same length.

    The checksum of the job table is stored in the index and is verified, too.
    """
    with suppress(LidarError):
        index = read_index(storage)
        table = {row.number: row.sha256 for row in read_table(storage, index["table"])}
        has_table = table == {row.number: row.sha256 for row in rows}
        return has_table and len(index["jobs"]) == len(rows)
    return False


def read_notes(storage: Storage) -> list[str]:
    """Return the notes from a data set's report.

    If the report is damaged, return a single note that says so.
    """
    try:
        notes = json.loads(storage.read(LAST_FILE))["notes"]
        if isinstance(notes, list):
            return [*map(str, notes)]
        reason = "its entry `notes` is not a list"
    except (OSError, ValueError, LookupError, TypeError) as error:
        reason = message_of(error).rstrip(".")
    return [f"{storage.path(LAST_FILE)} is damaged: {reason}. Its notes are lost"]


def write_shared_files(
    dataset: DataSet,
    record: Mapping[str, Any],
    sums: CampaignRun,
    rows: Callable[[], Iterator[JobRow]],
) -> tuple[CampaignRun, dict[str, Any]]:
    """Write the files that all jobs of a data set share.

    The last file that is written marks the data set as complete.

    Parameters
    ----------
    dataset
        The data set, which already contains the files of its jobs.
    record
        Content of CAMPAIGN_FILE.
    sums
        Totals of the run.
    rows
        Function that returns an iterator over the job rows. It is called several times.

    Returns
    -------
    The totals with the class names added, and the content of report.json.
    """
    # Importing Matplotlib takes as long as all other imports together.
    from .campaign_report import write_card
    from .charts import draw_sweep

    campaign = record["campaign"]
    storage = dataset.storage
    with explain_os_errors(f"{storage} cannot be written"):
        storage.remove([INDEX_FILE])  # contains the checksum of the table that is replaced next
    write_table(storage, campaign["names"], rows)
    # The record is written after the table, so it never lists shards that the table lacks.
    write_record(storage, record)
    dataset.finish(rows())
    # Some formats restrict sensor names, so sensors may be renamed in the data set.
    cloud_format = load_format(DATA_SETS[dataset.format])
    sensors_of_jobs = read_index(storage)["jobs"].values()
    renamed = (
        note for sensors in sensors_of_jobs for note in cloud_format.renaming_notes([*sensors])
    )
    saved = sweeps(storage.url)
    picture = draw_sweep(next(iter(saved)), saved.classes) if len(saved) else None
    sums = replace(sums, notes=(*sums.notes, *dict.fromkeys(renamed)), classes=saved.classes)
    versions = record["casting"] or software()
    return sums, write_card(storage, campaign, sums, rows(), versions, picture)


def _check_jobs(
    dataset: DataSet,
    rows: Iterable[JobRow],
    contents: bool,
    campaign: CampaignSpec | None = None,
) -> dict[int, str]:
    """Validate jobs, and describe the problem of each invalid job, keyed by job number.

    Raise LidarError if a job is not part of the campaign, or if an input file of the campaign has
    changed since intact jobs were created from it.
    """
    wrong = dict[int, str]()
    # {(name, hash) of an input file: names of the jobs created from it}
    jobs_of_file: dict[tuple[str, str], list[str]] = {}
    with explain_os_errors(f"{dataset.storage} cannot be read"):
        for row, (manifest, difference) in dataset.check_jobs(rows, contents=contents):
            if campaign is not None and row.number not in campaign.numbers:
                share = f" in total and this run is shard {campaign.shard}"
                share *= campaign.shard != ALL
                raise LidarError(
                    f"{dataset.storage} contains job {row.name}, which is not part of this "
                    f"run, because the campaign has {plural(campaign.count, 'job')}{share}. "
                    "The number of jobs can only be increased. Specify another folder with "
                    "`--out`."
                )
            if difference:
                wrong[row.number] = f"job {row.name} ({difference})"
                continue
            for file in manifest["made_of"]:
                jobs_of_file.setdefault(tuple(file), []).append(row.name)
    current_files = file_hashes(campaign.files) if campaign is not None and jobs_of_file else []
    for (name, digest), jobs in jobs_of_file.items():
        if (name, digest) not in current_files and name in dict(current_files):
            raise LidarError(
                f"These jobs in {dataset.storage} were created from a different version of "
                f"{name}: {list_names(jobs)}. Restore that version, or specify another folder "
                "with `--out`."
            )
    return wrong


def verify_dataset(storage: Storage, number: int | None = None) -> str:
    """Verify the checksums of a finished data set, or of a single job in it.

    Returns
    -------
    A line of text that confirms that the data set is intact.

    Raises
    ------
    LidarError
        If there is no finished data set, or if files are damaged. The message names these files.
    """
    index = read_index(storage)
    dataset = DataSet(storage, index["format"], index["layout"], index["compensated"])
    rows = [row for row in read_table(storage, index["table"]) if row.done]
    is_complete = {row.number for row in rows} == index["jobs"].keys()
    rows = [row for row in rows if number in (None, row.number)]
    wrong = {} if is_complete else {-1: f"{TABLE_FILE} and {INDEX_FILE} list different jobs"}
    if number is None and CAMPAIGN_FILE in storage.sizes():
        read_record(storage)
    wrong |= _check_jobs(dataset, rows, True)
    if wrong:
        raise LidarError(
            f"{storage} is damaged: {list_names([*wrong.values()])}. To run these jobs again, "
            "pass the campaign with `--verify`."
        )
    return f"{storage} is intact, with {plural(len(rows), 'job')}"


def check_same_campaign(storage: Storage, campaign: CampaignSpec) -> Mapping[str, Any]:
    """Check that a data set was created by this campaign and software, and return its record.

    Raises
    ------
    LidarError
        If the software or the campaign differs. The message names the difference.
    """
    record = read_record(storage)
    installed = software(record["backend"])
    recorded = record["casting"] or {"lidarpool": record["identity"]["lidarpool"]}
    if differs := describe_difference(
        recorded, {name: installed.get(name, "none") for name in recorded}
    ):
        raise LidarError(
            f"{storage} was created with {differs}. Only that version reproduces its jobs bit "
            "for bit. Install it, or run the job in a separate folder with `--out`."
        )
    for name, value in campaign.identity.items():
        if record["identity"].get(name) != value:
            changed = describe_changes(record["fields"], campaign.fields)
            raise LidarError(
                f"{storage} belongs to a different campaign "
                f"({changed or f'its {name} differs'}). Run the job in a separate folder with "
                "`--out`."
            )
    return record


def list_dataset_files(storage: Storage, *, begun: bool) -> list[str]:
    """Return the names of all files in a data set.

    The folder must be empty unless the data set has been `begun`.

    Raises
    ------
    LidarError
        If the folder contains a link or a file that does not belong to a data set.
    """
    files = [name for name in storage.tree() if not _BESIDE.fullmatch(name)]
    allowed = _FINISHED if CAMPAIGN_FILE in files else JOB_FILES
    for name in sorted(files):
        if not begun or not allowed.fullmatch(name):
            raise LidarError(
                f"{storage} contains {name}, but a data set requires a separate folder. Move "
                "this file elsewhere, or specify another folder with `--out`."
            )
    return files


def _remove_dataset(storage: Storage, run_folder: Storage) -> None:
    """Remove a data set and its run store.

    Raise LidarError if the folder contains other files.
    """
    begun = CAMPAIGN_FILE in storage.sizes() or FILE in run_folder.sizes()
    files = list_dataset_files(storage, begun=begun)
    with explain_os_errors(f"{storage} cannot be removed"):
        storage.remove_unfinished()
        # INDEX_FILE, which marks the data set as finished, is removed first. CAMPAIGN_FILE, which
        # identifies the folder as a data set, is removed last.
        storage.prune(sorted(files, key=lambda name: (name == CAMPAIGN_FILE, name != INDEX_FILE)))
    remove_run(run_folder)


def describe_failures(sums: CampaignRun, max_errors: int = 5) -> str:
    """Summarize the errors of failed jobs, including the varied values of these jobs."""
    head = f"{plural(len(sums.failed), 'job')} failed and {sums.done:,} succeeded:"
    errors = []
    for row in sums.failed:
        values = ", ".join(
            f"{name} {'none' if value is None else value}" for name, value in row.values.items()
        )
        errors.append((f"{row.name}{f' ({values})' if values else ''}", row.error))
    lines = summarize_errors(errors, max_jobs=3)
    if (hidden := len(lines) - max_errors) > 0:
        lines[max_errors:] = [f"{plural(hidden, 'more error')}, listed in jobs.csv"]
    return "\n".join([head, *lines, "To run the failed jobs again, use `--retry-failed`."])
