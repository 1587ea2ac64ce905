"""Shards of a campaign or survey, and the one data set or result that is made of them."""

from __future__ import annotations

import json
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, replace
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

from ..base.errors import LidarpoolError, Mistakes, explained
from ..base.shard import Shard
from ..base.software import software
from ..base.storage import Storage
from ..base.validation import checked
from ..base.words import plural
from ..columns.parts import part_name
from ..datasets.dataset import INDEX_FILE, DataSet
from ..datasets.job_table import JobRow, read_table
from ..export.folder import LAST_FILE, output_place, result_folder
from ..pipeline.database import FILE, RunDatabase, pack_trial, unpack_trial
from ..pipeline.messages import Receipt
from ..run.conductor import Conductor, Output
from ..run.job_points import CHECKERS, listed
from ..run.job_source import OneJob
from ..run.options import RunOptions
from ..run.progress import Screen
from ..run.run_page import RunPage
from ..run.run_result import CampaignRun, RunResult
from ..run.store import PARTS, RUN_FOLDER, RunStore, with_sensors
from ..scenario.build import build
from ..scenario.scenario import Scenario
from .campaign_output import (
    CAMPAIGN_FILE,
    dataset_files,
    described,
    write_record,
    write_shared,
)
from .output import SurveyOutput

SHARD_FILE = "shard.json"  # the manifest of a shard of a survey
ROWS = 1_000  # of jobs in memory at a time
_WHOLE: Mapping[str, Any] = {"of": 1, "there": [1]}  # what a record of None stands for
_MISSING = "missing: "  # begins a note
_AGAIN = "Run these shards again with --resume (a campaign with --verify), then merge again"


@dataclass(eq=False)
class ShardOutput(Output[RunResult]):
    """A shard of a survey in its folder or storage: the parts of its run, and their manifest.

    `scenario` says what the survey is made of, for `merge`: path, options of a mesh, plans.
    """

    place: Path | Storage
    scenario: Mapping[str, Any]

    @contextmanager
    def held(self) -> Iterator[None]:
        """Lock the place while the body runs."""
        with result_folder(self.place):
            yield

    def begin(self, conductor: Conductor[RunResult]) -> None:
        """Refuse a place with something else, or with a finished shard."""
        there, options = Storage.at(self.place).entries(), conductor.options
        if strange := sorted(there.keys() - {RUN_FOLDER, SHARD_FILE}):
            raise LidarpoolError(
                f"{self.place} holds {strange[0]}: a shard needs a folder of its own, give another "
                "with --out."
            )
        if SHARD_FILE in there and not (conductor.resume or options.fresh):
            raise LidarpoolError(
                f"{self.place} holds a finished shard: give another folder with --out, or delete "
                "that with --fresh."
            )

    def look(self, conductor: Conductor[RunResult]) -> None:
        """Take the manifest away while scans are missing."""
        if (only := conductor.store.only) is not None and not only.complete:
            Storage.at(self.place).remove([SHARD_FILE])

    def finish(self, conductor: Conductor[RunResult]) -> RunResult:
        """Write the manifest; the run stays."""
        result, store, only = conductor.result(), conductor.store, conductor.store.only
        assert only is not None, "of a survey"
        record = {
            "identity": dict(store.identity),
            "casting": store.casting,
            "backend": store.backend,
            "shards": {"of": store.jobs.shard.of, "there": [store.jobs.shard.number]},
            "notes": store.notes,
            "scenario": dict(self.scenario),
            "scans": only.job.survey.scan_count,
            "place": store.db.meta["parts"] or f"{RUN_FOLDER}/{PARTS}",
            "parts": [[p.name, p.first, p.stop, p.rows, p.size] for p in only.parts.ordered],
            "trials": [pack_trial(trial) for trial in only.parts.trials],
        }
        with explained(f"{self.place} cannot be written"):
            Storage.at(self.place).write(SHARD_FILE, json.dumps(record).encode())
        conductor.page.finish(result.seconds, result)
        store.save(now=True)
        store.db.close()
        return result


