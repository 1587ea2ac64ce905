"""What a run would do and take, found out without starting anything."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from distributed import Client
from distributed.system import MEMORY_LIMIT

from poolpart import Pool, PoolError
from poolpart.local import usable_cores
from poolpart.probe import visible_gpus
from raybeam import available_backends

from ..base.errors import LidarpoolError
from ..report.output import folder_in_the_way
from ..run.checks import check_backend_here, find_workers
from ..run.database import FILE
from ..run.job import Job
from ..run.local import default_workers
from ..scan import GPU, LIDAR, OTHER
from ..scenario.advice import advice
from ..scenario.sampling import Sample, sample_survey
from ..scenario.sections import PoolSection
from .needs import Needs, needs_of
from .run_command import RUN_FOLDER


@dataclass
class Forecast:
    """What a run would do and take; filled in by `forecast`.

    Parameters
    ----------
    job, out
        What is to be run, and the folder of the result.
    backend
        Ray-casting backend that stage 2 would use; empty where it is not to be had.
    slots
        Slots of each partition: those needed, and those there.
    sample
        Estimate of hits and points; None where no ray could be cast.
    needs
        Memory and disk.
    memory, memory_needed
        Bytes that there are and that are needed: of this machine and by all processes, or, on
        another cluster, those of a GPU worker. 0 where there is no limit.
    disk_free
        Bytes that the disk of `out` has free.
    reasons
        Why it cannot run, each with what to do.
    notes
        What should be known besides.
    """

    job: Job
    out: Path
    backend: str = ""
    slots: dict[str, tuple[int, int]] = field(default_factory=dict)
    sample: Sample | None = None
    needs: Needs | None = None
    memory: int = 0
    memory_needed: int = 0
    disk_free: int = 0
    reasons: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def as_data(self) -> dict[str, Any]:
        """Return it as plain data for JSON; sizes in bytes."""
        scene, survey, planning = self.job.scene, self.job.survey, self.job.planning
        return {
            "can_run": not self.reasons,
            "reasons": self.reasons,
            "notes": self.notes,
            "objects": len(scene.names),
            "triangles": len(scene.faces),
            "bounds": (scene.bounds + scene.origin).tolist(),
            "poses": survey.path.stations,
            "scans": survey.scan_count,
            "rays": survey.ray_count,
            "estimate": asdict(self.sample) if self.sample else None,
            "trials": planning.trials if planning else 0,
            "backend": self.backend or None,
            "slots": {
                name: {"needed": needed, "there": there}
                for name, (needed, there) in self.slots.items()
            },
            "memory": {
                "gpu_worker": self.needs.gpu_worker if self.needs else None,
                "driver": self.needs.driver if self.needs else None,
                "needed": self.memory_needed,
                "there": self.memory or None,
            },
            "disk": {
                "parts": self.needs.parts if self.needs else None,
                "result": self.needs.cloud + self.needs.pictures if self.needs else None,
                "free": self.disk_free,
                "folder": str(self.out),
            },
        }


def forecast(
    job: Job,
    pool: PoolSection,
    out: Path,
    client: Client | None = None,
    unitless: Sequence[str] = (),
) -> Forecast:
    """Find out what a run would do and take, and whether it can.

    Parameters
    ----------
    job, out
        What is to be run, and the folder of the result; the folder is only looked at.
    pool
        Sizes of a cluster on this machine, which is not started.
    client
        Client of the cluster to run on instead.
    unitless
        Names of mesh files whose unit is neither stated nor given.
    """
    made = Forecast(job, out)
    with _taken_for_reason(made):
        if client is None:
            _look_here(made, pool)
        else:
            _look_there(made, client)
    _look_at_folder(made)
    # Casting here takes what it takes on a worker: it would be refused, or killed.
    if needs_of(job, 0).gpu_worker <= MEMORY_LIMIT:
        made.sample = sample_survey(job.scene, job.survey)
    made.notes += advice(job.scene, job.survey, unitless, made.sample)
    # Without a sample every ray may hit.
    points = made.sample.points if made.sample else job.survey.ray_count // job.survey.keep_every
    made.needs = needs_of(job, points)
    made.memory_needed = (
        made.needs.on_one_machine(made.slots[GPU][1], made.slots.get(OTHER, (0, 0))[1])
        if client is None
        else made.needs.gpu_worker
    )
    _compare(made, made.needs)
    return made


@contextmanager
def _taken_for_reason(made: Forecast) -> Iterator[None]:
    """Record errors as reasons why it cannot run."""
    try:
        yield
    except (LidarpoolError, PoolError) as error:
        made.reasons.append(str(error))


def _slots_needed(job: Job) -> dict[str, int]:
    needed = {GPU: 1, LIDAR: 2 + job.collectors}
    return needed | ({OTHER: 1} if job.planning else {})


def _look_here(made: Forecast, pool: PoolSection) -> None:
    """Find out what a cluster of this machine would have."""
    needed = _slots_needed(made.job)
    workers = default_workers(usable_cores(), len(visible_gpus()))
    there = {
        GPU: pool.gpu or workers[GPU],
        LIDAR: needed[LIDAR],  # one worker with as many threads
        OTHER: pool.other or workers[OTHER],
    }
    made.slots = {name: (needed[name], there[name]) for name in needed}
    made.memory = MEMORY_LIMIT
    check_backend_here(made.job.backend)
    made.backend = _settled(made.job.backend)


def _settled(wanted: str) -> str:
    """Backend that is taken here."""
    usable = (name for name, reason in available_backends().items() if not reason)
    return next(usable) if wanted == "auto" else wanted


def _look_there(made: Forecast, client: Client) -> None:
    """Find out what a cluster has that is running already."""
    needed = _slots_needed(made.job)
    everybody = Pool.from_client(client)
    there = {name: sum(w.resources.get(name, 0) for w in everybody) for name in needed}
    made.slots = {name: (needed[name], int(there[name])) for name in needed}
    planning = made.job.planning is not None
    _, casting, made.backend = find_workers(client, made.job.collectors, planning, made.job.backend)
    made.memory = min((worker.memory for worker in casting if worker.memory), default=0)
    if not any(worker.gpus for worker in casting):
        made.notes.append(f"no GPU in partition GPU: CPU workers cast the rays with {made.backend}")


def _look_at_folder(made: Forecast) -> None:
    """See whether the result can go there; nothing is made or changed."""
    there = next(path for path in (made.out, *made.out.absolute().parents) if path.exists())
    made.disk_free = shutil.disk_usage(there).free
    if not there.is_dir():
        made.reasons.append(f"{there} is a file: give a folder for the results with --out.")
    elif not os.access(there, os.W_OK | os.X_OK):
        made.reasons.append(f"Cannot write to the folder {there}: give another with --out.")
    elif obstacle := folder_in_the_way(made.out):
        made.reasons.append(obstacle)
    for part in made.out.absolute().relative_to(there.absolute()).parts:
        with suppress(FileNotFoundError, NotADirectoryError):
            os.lstat(there / part)  # OSError for a name that no folder of that disk can have
    if (made.out / RUN_FOLDER / FILE).exists():
        made.notes.append(
            f"{made.out} holds an unfinished run: --resume goes on with it, --fresh drops it"
        )


def _compare(made: Forecast, needs: Needs) -> None:
    """Compare what it takes with what there is."""
    if made.disk_free < needs.disk:
        made.reasons.append(
            f"The disk of {made.out} has {in_bytes(made.disk_free)} free and the run needs about "
            f"{in_bytes(needs.disk)}: make room, name another folder with --out, or take a "
            "larger keep_every."
        )
    if made.memory and made.memory < made.memory_needed:
        made.reasons.append(
            f"There are {in_bytes(made.memory)} of memory and the run needs about "
            f"{in_bytes(made.memory_needed)}: take a smaller scene, fewer workers (pool.gpu), "
            "rays_per_revolution or planning.particles, or a machine with more."
        )


def in_bytes(count: int) -> str:
    """Size with three digits: 950 bytes, 2.35 MB, 104 GB.

    Examples
    --------
    >>> in_bytes(950), in_bytes(2_345_678), in_bytes(103_900_000_000)
    ('950 bytes', '2.35 MB', '104 GB')
    """
    for factor, unit in ((1e12, "TB"), (1e9, "GB"), (1e6, "MB"), (1e3, "kB")):
        if count >= factor * 0.9995:
            digits = 2 if count < 9.995 * factor else 1 if count < 99.95 * factor else 0
            return f"{count / factor:,.{digits}f} {unit}"
    return f"{count} bytes"
