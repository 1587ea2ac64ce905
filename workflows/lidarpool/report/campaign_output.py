"""The data set of a campaign: conducts its run, and writes what all jobs share."""

from __future__ import annotations

import json
import re
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import AbstractContextManager, ExitStack, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from distributed import Client

from ..base.errors import LidarpoolError, explained
from ..base.software import difference, software
from ..base.storage import Storage
from ..base.words import counted
from ..export.dataset import INDEX_FILE, OF_JOBS, DataSet
from ..export.folder import result_folder
from ..export.jobs import JobRow, read_table, write_table
from ..export.loader import read_index, sweeps
from ..pipeline.database import FILE
from ..run.campaign import CampaignPage, CampaignRun, described_job, run_campaign, run_result
from ..run.campaign_store import CampaignStore
from ..run.identity import OF_CAMPAIGN
from ..run.job import Job
from ..run.progress import Show
from ..run.store import RUN_FOLDER, drop_run, listed
from ..run.watch import Waiting
from ..scenario.campaign import Campaign, Described, hashes
from .campaign_report import write_card
from .sweep_picture import draw_sweep

CAMPAIGN_FILE = "campaign.json"  # whose data set this is, and the software that made it

# With what `_finish` writes, CAMPAIGN_FILE first.
_FINISHED = re.compile(
    OF_JOBS.pattern + r"|(campaign|dataset|report)\.json|README\.md|report\.html|pictures/\w+\.png|"
    r"jobs\.(csv|parquet)|splits/[^/]+\.txt"
)
# The run, results of single jobs, and what writers that have not heard of their end may add.
_BESIDE = re.compile(r"(run|job-[^/]+)/.*|(.*/)?\.lidarpool-(tmp|writing)-.*")


@dataclass(frozen=True)
class Making:
    """How a campaign is to be made into a data set.

    `out` is its place; `own` says that the cluster is a local one for this run. `resume` continues
    an unfinished run, `fresh` drops it, `retry_failed` does failed jobs again; `overwrite` replaces
    a finished data set. Of the jobs that are done a resumed run compares sizes of files, and with
    `verify` every byte.
    """

    out: Path | Storage
    own: bool
    resume: bool = False
    fresh: bool = False
    retry_failed: bool = False
    verify: bool = False
    overwrite: bool = False
    parts: str | Path | None = None
    backend: str | None = None
    wait_s: float = 0.0
    patience_s: float = 60.0


def make_dataset(
    campaign: Campaign,
    making: Making,
    cluster: Callable[[Waiting, Job], AbstractContextManager[Client]],
    progress: AbstractContextManager[Show],
    tell: Callable[[str], None],
    page: CampaignPage,
) -> CampaignRun:
    """Do the jobs of a campaign that are not done, and write the data set.

    `cluster` starts a cluster or connects to one, for jobs such as the one it is given. `page` is
    told of all jobs.

    LidarpoolError if the place holds something else, the cluster lacks something, or what all jobs
    need fails; its notes say what was kept.
    """
    out = replace(Storage.at(making.out), durable=False)
    dataset = DataSet(out, campaign.keep.format, campaign.keep.layout)
    dataset.check_installed()
    resume = making.resume or making.retry_failed or making.verify
    if (making.fresh or making.overwrite) and resume:
        raise LidarpoolError(
            "fresh and overwrite remove what resume, retry_failed and verify go on with."
        )
    kept = out.below(RUN_FOLDER)
    backend = making.backend or "auto"

    def opened() -> CampaignStore:
        whole = campaign.identity, campaign.count, backend, kept, making.parts
        return CampaignStore(*whole, resume=resume)

    with result_folder(making.out), ExitStack() as stack:
        there, unfinished = out.entries(), FILE in kept.sizes()
        begin = not resume and (making.fresh or not unfinished)
        if begin and INDEX_FILE in there and not making.overwrite:
            raise LidarpoolError(
                f"{out} holds a finished data set, and one needs a folder of its own: give another "
                "with --out, or replace it with --overwrite (in Python overwrite=True)."
            )
        if begin and (making.fresh or making.overwrite):
            _remove_dataset(out, kept)
        made, wrong = None, dict[int, str]()
        if resume and CAMPAIGN_FILE in there and not unfinished:
            made = check_same(out, campaign)
            whole, wrong = _look(dataset, read_table(out), making.verify, campaign)
            if whole == campaign.count and not wrong and _is_indexed(out, whole):
                if RUN_FOLDER in there:  # a killed run has not removed all of itself
                    opened().remove()
                tell(f"{out} is complete: nothing is left to do")
                run = run_result(_shown(read_table(out), page), time.monotonic())
                page.finish(run)
                return run
        store = opened()
        stack.enter_context(store.kept_on_error())
        _own_files(out, begun=made is not None or bool(store.kept))
        if made is not None:
            store.take_over(made, read_table(out))
        else:
            _, wrong = _look(dataset, store.rows(), making.verify, campaign)
        if not store.kept:
            campaign.check_files()
        retried = (number for number, failed in store.db.jobs.items() if failed)
        store.forget([*wrong, *(retried if making.retry_failed else ())])
        if wrong:
            store.notes.append(f"made again: {listed([*wrong.values()])}")
        deque(_shown(store.rows(), page), maxlen=0)
        if store.left:
            run = run_campaign(
                lambda waiting, job: stack.enter_context(cluster(waiting, job)),
                campaign,
                store,
                dataset,
                tell,
                Waiting(making.wait_s, tell),
                own=making.own,
                progress=progress,
                page=page,
                backend=making.backend,
                wait_s=making.wait_s,
                patience_s=making.patience_s,
            )
        else:
            run = run_result(store.rows(), time.monotonic(), store=store)
        _finish(campaign, dataset, store, run)
        if run.failed:
            store.save(now=True)
            store.db.close()
        else:
            store.remove()
    page.finish(run)
    return run


