"""A made-up run whose deliveries go into a journal, for the tests of journals."""

import numpy as np

from lidarpool import Planning, Scene, Sensor, Survey
from lidarpool.deliveries import Deliveries
from lidarpool.job import Job
from lidarpool.journal import Journal, open_journal
from lidarpool.mesh import Mesh
from lidarpool.plan import Trial
from lidarpool.run import make_result
from lidarpool.scan.messages import POINT, Frame, Part
from lidarpool.survey import Pose

SCANS, TRIALS = 12, 3
VERTICES = [[0, 0, 0], [1, 0, 0], [0, 1, 0]]


def make_job(**changes):
    scene = Scene.from_meshes([Mesh("wall", np.array(VERTICES, float), np.array([[0, 1, 2]]))])
    settings = {"scene": scene, "survey": make_survey(), "planning": make_planning()} | changes
    return Job(**settings)


def make_survey(**changes):
    settings = {"poses": [(0, 0, 1), (0, 0, 2)], "steps": SCANS // 2} | changes
    return Survey(Sensor(layers=2), **settings)


def make_planning(**changes):
    return Planning((0, 0), (9, 0), trials=TRIALS, **changes)


def part(*scans):
    """Points of some scans, 0 to 4 of each."""
    tables = []
    for scan in scans:
        table = np.zeros(scan % 5, POINT)
        table["cell"] = np.arange(3 * len(table)).reshape(-1, 3) * (scan - 7)
        table["scan"], table["ray"] = scan, np.arange(len(table))
        table["ring"] = table["ray"] % 2
        tables.append(table)
    return Part(scans, tuple(map(len, tables)), np.concatenate(tables))


def frame(scan):
    triangle, count = np.zeros(1, np.int32), np.full(1, scan + 1, np.int32)
    samples = np.full((2, 3), scan, np.float32)
    return Frame(scan, Pose((0, 0, scan)), 56, scan + 1, triangle, count, samples)


def trial(number):
    rng = np.random.default_rng(number)
    history = rng.normal(size=20).astype(np.float32)
    return Trial(number, 2**63 + number, rng.normal(), rng.normal(size=(5, 2)), True, history, 0.1)


# The order in which a run's deliveries come; a scan may come twice.
DELIVERIES = [
    part(3, 4), frame(0), part(0), trial(2), frame(1), frame(2), part(1, 2, 0), frame(3), part(8),
    trial(0), frame(4), frame(5), part(5, 6, 7), frame(6), frame(7), part(10, 9), frame(8),
    trial(1), frame(9), frame(10), part(11), frame(11),
]  # fmt: skip


def deliver(kept, deliveries=DELIVERIES):
    """Deliver what is not there yet, as the pumps would."""
    kept.backend = kept.backend or "numpy"
    done = {trial.trial for trial in kept.trials}
    for item in deliveries:
        if isinstance(item, Part):
            kept.cloud.add(item)
        elif isinstance(item, Trial):
            if item.trial not in done:
                kept.add_trial(item)
        elif item.scan >= kept.totals.frames:
            kept.totals.take(item)


def content(kept):
    """All that a result says of what was delivered, as bytes."""
    result = make_result(kept)
    cloud = result.cloud
    arrays = [cloud.positions, cloud.scan, cloud.ring, cloud.object]
    arrays += [result.hit_counts, result.sample_rays]
    for one in result.trials:
        arrays += [np.array([one.trial, one.length, one.seconds]), one.waypoints, one.history]
    return [a.tobytes() for a in arrays], result.hits, result.backend, result.plan.length


def expected_content():
    """Content of a run that was not interrupted."""
    kept = Deliveries(make_job())
    deliver(kept)
    return content(kept)


def reopen(path, **changes):
    return open_journal(path, make_job(**changes), resume=True)


def files(path):
    return {entry.name: entry.read_bytes() for entry in path.iterdir()}


def interrupted(path, after, *, orderly=True):
    """Leave the journal of a run that ended after so many deliveries."""
    journal = Journal(path, make_job())
    deliver(journal, DELIVERIES[:after])
    if orderly:
        journal.save()
    journal.close()
