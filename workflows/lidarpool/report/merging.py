"""Merges shards, done by several clusters, into the data set or result of one run."""

from __future__ import annotations

import heapq
import json
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import asdict, dataclass, replace
from functools import partial
from itertools import groupby
from operator import attrgetter
from pathlib import Path
from typing import Any

from lidarsim.base.errors import LidarError, Mistakes, explained
from lidarsim.base.storage import Storage
from lidarsim.base.validation import checked
from lidarsim.base.words import listed, plural

from ..base.fingerprint import fingerprint
from ..base.shard import ALL, Shard
from ..base.software import software
from ..columns.parts import part_name
from ..datasets.dataset import INDEX_FILE, DataSet, manifest_file, read_ahead
from ..datasets.job_table import TABLE_FILE, JobRow, read_table
from ..datasets.loader import read_index
from ..export.folder import LAST_FILE, output_place, result_folder
from ..plan import Trial
from ..run.job_source import OneJob
from ..run.options import RunOptions
from ..run.pipeline.committed_job import CommittedJob
from ..run.pipeline.messages import Receipt
from ..run.progress import Screen
from ..run.run_page import RunPage
from ..run.run_result import CampaignRun, RunResult
from ..run.runner import Run
from ..run.store.database import FILE, DamagedError, RunDatabase
from ..run.store.remote import fetch_database
from ..run.store.run_store import RUN_FOLDER, parts_of, remove_run, with_sensors
from ..scenario.build import build
from ..scenario.empty_cloud import NO_POINTS, empty_jobs_warning
from ..scenario.scenario import Scenario
from .campaign_output import CAMPAIGN_FILE, dataset_files, read_record, write_record, write_shared
from .output import SurveyOutput

NAMED = 20  # shards or files in a message
_MISSING = "missing: "  # begins a note
_AGAIN = "run their shards again with --resume (of a campaign --verify), and merge again"


@dataclass(frozen=True)
class _Part:
    """Some shards of a run, in one place; `record` has what is in CAMPAIGN_FILE of a data set.

    `whole` are the jobs or scans of the run in all; parts and trials are of a survey.
    """

    place: Storage
    record: Mapping[str, Any]
    shards: Sequence[Shard]
    whole: int
    points: Sequence[Receipt] = ()
    trials: Sequence[Trial] = ()

    @property
    def notes(self) -> list[str]:
        """Remarks for the user, without that on missing shards."""
        return [
            note
            for note in self.record["notes"]
            if not note.startswith(_MISSING) and NO_POINTS not in note  # of an earlier merge
        ]

    def done(self, shard: Shard) -> range:
        """Return the numbers of the jobs or scans of a shard."""
        return (shard.jobs if "campaign" in self.record else shard.scans)(self.whole)

    @property
    def common(self) -> dict[str, Any]:
        """What all parts must have in common."""
        record = self.record
        found = {"kind": [*record["identity"]]} | record["identity"]
        found |= {f"the file {name}": digest for name, digest in record["files"]}
        if record["casting"]:  # else it has cast nothing
            found |= {f"{name} of workers": value for name, value in record["casting"].items()}
        return found | ({"the number of shards": self.shards[0].total} if self.shards else {})