def _shown(rows: Iterable[JobRow], page: CampaignPage) -> Iterator[JobRow]:
    for row in rows:
        page.ended(row)
        yield row


def _finish(campaign: Campaign, dataset: DataSet, store: CampaignStore, run: CampaignRun) -> None:
    """Write what all jobs share, and last what says that the data set is complete."""
    place = dataset.place
    made = {"identity": dict(store.identity), "casting": store.casting, "backend": store.backend}
    made |= {"sensors": run.sensors}
    with explained(f"{place} cannot be written"):
        place.write(CAMPAIGN_FILE, (json.dumps(made, indent=1) + "\n").encode())
    write_table(place, campaign.names, store.rows())
    dataset.finish(store.rows())
    saved = sweeps(place.url)
    picture = draw_sweep(next(iter(saved))) if len(saved) else None
    write_card(place, campaign, run, store.rows(), store.casting or software(), picture)


def _look(
    dataset: DataSet, rows: Iterable[JobRow], contents: bool, campaign: Campaign | None = None
) -> tuple[int, dict[int, str]]:
    """Count the jobs that are whole, and tell what is wrong with others, {number: a clause}.

    LidarpoolError if a file of the campaign is another than the one that whole jobs are made of.
    """
    whole, wrong = 0, dict[int, str]()
    made: dict[tuple[str, str], list[str]] = {}  # {name and hash of a file: jobs made of it}
    with explained(f"{dataset.place} cannot be read"):
        for row, (manifest, difference) in dataset.look(rows, contents=contents):
            if campaign is not None and row.number >= campaign.count:
                raise LidarpoolError(
                    f"{dataset.place} has job {row.name}, and count is {campaign.count:,}: a "
                    "campaign can only grow. Give another folder with --out."
                )
            if difference:
                wrong[row.number] = f"job {row.name} ({difference})"
                continue
            whole += 1
            for file in manifest["made_of"]:
                made.setdefault(tuple(file), []).append(row.name)
    now = hashes(campaign.files) if campaign is not None and made else []
    for (name, digest), jobs in made.items():
        if (name, digest) not in now and name in dict(now):
            raise LidarpoolError(
                f"Jobs of {dataset.place} were made of another {name} than there is now: "
                f"{listed(jobs)}. Bring that back, or give another folder with --out."
            )
    return whole, wrong


def _is_indexed(place: Storage, jobs: int) -> bool:
    """Whether the last file of a data set is there, whole, and has all of its jobs."""
    with suppress(LidarpoolError):
        return len(read_index(place)["jobs"]) == jobs
    return False


