"""Compute the occupancy grids of a scenario or campaign in worker processes, and write them.

Each worker prepares the jobs of its tasks from the files of the scenario, and simulates the rays of
the sweeps. No point cloud is required, and the files do not depend on the number of workers.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field
from functools import cached_property, lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from lidarfiles.clouds.folder import check_new_result, check_not_existing, result_folder
from lidarfiles.clouds.job_reader import Entry
from lidarfiles.identity.fingerprint import fingerprint
from lidarfiles.work.mapping import describe_sweeps, parallel_map
from lidarfiles.work.work import FileStep, Inputs, Work, fingerprint_files, link_files
from lidarsim.errors import LidarError, explain_os_errors
from lidarsim.simulator.occupancy import GridFrame, OccupancySimulator, VoxelGrid
from lidarsim.words import join_names

from ..campaign.campaign import CampaignSpec
from ..campaign.campaign_file import is_campaign
from ..job import Job
from ..prepare import prepare
from ..scenario import Scenario
from .layouts import LAYOUTS, GridLayout

if TYPE_CHECKING:
    from lidarfiles.work.mapping import Client

INFO_FILE = "occupancy.json"
_TASK_SWEEPS = 4
_WORKER_BYTES = 2 << 30
_GRIDS = FileStep("grids")


@dataclass(frozen=True)
class OccupancySettings:
    """Options of occupancy grids.

    Attributes
    ----------
    layout
        Name of the layout, as in `LAYOUTS`.
    grid
        Extent and voxel size, or None for those of the layout.
    frame
        Frame of the grid, or None for that of the layout.
    sensor
        Name of the sensor, or None for the first one.
    following
        Number of following sweeps whose rays also make voxels valid.
    backend
        Ray-casting backend, or None for that of the scenario.

    Raises
    ------
    LidarError
        If the layout does not support an option.
    """

    layout: str
    grid: VoxelGrid | None = None
    frame: GridFrame | None = None
    sensor: str | None = None
    following: int = 0
    backend: str | None = None

    def __post_init__(self) -> None:
        if self.following and self.layout != "semantickitti":
            raise LidarError(
                "`--following` affects the .invalid files, which only exist in the layout "
                "semantickitti."
            )

    @property
    def chosen_grid(self) -> VoxelGrid:
        """Grid that is written."""
        return self.grid or LAYOUTS[self.layout].grid

    @property
    def chosen_frame(self) -> GridFrame:
        """Frame of the grid."""
        return self.frame or LAYOUTS[self.layout].frame


class _Task(NamedTuple):
    """Consecutive sweeps of a job."""

    path: Path
    number: int | None  # job of a campaign, or None for a scenario
    settings: OccupancySettings
    state: str  # fingerprint of the scenario files, which may change between two calls
    sweeps: range

    @property
    def label(self) -> str:
        """Sweeps of the task, for messages."""
        return describe_sweeps(self.sweeps[0], self.sweeps[-1])


@dataclass(frozen=True)
class _OpenJob:
    """Job whose scenario has been read."""

    path: Path
    number: int | None
    settings: OccupancySettings
    state: str

    @cached_property
    def job(self) -> Job:
        """Scene and survey."""
        if self.number is None:
            return prepare(Scenario.load(self.path), plans=False).job
        return CampaignSpec.load(self.path).job(self.number)

    @cached_property
    def backend(self) -> str:
        """Name of the ray-casting backend."""
        if self.settings.backend is not None:
            return self.settings.backend
        source = Scenario if self.number is None else CampaignSpec
        return source.load(self.path).pool.backend

    @cached_property
    def sensor(self) -> int:
        """Number of the chosen sensor."""
        names = [carried.name for carried in self.job.survey.mounted_sensors]
        name = self.settings.sensor
        if name is None:
            return 0
        if name not in names:
            known = join_names([other for other in names if other]) or "none with a name"
            raise LidarError(
                f"{self.path} has no sensor {name!r}. The sensors of the scenario are {known}."
            )
        return names.index(name)

    @cached_property
    def layout(self) -> GridLayout:
        """Names and content of the files."""
        job = self.job
        entry = None if self.number is None else Entry(job.number, job.name, job.split, job.values)
        return LAYOUTS[self.settings.layout](job.sweeps, entry, self.sensor)

    @property
    def identity(self) -> tuple[Any, ...]:
        """What the files depend on, in addition to the settings."""
        job = self.job
        entry = (job.number, job.name, job.split, dict(job.values))
        return fingerprint(job.scene), fingerprint(job.survey), entry, self.backend

    def paths(self) -> Iterator[str]:
        """Yield the paths of all files, relative to the output folder."""
        for sweep in range(self.layout.count):
            yield from self.layout.paths(sweep)

    def tasks(self) -> Iterator[_Task]:
        """Yield the tasks that compute the files."""
        sweeps = range(self.layout.count)
        for first in range(0, len(sweeps), _TASK_SWEEPS):
            stop = first + _TASK_SWEEPS
            yield _Task(self.path, self.number, self.settings, self.state, sweeps[first:stop])

    @cached_property
    def simulator(self) -> OccupancySimulator:
        """Simulator of the grids."""
        settings = self.settings
        return OccupancySimulator(
            self.job.scene,
            self.job.survey,
            settings.chosen_grid,
            sensor=self.sensor,
            frame=settings.chosen_frame,
            backend=self.backend,
            threads=1,  # sweeps are computed in parallel
        )


@dataclass
class _Jobs:
    """Jobs whose grids are written.

    Attributes
    ----------
    tasks
        Tasks that compute the files.
    identities
        Values that determine the files of each job.
    existing
        Paths of files of the jobs in the output folder.
    notes
        Notes for the user, without duplicates.
    """

    tasks: list[_Task] = field(default_factory=list)
    identities: list[Any] = field(default_factory=list)
    existing: set[str] = field(default_factory=set)
    notes: dict[str, None] = field(default_factory=dict)

    def add(self, opened: _OpenJob, out: Path) -> None:
        """Add a job. `out` is the output folder."""
        self.tasks += opened.tasks()
        self.identities.append(opened.identity)
        self.existing.update(opened.layout.existing_paths(out))
        self.notes |= dict.fromkeys(opened.layout.notes())


@lru_cache(maxsize=1)
def _open_job(path: Path, number: int | None, settings: OccupancySettings, state: str) -> _OpenJob:
    return _OpenJob(path, number, settings, state)


def _compute_files(task: _Task) -> dict[str, bytes]:
    """Return the files of the sweeps of a task."""
    opened = _open_job(task.path, task.number, task.settings, task.state)
    files: dict[str, bytes] = {}
    for sweep in task.sweeps:
        occupancy = opened.simulator.sweep(sweep, task.settings.following)
        files |= zip(opened.layout.paths(sweep), opened.layout.contents(occupancy), strict=True)
    return files


class WrittenOccupancy(NamedTuple):
    """Summary of written occupancy grids."""

    jobs: int
    sweeps: int
    files: int
    notes: tuple[str, ...]


def write_occupancy(
    path: Path,
    out: Path,
    settings: OccupancySettings,
    *,
    job: int | None = None,
    client: Client | None = None,
    workers: int | None = None,
    resume: bool = False,
    restart: bool = False,
    overwrite: bool = False,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> WrittenOccupancy:
    """Write the occupancy grids of all sweeps of a scenario or campaign.

    Parameters
    ----------
    path
        Scenario or campaign file.
    out
        Output folder. Finished grids are kept in it until all of them are written. Files of other
        jobs and sensors remain.
    settings
        Layout, grid and sensor.
    job
        Number of the campaign job to write, or None for all jobs.
    client
        Client of a cluster whose OTHER workers can read the scenario at the same path. By default,
        processes on this machine compute the grids.
    workers
        Number of processes on this machine. The files do not depend on it.
    resume
        Whether to continue an unfinished computation in the folder.
    restart
        Whether to remove an unfinished computation in the folder.
    overwrite
        Whether to replace existing files. Files of the same jobs and sensor are removed if they
        belong to an earlier result with more sweeps.
    progress
        Function that is called with the number of finished sweeps and the number of all sweeps.

    Raises
    ------
    LidarError
        If the scenario cannot be read, if files exist or cannot be written, if the folder contains
        an unfinished computation that is neither resumed nor removed, or if the cluster is lost.
    """
    path = path.absolute()
    numbers = _job_numbers(path, job)
    info = _info(settings)
    check_new_result(out, (), resume=resume, restart=restart, overwrite=overwrite)
    replaces = overwrite or (resume and Work.is_unfinished(out))
    if not replaces:
        _check_same_grid(out / INFO_FILE, info)
        _check_first_files(out, settings, numbers)
    sources = _source_files(path)
    state = fingerprint({name: fingerprint_files(file) for name, file in sources.items()})
    jobs = _Jobs()
    for number in numbers:
        opened = _open_job(path, number, settings, state)
        check_not_existing((out / name for name in opened.paths()), overwrite=replaces)
        jobs.add(opened, out)
    inputs = Inputs(sources, {"jobs": jobs.identities, "options": settings})
    tasks = jobs.tasks
    total = sum(len(task.sweeps) for task in tasks)
    done = 0
    files: dict[str, Path] = {}
    with (
        result_folder(out),
        Work.open(out, inputs, noun="computation", resume=resume, restart=restart) as work,
    ):
        with parallel_map(client, len(tasks), _WORKER_BYTES, workers) as run:
            results = work.each(_GRIDS, run, _compute_files, tasks)
            for task, found in zip(tasks, results, strict=True):
                files |= found
                done += len(task.sweeps)
                progress(done, total)
        longer = sorted(jobs.existing - {*files}) if replaces else []
        with work.publishing(INFO_FILE, longer, merge=True) as staged:
            link_files(files, staged)
            (staged / INFO_FILE).write_bytes(info)
    return WrittenOccupancy(len(numbers), total, len(files), tuple(jobs.notes))


def _source_files(path: Path) -> dict[str, Path]:
    """Return the files of the scenario, which workers read again."""
    source = CampaignSpec if is_campaign(path) else Scenario
    files = {str(file): file for file in sorted(source.load(path).files)}
    return {"scenario": path, **files}


def _job_numbers(path: Path, job: int | None) -> Sequence[int | None]:
    """Return the numbers of the jobs to write, or None for the only job of a scenario."""
    if not is_campaign(path):
        if job is not None:
            raise LidarError(f"`--job` can only be used with campaigns, but {path} is a scenario.")
        return [None]
    numbers = CampaignSpec.load(path).numbers
    if job is None:
        return numbers
    if job not in numbers:
        raise LidarError(
            f"Job {job} does not exist. The jobs of the campaign are 0 to {len(numbers) - 1}."
        )
    return [job]


def _check_same_grid(file: Path, info: bytes) -> None:
    """Raise LidarError if the description file exists and differs from `info`."""
    with explain_os_errors(f"{file} cannot be read"):
        if file.exists() and file.read_bytes() != info:
            raise LidarError(
                f"{file} already exists and describes another grid. Use another folder with "
                "`--out`, or pass `--overwrite`."
            )


def _check_first_files(
    out: Path, settings: OccupancySettings, numbers: Sequence[int | None]
) -> None:
    """Raise LidarError if files exist whose names are known before the jobs are opened.

    The names of other files depend on the survey, for example on the number of the sensor.
    """
    if settings.sensor is None:
        first = map(LAYOUTS[settings.layout].first_path, numbers)
        check_not_existing((out / path for path in first if path is not None), overwrite=False)


def _info(settings: OccupancySettings) -> bytes:
    """Return a JSON document that describes the grid."""
    info = {
        "layout": settings.layout,
        "frame": settings.chosen_frame,
        "sensor": settings.sensor,
        "following": settings.following,
        **asdict(settings.chosen_grid),
        "shape": settings.chosen_grid.shape,
    }
    return json.dumps(info, indent=1).encode() + b"\n"