@dataclass(frozen=True)
class _Part:
    """What is to be merged: a shard, or a data set of several."""

    place: Storage
    record: Mapping[str, Any]  # content of SHARD_FILE or CAMPAIGN_FILE
    notes: Sequence[str] = ()

    @property
    def whole(self) -> int:
        """How many jobs or scans there are in all."""
        record = self.record
        return int(record["scans"] if "scans" in record else record["campaign"]["count"])

    @property
    def of(self) -> int:
        """Into how many shards the campaign or survey is divided."""
        return int((self.record["shards"] or _WHOLE)["of"])

    @property
    def there(self) -> list[Shard]:
        """The shards in it."""
        return [Shard(n, self.of) for n in (self.record["shards"] or _WHOLE)["there"]]

    @property
    def made_of(self) -> dict[str, Any]:
        """What all shards must have in common."""
        record = self.record
        found = {f"its {name}": value for name, value in record["identity"].items()}
        found |= {"its kind": "scans" in record, "number of shards": self.of}
        found |= {f"file {name}": digest for name, digest in record.get("files", ())}
        if record["casting"]:  # of a shard without jobs nothing was cast
            casting = record["casting"] | {"backend": record["backend"]}
            found |= {f"its {name} of workers": value for name, value in casting.items()}
        return found


def _read(place: Storage) -> _Part:
    """Read a part; LidarpoolError if it is none, or not finished."""
    with explained(f"{place} cannot be read"):
        there, notes = place.sizes(), []
        of_survey = SHARD_FILE in there
        if of_survey or {CAMPAIGN_FILE, INDEX_FILE, LAST_FILE} <= there.keys():
            with suppress(ValueError, LookupError, TypeError):
                record = json.loads(place.read(SHARD_FILE if of_survey else CAMPAIGN_FILE))
                told = record if of_survey else json.loads(place.read(LAST_FILE))
                notes = [note for note in told["notes"] if not note.startswith(_MISSING)]
                part = _Part(place, record, notes)
                if part.there and part.whole and part.made_of:
                    return part
    raise LidarpoolError(
        f"{place} holds no finished shard: give a folder that lidarpool run --shard has written, "
        "and finish an unfinished one with --resume."
    )


def _check(parts: Sequence[_Part], own: _Part | None) -> None:
    """Check that all are of one run and of the code here; LidarpoolError names those that are not.

    `own` is what the place holds already.
    """
    mistakes, here = Mistakes(), software()["lidarpool"]
    first = next((part for part in parts if part.record["casting"]), parts[0])
    wanted = first.made_of
    if (there := first.record["identity"]["lidarpool"]) != here:
        raise LidarpoolError(f"{first.place} was made with lidarpool {there}, here is {here}.")
    seen: dict[int, _Part] = {}
    for part in parts:
        made = part.made_of
        differs = [name for name in wanted if made.get(name, wanted[name]) != wanted[name]]
        if differs:
            what = "shards of one campaign or survey, made with the same software"
            told = f"{part.place} and {first.place} differ: {differs[0]}; {what}, can be merged."
            mistakes.lines.append(told)
            continue
        for shard in part.there:
            if part is not own and (other := seen.setdefault(shard.number, part)) is not part:
                mistakes.lines.append(
                    f"shard {shard} is in {other.place} and in {part.place}: give one of them."
                )
    mistakes.tell()


def _missing(parts: Sequence[_Part]) -> list[Shard]:
    """List the shards that are not there, or lack jobs since the campaign has grown."""
    whole, of = max(part.whole for part in parts), parts[-1].of

    def share(shard: Shard, whole: int) -> int:
        return len(shard.jobs(whole)) if "campaign" in parts[0].record else len(shard.scans(whole))

    have = {s.number: share(s, part.whole) for part in parts for s in part.there}
    every = (Shard(number, of) for number in range(1, of + 1))
    return [shard for shard in every if have.get(shard.number, 0) < share(shard, whole)]


@checked
def merge(
    shards: Sequence[str | Path],
    out: str | Path,
    *,
    partial: bool = False,
    scenario: str | Path | None = None,
) -> dict[str, Any]:
    """Make one data set or result of shards, with the files that one run would have made.

    Files are linked (hard links) or copied by the object store where that is possible, else copied;
    every byte is checked. After a kill, the same call goes on.

    Parameters
    ----------
    shards
        Folders or URLs of all shards of one campaign or survey, see `Campaign.run`.
    out
        Folder or URL of the data set or result. Shards of a campaign can be added to it later.
    partial
        Merge what there is; a note says what is missing.
    scenario
        Of a survey: its scenario or mesh file, if that is not where it was when the shards ran.

    Returns
    -------
    The content of report.json.

    Raises
    ------
    LidarpoolError
        If shards are missing, damaged, given twice, unfinished, of other runs or of other software;
        the message names them.
    """
    return merge_shards([*map(Storage.at, shards)], output_place(out), partial, scenario, Screen())