@checked
def merge(
    shards: Sequence[str | Path | Storage],
    out: str | Path | Storage,
    *,
    partial: bool = False,
    scenario: str | Path | None = None,
    screen: Screen | None = None,
) -> dict[str, Any]:
    """Merge shards into the data set or result that one run would have made.

    Every byte is compared with what its shard says of it. The rows of jobs are those of their
    manifests, which have checksums. After a kill, the same call goes on.

    Parameters
    ----------
    shards, out
        Folders or URLs of the shards of one campaign or survey, and of the data set or result.
        Shards can be added to a data set later. `out` may neither be in a shard nor hold one.
    partial
        Merge what there is; a note says what is missing.
    scenario
        Of a survey: its scenario or mesh file, if that is not where it was when the shards ran.
    screen
        To be told what goes on; by default the log.

    Returns
    -------
    The content of report.json.

    Raises
    ------
    LidarError
        If shards are missing, damaged, given twice, unfinished, of another run or other software:
        it names them.
    """
    place = output_place(str(out))
    screen = screen or Screen()
    places = {_real(one): one for one in map(Storage.at, shards)}
    _check_apart(Storage.at(place), places)
    parts = list[_Part]()
    mistakes = Mistakes()
    for one in places.values():
        with mistakes.noted():
            parts.append(_read(one))
    mistakes.lines += [] if places else ["there is nothing to merge: give the folders of shards."]
    with suppress(LidarError):  # the result would have the place of the shard's points
        if "made_of" in _read(Storage.at(place)).record:
            told = f"{place} holds a shard of a survey: give another folder with --out."
            parts = []
            mistakes.lines = [told]
    if not (partial and parts):
        mistakes.tell()
    if "made_of" in parts[0].record:
        return _merge_survey(parts, place, partial, scenario, screen)
    with result_folder(place), screen.status("merging the data set"):
        return _merge_dataset(parts, Storage.at(place), partial, screen)


def _real(place: Storage) -> str:
    """Return the same for a folder by whatever path or URL, which may lead through links."""
    scheme, separator, path = place.url.partition("://")
    if separator and scheme not in ("file", "local"):
        return place.url
    return str(Path(path or place.url).resolve())


def _check_apart(out: Storage, places: Mapping[str, Storage]) -> None:
    """Check that `out` is apart from all places of shards, {as of `_real`: place}."""
    path = _real(out)
    for real, place in places.items():
        relation = ""
        if path == real:
            relation = "is one of the shards"
        elif f"{path}/".startswith(f"{real.rstrip('/')}/"):
            relation = f"lies in the shard {place}"
        elif f"{real}/".startswith(f"{path.rstrip('/')}/"):
            relation = f"holds the shard {place}"
        if relation:
            raise LidarError(
                f"--out {out} {relation}, which stays as it is: give another folder with --out, or "
                "name the shards without that one."
            )


def _read(place: Storage) -> _Part:
    """Read a finished shard, or data set of several; LidarError if it is none, or damaged."""
    with explained(f"{place} cannot be read"):
        files = place.sizes()
        run = place.below(RUN_FOLDER)
        if {CAMPAIGN_FILE, INDEX_FILE, LAST_FILE} <= files.keys():
            return _of_dataset(place)
        if FILE in run.sizes():
            with suppress(LookupError):
                return _of_survey(place, run)
    raise LidarError(
        f"{place} holds no finished shard: give a folder of lidarpool run --shard; --resume "
        "finishes an unfinished one."
    )


def _of_dataset(place: Storage, of: int = 1) -> _Part:
    """Read a data set of some shards; one that has all has each of so many."""
    record = read_record(place)
    shards = [Shard.parse(text) for text in record["shards"]]
    if shards == [ALL]:
        shards = [Shard(number, of) for number in range(1, of + 1)]
    return _Part(place, record, shards, record["campaign"]["count"])


def _of_survey(place: Storage, run: Storage) -> _Part:
    """Read a shard of a survey; LookupError if it is none or not finished.

    LidarError if its database is damaged.
    """
    with tempfile.TemporaryDirectory(prefix="lidarpool-") as folder:
        path = Path(folder, FILE)
        fetch_database(run, path)
        try:
            with closing(RunDatabase(path, durable=False)) as db:
                meta = {"casting": "{}"} | db.meta
                texts = ("identity", "casting", "made_of", "notes")
                record = {**meta, "files": [], **{name: json.loads(meta[name]) for name in texts}}
                shard = Shard.parse(record["identity"].pop("shard"))
                scan_count = record["made_of"]["scans"]
                scans = shard.scans(scan_count)
                job = CommittedJob(0, scans)
                db.read(job)
                if job.missing_count:
                    raise LookupError("scans are missing")
                parts = job.parts.ordered
                return _Part(place, record, [shard], scan_count, parts, job.trials)
        except DamagedError as error:
            raise LidarError(
                f"{run.path(FILE)} is damaged: run its shard again with --resume, which makes it "
                "anew from the points, and merge again."
            ) from error


