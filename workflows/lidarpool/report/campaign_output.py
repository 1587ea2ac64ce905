"""The data set of a campaign: what is there, what is wrong with it, and what all jobs share."""

from __future__ import annotations

import json
import re
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from lidarsim.base.errors import LidarError, explained
from lidarsim.base.storage import Storage
from lidarsim.base.words import listed, plural

from ..base.sealed import sealed, unsealed
from ..base.shard import ALL, Shard, shard_in_words
from ..base.software import difference, software
from ..datasets.dataset import INDEX_FILE, JOB_FILES, DataSet, manifest_file
from ..datasets.job_table import TABLE_FILE, JobRow, read_table, write_table
from ..datasets.loader import read_index, sweeps
from ..export.folder import result_folder
from ..run.run_result import CampaignRun
from ..run.runner import Output, Run
from ..run.store.database import FILE
from ..run.store.run_store import RUN_FOLDER, RunStore, remove_run
from ..scenario.campaign import CampaignSpec
from ..scenario.campaign_jobs import file_hashes

CAMPAIGN_FILE = "campaign.json"  # whose data set this is, and the software that made it
# Entries of CAMPAIGN_FILE and their types.
_RECORDED: dict[str, type] = {
    "identity": dict,
    "casting": dict,
    "backend": str,
    "sensors": dict,
    "files": list,
    "campaign": dict,
    "shards": list,
    "notes": list,
}

# With what `write_shared` writes, CAMPAIGN_FILE first.
_FINISHED = re.compile(
    JOB_FILES.pattern
    + r"|(campaign|dataset|report)\.json|README\.md|report\.html|pictures/\w+\.png|"
    r"jobs\.(csv|parquet)|splits/[^/]+\.txt"
)
# The run, results of single jobs, and what writers that have not heard of their end may add.
_BESIDE = re.compile(r"(run|job-[^/]+)/.*|(.*/)?\.lidarpool-(tmp|writing)-.*")


