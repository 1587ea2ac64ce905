"""The data set of a campaign: checks of existing files, and the files that all jobs share."""

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

from lidarsim.errors import LidarError, explained, message_of
from lidarsim.io.storage import Storage
from lidarsim.words import listed, plural

from ..clouds.folder import LAST_FILE, check_exists, result_folder
from ..clouds.format_table import DATA_SETS, load_format
from ..datasets.dataset import INDEX_FILE, JOB_FILES, DataSet, manifest_file
from ..datasets.job_seconds import known_seconds
from ..datasets.job_table import TABLE_FILE, JobRow, read_table, write_table
from ..datasets.loader import read_index, sweeps
from ..identity.field_words import describe_changes
from ..identity.job_errors import summarize_errors
from ..identity.sealed import seal_json, unseal_json
from ..identity.shard import ALL, Shard, describe_shard
from ..identity.software import describe_difference, software
from ..run.cluster.cluster import ClusterConnection
from ..run.committed import Committed
from ..run.listener import Listener
from ..run.options import RunOptions
from ..run.progress import Screen
from ..run.run_page import RunPage
from ..run.run_result import CampaignRun
from ..run.runner import cast, open_store
from ..run.store.database import FILE
from ..run.store.run_store import RUN_FOLDER, RunStore, remove_run
from ..scenario.campaign import CampaignSpec
from ..scenario.campaign_jobs import file_hashes
from ..scenario.empty_cloud import empty_cloud_reason, empty_jobs_warning

CAMPAIGN_FILE = "campaign.json"  # the campaign of the data set, and the software that wrote it
# Entries of CAMPAIGN_FILE and their types.
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

# Files of jobs, and the files of `write_shared`, CAMPAIGN_FILE first.
_FINISHED = re.compile(
    JOB_FILES.pattern
    + r"|(campaign|dataset|report)\.json|README\.md|report\.(html|csv)|pictures/\w+\.png|"
    r"jobs\.(csv|parquet)|splits/[^/]+\.txt"
)
# The run, results of single jobs, and files of writers that have not yet noticed the end.
_BESIDE = re.compile(r"(run|job-[^/]+)/.*|(.*/)?\.lidarpool-(tmp|writing)-.*")


def run_campaign(
    target: Path | Storage,
    campaign: CampaignSpec,
    options: RunOptions,
    screen: Screen,
    page: RunPage,
) -> CampaignRun:
    """Cast the jobs of a campaign, write the data set, and return a summary."""
    storage = replace(Storage.at(target), durable=False)
    dataset = DataSet(storage, **asdict(campaign.keep))
    output = DataSetOutput(dataset, campaign, options, screen, page)
    dataset.check_installed()
    with result_folder(target):
        earlier = output.check_existing()
        if earlier.is_complete:
            return output.finished(earlier)
        with (
            ClusterConnection(campaign, options, screen) as connection,
            open_store(campaign, options, screen) as store,
        ):
            output.compare_with_store(earlier, store)
            committed = cast(store, connection, Listener(page), dataset)
            return output.publish(committed)


class FinishedDataSet(NamedTuple):
    """A finished data set that a run continues.

    `record` is the content of CAMPAIGN_FILE; it is empty if there is no such data set, or the file
    is damaged, as `note` reports. `wrong` are faults of jobs, {number: a clause}.
    """

    record: Mapping[str, Any] = MappingProxyType({})
    rows: Sequence[JobRow] = ()
    wrong: Mapping[int, str] = MappingProxyType({})
    is_complete: bool = False
    note: str = ""