def _check(parts: Sequence[_Part], partial: bool, own: _Part | None = None) -> list[str]:
    """Check that all are of one run, and none is missing but with `partial`; returns all notes.

    Others may have what is in `own`, too. LidarError names the parts that are wrong.
    """
    mistakes = Mistakes()
    wanted = software()
    first = "the software here"
    seen = dict[int, _Part]()
    for part in sorted(parts, key=lambda part: not part.record["casting"]):
        common = part.common
        if part.shards == [ALL] and part is not own and len(parts) > 1 + bool(own):
            mistakes.lines.append(f"{part.place} is a whole run: give it alone, or leave it out.")
            continue
        if differs := [name for name in wanted if common.get(name, wanted[name]) != wanted[name]]:
            told = f"{part.place} and {first} differ in {differs[0]}"
            mistakes.lines.append(f"{told}: merge shards of one run and of the same software.")
        elif len(common) > len(wanted):
            wanted = common
            first = str(part.place)
        for shard in part.shards if part is not own else ():
            if (other := seen.setdefault(shard.number, part)) is not part:
                twice = f"shard {shard} is in {other.place} and in {part.place}"
                mistakes.lines.append(f"{twice}: give one of them.")
    mistakes.tell()
    notes = [*dict.fromkeys(note for part in parts for note in part.notes)]
    if not (missing := _missing(parts)):
        return notes
    told = f"{_MISSING}{plural(len(missing), 'shard')}, {listed([*map(str, missing)], NAMED)}"
    if not partial:
        grown = any(shard in part.shards for part in parts for shard in missing)
        give = f"give them, too{', run again with the larger count and --resume' * grown}"
        raise LidarError(f"{told}: {give}, or merge what there is with --partial.")
    return [*notes, told]


def _missing(parts: Sequence[_Part]) -> list[Shard]:
    """List the shards that are not there, or lack jobs by which the campaign has grown."""
    of = parts[-1].shards[0].total
    parts = sorted(parts, key=lambda part: part.whole)
    have = {shard.number: len(part.done(shard)) for part in parts for shard in part.shards}
    have.setdefault(1, -1)  # which plans the path, even if it has no scans
    every = (Shard(number, of) for number in range(1, of + 1))
    return [shard for shard in every if have.get(shard.number, 0) < len(parts[-1].done(shard))]


def _merge_dataset(
    parts: Sequence[_Part], out: Storage, partial: bool, screen: Screen
) -> dict[str, Any]:
    """Take the jobs of all parts into a data set, and write what all jobs share."""
    begun = CAMPAIGN_FILE in out.sizes()
    dataset_files(out, begun=begun)
    own = _of_dataset(out, of=parts[0].shards[0].total) if begun else None
    known = [own, *parts] if own else parts
    notes = _check(known, partial, own)
    sensors = dict[str, str]()
    for part in known:
        sensors = with_sensors(sensors, part.record["sensors"].items())
    cast = next((part for part in known if part.record["casting"]), parts[0])
    campaign = max(known, key=lambda part: part.whole).record["campaign"]
    record = {**cast.record, "sensors": sensors, "campaign": campaign, "notes": notes}
    dataset = DataSet(replace(out, durable=False), **campaign["keep"])
    dataset.check_installed()
    if own is None:  # from now on it is known whose files these are
        write_record(out, record | {"shards": []})
    with tempfile.TemporaryDirectory(prefix="lidarpool-") as folder:
        files = [_RowFile(Path(folder, str(index))) for index in range(len(known))]
        damaged = list[str]()
        with explained(f"{out} cannot be merged"):
            for part, file in zip(parts, files[-len(parts) :], strict=True):
                file.write(part, _taken(part, dataset, damaged), _seconds(part, notes))
            if own:
                # A killed merge leaves a table that is not that of its index: no news.
                files[0].write(own, _rows_of(own, dataset), _seconds(own, []))
        if not damaged:
            damaged += _lacking(known, _merged(files))
        if damaged:
            raise LidarError(f"missing or damaged: {listed(damaged, NAMED)}; {_AGAIN}.")
        lacking = _missing(known)
        there = {shard for part in known for shard in part.shards}
        record["shards"] = [*map(str, sorted(there.difference(lacking)) if lacking else [ALL])]
        if empty := [row for row in _merged(files) if row.done and not row.points]:
            notes.append(empty_jobs_warning(empty, ""))
            screen.warn(notes[-1])
        record["notes"] = notes
        more = {"sensors": sensors, "notes": tuple(notes)}
        run = CampaignRun.from_rows(_merged(files), 0.0, 0, **more)
        report = write_shared(dataset, record, run, lambda: _merged(files))[1]
    if own:  # a run with failed jobs, which would go on with what it knows of them
        remove_run(out.below(RUN_FOLDER))
    return report


