"""What a run has delivered so far, and with what backend."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from .checks import AUTO_TAKES
from .job import Job
from .plan import Trial
from .progress import Progress
from .scan import CloudBuilder
from .scan.point_store import PointStore
from .totals import FrameTotals


class Deliveries:
    """Points, totals of the frames, planning trials; gone with the run, see `Journal`.

    Parameters
    ----------
    job
        What the run is to do.
    store
        Where the points go; by default a temporary file.
    """

    def __init__(self, job: Job, store: PointStore | None = None) -> None:
        self.job = job
        self.backend = ""  # that casts the scans; set before the first delivery
        self.cloud = CloudBuilder(job.survey.scan_count, store)
        self.totals = FrameTotals(len(job.scene.faces), job.survey.scan_count)
        self.trials: list[Trial] = []
        self.notes: list[str] = []  # what a user should know of them
        self.resumed = 0  # scans whose points are of an earlier run

    @property
    def complete(self) -> bool:
        """Whether this is all that a result is made of."""
        return (
            self.cloud.ledger.complete
            and self.totals.frames == self.job.survey.scan_count
            and len(self.trials) == self.job.trials
        )

    @property
    def advice(self) -> str:
        """What to do where the backend is not to be had, for the end of a message."""
        return AUTO_TAKES

    def progress(self) -> Progress:
        """How far a run is that goes on from here, before it does."""
        both_ways = sum(scan in self.cloud.ledger for scan in range(self.totals.frames))
        return Progress(
            scans=self.job.survey.scan_count,
            generated=min(self.totals.frames, self.cloud.ledger.first_missing),
            cast=both_ways,
            framed=self.totals.frames,
            collected=self.cloud.ledger.delivered,
            points=self.cloud.point_count,
            trials=self.job.trials,
            trials_done=len(self.trials),
            seconds=0.0,
        )

    def add_trial(self, trial: Trial) -> None:
        """Enter a planning trial."""
        self.trials.append(trial)

    def look(self) -> None:
        """Do what is to be done from time to time; the run calls it often."""

    def sync(self) -> None:
        """Make sure of what there is: for a while nothing may come."""

    def check(self) -> None:
        """See that what a result is to be made of is as it was delivered."""

    def save(self) -> None:
        """Make sure of everything, at the end."""

    def remove(self) -> None:
        """Let it go: the result is where it belongs."""

    @contextmanager
    def kept_on_error(self) -> Iterator[None]:
        """Keep what can be kept if the body raises."""
        yield
