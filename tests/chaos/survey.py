"""Survey that is disturbed, and the outcome of disturbed runs."""

from __future__ import annotations

import hashlib
import shutil
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
from tests.shapes import block

from lidarpool import (
    Actor,
    Planning,
    Result,
    Scene,
    Sensor,
    Survey,
    Track,
    remove_run,
    save_cloud,
    simulate,
)
from lidarpool.report.growing_cloud import GrowingCloud
from lidarpool.run.cluster.cluster import ClusterConnection
from lidarpool.run.listener import Listener
from lidarpool.run.pipeline.task_records import placement_violations
from lidarpool.run.run_result import RunResult
from lidarpool.run.runner import cast, open_store

from .arena import Arena
from .checker import Verdict, judge
from .events import DAMAGE, LINK, Fault
from .nemesis import Nemesis

STEPS = 360
POSES = 2
# Seconds a scan for which the generator is held, so that there is time for things to go wrong.
PAUSES = {"generate.put": 0.006}
PLANNING = Planning((25, 25), (-30, -20), [(0, 0)], 2.0, trials=12, particles=60, iterations=60)


def room() -> Scene:
    """Return a room of 10 by 8 by 6 meters with two moving blocks.

    All rays hit.
    """
    ways = [[(-3, -3, -2), (-3, 3, 2)], [(4, 3, 0), (4, -3, 1)]]
    moving = [
        Actor(block(f"block {k}", (1, 1, 1)), Track([0, 9], way, beyond="hold"))
        for k, way in enumerate(ways)
    ]
    return Scene.from_meshes([block("room", (10, 8, 6))]).with_actors(tuple(moving))


def survey(poses: int = POSES, layers: int = 8) -> Survey:
    """Return a survey of `poses` poses with 360 scans each.

    Each scan covers two azimuths.
    """
    sensor = Sensor.grid(rays_per_revolution=720, layers=layers, vertical_fov_deg=60, step_deg=1)
    places = [(0.5 * (pose % 7), 0.25 * (pose % 5), 0.0) for pose in range(poses)]
    return Survey(sensor, places, STEPS, keep_every=3)


def digest(result: Result) -> str:
    """Return the SHA-256 checksum of everything in a result that must be reproducible."""
    cloud = result.cloud
    plan = () if result.plan is None else (result.plan.path,)
    arrays = (cloud.positions, cloud.scan, cloud.channel, cloud.object, result.hit_counts, *plan)
    sha = hashlib.sha256()
    for array in arrays:
        array = np.asarray(array)
        sha.update(f"{array.dtype} {array.shape} ".encode())
        sha.update(np.ascontiguousarray(array).tobytes())
    return sha.hexdigest()


def growing(*arguments: Any, **options: Any) -> tuple[Result, bytes | None]:
    """Run `simulate` with a cloud.ply that grows during the run.

    Return the result, and the content of this file or None if it could not be finished. That is
    allowed if a part is damaged.
    """
    written: list[bytes] = []

    def cast_and_grow(
        jobs: Any, run_options: Any, screen: Any, page: Any, on_frame: Any
    ) -> RunResult:
        with (
            ClusterConnection(jobs, run_options, screen) as connection,
            open_store(jobs, run_options, screen) as store,
        ):
            job = store.only_job
            assert job is not None
            with GrowingCloud(Path(folder, "growing.ply"), job) as cloud:
                listener = Listener(page, on_frame, cloud.append_committed, run_options.pace)
                result = cast(store, connection, listener).result(screen)
                path = Path(folder, "cloud.ply")
                if cloud.finish(path, job.points()) is not None:
                    written.append(path.read_bytes())
            store.close_with_points(None, ())
            return result

    with tempfile.TemporaryDirectory(prefix="chaos-ply-") as folder:
        with patch("lidarpool.api.simulation.cast_to_store", cast_and_grow):
            result = simulate(*arguments, **options)
        left = {path.name for path in Path(folder).iterdir()}
    assert left == ({"cloud.ply"} if written else set()), left
    return result, written[0] if written else None