@dataclass(eq=False)
class DataSetOutput(Output[CampaignRun]):
    """The data set of a campaign in its folder or storage, `place`."""

    place: Path | Storage
    campaign: CampaignSpec
    dataset: DataSet = field(init=False)

    def __post_init__(self) -> None:
        out = replace(Storage.at(self.place), durable=False)
        self.dataset = DataSet(out, **asdict(self.campaign.keep))
        # Of a finished data set: its record, rows, and what is wrong with jobs, {number: a clause}.
        self._made: Mapping[str, Any] | None = None
        self._rows: list[JobRow] = []
        self._wrong: dict[int, str] = {}
        self._lost_record = ""  # a note, if the record was damaged

    @contextmanager
    def held(self) -> Iterator[None]:
        """Lock the place while the body runs."""
        self.dataset.check_installed()
        with result_folder(self.place):
            yield

    # -- what is there -----------------------------------------------------------------------

    def begin(self, run: Run[CampaignRun]) -> CampaignRun | None:
        """Refuse or remove a finished data set, or look at it; its sums if nothing is left."""
        out = self.dataset.storage
        options = run.options
        kept = out.below(RUN_FOLDER)
        there = out.entries()
        unfinished = FILE in kept.sizes()
        anew = options.fresh or options.overwrite
        if not run.resume and (anew or not unfinished):
            if INDEX_FILE in there and not options.overwrite:
                raise LidarError(
                    f"{out} holds a finished data set, and one needs a folder of its own: give "
                    "another with --out, or replace it with --overwrite (in Python overwrite=True)."
                )
            if anew:
                _remove_dataset(out, kept)
        if not run.resume or CAMPAIGN_FILE not in there or unfinished:
            return None
        try:
            self._made = check_same(out, self.campaign)
        except DamagedRecordError:  # the manifests say of which campaign the jobs are
            self._lost_record = f"{CAMPAIGN_FILE} was damaged, and is made again"
            return None
        if (shards := self._made["shards"]) != [str(self.campaign.shard)]:
            raise LidarError(
                f"{out} holds {listed([*map(shard_in_words, shards)]) or 'no shard'}, and this is "
                f"{shard_in_words(str(self.campaign.shard))}: give another folder with --out."
            )
        with explained(f"{out} cannot be read"):
            rows = (row for row, _ in self.dataset.rows())
            self._rows += sorted(rows, key=lambda row: row.number)
        told = with_seconds(out, self._rows)
        whole, self._wrong = _look(self.dataset, self._rows, options.verify, self.campaign)
        known = {row.number for row in self._rows}
        for number in self.campaign.shard.jobs(self._made["campaign"]["count"]):
            if number not in known:
                name = self.campaign.name(number)
                self._wrong[number] = f"job {name} ({manifest_file(name)} is missing or damaged)"
        if not told or whole != len(self.campaign.numbers) or not _is_indexed(out, whole):
            return None
        if RUN_FOLDER in there:  # a killed run has not removed all of itself
            remove_run(kept)
        if (files := file_hashes(self.campaign.files)) != [*map(tuple, self._made["files"])]:
            write_record(out, {**self._made, "files": files})  # `_look`: no job has an older one
        run.screen.tell(f"{out} is complete: nothing is left to do")
        for row in self._rows:
            run.page.ended(row)
        notes = tuple(run.warn_of_empty_jobs(self._rows))
        sums = CampaignRun.from_rows(self._rows, time.monotonic() - run.started, notes=notes)
        run.page.finish(sums.seconds)
        return sums

    def look(self, run: Run[CampaignRun]) -> None:
        """Compare what is there with what the store says is done; take over what it lacks."""
        store = run.store
        options = run.options
        out = self.dataset.storage
        if self._made is not None:
            store.cast_with(self._made["backend"], self._made["casting"])
            rows = [row for row in self._rows if row.number in self.campaign.numbers]
            store.adopt(rows, sensors=json.dumps(self._made["sensors"]))
        elif run.resume:
            store.notes += [self._lost_record] * bool(self._lost_record)
            self._take_over(store)
        dataset_files(
            out, begun=store.begun or bool(store.committed_in_words)
        )  # some were perhaps taken over
        if self._made is None:
            _, self._wrong = _look(self.dataset, store.rows(), options.verify, self.campaign)
        if not store.committed_in_words:
            self.campaign.check_files()
        retried = store.db.failed() if options.retry_failed else ()
        store.forget([*self._wrong, *retried])
        if self._wrong:
            store.notes.append(f"made again: {listed([*self._wrong.values()])}")
        for row in store.rows():
            run.page.ended(row)

    def _take_over(self, store: RunStore) -> None:
        """Take over jobs that are there and the database does not know, if it was lost."""
        known = {row.name for row in store.rows()}
        rows: list[JobRow] = []
        with explained(f"{self.dataset.storage} cannot be read"):
            for row, made in self.dataset.rows(known):
                if made.get("identity") != store.made_with["identity"]:
                    continue
                if not store.backend:
                    store.cast_with(made["backend"], made["casting"])
                if made == store.made_with:
                    rows.append(row)
        store.adopt(rows)

    # -- the end ------------------------------------------------------------------------------

    def finish(self, run: Run[CampaignRun]) -> CampaignRun:
        """Write what all jobs share, and remove the run unless jobs have failed."""
        store = run.store
        loop = run.loop
        seconds = time.monotonic() - run.started
        more: dict[str, Any] = {"stages": loop.stages if loop else (), "notes": tuple(store.notes)}
        warnings = run.warn_of_empty_jobs(store.rows())
        if self.campaign.shard == ALL:  # else the merged data set has this note
            more["notes"] = (*more["notes"], *warnings)
        sums = CampaignRun.from_rows(
            store.rows(), seconds, store.resumed, sensors=store.sensors, **more
        )
        record: dict[str, Any] = {"identity": dict(store.identity), "casting": store.casting}
        record |= {"backend": store.backend, "sensors": sums.sensors}
        record |= {"files": file_hashes(self.campaign.files), "campaign": self.campaign.described}
        record |= {"shards": [str(self.campaign.shard)], "notes": [*sums.notes]}
        write_record(self.dataset.storage, record)  # before anything that it tells whose it is
        replace(self.dataset, made_with=store.made_with).write_failed(store.rows())
        sums, _ = write_shared(self.dataset, record, sums, store.rows)
        if sums.failed:
            store.save(force=True)
            store.db.close()
        else:
            store.remove()
        run.page.finish(sums.seconds)
        return sums