def verify(place: Storage, number: int | None = None) -> str:
    """Compare each file of a finished data set, or of one of its jobs, with what is kept of it.

    Returns a line; LidarpoolError names what is damaged, or says that there is no such data set.
    """
    index = read_index(place)
    dataset = DataSet(place, index["format"], index["layout"])
    rows = [row for row in read_table(place) if row.done]
    whole = len(rows) == len(index["jobs"])
    rows = [row for row in rows if number in (None, row.number)]
    wrong = _look(dataset, rows, True)[1] | ({} if whole else {-1: "rows of jobs.csv are missing"})
    if wrong:
        raise LidarpoolError(
            f"{place} is damaged: {listed([*wrong.values()])}. With the campaign, --verify makes "
            "these jobs again."
        )
    return f"{place} is whole: {counted(len(rows), 'job')}"


def check_same(place: Storage, campaign: Campaign) -> Mapping[str, Any]:
    """Check that a data set is of this campaign, and of the software here; returns its record.

    LidarpoolError names what differs, there and here.
    """
    try:
        made: dict[str, Any] = json.loads(place.read(CAMPAIGN_FILE))
    except (OSError, ValueError) as error:
        raise LidarpoolError(
            f"{place} holds no finished data set, which has a {CAMPAIGN_FILE}: {error}."
        ) from error
    here = software(made["backend"])
    there = made["casting"] or {"lidarpool": made["identity"]["lidarpool"]}
    if differs := difference(there, {name: here.get(name, "none") for name in there}):
        raise LidarpoolError(
            f"{place} was made with {differs}: the bits of its jobs are the same only with that. "
            "Install it, or make the job in a folder of its own with --out."
        )
    for name, value in campaign.identity.items():
        if made["identity"].get(OF_CAMPAIGN + name) != value:
            raise LidarpoolError(
                f"{place} is of another campaign: its {name} differs. Make the job in a folder of "
                "its own with --out."
            )
    return made


def job_again(
    campaign: Campaign, number: int, columns: tuple[str, ...], **options: Any
) -> tuple[Described, Job]:
    """Make a job of a campaign as it is for its data set."""
    described = campaign.describe(number)
    return described, described_job(described, columns, **options)


def row_of(place: Storage, number: int) -> JobRow | None:
    """Row of a job in the table of a data set; None if it is not there."""
    return next((row for row in read_table(place) if row.number == number), None)


def _own_files(out: Storage, *, begun: bool) -> list[str]:
    """Name the files of a data set, which has begun or is empty.

    LidarpoolError if there is a link, or a file that neither jobs nor `_finish` write.
    """
    files = [name for name in out.tree() if not _BESIDE.fullmatch(name)]
    own = _FINISHED if CAMPAIGN_FILE in files else OF_JOBS
    for name in sorted(files):
        if not begun or not own.fullmatch(name):
            raise LidarpoolError(
                f"{out} holds {name}: a data set needs a folder of its own, move that elsewhere, "
                "or give another with --out."
            )
    return files


def _remove_dataset(out: Storage, kept: Storage) -> None:
    """Remove a data set and its run; LidarpoolError, and nothing is removed, if there is more."""
    begun = CAMPAIGN_FILE in out.sizes() or FILE in kept.sizes()
    own = _own_files(out, begun=begun)
    with explained(f"{out} cannot be removed"):
        out.tidy()
        # First what says that it is finished, and last what says that it is a data set.
        out.prune(sorted(own, key=lambda name: (name == CAMPAIGN_FILE, name != INDEX_FILE)))
    drop_run(kept)


def failures(run: CampaignRun, most: int = 5) -> str:
    """Name the jobs that have failed, with their values and why."""
    lines = [f"{counted(len(run.failed), 'job')} failed, the other {run.done:,} are done:"]
    for row in run.failed[:most]:
        values = ", ".join(f"{name} {value}" for name, value in row.values.items())
        lines.append(f"job {row.name}{f' ({values})' if values else ''}: {row.error}")
    if (more := len(run.failed) - most) > 0:
        lines.append(f"and {more:,} more, see jobs.csv")
    return "\n".join(lines) + "\n--retry-failed does these jobs again."
