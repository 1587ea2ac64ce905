"""Sources of playback, which provide the sweeps of a result or a scenario.

The sweeps of a scenario are simulated during playback.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from types import MappingProxyType
from typing import Any

import numpy as np

from lidarfiles.clouds.folder import local_result
from lidarfiles.clouds.navigation_files import write_instruments
from lidarfiles.clouds.writing import ExportSpec
from lidarfiles.picture_file import PICTURE_FILE, PictureContent
from lidarscenario.advice import advice
from lidarscenario.campaign.campaign import CampaignSpec
from lidarscenario.campaign.campaign_file import is_campaign
from lidarscenario.job import Job
from lidarscenario.prepare import prepare
from lidarscenario.scenario import Scenario
from lidarscenario.sections import OutputSection
from lidarsim.columns.cloud import Cloud
from lidarsim.columns.cloud_file import CloudFile
from lidarsim.columns.table import AXES, SCAN
from lidarsim.errors import LidarError, MissingFileError
from lidarsim.io.storage import Storage
from lidarsim.packets.capture import ENDINGS as CAPTURE_ENDINGS
from lidarsim.simulator.points.batch_columns import columns_of
from lidarsim.simulator.rig import Rig
from lidarsim.sweeps.instruments import INSTRUMENT_FILES
from lidarsim.sweeps.sweeps import SWEEPS_FILE, Sweeps

from .schedule import casting_threads

CLOUD = "cloud.ply"


@dataclass(frozen=True, eq=False)
class PlaybackSource:
    """Sweeps for playback, with their points.

    Iterating yields the number and points of each sweep, in order of their start times.
    """

    sweeps: Sweeps
    points: Callable[[int], Cloud]  # Reads or simulates the points of a sweep, given its number.
    # Returns the scene and planned path, or None for a result without them.
    content: Callable[[], PictureContent | None] = lambda: None
    threads: int = 1  # number of threads that may call `points` at the same time

    def __post_init__(self) -> None:
        if not len(self.sweeps):
            raise LidarError("There are no sweeps to play. Set `poses`, or a longer trajectory.")

    def __iter__(self) -> Iterator[tuple[int, Cloud]]:
        for sweep in self.order:
            yield sweep, self.points(sweep)

    @property
    def order(self) -> list[int]:
        """Numbers of the sweeps, sorted by start time."""
        order: list[int] = np.argsort(self.sweeps.begins_ns, kind="stable").tolist()
        return order

    @property
    def period_ns(self) -> int:
        """Period of the repetitions with `--loop`, in nanoseconds."""
        ends_ns = []
        for number in range(len(self.sweeps.sensors)):
            rows = np.flatnonzero(self.sweeps.sensor == number)
            begins_ns = self.sweeps.begins_ns[rows]
            last_ns = self.sweeps.ends_ns[rows[-1]] - begins_ns[-1]
            ends_ns.append(begins_ns[-1] + max(last_ns, *np.diff(begins_ns[-2:]), 1.0))
        return round(max(ends_ns) - self.sweeps.begins_ns.min())


@contextmanager
def open_source(
    source: Path | Storage,
    needs: ExportSpec | None = None,
    of_mesh: Mapping[str, Any] = MappingProxyType({}),
    report: Callable[[str], None] = lambda note: None,
) -> Iterator[PlaybackSource]:
    """Open a result, scenario, campaign or mesh file for playback.

    Parameters
    ----------
    source
        Path or URL. Only the first job of a campaign is played.
    needs
        Format whose columns the cloud of a scenario must have.
    of_mesh
        Options of `mesh_data` for a mesh file.
    report
        Function that is called with each note on the scene.

    Raises
    ------
    LidarError
        If the source cannot be read, or has no sweeps.
    """
    if isinstance(source, Path) and not source.exists():
        raise MissingFileError(
            f"{source} does not exist. Specify a result, a scenario or a recording."
        )
    with ExitStack() as stack:
        if isinstance(source, Path) and source.is_file():
            if source.suffix.lower() in CAPTURE_ENDINGS:
                raise LidarError(
                    f"{source} contains packets. Play it with `--as packets`, or specify a "
                    "result or a scenario."
                )
            yield _simulated_sweeps(scenario_job(source, needs, of_mesh, report), stack)
            return
        if of_mesh:
            raise LidarError(
                f"`unit` and `up_axis` can only be used with mesh files, but {source} is a "
                "result. Omit them."
            )
        files = (CLOUD, SWEEPS_FILE, PICTURE_FILE, *INSTRUMENT_FILES)
        folder = stack.enter_context(local_result(source, files))
        yield _stored_sweeps(folder, source)


def _stored_sweeps(folder: Path, source: Path | Storage) -> PlaybackSource:
    """Return the sweeps of a result that is stored in a folder.

    Raise LidarError if files are missing.
    """
    for name in (CLOUD, SWEEPS_FILE):
        if not (folder / name).exists():
            raise LidarError(
                f"{source} contains no {name}. Specify a scenario, or the output folder of a "
                "finished run."
            )
    sweeps = Sweeps.load(folder / SWEEPS_FILE)
    cloud = CloudFile(folder / CLOUD)

    def read(sweep: int) -> Cloud:
        return next(sweeps.points(cloud, sweep, sweep + 1))

    return PlaybackSource(sweeps, read, lambda: PictureContent.load_from(folder))


def scenario_job(
    path: Path,
    needs: ExportSpec | None = None,
    of_mesh: Mapping[str, Any] = MappingProxyType({}),
    report: Callable[[str], None] = lambda note: None,
) -> Job:
    """Return the job of a scenario or mesh file, or a campaign's first job.

    The cloud has the columns that the format `needs` requires, instead of those for the formats
    that the scenario writes. For `of_mesh` and `report`, see `open_source`.
    """
    if path.suffix.lower() in (".yaml", ".yml") and not of_mesh and is_campaign(path):
        campaign = CampaignSpec.load(path)
        scenario = campaign.scenario(0)
        if scenario is None:
            raise LidarError(
                f"The jobs of {path} are created by a function, so they cannot be played. Specify "
                "a scenario."
            )
    else:
        scenario = Scenario.load(path, of_mesh)
    output = OutputSection(write=() if needs is None else (needs,))
    prepared = prepare(scenario.model_copy(update={"output": output}), plans=False)
    for note in advice(prepared):
        report(note)
    return prepared.job


def _simulated_sweeps(job: Job, stack: ExitStack) -> PlaybackSource:
    """Return the sweeps of a job, each of which is simulated when its points are requested."""
    survey = job.survey
    sweeps = job.sweeps
    if sweeps.instruments is not None:
        folder = Path(stack.enter_context(TemporaryDirectory(prefix="lidarpool-")))
        write_instruments(folder, survey, job.scene.origin)
        sweeps = replace(sweeps, instruments=replace(sweeps.instruments, folder=folder))
    rig = Rig(job.scene, survey, threads=1)  # sweeps are simulated in parallel
    table = (SCAN, *(column for column in survey.stored_columns if column not in AXES))
    origin = job.scene.origin if survey.coordinates == "world" else np.zeros(3)

    def cast(sweep: int) -> Cloud:
        start, stop = sweeps.scans[sweep : sweep + 2].tolist()
        part = columns_of([*rig.cast(start, stop)])
        return part.cloud(table, survey.precision_m, origin)

    def content() -> PictureContent | None:
        return PictureContent.before_casting(job.scene, survey)[0]

    return PlaybackSource(sweeps, cast, content, casting_threads())