class DamagedRecordError(LidarError):
    """CAMPAIGN_FILE cannot be read any more."""


def write_record(place: Storage, record: Mapping[str, Any]) -> None:
    """Write CAMPAIGN_FILE."""
    with explained(f"{place} cannot be written"):
        place.write(CAMPAIGN_FILE, sealed(record))


def read_record(place: Storage) -> dict[str, Any]:
    """Read CAMPAIGN_FILE.

    DamagedRecordError if the file is damaged or edited; LidarError if there is none.
    """
    try:
        record = unsealed(place.read(CAMPAIGN_FILE))
        for name, kind in _RECORDED.items():
            if not isinstance(record.get(name), kind):
                raise ValueError(f"its entry {name} is missing or of another type")
        for shard in record["shards"]:
            Shard.parse(str(shard))
    except OSError as error:
        raise LidarError(
            f"{place} holds no finished data set, which has a {CAMPAIGN_FILE}: {error}."
        ) from error
    except (ValueError, LidarError) as error:
        raise DamagedRecordError(
            f"{place.path(CAMPAIGN_FILE)} is damaged or edited ({error}): run the campaign again "
            "with --resume, which writes it anew."
        ) from error
    return record


def with_seconds(place: Storage, rows: list[JobRow]) -> bool:
    """Add the seconds of casting, which only the table of jobs has, to rows of manifests.

    `rows` are in the order of their numbers. Returns whether the table has the checksum that
    `dataset.json` has of it, and these rows.
    """
    with suppress(LidarError):
        seconds = {row.number: row for row in read_table(place, read_index(place)["table"])}
        same = seconds.keys() == {row.number for row in rows}
        for index, row in enumerate(rows):
            timed = seconds.get(row.number, row)
            if timed.sha256 == row.sha256:
                rows[index] = replace(row, seconds=timed.seconds)
            same &= timed.sha256 == row.sha256
        return same
    return False


def write_shared(
    dataset: DataSet,
    record: Mapping[str, Any],
    sums: CampaignRun,
    rows: Callable[[], Iterator[JobRow]],
) -> tuple[CampaignRun, dict[str, Any]]:
    """Write what all jobs share, and last what says that the data set is complete.

    `record` is for CAMPAIGN_FILE. Returns the sums, with names of classes, and the content of
    report.json.
    """
    # Matplotlib takes as long as all other imports.
    from .campaign_report import write_card
    from .charts import draw_sweep

    campaign = record["campaign"]
    place = dataset.storage
    with explained(f"{place} cannot be written"):
        place.remove([INDEX_FILE])  # it has the checksum of the table
    write_table(place, campaign["names"], rows)
    write_record(place, record)  # behind the table, which has the jobs of all shards in it
    dataset.finish(rows())
    saved = sweeps(place.url)
    picture = draw_sweep(next(iter(saved)), saved.classes) if len(saved) else None
    sums = replace(sums, classes=saved.classes)
    versions = record["casting"] or software()
    return sums, write_card(place, campaign, sums, rows(), versions, picture)


def _look(
    dataset: DataSet,
    rows: Iterable[JobRow],
    contents: bool,
    campaign: CampaignSpec | None = None,
) -> tuple[int, dict[int, str]]:
    """Count the jobs that are whole, and tell what is wrong with others, {number: a clause}.

    LidarError if a file of the campaign is another than the one that whole jobs are made of.
    """
    whole = 0
    wrong = dict[int, str]()
    made: dict[tuple[str, str], list[str]] = {}  # {name and hash of a file: jobs made of it}
    with explained(f"{dataset.storage} cannot be read"):
        for row, (manifest, difference) in dataset.look(rows, contents=contents):
            if campaign is not None and row.number not in campaign.numbers:
                share = (
                    "" if campaign.shard == ALL else f", of which this is shard {campaign.shard}"
                )
                raise LidarError(
                    f"{dataset.storage} has job {row.name}, and count is {campaign.count:,}"
                    f"{share}: a campaign can only grow. Give another folder with --out."
                )
            if difference:
                wrong[row.number] = f"job {row.name} ({difference})"
                continue
            whole += 1
            for file in manifest["made_of"]:
                made.setdefault(tuple(file), []).append(row.name)
    now = file_hashes(campaign.files) if campaign is not None and made else []
    for (name, digest), jobs in made.items():
        if (name, digest) not in now and name in dict(now):
            raise LidarError(
                f"Jobs of {dataset.storage} were made of another {name} than there is now: "
                f"{listed(jobs)}. Bring that back, or give another folder with --out."
            )
    return whole, wrong