class _RowFile:
    """Rows of the jobs of a part in a temporary file: manifests are read once, one at a time."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._offsets: dict[int, int] = {}  # {number of a job: first byte of its row}

    def write(
        self, part: _Part, rows: Iterator[JobRow], seconds: Mapping[int, tuple[str, float]]
    ) -> None:
        """Write rows with their seconds of casting.

        LidarError if the part cannot have such a job, or two manifests are of one job.
        """
        ranges = [part.done(shard) for shard in part.shards]
        with self._path.open("wb") as file:
            for row in rows:
                path = part.place.path(manifest_file(row.name))
                number = row.number
                if not any(number in numbers for numbers in ranges):
                    raise LidarError(
                        f"{path} is of job {number}, which is not in shard "
                        f"{listed([*map(str, part.shards)])} of {part.whole:,} jobs: move it "
                        "elsewhere, and merge again."
                    )
                if number in self._offsets:
                    raise LidarError(
                        f"{path} is of job {number}, of which there is another manifest: move one "
                        "of them elsewhere, and merge again."
                    )
                sha256, casting_s = seconds.get(number, ("", 0.0))
                row = replace(row, seconds=casting_s) if sha256 == row.sha256 else row
                self._offsets[number] = file.tell()
                file.write(json.dumps(asdict(row)).encode() + b"\n")

    def rows(self) -> Iterator[JobRow]:
        """Yield the rows in the order of numbers."""
        if self._offsets:
            with self._path.open("rb") as file:
                for _, offset in sorted(self._offsets.items()):
                    file.seek(offset)
                    yield JobRow.from_json(json.loads(file.readline()))


def _taken(part: _Part, dataset: DataSet, damaged: list[str]) -> Iterator[JobRow]:
    """Take the jobs of a part into a data set; yields their rows, adds files to `damaged`."""
    for _, row, wrong in dataset.take(part.place, fingerprint(dict(part.record["identity"]))):
        damaged += [wrong] if wrong else []
        if row is not None:
            yield row


def _rows_of(own: _Part, dataset: DataSet) -> Iterator[JobRow]:
    """Yield the rows of the shards that the data set had before."""
    ranges = [own.done(shard) for shard in own.shards]
    for row, _ in dataset.rows():
        if any(row.number in numbers for numbers in ranges):
            yield row


def _seconds(part: _Part, notes: list[str]) -> dict[int, tuple[str, float]]:
    """Return {number: hash of points and seconds of casting}, which only jobs.csv has.

    A note says if the table is damaged; then nothing is known.
    """
    if not part.shards:
        return {}
    try:
        finished = INDEX_FILE in part.place.sizes()  # else an earlier merge was killed
        table = read_table(part.place, read_index(part.place)["table"] if finished else None)
        return {row.number: (row.sha256, row.seconds) for row in table}
    except LidarError:
        notes.append(
            f"{part.place.path(TABLE_FILE)} is damaged or edited: the rows of its jobs are those "
            "of their manifests, without seconds"
        )
    return {}


def _lacking(parts: Sequence[_Part], rows: Iterator[JobRow]) -> list[str]:
    """List the jobs of parts that have no row, as a folder and a number."""
    numbers = {row.number for row in rows}
    return [
        f"the manifest of job {number} in {part.place}"
        for part in parts
        for shard in part.shards
        for number in part.done(shard)
        if number not in numbers
    ]


def _merged(files: Sequence[_RowFile]) -> Iterator[JobRow]:
    """Yield the rows of all jobs by number; of a job of several parts, one that is done."""
    number = attrgetter("number")
    tables = [file.rows() for file in files]
    for _, rows in groupby(heapq.merge(*tables, key=number), number):
        yield max(rows, key=attrgetter("done", "seconds"))


def _merge_survey(
    parts: Sequence[_Part],
    out: Path | Storage,
    partial: bool,
    scenario: str | Path | None,
    screen: Screen,
) -> dict[str, Any]:
    """Make the survey again, and write its result from the points of all parts."""
    notes = _check(parts, partial)
    record = parts[0].record
    told = record["made_of"]
    path = Path(scenario or told["path"])
    if not path.exists():
        raise LidarError(f"{path}, of which these shards are, does not exist: give --scenario.")
    with screen.status("reading the scene"):
        built = build(Scenario.load(path, told["options"]), plans=told["plans"])
        job = built.job()
        jobs = OneJob(job)
        identity = jobs.identity
    if differs := [name for name in identity if identity[name] != record["identity"][name]]:
        raise LidarError(f"{path} has another {differs[0]} than these shards: give --scenario.")
    own: dict[str, Any] = {"scenario": built.scenario, "parts": parts, "notes": notes}
    output = _Merged(out, job.survey, job.outputs, told["extent"], **own)
    options = RunOptions(out=out, folder=Storage.at(out).below(RUN_FOLDER), resume=True)
    return Run(jobs, options, output, screen, RunPage()).execute()[1]


@dataclass(eq=False)
class _Merged(SurveyOutput):
    """The result of a survey whose points are those of parts."""

    parts: Sequence[_Part] = ()
    notes: Sequence[str] = ()
    casts = False

    def look(self, run: Run[tuple[RunResult, dict[str, Any]]]) -> None:
        """Take all points into the run's store; LidarError names damaged files."""
        store = run.store
        damaged = list[str]()
        only = store.only_job
        mark = store.db.meta["mark"]
        assert only is not None, "of a survey"

        def take(source: Storage, one: Receipt) -> Receipt | None:
            """Return the receipt of a file that is taken; None if it is missing or damaged."""
            own = part_name(mark, 0, one.first, one.stop)
            with explained(f"{source.path(one.name)} cannot be taken"), suppress(FileNotFoundError):
                store.storage.take(source, one.name, own)
                receipt = only.receipt(own)
                if receipt is not None and replace(receipt, name=one.name, summaries=b"") == one:
                    return receipt
                store.storage.remove([own])
            return None

        for part in self.parts:
            if casting := part.record["casting"]:
                store.cast_with(part.record["backend"], casting)
            if part.trials and not only.trials:
                store.db.add_trials(only, part.trials)
            source = parts_of(part.place.below(RUN_FOLDER), part.record["parts"])
            left = (one for one in part.points if only.parts.missing(one.first, one.stop))
            for one, receipt in read_ahead(partial(take, source), left):
                if receipt is None or not store.db.commit([(only, receipt)]):
                    damaged.append(source.path(one.name))
        if damaged:
            raise LidarError(f"missing or damaged: {listed(damaged, NAMED)}; {_AGAIN}.")
        if not only.trials:  # the first shard, which plans, is missing
            only.job = replace(only.job, planning=None)
        only.frames = only.scans.stop
        only.resumed = 0
        store.notes = [*self.notes]