def merge_shards(
    places: Sequence[Storage],
    out: Path | Storage,
    partial: bool,
    scenario: str | Path | None,
    screen: Screen,
) -> dict[str, Any]:
    """Do the work of `merge`, and tell the user on a screen."""
    parts, mistakes, target = list[_Part](), Mistakes(), Storage.at(out)
    for place in {place.url: place for place in places if place.url != target.url}.values():
        with mistakes.noted():
            parts.append(_read(place))
    if not parts or not partial:
        mistakes.tell()
    if not parts:
        raise LidarpoolError("there is nothing to merge: give the folders of shards.")
    notes = [*dict.fromkeys(note for part in parts for note in part.notes)]
    if "scans" in parts[0].record:
        _check(parts, None)
        notes += _note_missing(parts, partial)
        return _merge_survey(parts, out, notes, scenario, screen)
    with result_folder(out), screen.status("merging the data set"):
        return _merge_dataset(parts, target, notes, partial)


def _note_missing(parts: Sequence[_Part], partial: bool) -> list[str]:
    """Return a note on shards that are missing, if any; LidarpoolError unless it is `partial`."""
    if not (missing := _missing(parts)):
        return []
    told = f"{_MISSING}{plural(len(missing), 'shard')}, {listed([*map(str, missing)], 20)}"
    if not partial:
        raise LidarpoolError(
            f"{told}: give their folders, too, or merge what there is with --partial."
        )
    return [told]


# -- campaigns --------------------------------------------------------------------------------


def _merge_dataset(
    parts: Sequence[_Part], out: Storage, notes: Sequence[str], partial: bool
) -> dict[str, Any]:
    """Take the jobs of all parts into a data set, and write what all jobs share."""
    began = time.monotonic()
    own = _own_part(out, parts)
    known = parts if own is None else [own, *parts]  # a later one has what was done again
    _check(known, own)
    missing = _note_missing(known, partial)
    newest = max(known, key=lambda part: part.whole)
    cast = next((part for part in known if part.record["casting"]), newest)
    record = {**cast.record, "campaign": newest.record["campaign"], "sensors": {}}
    for part in known:
        sensors = with_sensors(record["sensors"], part.record["sensors"].items())
        record["sensors"] = sensors
    keep = described(record).keep
    dataset = DataSet(replace(out, durable=False), keep.format, keep.layout)
    dataset.check_installed()
    of, there = parts[0].of, {shard.number for part in known for shard in part.there}
    if own is None:  # from now on it is known whose files these are
        write_record(out, record | {"shards": {"of": of, "there": []}})
    with tempfile.TemporaryDirectory(prefix="lidarpool-") as folder:
        rows = RunDatabase(Path(folder, FILE), durable=False)
        try:
            _take_jobs(dataset, known, own, rows)
            lack = {shard.number for shard in _missing(known)}
            shards = {"of": of, "there": sorted(there - lack)} if lack else None
            run = CampaignRun.of(
                map(JobRow.of, rows.job_rows()),
                time.monotonic() - began,
                0,
                sensors=record["sensors"],
                notes=(*notes, *missing),
            )
            record["shards"] = shards
            return write_shared(dataset, record, run, lambda: map(JobRow.of, rows.job_rows()))
        finally:
            rows.close()


def _own_part(out: Storage, parts: Sequence[_Part]) -> _Part | None:
    """Return what the place holds already; None if it is empty.

    LidarpoolError if it holds something else than a data set.
    """
    if FILE in out.below(RUN_FOLDER).sizes():
        raise LidarpoolError(
            f"{out} holds an unfinished run: finish it with --resume, or give another with --out."
        )
    begun = CAMPAIGN_FILE in out.sizes()
    dataset_files(out, begun=begun)
    if not begun:
        return None
    with explained(f"{out} cannot be read"):
        try:
            record = json.loads(out.read(CAMPAIGN_FILE))
            of = parts[0].of
            shards = record["shards"] or {"of": of, "there": [*range(1, of + 1)]}
            return _Part(out, record | {"shards": shards})
        except (ValueError, LookupError, TypeError) as error:
            raise LidarpoolError(
                f"{out.path(CAMPAIGN_FILE)} is damaged: give another folder with --out."
            ) from error