def _is_indexed(place: Storage, jobs: int) -> bool:
    """Whether the last file of a data set is there, whole, and has all of its jobs."""
    with suppress(LidarError):
        return len(read_index(place)["jobs"]) == jobs
    return False


def verify(place: Storage, number: int | None = None) -> str:
    """Compare each file of a finished data set, or of one of its jobs, with what is kept of it.

    Returns a line; LidarError names what is damaged, or says that there is no such data set.
    """
    index = read_index(place)
    dataset = DataSet(place, index["format"], index["layout"], index["compensated"])
    rows = [row for row in read_table(place, index["table"]) if row.done]
    whole = {row.number for row in rows} == index["jobs"].keys()
    rows = [row for row in rows if number in (None, row.number)]
    wrong = {} if whole else {-1: f"{TABLE_FILE} has other jobs than {INDEX_FILE}"}
    if number is None and CAMPAIGN_FILE in place.sizes():
        read_record(place)
    wrong |= _look(dataset, rows, True)[1]
    if wrong:
        raise LidarError(
            f"{place} is damaged: {listed([*wrong.values()])}. With the campaign, --verify makes "
            "these jobs again."
        )
    return f"{place} is whole: {plural(len(rows), 'job')}"


def check_same(place: Storage, campaign: CampaignSpec) -> Mapping[str, Any]:
    """Check that a data set is of this campaign, and of the software here; returns its record.

    LidarError names what differs, there and here.
    """
    made = read_record(place)
    here = software(made["backend"])
    there = made["casting"] or {"lidarpool": made["identity"]["lidarpool"]}
    if differs := difference(there, {name: here.get(name, "none") for name in there}):
        raise LidarError(
            f"{place} was made with {differs}: the bits of its jobs are the same only with that. "
            "Install it, or make the job in a folder of its own with --out."
        )
    for name, value in campaign.identity.items():
        if made["identity"].get(name) != value:
            raise LidarError(
                f"{place} is of another campaign: its {name} differs. Make the job in a folder of "
                "its own with --out."
            )
    return made


def dataset_files(out: Storage, *, begun: bool) -> list[str]:
    """Name the files of a data set, which has begun or is empty.

    LidarError if there is a link, or a file that neither jobs nor `write_shared` write.
    """
    files = [name for name in out.tree() if not _BESIDE.fullmatch(name)]
    own = _FINISHED if CAMPAIGN_FILE in files else JOB_FILES
    for name in sorted(files):
        if not begun or not own.fullmatch(name):
            raise LidarError(
                f"{out} holds {name}: a data set needs a folder of its own, move that elsewhere, "
                "or give another with --out."
            )
    return files


def _remove_dataset(out: Storage, kept: Storage) -> None:
    """Remove a data set and its run; LidarError, and nothing is removed, if there is more."""
    begun = CAMPAIGN_FILE in out.sizes() or FILE in kept.sizes()
    own = dataset_files(out, begun=begun)
    with explained(f"{out} cannot be removed"):
        out.tidy()
        # First what says that it is finished, and last what says that it is a data set.
        out.prune(sorted(own, key=lambda name: (name == CAMPAIGN_FILE, name != INDEX_FILE)))
    remove_run(kept)


def failures(sums: CampaignRun, most: int = 5) -> str:
    """Name the jobs that have failed, with their values and why."""
    lines = [f"{plural(len(sums.failed), 'job')} failed, the other {sums.done:,} are done:"]
    for row in sums.failed[:most]:
        values = ", ".join(f"{name} {value}" for name, value in row.values.items())
        lines.append(f"job {row.name}{f' ({values})' if values else ''}: {row.error}")
    if (more := len(sums.failed) - most) > 0:
        lines.append(f"and {more:,} more, see jobs.csv")
    return "\n".join(lines) + "\n--retry-failed does these jobs again."