@dataclass(eq=False)
class DataSetOutput:
    """The data set of a campaign as the output of a run."""

    dataset: DataSet
    campaign: CampaignSpec
    options: RunOptions
    screen: Screen
    page: RunPage
    begun_at: float = field(default_factory=time.monotonic)  # seconds

    def check_existing(self) -> FinishedDataSet:
        """Refuse, remove or check a finished data set, and return it if the run continues it."""
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
            record = check_same(storage, self.campaign)
        except DamagedRecordError:  # the manifests name the campaign of the jobs
            return FinishedDataSet(note=f"{CAMPAIGN_FILE} was damaged and has been recreated")
        shard = str(self.campaign.shard)
        if record["shards"] != [shard]:
            held = listed([*map(describe_shard, record["shards"])]) or "no shards"
            raise LidarError(
                f"{storage} contains {held}, but this run is {describe_shard(shard)}. Specify "
                "another folder with `--out`."
            )
        finished = self._check_finished(record)
        if finished.is_complete:
            if RUN_FOLDER in entries:  # a killed run may leave files
                remove_run(run_folder)
            if (files := file_hashes(self.campaign.files)) != [*map(tuple, record["files"])]:
                # `_check_jobs` has found no job of an older file
                write_record(storage, {**record, "files": files})
        return finished

    def _check_finished(self, record: Mapping[str, Any]) -> FinishedDataSet:
        """Read the rows of a finished data set, and check its jobs."""
        storage = self.dataset.storage
        with explained(f"{storage} cannot be read"):
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

    def finished(self, complete: FinishedDataSet) -> CampaignRun:
        """Report that the data set is complete, and return its sums."""
        self.screen.tell(f"{self.dataset.storage} is already complete")
        for row in complete.rows:
            self.page.ended(row)
        notes = (*self._warnings_of_empty_jobs(complete.rows),)
        sums = CampaignRun.from_rows(complete.rows, time.monotonic() - self.begun_at, notes=notes)
        self.page.finish(sums.seconds)
        return sums

    def _warnings_of_empty_jobs(self, rows: Iterable[JobRow]) -> list[str]:
        """Warn if jobs have no points, and return the warning, if any."""
        empty = [row for row in rows if row.done and not row.points]
        if not empty:
            return []
        reason = ""
        with suppress(LidarError):  # a file that the job is made of may be gone
            job = self.campaign.job(empty[0].number)
            reason = empty_cloud_reason(job.scene, job.survey)
        warning = empty_jobs_warning(empty, reason)
        self.screen.warn(warning)
        return [warning]

    def compare_with_store(self, earlier: FinishedDataSet, store: RunStore) -> None:
        """Compare existing jobs with the run's store, and add jobs that the store lacks."""
        options = self.options
        if record := earlier.record:
            store.cast_with(record["backend"], record["casting"])
            rows = [row for row in earlier.rows if row.number in self.campaign.numbers]
            store.adopt(rows, sensors=json.dumps(record["sensors"]))
        elif options.may_continue:
            store.notes += [earlier.note] * bool(earlier.note)
            self._take_over(store)
        # Some jobs were perhaps taken over.
        begun = store.begun or bool(store.committed_in_words)
        dataset_files(self.dataset.storage, begun=begun)
        wrong = earlier.wrong
        if not record:
            wrong = _check_jobs(self.dataset, store.rows(), options.verify, self.campaign)
        if not store.committed_in_words:
            self.campaign.check_files()
        retried = store.db.failed() if options.retry_failed else ()
        store.forget([*wrong, *retried])
        if wrong:
            store.notes.append(f"these jobs are run again: {listed([*wrong.values()])}")
        for row in store.rows():
            self.page.ended(row)

    def _take_over(self, store: RunStore) -> None:
        """Add finished jobs to the store whose database was lost."""
        names = {row.name for row in store.rows()}
        rows: list[JobRow] = []
        seconds = known_seconds(self.dataset.storage)  # of a data set whose record was damaged
        with explained(f"{self.dataset.storage} cannot be read"):
            for row, made_with in self.dataset.rows(names):
                if made_with.get("identity") != store.made_with["identity"]:
                    continue
                if not store.backend:
                    store.cast_with(made_with["backend"], made_with["casting"])
                if made_with == store.made_with:
                    rows.append(replace(row, seconds=seconds.get(row.number)))
        store.adopt(rows)

    def publish(self, committed: Committed) -> CampaignRun:
        """Write the shared files, and remove the run unless jobs have failed."""
        store = committed.store
        seconds = time.monotonic() - self.begun_at
        notes = committed.notes
        warnings = self._warnings_of_empty_jobs(store.rows())
        if self.campaign.shard == ALL:  # else the merged data set has this note
            notes += (*warnings,)
        if untimed := [row.name for row in store.rows() if row.done and row.seconds is None]:
            notes += (
                "the casting times of these jobs are unknown, because a run was interrupted before "
                f"their results were recorded: {listed(untimed)}",
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
        write_record(self.dataset.storage, record)  # before the files that it assigns to a campaign
        replace(self.dataset, made_with=store.made_with).write_failed(store.rows())
        sums, _ = write_shared(self.dataset, record, sums, store.rows)
        if sums.failed:
            store.save(force=True)
            store.db.close()
        else:
            store.remove()
        self.page.finish(sums.seconds)
        return sums


class DamagedRecordError(LidarError):
    """CAMPAIGN_FILE cannot be read any more."""


def write_record(storage: Storage, record: Mapping[str, Any]) -> None:
    """Write CAMPAIGN_FILE."""
    with explained(f"{storage} cannot be written"):
        storage.write(CAMPAIGN_FILE, seal_json(record))


def read_record(storage: Storage) -> dict[str, Any]:
    """Read CAMPAIGN_FILE, or raise DamagedRecordError, or LidarError if there is none."""
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
    """Return True if the job table has these rows, and the last file lists as many jobs.

    The last file has the checksum of the table.
    """
    with suppress(LidarError):
        index = read_index(storage)
        table = {row.number: row.sha256 for row in read_table(storage, index["table"])}
        has_table = table == {row.number: row.sha256 for row in rows}
        return has_table and len(index["jobs"]) == len(rows)
    return False


def read_notes(storage: Storage) -> list[str]:
    """Return the notes in the report of a data set, or a note that the report is unusable."""
    try:
        notes = json.loads(storage.read(LAST_FILE))["notes"]
        if isinstance(notes, list):
            return [*map(str, notes)]
        reason = "its entry `notes` is not a list"
    except (OSError, ValueError, LookupError, TypeError) as error:
        reason = message_of(error).rstrip(".")
    return [f"{storage.path(LAST_FILE)} is damaged: {reason}. Its notes are lost"]


def write_shared(
    dataset: DataSet,
    record: Mapping[str, Any],
    sums: CampaignRun,
    rows: Callable[[], Iterator[JobRow]],
) -> tuple[CampaignRun, dict[str, Any]]:
    """Write the shared files of a data set.

    The last file marks the data set as complete.

    `record` is for CAMPAIGN_FILE. Returns the sums, with names of classes, and the content of
    report.json.
    """
    # Matplotlib takes as long as all other imports.
    from .campaign_report import write_card
    from .charts import draw_sweep

    campaign = record["campaign"]
    storage = dataset.storage
    with explained(f"{storage} cannot be written"):
        storage.remove([INDEX_FILE])  # which has the checksum of the table
    write_table(storage, campaign["names"], rows)
    write_record(storage, record)  # behind the table, which has the jobs of all shards in it
    dataset.finish(rows())
    # Notes on sensors that have other names in the data set.
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
    """Describe the faults of jobs, {number: a clause}.

    LidarError if a file of the campaign differs from the file that intact jobs are made of.
    """
    wrong = dict[int, str]()
    # {name and hash of a file: jobs made of it}
    jobs_of_file: dict[tuple[str, str], list[str]] = {}
    with explained(f"{dataset.storage} cannot be read"):
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
                f"{name}: {listed(jobs)}. Restore that version, or specify another folder "
                "with `--out`."
            )
    return wrong


