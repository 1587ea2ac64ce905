"""A whole run from Python: `simulate`."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path

from distributed import Client

from .checks import check_backend_here, check_counts
from .connection import local_client
from .deliveries import Deliveries
from .job import Job
from .journal import open_journal
from .plan import Planning
from .progress import Progress
from .result import Result
from .run import Run, make_result
from .scan import Frame
from .scene import Scene
from .survey import Survey


def simulate(
    scene: Scene,
    survey: Survey,
    planning: Planning | None = None,
    *,
    client: Client | None = None,
    backend: str = "auto",
    on_frame: Callable[[Frame], None] | None = None,
    on_progress: Callable[[Progress], None] | None = None,
    queue_capacity: int = 10,
    collectors: int = 2,
    scans_per_second: float | None = None,
    gpu_workers: int | None = None,
    other_workers: int | None = None,
    tls: bool = False,
    journal: str | Path | None = None,
    resume: bool = False,
) -> Result:
    """Scan a scene on a partitioned cluster and plan a path meanwhile.

    Parameters
    ----------
    scene, survey
        What to scan, and how; poses in the scene's local coordinates.
    planning
        A path to plan on the OTHER partition while the survey runs; None for none.
    client
        Client of a cluster whose workers declare the resources GPU, LIDAR and OTHER. Without
        one, a local cluster is started on the loopback interface and stopped in the end.
    backend
        Ray-casting backend of stage 2: auto, cuda, embree or numpy.
    on_frame
        Called with each frame, in scan order, while the survey runs. It is called in this
        thread: while it takes its time the pipeline waits, and nothing is lost.
    on_progress
        Called some ten times a second with how far things are.
    queue_capacity
        Items that stage 1 may be ahead of stage 2.
    collectors
        Tasks of stage 4.
    scans_per_second
        How fast scans are made, as by a sensor that takes its time; by default as fast as
        they are cast.
    gpu_workers, other_workers
        Workers of a local cluster; by default what suits the machine.
    tls
        Encrypt the traffic of a local cluster, with a certificate made for it.
    journal
        A folder to keep what is delivered in, so that nothing is lost should this process or
        its machine die. It is made with the first delivery and stays there in the end: remove
        it with `remove_journal` once the result is where it belongs. Without one, the points
        are in a temporary file as long as the result is in use.
    resume
        Go on from what an earlier run has left in `journal`; from the beginning if there is
        nothing. `on_frame` gets the frames that it has not had yet, but for those of the last
        few seconds before the earlier run died, which it gets again.

    Returns
    -------
    Result
        The same survey gives the same cloud on any cluster.

    Raises
    ------
    LidarpoolError
        If the cluster lacks something or a task fails, if `journal` holds an unfinished run and
        `resume` is not set, if that is damaged, or of another scene, survey, planning or
        version; one or two lines say which and what to do. KeyboardInterrupt passes through
        once everything has been stopped.

    Examples
    --------
    >>> from lidarpool import Scene, Survey, simulate
    >>> if __name__ == "__main__":                                     # doctest: +SKIP
    ...     result = simulate(Scene.seed(), Survey(poses=[(0, 0, 1)]))
    ...     print(len(result.cloud), "points")
    """
    job = Job(scene, survey, planning, backend, queue_capacity, collectors, scans_per_second)
    check_counts(gpu_workers=gpu_workers, other_workers=other_workers)
    if client is None:
        check_backend_here(backend)
    kept = Deliveries(job) if journal is None else open_journal(Path(journal), job, resume=resume)
    with kept.kept_on_error():
        if kept.complete:
            kept.save()
            return make_result(kept)
        if client is None:
            check_backend_here(kept.backend or backend, kept.advice)
        with (
            local_client(
                gpu_workers=gpu_workers, collectors=collectors, other_workers=other_workers, tls=tls
            )
            if client is None
            else nullcontext(client) as client
        ):
            return Run(client, kept).drive(on_frame, on_progress)
