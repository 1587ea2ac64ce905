"""The data set of a campaign: checks of existing files, and the files that all jobs share."""

from __future__ import annotations

import json
import re
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from lidarsim.base.errors import LidarError, explained, message_of
from lidarsim.base.storage import Storage
from lidarsim.base.words import listed, plural

from ..base.field_words import differences
from ..base.job_errors import lines_of_errors
from ..base.sealed import sealed, unsealed
from ..base.shard import ALL, Shard, shard_in_words
from ..base.software import difference, software
from ..clouds.folder import LAST_FILE, refuse_missing, result_folder
from ..clouds.format_table import DATA_SETS, format_named
from ..datasets.dataset import INDEX_FILE, JOB_FILES, DataSet, manifest_file
from ..datasets.job_seconds import known_seconds
from ..datasets.job_table import TABLE_FILE, JobRow, read_table, write_table
from ..datasets.loader import read_index, sweeps
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
    output = DataSetOutput(target, campaign, options, screen, page)
    with output.lock():
        if (finished := output.check_existing()) is not None:
            return finished
        with (
            ClusterConnection(campaign, options, screen) as connection,
            open_store(campaign, options, screen) as store,
        ):
            output.compare_with_store(store)
            committed = cast(store, connection, Listener(page), output.dataset)
            return output.publish(committed)


@dataclass(eq=False)
class DataSetOutput:
    """The data set of a campaign in a folder or storage, as the output of a run."""

    target: Path | Storage
    campaign: CampaignSpec
    options: RunOptions
    screen: Screen
    page: RunPage
    dataset: DataSet = field(init=False)

    def __post_init__(self) -> None:
        self._begun_at = time.monotonic()
        storage = replace(Storage.at(self.target), durable=False)
        self.dataset = DataSet(storage, **asdict(self.campaign.keep))
        # Of a finished data set: its record, rows, and faults of jobs, {number: a clause}.
        self._record: Mapping[str, Any] | None = None
        self._rows: list[JobRow] = []
        self._wrong: dict[int, str] = {}
        self._lost_record = ""  # a note, if the record was damaged

    @contextmanager
    def lock(self) -> Iterator[None]:
        """Lock the target while the body runs."""
        self.dataset.check_installed()
        with result_folder(self.target):
            yield

    # -- existing files -----------------------------------------------------------------------

    def check_existing(self) -> CampaignRun | None:
        """Refuse, remove or check a finished data set.

        Returns its sums if no job is left to do.
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
            return None
        try:
            self._record = check_same(storage, self.campaign)
        except DamagedRecordError:  # the manifests name the campaign of the jobs
            self._lost_record = f"{CAMPAIGN_FILE} was damaged and has been recreated"
            return None
        self._check_shards(self._record["shards"])
        if not self._is_complete(self._record, verify=options.verify):
            return None
        if RUN_FOLDER in entries:  # a killed run may leave files
            remove_run(run_folder)
        if (files := file_hashes(self.campaign.files)) != [*map(tuple, self._record["files"])]:
            # `_check_jobs` has found no job of an older file
            write_record(storage, {**self._record, "files": files})
        return self._finished()

    def _check_shards(self, shards: Sequence[str]) -> None:
        """Raise LidarError unless a finished data set has the shards of this run."""
        if shards != [str(self.campaign.shard)]:
            held = listed([*map(shard_in_words, shards)]) or "no shards"
            raise LidarError(
                f"{self.dataset.storage} contains {held}, but this run is "
                f"{shard_in_words(str(self.campaign.shard))}. Specify another folder with "
                "`--out`."
            )

    def _is_complete(self, record: Mapping[str, Any], *, verify: bool) -> bool:
        """Read the rows of a finished data set, and return True if all jobs are intact."""
        storage = self.dataset.storage
        with explained(f"{storage} cannot be read"):
            rows = (row for row, _ in self.dataset.rows())
            seconds = known_seconds(storage)
            self._rows += sorted(
                (replace(row, seconds=seconds.get(row.number)) for row in rows),
                key=lambda row: row.number,
            )
        has_table = _is_tabled(storage, self._rows)
        intact_count, self._wrong = _check_jobs(self.dataset, self._rows, verify, self.campaign)
        numbers = {row.number for row in self._rows}
        for number in self.campaign.shard.jobs(record["campaign"]["count"]):
            if number not in numbers:
                name = self.campaign.name(number)
                self._wrong[number] = f"job {name} ({manifest_file(name)} is missing or damaged)"
        has_all = intact_count == len(self.campaign.numbers)
        return has_table and has_all and _is_indexed(storage, intact_count)

    def _finished(self) -> CampaignRun:
        """Report that the data set is complete, and return its sums."""
        self.screen.tell(f"{self.dataset.storage} is already complete")
        for row in self._rows:
            self.page.ended(row)
        notes = (*self._warnings_of_empty_jobs(self._rows),)
        sums = CampaignRun.from_rows(self._rows, self._seconds(), notes=notes)
        self.page.finish(sums.seconds)
        return sums

    def _seconds(self) -> float:
        """Return the wall time of the run so far."""
        return time.monotonic() - self._begun_at

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

    def compare_with_store(self, store: RunStore) -> None:
        """Compare existing jobs with the run's store, and add jobs that the store lacks."""
        options = self.options
        storage = self.dataset.storage
        if self._record is not None:
            store.cast_with(self._record["backend"], self._record["casting"])
            rows = [row for row in self._rows if row.number in self.campaign.numbers]
            store.adopt(rows, sensors=json.dumps(self._record["sensors"]))
        elif options.may_continue:
            store.notes += [self._lost_record] * bool(self._lost_record)
            self._take_over(store)
        # Some jobs were perhaps taken over.
        dataset_files(storage, begun=store.begun or bool(store.committed_in_words))
        if self._record is None:
            _, self._wrong = _check_jobs(self.dataset, store.rows(), options.verify, self.campaign)
        if not store.committed_in_words:
            self.campaign.check_files()
        retried = store.db.failed() if options.retry_failed else ()
        store.forget([*self._wrong, *retried])
        if self._wrong:
            store.notes.append(f"these jobs are run again: {listed([*self._wrong.values()])}")
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

    # -- the end ------------------------------------------------------------------------------

    def publish(self, committed: Committed) -> CampaignRun:
        """Write the shared files, and remove the run unless jobs have failed."""
        store = committed.store
        seconds = self._seconds()
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
        record: dict[str, Any] = {"identity": dict(store.identity), "casting": store.casting}
        record |= {"fields": dict(store.fields)}
        record |= {"backend": store.backend, "sensors": sums.sensors}
        record |= {"files": file_hashes(self.campaign.files), "campaign": self.campaign.described}
        record |= {"shards": [str(self.campaign.shard)]}
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
        storage.write(CAMPAIGN_FILE, sealed(record))