def verify(storage: Storage, number: int | None = None) -> str:
    """Compare the files of a finished data set, or of a job in the data set, with their checksums.

    Returns a line; LidarError names damaged files, or the missing data set.
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
            f"{storage} is damaged: {listed([*wrong.values()])}. To run these jobs again, "
            "pass the campaign with `--verify`."
        )
    return f"{storage} is intact, with {plural(len(rows), 'job')}"


def check_same(storage: Storage, campaign: CampaignSpec) -> Mapping[str, Any]:
    """Check that a data set is of this campaign and software, and return its record.

    LidarError names each difference.
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


def dataset_files(storage: Storage, *, begun: bool) -> list[str]:
    """Name the files of a data set, which is empty unless `begun`.

    LidarError if there is a link, or a file that neither jobs nor `write_shared` write.
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
    """Remove a data set and its run, unless LidarError names further files."""
    begun = CAMPAIGN_FILE in storage.sizes() or FILE in run_folder.sizes()
    files = dataset_files(storage, begun=begun)
    with explained(f"{storage} cannot be removed"):
        storage.tidy()
        # First the file that marks it as finished, and last the file that marks it as a data set.
        storage.prune(sorted(files, key=lambda name: (name == CAMPAIGN_FILE, name != INDEX_FILE)))
    remove_run(run_folder)


def failures(sums: CampaignRun, max_errors: int = 5) -> str:
    """Describe the different errors of jobs that have failed, with the values of the jobs."""
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