@dataclass(frozen=True)
class Reference:
    """Result of an undisturbed run."""

    digest: str
    rows: tuple[int, ...]  # scan of each row of the cloud
    ply: bytes  # of the whole cloud, written at once

    @classmethod
    def of(cls, result: Result) -> Reference:
        """Keep the values that are compared."""
        with tempfile.TemporaryDirectory() as folder:
            save_cloud(result.points, path := Path(folder, "cloud.ply"))
            ply = path.read_bytes()
        return cls(digest(result), tuple(result.cloud.scan.tolist()), ply)

    def is_same(self, result: Result, ply: bytes | None) -> bool:
        """Return whether a run has the same result.

        A cloud.ply that has not grown to its end is not a defect.
        """
        return digest(result) == self.digest and ply in (None, self.ply)


@dataclass(frozen=True)
class Outcome:
    """Outcome of a disturbed run."""

    verdict: Verdict
    identical: bool
    done: Counter[tuple[str, str]]  # {(kind of fault, point): times}
    left: tuple[Fault, ...]  # not carried out
    seconds: float
    replayed: int
    misplaced: int
    grown: bool  # whether cloud.ply has grown to its end
    error: str = ""

    @property
    def sound(self) -> bool:
        """Whether this run is equal to an undisturbed one."""
        return self.verdict.sound and self.identical and not self.misplaced and not self.error


def reference(arena: Arena, what: Survey, planning: Planning | None = PLANNING) -> Reference:
    """Run a survey without faults."""
    result = simulate(room(), what, planning, client=arena.client, backend="numpy")
    return Reference.of(result)


def _run_of_another(folder: Path) -> dict[str, bytes]:
    """Create files with the names of those that a run deletes, and return their content."""
    mark = "0123456789abcdef"
    (folder / "parts").mkdir()
    for name in ("run.owner", f"parts/{mark}-mark", f"parts/{mark}-000000-00000000-00000004.npz"):
        (folder / name).write_text("theirs")
    return _files_of(folder)


def _files_of(folder: Path) -> dict[str, bytes]:
    return {str(path): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def disturbed(
    arena: Arena,
    what: Survey,
    known: Reference,
    faults: Sequence[Fault],
    planning: Planning | None = PLANNING,
    **options: float,
) -> Outcome:
    """Run a survey while faults are injected, and judge the result.

    If parts were damaged or links were added, the run is resumed at the end.
    """
    arena.wait_until_whole()
    arena.board.forget_events()
    started = time.monotonic()
    result: Result | None = None
    ply: bytes | None = None
    error = ""
    place, stranger = (tempfile.mkdtemp(prefix=f"chaos-{of}-") for of in ("run", "stranger"))
    theirs = _run_of_another(Path(stranger))
    again = partial(
        growing, room(), what, planning, client=arena.client, backend="numpy", folder=place
    )
    try:
        with Nemesis(arena, faults, Path(place, "parts"), Path(stranger)) as nemesis:
            try:
                result, ply = again(**options)
            except Exception as failure:
                error = "".join(traceback.format_exception(failure))
        events = arena.board.events(nemesis.run)
        if result is not None and not {DAMAGE, LINK}.isdisjoint(kind for kind, _ in nemesis.done):
            arena.wait_until_whole()
            mended, ply = again(resume=True)
            cloud = mended.cloud
            same = known.is_same(mended, ply)
            remove_run(place)
        else:
            cloud = None if result is None else result.cloud
            same = result is not None and known.is_same(result, ply)
    finally:
        error += "" if _files_of(Path(stranger)) == theirs else "another's run was touched"
        shutil.rmtree(place, ignore_errors=True)
        shutil.rmtree(stranger)
    return Outcome(
        verdict=judge(
            events, what.scan_count, [] if cloud is None else cloud.scan.tolist(), known.rows
        ),
        identical=same,
        done=nemesis.done,
        left=tuple(nemesis.left),
        seconds=time.monotonic() - started,
        replayed=0 if result is None else result.replayed,
        grown=ply is not None,
        misplaced=0 if result is None else len(placement_violations(result.records)),
        error=error,
    )