def read_record(storage: Storage) -> dict[str, Any]:
    """Read CAMPAIGN_FILE.

    DamagedRecordError if the file is damaged or edited; LidarError if there is none.
    """
    refuse_missing(storage, "specify the output folder of a campaign")
    try:
        record = unsealed(storage.read(CAMPAIGN_FILE))
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


def _is_tabled(storage: Storage, rows: Sequence[JobRow]) -> bool:
    """Return True if the table of jobs has these rows, and the checksum in `dataset.json`."""
    with suppress(LidarError):
        table = read_table(storage, read_index(storage)["table"])
        return {row.number: row.sha256 for row in table} == {row.number: row.sha256 for row in rows}
    return False


def read_notes(storage: Storage) -> list[str]:
    """Return the notes in the report of a data set.

    A note says if the report is unusable.
    """
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
    sums = replace(sums, notes=(*sums.notes, *_renamed_sensors(dataset)))
    saved = sweeps(storage.url)
    picture = draw_sweep(next(iter(saved)), saved.classes) if len(saved) else None
    sums = replace(sums, classes=saved.classes)
    versions = record["casting"] or software()
    return sums, write_card(storage, campaign, sums, rows(), versions, picture)


def _renamed_sensors(dataset: DataSet) -> list[str]:
    """Return notes on the sensors of finished jobs that have other names in the data set."""
    cloud_format = format_named(DATA_SETS[dataset.format])
    sensors_of_jobs = read_index(dataset.storage)["jobs"].values()
    notes = (note for sensors in sensors_of_jobs for note in cloud_format.renamed([*sensors]))
    return list(dict.fromkeys(notes))


def _check_jobs(
    dataset: DataSet,
    rows: Iterable[JobRow],
    contents: bool,
    campaign: CampaignSpec | None = None,
) -> tuple[int, dict[int, str]]:
    """Count the intact jobs, and describe the faults of the rest, {number: a clause}.

    LidarError if a file of the campaign differs from the file that intact jobs are made of.
    """
    intact_count = 0
    wrong = dict[int, str]()
    jobs_of_file: dict[
        tuple[str, str], list[str]
    ] = {}  # {name and hash of a file: jobs made of it}
    with explained(f"{dataset.storage} cannot be read"):
        for row, (manifest, difference) in dataset.check_jobs(rows, contents=contents):
            if campaign is not None and row.number not in campaign.numbers:
                share = (
                    ""
                    if campaign.shard == ALL
                    else f" in total and this run is shard {campaign.shard}"
                )
                raise LidarError(
                    f"{dataset.storage} contains job {row.name}, which is not part of this "
                    f"run, because the campaign has {plural(campaign.count, 'job')}{share}. "
                    "The number of jobs can only be increased. Specify another folder with "
                    "`--out`."
                )
            if difference:
                wrong[row.number] = f"job {row.name} ({difference})"
                continue
            intact_count += 1
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
    return intact_count, wrong


def _is_indexed(storage: Storage, jobs: int) -> bool:
    """Return True if the last file of a data set is intact and lists a number of jobs."""
    with suppress(LidarError):
        return len(read_index(storage)["jobs"]) == jobs
    return False


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
    wrong |= _check_jobs(dataset, rows, True)[1]
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
    if differs := difference(recorded, {name: installed.get(name, "none") for name in recorded}):
        raise LidarError(
            f"{storage} was created with {differs}. Only that version reproduces its jobs bit "
            "for bit. Install it, or run the job in a separate folder with `--out`."
        )
    for name, value in campaign.identity.items():
        if record["identity"].get(name) != value:
            changed = differences(record["fields"], campaign.fields)
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
    """Remove a data set and its run.

    Raises LidarError, before any removal, for further files.
    """
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
    lines = lines_of_errors(errors, max_jobs=3)
    if (hidden := len(lines) - max_errors) > 0:
        lines[max_errors:] = [f"{plural(hidden, 'more error')}, listed in jobs.csv"]
    return "\n".join([head, *lines, "To run the failed jobs again, use `--retry-failed`."])
