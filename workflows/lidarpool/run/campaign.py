"""A campaign on a cluster: several jobs under way at a time, into one data set."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Future as Done
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, ExitStack, nullcontext, suppress
from dataclasses import dataclass, field, replace
from queue import Empty, Full, Queue
from threading import Event, Thread
from typing import Any

from distributed import Client, Future

from poolpart import (
    Partition,
    Recorder,
    TaskRecord,
    fetch_available,
    look_for_tasks,
)

from ..base.errors import LidarpoolError, explained
from ..base.software import call_alike
from ..base.storage import Storage
from ..columns.cloud import CloudLike
from ..columns.parts import StoredCloud
from ..export.dataset import DataSet, Listing
from ..export.jobs import JobRow, Tally
from ..export.sweeps import Sweeps
from ..export.table import check_whole
from ..pipeline import EXPORT, INTERSECT, LIDAR, Crew, JobError, SurveyDriver
from ..pipeline.failures import raise_if_failed, was_killed
from ..pipeline.task_book import StageTotals, TaskBook
from ..scenario.campaign import Campaign, Described, hashes
from ..scenario.scenario import KeptScenes
from .campaign_store import CampaignStore
from .checks import slots_needed
from .job import Job, make_job
from .page import JobNow, Page
from .progress import Progress, Show
from .run import Cluster, Surveys
from .store import RunStore
from .watch import Waiting

READY = 2  # jobs that are made ahead
ANNOUNCED = 2  # jobs whose scans stage 1 has yet to describe
SPARE = 8  # jobs under way beside two for each GPU slot
WRITING = 2  # jobs that wait to be written, for each free slot of LIDAR
BEGIN_S = 10.0  # for any job to begin to be written; then the driver writes one
STOP_S = 10.0  # for a job that is being made when the run ends


@dataclass(eq=False)
class Entry:
    """A job on its way into the data set."""

    described: Described
    job: Job
    store: RunStore
    sweeps: Sweeps
    made_of: Sequence[Sequence[str]]
    driver: SurveyDriver | None = None
    casting: float = 0.0  # seconds of its tasks

    @property
    def name(self) -> str:
        """Its name in files."""
        return self.described.name


@dataclass(frozen=True)
class CampaignRun:
    """What `Campaign.run` returns.

    Parameters
    ----------
    failed
        Jobs that have failed, with `number`, `name`, `values` and `error`; see `jobs.csv`.
    done, points, rays
        Jobs in the data set, their points, and the rays that were cast for them.
    casting_seconds
        Of all casting tasks together.
    resumed
        Jobs of an earlier run.
    seconds
        Wall time of this run.
    stages
        Tasks of each stage.
    notes, sensors
        Remarks for the user, and the sensors of the jobs that are done, {name: models and rates}.
    """

    failed: tuple[JobRow, ...]
    done: int
    points: int
    rays: int
    casting_seconds: float
    resumed: int
    seconds: float
    stages: tuple[StageTotals, ...]
    notes: tuple[str, ...]
    sensors: Mapping[str, str]


def failed_row(number: int, error: object, described: Described | None) -> JobRow:
    """Return the row of a job that has failed."""
    name = described.name if described else f"{number:04}"
    split = described.split if described else ""
    return JobRow(number, name, split, dict(described.values) if described else {}, str(error))


def described_job(
    described: Described, columns: tuple[str, ...], kept: KeptScenes | None = None, **options: Any
) -> Job:
    """Make a described job, with the columns that its data set needs, and without planning."""
    if described.scenario is not None:
        job = make_job(described.scenario, options.pop("backend", None), True, kept=kept, **options)
    else:
        assert described.made is not None, "either of both"
        backend = options.pop("backend", None) or "auto"
        job = Job(described.made.scene, described.made.survey, backend=backend, **options)
    if job.survey.navigation is not None:
        raise LidarpoolError(
            "navigation is for single surveys, since a data set has no place for its files: leave "
            "it out of the campaign's base."
        )
    check_whole(columns, job.survey.keep_every)
    there = {column.name for column in job.survey.stored_columns}
    if missing := [name for name in columns if name not in there]:
        survey = replace(job.survey, columns=(*job.survey.columns, *missing))
        job = replace(job, survey=survey)
    return job


class _Maker:
    """Makes the jobs that are left, in a thread, a few ahead."""

    def __init__(
        self, campaign: Campaign, store: CampaignStore, columns: tuple[str, ...], **options: Any
    ) -> None:
        self._campaign, self._store, self._columns = campaign, store, columns
        self._options, self._scenes = options, KeptScenes()
        self._ready: Queue[Entry | JobRow | BaseException | None] = Queue(READY)
        self._stopped = Event()
        self._put_back: deque[Entry] = deque()
        self._thread = Thread(target=self._work, name="jobs", daemon=True)
        self._thread.start()

    def take(self, *, wait: bool = False) -> Entry | JobRow | None:
        """Return the next job, or the row of one that cannot be made; None if none is ready.

        EOFError after the last. With `wait` it waits for one.
        """
        if self._put_back:
            return self._put_back.popleft()
        try:
            found = self._ready.get(block=wait)
        except Empty:
            return None
        if found is None:
            self._ready.put(None)
            raise EOFError
        if isinstance(found, BaseException):
            raise found
        return found

    def put_back(self, entry: Entry) -> None:
        """Let a job be taken again."""
        self._put_back.append(entry)

    def _work(self) -> None:
        try:
            for number in self._store.left:
                if not self._put(self._made(number)):
                    return
            self._put(None)
        except BaseException as error:
            self._put(error)

    def _made(self, number: int) -> Entry | JobRow:
        described = None
        try:
            described = self._campaign.describe(number)
            made_of = hashes(described.scenario.files) if described.scenario else []
            job = described_job(described, self._columns, self._scenes, **self._options)
            sweeps = Sweeps.of(job.survey, job.scene)
        except MemoryError:
            raise
        except Exception as error:
            # A class of the user's own may raise anything: the other jobs go on.
            told = str(error) if isinstance(error, LidarpoolError) else repr(error)
            return failed_row(number, told, described)
        try:
            return Entry(described, job, self._store.store_of(described.name, job), sweeps, made_of)
        except JobError as error:  # any other is of the place, which all jobs need
            return failed_row(number, error, described)

    def _put(self, found: Entry | JobRow | BaseException | None) -> bool:
        while not self._stopped.is_set():
            with suppress(Full):
                self._ready.put(found, timeout=0.1)
                return True
        if isinstance(found, Entry):
            found.store.close()
        return False

    def close(self) -> None:
        """Make no more jobs, and close those that nobody has taken."""
        self._stopped.set()
        self._thread.join(STOP_S)
        entries = [*self._put_back]
        while not self._ready.empty():
            with suppress(Empty):
                entries += [one for one in [self._ready.get_nowait()] if isinstance(one, Entry)]
        for entry in entries:
            entry.store.close()


def write_job(
    dataset: DataSet, probes: tuple[Any, Any], number: int, name: str, cloud: StoredCloud,
    sweeps: Sweeps, made_of: Sequence[Sequence[str]],
) -> tuple[dict[str, Any] | None, TaskRecord]:  # fmt: skip
    """Write the files of a job on a LIDAR worker, and count its points.

    None in place of the counts if the worker does not see the data set, or the parts.
    """
    recorder = Recorder(EXPORT, LIDAR)
    (place, *probe), (parts, *other) = probes
    if not place.sees(*probe) or not parts.sees(*other):
        return None, recorder.done()
    written = _written(dataset, number, name, cloud, sweeps, made_of)
    return written, recorder.done(int(sweeps.scans[-1]))


def _written(
    dataset: DataSet, number: int, name: str, cloud: CloudLike, *more: Any
) -> dict[str, Any]:
    """Write a job; JobError if that fails, LidarpoolError if it is because of the place."""
    listing = Listing.of(dataset.place)
    try:
        tally = Tally.of(cloud)
        dataset.write_job(number, name, cloud, *more, listing=listing)
    except Exception as error:
        why = error if isinstance(error, OSError) else error.__cause__
        if isinstance(why, OSError):  # a full disk fails all jobs
            told = f"{error}" if isinstance(error, LidarpoolError) else f"job {name}: {error}"
            raise LidarpoolError(told) from error
        with suppress(OSError):
            listing.prune(listing.files)
        raise JobError(str(error) if isinstance(error, LidarpoolError) else repr(error)) from error
    return {"points": tally.points, "sha256": tally.sha256, "classes": tally.classes}


@dataclass(eq=False)
class _Writer:
    """Has LIDAR workers write jobs into the data set; what they cannot see is written here."""

    client: Client
    partition: Partition
    dataset: DataSet
    probes: tuple[Any, Any]
    sources: str
    book: TaskBook = field(default_factory=TaskBook)
    waiting: deque[Entry] = field(default_factory=deque)
    writing: dict[Future, Entry] = field(default_factory=dict)
    here: dict[Done[Any], Entry] = field(default_factory=dict)
    _thread: ThreadPoolExecutor = field(default_factory=lambda: ThreadPoolExecutor(1, "write"))
    hidden: bool = False
    _moved_at: float = field(default_factory=time.monotonic)

    def __len__(self) -> int:
        return len(self.waiting) + len(self.writing) + len(self.here)

    def add(self, entry: Entry) -> None:
        """Have a job written."""
        self.waiting.append(entry)

    def step(self, slots: int) -> list[tuple[Entry, dict[str, Any] | LidarpoolError]]:
        """Submit what there is room for; returns the jobs that were written, or why they were not.

        Errors of single jobs are JobErrors; others are of the place, or of a worker's software.
        """
        while self.waiting and len(self.writing) < WRITING * slots:
            entry = self.waiting.popleft()
            self.writing[self._submitted(entry)] = entry
        ended: list[tuple[Entry, Any]] = []
        done = {f.key: f for f in self.writing if f.status == "finished"}
        for key, (made, record) in fetch_available(self.client, [*done]).items() if done else ():
            entry = self.writing.pop(done[key])
            self.book.add(record)
            if made is None:
                self.hidden = True
                self._write_here(entry)
            else:
                ended.append((entry, made))
        for future in [f for f in self.writing if f.status not in ("pending", "finished")]:
            entry = self.writing.pop(future)
            if future.status == "error" and was_killed(future):
                self._write_here(entry)
                continue
            try:
                raise_if_failed(future, "writing it")
                self.waiting.append(entry)  # lost: it is done again
            except LidarpoolError as error:
                of_job = isinstance(error.__cause__, JobError)
                ended.append((entry, JobError(str(error)) if of_job else error))
        for result in [one for one in self.here if one.done()]:
            entry = self.here.pop(result)
            try:
                ended.append((entry, result.result()))
            except LidarpoolError as error:
                ended.append((entry, error))
        self._relieve(bool(ended))
        return ended

    def _relieve(self, moved: bool) -> None:
        """Write a job here if none has begun for long: all slots are held, or have gone."""
        now = time.monotonic()
        if moved or self.here or not self.writing:
            self._moved_at = now
        elif now - self._moved_at > BEGIN_S:
            self._moved_at = now
            keys = [future.key for future in self.writing]
            seen = look_for_tasks(self.client, self.partition.name, keys)
            if any(at.started and not seen.out_of_reach(key) for key, at in seen.tasks.items()):
                return
            future = next(iter(self.writing))
            entry = self.writing.pop(future)
            future.cancel()
            self._write_here(entry)

    def _submitted(self, entry: Entry) -> Future:
        number, name = entry.described.number, entry.name
        future: Future = self.partition.submit(
            call_alike, self.sources, write_job, self.dataset, self.probes, number, name,
            entry.store.points(), entry.sweeps, entry.made_of, priority=5,
        )  # fmt: skip
        return future

    def _write_here(self, entry: Entry) -> None:
        number, name = entry.described.number, entry.name
        what = (entry.store.points(), entry.sweeps, entry.made_of)
        written = self._thread.submit(_written, self.dataset, number, name, *what)
        self.here[written] = entry

    def close(self) -> None:
        """Write nothing more."""
        self.client.cancel([*self.writing])
        self._thread.shutdown(cancel_futures=True)


class CampaignDriver(Surveys):
    """Casts the jobs of a campaign, several at a time, and has them written."""

    def __init__(
        self,
        cluster: Cluster,
        crew: Crew,
        store: CampaignStore,
        maker: _Maker,
        writer: _Writer,
        page: Page,
    ) -> None:
        self._cluster, self._crew, self._store = cluster, crew, store
        self._maker, self._writer, self._page = maker, writer, page
        # Slots of LIDAR that the long stages leave, as they are at the start.
        needed = slots_needed(cluster.job)[LIDAR]
        self._slots = max(1, cluster.partitions[LIDAR].slots - needed)
        self._under_way: list[Entry] = []
        self._all_made = False
        self._remover = ThreadPoolExecutor(1, "remove")
        self._committed = 0
        self._begun = (0, 0)  # jobs, and their scans
        self.books = TaskBook()

    @property
    def finished(self) -> bool:
        """True once all jobs have ended."""
        return self._all_made and not self._under_way and not len(self._writer)

    @property
    def progress(self) -> int:
        """A number that grows when something is committed."""
        under_way = sum(e.driver.progress for e in self._under_way if e.driver is not None)
        return self._committed + under_way

    def under_way(self) -> list[JobNow]:
        """List the jobs that are cast, then those that are written."""
        writer = self._writer
        written = (*writer.writing.values(), *writer.here.values(), *writer.waiting)
        return [_under_way(entry) for entry in (*self._under_way, *written)]

    def step(self) -> bool:
        """Do what can be done now; returns whether there was anything to do.

        LidarpoolError if something fails that all jobs need.
        """
        moved = self._admit()
        for entry in [*self._under_way]:
            assert entry.driver is not None, "it is under way"
            try:
                moved |= entry.driver.step()
            except JobError as error:
                self._leave(entry)
                self._fail(entry, error)
                moved = True
                continue
            if entry.driver.finished:
                self._leave(entry)
                self._writer.add(entry)
                moved = True
        slots = 0 if self._crew.stages.lacks_slot else self._slots  # that has to come first
        for_all: LidarpoolError | None = None
        for entry, made in self._writer.step(slots) if len(self._writer) else ():
            if isinstance(made, JobError):
                self._fail(entry, made)
            elif isinstance(made, LidarpoolError):
                self._writer.add(entry)  # it is not lost
                for_all = made
            else:
                self._end(entry, made)
            moved = True
        if for_all is not None:
            raise for_all
        return moved

    # -- jobs come and go --------------------------------------------------------------------

    def _admit(self) -> bool:
        """Take on jobs that are ready, if there is room for them."""
        moved = False
        while not self._all_made and self._has_room:
            try:
                found = self._maker.take()
            except EOFError:
                self._all_made = True
                break
            if found is None:
                break
            moved = True
            if isinstance(found, JobRow):
                self._commit(found)
                continue
            try:
                self._cluster.check(found.job)
                self._begin(found)
            except JobError as error:  # too large for the workers, or it cannot be pickled
                self._fail(found, error)
        return moved

    @property
    def _has_room(self) -> bool:
        announced = sum(
            e.driver.generated < e.job.survey.scan_count for e in self._under_way if e.driver
        )
        most = SPARE + 2 * self._crew.workers.slot_count
        return announced < ANNOUNCED and len(self._under_way) + len(self._writer) < most

    def _begin(self, entry: Entry) -> None:
        # Of this job many follow, so that its batches need not be divided among all workers.
        left = self._store.count - len(self._store.db.jobs)
        entry.driver = self._cluster.driver(
            self._crew,
            entry.store,
            lambda frame: None,
            entry.name,
            self._store.folder_of(entry.store),
            entry.job.survey.scan_count * left,
        )
        self._under_way.append(entry)
        self._begun = (self._begun[0] + 1, self._begun[1] + entry.job.survey.scan_count)
        ended = len(self._store.db.jobs)
        to_come = self._store.count - ended - len(self._under_way) - len(self._writer)
        self._crew.later = max(0, to_come) * self._begun[1] // self._begun[0]

    def _leave(self, entry: Entry) -> None:
        """Let the crew do nothing more for a job."""
        driver = entry.driver
        assert driver is not None, "it was under way"
        self._crew.leave(driver.seat)
        self._under_way.remove(entry)
        self._committed += driver.progress
        totals = driver.book.stages.get(INTERSECT)
        entry.casting = _casting_seconds(driver)
        for record in driver.book.stages[INTERSECT].records if totals else ():
            self.books.add(record)
        entry.driver = None

    def _end(self, entry: Entry, made: Mapping[str, Any]) -> None:
        """Commit a job that is written."""
        described, survey, db = entry.described, entry.job.survey, entry.store.db
        row = JobRow(
            number=described.number,
            name=described.name,
            split=described.split,
            values=dict(described.values),
            scans=survey.scan_count,
            sweeps=len(entry.sweeps),
            rays=survey.ray_count,
            hits=db.hits,
            seconds=entry.casting,
            **made,
        )
        self._store.name_sensors(
            (carried.name or "lidar", f"{sensor.model}, {1e9 / sensor.turn_ns(1):.3g} Hz")
            for carried in survey.carried
            for sensor in [carried.sensor]
        )
        self._commit(row)
        self._drop(entry, row)

    def _fail(self, entry: Entry, error: LidarpoolError) -> None:
        """Commit that a job has failed."""
        described = entry.described
        self._commit(failed_row(described.number, error, described))
        self._drop(entry)

    def _commit(self, row: JobRow) -> None:
        self._store.end(row)
        self._page.ended(row)

    def _drop(self, entry: Entry, row: JobRow | None = None) -> None:
        def drop() -> None:
            try:
                if row is not None:
                    self._page.look(row, entry.store)
            finally:
                with suppress(LidarpoolError, OSError):  # what is left does no harm
                    entry.store.remove()

        self._remover.submit(drop)

    def close(self) -> None:
        """Close the stores of what is under way, and wait for those that are removed."""
        with suppress(Exception):  # report the first error
            self._writer.close()
        self._remover.shutdown()
        left = [*self._writer.waiting, *self._writer.writing.values(), *self._writer.here.values()]
        for entry in (*self._under_way, *left):
            with suppress(LidarpoolError):
                entry.store.save(now=True)
            entry.store.close()


def _casting_seconds(driver: SurveyDriver) -> float:
    totals = driver.book.stages.get(INTERSECT)
    return totals.seconds if totals else 0.0


def _under_way(entry: Entry) -> JobNow:
    driver, db = entry.driver, entry.store.db
    return JobNow(
        name=entry.name,
        values=entry.described.values,
        stored=db.scans_done,
        scans=entry.job.survey.scan_count,
        points=db.point_count,
        seconds=entry.casting if driver is None else _casting_seconds(driver),
        writing=driver is None,
    )


def run_campaign(
    connect: Callable[[Waiting, Job], Client],
    campaign: Campaign,
    store: CampaignStore,
    dataset: DataSet,
    tell: Callable[[str], None],
    waiting: Waiting,
    *,
    own: bool,
    progress: AbstractContextManager[Show],
    page: Page,
    backend: str | None,
    wait_s: float,
    patience_s: float,
) -> CampaignRun:
    """Do the jobs that are left; on any error, everything has been stopped.

    `connect` is called with the first job, if there is one that can be made.

    LidarpoolError if the cluster lacks something, or what all jobs need fails.
    """
    started = time.monotonic()
    options = {"backend": backend, "wait_s": wait_s, "patience_s": patience_s}
    with ExitStack() as stack:
        maker = _Maker(campaign, store, dataset.columns, **options)
        stack.callback(maker.close)
        if (first := _first(maker, store, page)) is None:
            return run_result(store.rows(), started, store=store)
        client = connect(waiting, first.job)
        show = stack.enter_context(progress)
        probe = (f"{store.db.meta['mark']}-dataset", store.db.meta["mark"].encode())
        with explained(f"{dataset.place} cannot be written"):
            dataset.place.prepare()
            dataset.place.write(*probe)
        stack.callback(_remove_probe, dataset.place, probe[0])
        while True:
            needed = slots_needed(first.job)
            needed[LIDAR] += 1  # which jobs are written in
            left = first.job.survey.scan_count * len(store.left)
            try:
                cluster = Cluster(client, first.job, store, tell, waiting, needed, left)
                break
            except JobError as error:  # it is too large for the workers; others may not be
                described = first.described
                row = failed_row(described.number, error, described)
                store.end(row)
                page.ended(row)
                maker.take()  # that one
                first.store.remove()
                if (first := _first(maker, store, page)) is None:
                    return run_result(store.rows(), started, store=store)
        crew = cluster.crew(store.storage, store.db.meta["mark"])
        probes = ((dataset.place, *probe), (store.storage, *crew.probe))
        sources = store.casting["lidarpool"]
        writer = _Writer(client, cluster.partitions[LIDAR], dataset, probes, sources)
        driver = CampaignDriver(cluster, crew, store, maker, writer, page)
        stack.callback(driver.close)
        page.follow(cluster.partitions)

        def on_progress(_: Surveys, seconds: float) -> None:
            waits_for = LIDAR if crew.stages.waiting else ""
            now = _progress(store, seconds, waits_for)
            cluster.call(show, now)
            cluster.call(lambda progress: page.on_progress(progress, driver.under_way), now)

        with nullcontext() if own else cluster.partitions_page():
            cluster.run(crew, lambda: driver, None, store.save, on_progress)
    store.save(now=True)
    books = (driver.books, writer.book, cluster.stages)
    stages = tuple(totals for book in books for totals in book.stages.values())
    notes = [*cluster.notes]
    if writer.hidden:
        notes.append(f"no worker of {LIDAR} sees {dataset.place}: the driver wrote the data set")
    return run_result(store.rows(), started, stages, notes, store)


def _first(maker: _Maker, store: CampaignStore, page: Page) -> Entry | None:
    """Wait for a job that can be made, which stays the next to be taken; None without any."""
    try:
        while not isinstance(found := maker.take(wait=True), Entry):
            assert found is not None, "it was waited for"
            store.end(found)
            page.ended(found)
    except EOFError:
        return None
    maker.put_back(found)
    return found


def _remove_probe(place: Storage, name: str) -> None:
    with suppress(OSError):
        place.remove([name])


def _progress(store: CampaignStore, seconds: float, waits_for: str) -> Progress:
    return Progress(
        scans=0, generated=0, cast=0, framed=0, collected=0, points=0, trials=0, trials_done=0,
        seconds=seconds, waits_for=waits_for, jobs=store.count, jobs_done=len(store.db.jobs),
    )  # fmt: skip


def run_result(
    rows: Iterable[JobRow],
    started: float,
    stages: tuple[StageTotals, ...] = (),
    notes: Sequence[str] = (),
    store: CampaignStore | None = None,
) -> CampaignRun:
    """Sum up the rows of a campaign."""
    failed, done, points, rays, seconds = [], 0, 0, 0, 0.0
    for row in rows:
        if row.error:
            failed.append(row)
        else:
            done, points, rays = done + 1, points + row.points, rays + row.rays
            seconds += row.seconds
    return CampaignRun(
        tuple(failed),
        done,
        points,
        rays,
        seconds,
        store.resumed if store else done,
        time.monotonic() - started,
        stages,
        (*(store.notes if store else ()), *notes),
        store.sensors if store else {},
    )
