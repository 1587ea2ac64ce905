"""Tasks of workers that cast scans, without a cluster."""

import pickle
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from tests.cuda_on_host import source_backend  # noqa: F401 - a fixture
from tests.lidarfiles.test_device_columns import MADE, backend, scenes  # noqa: F401 - fixtures
from tests.lidarfiles.test_rig import TURNED, survey

from lidarfiles.parts.parts import pack
from lidarpool.processes.shared_memory import Pickled
from lidarpool.run.pipeline import rigs
from lidarpool.run.pipeline import stage2_intersect as stage
from lidarpool.run.pipeline.failures import naming_scans
from lidarsim import Scene, box
from lidarsim.simulator.rig import Rig
from poolpart.task_context import WorkerLeavingError


def test_a_worker_that_leaves_is_not_a_failure_of_its_scans():
    """The driver casts those elsewhere, and would end the run at any other error."""
    with pytest.raises(WorkerLeavingError), naming_scans(3, 5):
        raise WorkerLeavingError("the worker has left")


def test_a_cast_that_outlives_its_run_keeps_no_rig(monkeypatch):
    monkeypatch.setattr(
        rigs, "get_worker", lambda: SimpleNamespace(state=SimpleNamespace(nthreads=1))
    )
    monkeypatch.setattr(rigs, "own_device", lambda: None)
    scene = Pickled.from_value(Scene.from_meshes([box("Room", (8, 6, 3))]))
    packed = pickle.dumps(survey(poses=TURNED))

    def made(run):
        plan = Pickled.from_value((f"{run}.scene-1", (), packed, "numpy"))
        return rigs.rig_of(f"{run}.0-2", plan, scene)

    assert made("a") is rigs.rig_of("a.0-2")
    rigs.drop_all("a")
    assert made("a").survey.steps == 14  # of a task that is under way yet
    with pytest.raises(rigs.RigMissing):
        rigs.rig_of("a.0-2")
    assert made("b") is rigs.rig_of("b.0-2")
    rigs.drop_all("b")


@pytest.mark.extended
def test_a_casting_task_gives_the_part_that_numpy_gives(scenes, backend, monkeypatch):  # noqa: F811
    driven = MADE["on the move"]
    spans = [(0, 9), (9, 28)]
    monkeypatch.setattr(stage, "Recorder", lambda *_: SimpleNamespace(finish=lambda scans: None))
    tasks = []
    for name in (backend, "numpy"):
        rig = Rig(scenes["both"], driven, name)
        monkeypatch.setattr(stage, "rig_of", lambda *_, rig=rig: rig)
        done = stage.intersect([stage.CastWork(0, "a run", spans)], (), None, None)
        tasks.append(pickle.loads(pickle.dumps(done, protocol=5)))
    for mine, other in zip(*tasks, strict=True):
        samples = mine.part.samples
        exact = other.part.samples
        assert pack(mine.part) == pack(replace(other.part, samples=samples))
        assert np.allclose(samples, exact, rtol=0, atol=driven.precision_m, equal_nan=True)