def _take_jobs(
    dataset: DataSet, parts: Sequence[_Part], own: _Part | None, rows: RunDatabase
) -> None:
    """Have the files of all jobs in a data set, and their rows; LidarpoolError names damaged ones."""
    damaged: list[str] = []
    for part in parts:
        if part is own and not part.there:
            continue
        jobs = read_table(part.place)
        with explained(f"{dataset.place} cannot be merged"):
            taken = ((job, "") for job in jobs) if part is own else dataset.take(part.place, jobs)
            while some := [*islice(taken, ROWS)]:
                rows.end_jobs((job.number, bool(job.error), asdict(job)) for job, _ in some)
                damaged += [wrong for _, wrong in some if wrong]
    if damaged:
        raise LidarpoolError(f"{listed(damaged, 20)}. {_AGAIN}.")


# -- surveys ----------------------------------------------------------------------------------


@dataclass(eq=False)
class _MergedSurvey(SurveyOutput):
    """The result of a survey, of the parts of its shards."""

    shards: Sequence[_Part] = ()
    notes: Sequence[str] = ()
    casts = False

    def look(self, conductor: Conductor[tuple[RunResult, dict[str, Any]]]) -> None:
        """Take the parts of all shards into the run's store; LidarpoolError names damaged ones."""
        store, damaged = conductor.store, list[str]()
        only = store.only
        assert only is not None, "of a survey"
        first = self.shards[0].record
        store.cast_with(first["backend"], first["casting"])
        for shard in self.shards:
            if shard.record["trials"] and not only.parts.trials:
                store.db.add_trials(0, [*map(unpack_trial, shard.record["trials"])])
            place, relative = shard.record["place"], shard.place
            source = (
                Storage.at(place) if place != f"{RUN_FOLDER}/{PARTS}" else relative.below(place)
            )
            left = [part for part in shard.record["parts"] if only.parts.missing(*part[1:3])]
            with ThreadPoolExecutor(CHECKERS, "take") as pool:
                for part, receipt in zip(
                    left, pool.map(partial(_take, store, source), left), strict=True
                ):
                    if receipt is None:
                        damaged.append(source.path(part[0]))
                    else:
                        store.db.commit([receipt])
        if damaged:
            raise LidarpoolError(f"missing or damaged: {listed(damaged, 20)}. {_AGAIN}.")
        every = (part for shard in self.shards for part in shard.record["parts"])
        if any(only.parts.missing(*part[1:3]) for part in every):
            raise LidarpoolError(
                f"{store.place} holds the unfinished run of other shards: remove that, or give "
                "another folder with --out."
            )
        if not only.parts.trials:  # the shard that has planned is missing
            only.job = replace(only.job, planning=None)
        only.parts.frames, only.resumed = only.parts.scans.stop, 0
        store.notes = [*self.notes]


def _take(store: RunStore, source: Storage, part: Sequence[Any]) -> Receipt | None:
    """Take a part into a store; returns its receipt, or None if it is missing or damaged."""
    name, first, stop, rows, _ = part
    own, only = part_name(store.db.meta["mark"], 0, first, stop), store.only
    assert only is not None, "of a survey"
    with explained(f"{source.path(name)} cannot be taken"):
        try:
            store.storage.take(source, name, own)
        except FileNotFoundError:
            return None
    receipt = only.receipt(own)
    if receipt is None or (receipt.first, receipt.stop, receipt.rows) != (first, stop, rows):
        store.storage.remove([own])
        return None
    return receipt


def _merge_survey(
    shards: Sequence[_Part],
    out: Path | Storage,
    notes: Sequence[str],
    scenario: str | Path | None,
    screen: Screen,
) -> dict[str, Any]:
    """Make the survey again, and write its result of the parts."""
    told = shards[0].record["scenario"]
    path = Path(told["path"] if scenario is None else scenario)
    if not path.exists():
        raise LidarpoolError(
            f"{path}, which these shards are of, is not here: say where it is with --scenario."
        )
    with screen.status("reading the scene"):
        built = build(Scenario.load(path, told["options"]), plans=told["plans"])
        job = built.job()
        jobs = OneJob(job)
        identity = jobs.identity
    there = shards[0].record["identity"]
    if differs := [name for name, value in identity.items() if there[name] != value]:
        raise LidarpoolError(
            f"{path} has another {differs[0]} than the shards: give theirs with --scenario."
        )
    output = _MergedSurvey(
        out, job.survey, job.outputs, scenario=built.scenario, shards=shards, notes=notes
    )
    options = RunOptions(out=out, folder=Storage.at(out).below(RUN_FOLDER), resume=True)
    return Conductor(jobs, options, output, screen, RunPage())()[1]
