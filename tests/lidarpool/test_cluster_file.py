"""Cluster files: what they say, and what is wrong with them. Nothing is started."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
from pathlib import Path

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from jsonschema import Draft7Validator
from tests.clusters import import_jobqueue

from lidarpool.run.cluster.checks import gpu_note
from lidarpool.run.cluster.connection import local_cluster
from lidarpool.run.cluster.requirements import default_workers
from lidarpool.run.cluster_file import ClusterFile
from lidarsim import LidarError
from poolpart import PoolError, WorkerInfo

EXAMPLES = Path(__file__).parents[2] / "examples" / "clusters"
GOOD = """
cluster: distributed.SSHCluster
arguments: {hosts: [head]}
partitions:
  GPU: {hosts: [a, b], slots: 2}
  LIDAR: {hosts: [head], slots: 4}
  OTHER: {hosts: [a, b], workers: 5}
"""


def load(folder: Path, text: str) -> ClusterFile:
    (folder / "c.yaml").write_text(text)
    return ClusterFile.load(folder / "c.yaml")


def test_slots_and_workers_of_a_file(tmp_path):
    file = load(tmp_path, GOOD)
    assert file.slots == {"GPU": 4, "LIDAR": 4, "OTHER": 5}
    assert str(file) == "SSHCluster: 8 workers, GPU 2, LIDAR 1, OTHER 5"
    file.require({"GPU": 1, "LIDAR": 4})
    with pytest.raises(
        LidarError, match=r"c.yaml: Partition LIDAR has 4 slots, but the run needs 5"
    ):
        file.require({"LIDAR": 5})


def test_partitions_that_grow_with_their_work(tmp_path):
    text = GOOD.replace("workers: 5", "adapt: [0, 8]").replace(
        "slots: 2", "adapt: [1, 3], slots: 2"
    )
    file = load(tmp_path, text)
    assert file.slots == {"GPU": 6, "LIDAR": 4, "OTHER": 8}
    assert str(file) == "SSHCluster: up to 12 workers, GPU 1 to 3, LIDAR 1, OTHER 0 to 8"
    file.require({"GPU": 1, "LIDAR": 4, "OTHER": 1})
    few = load(tmp_path, GOOD.replace("slots: 4", "adapt: [0, 3]"))
    with pytest.raises(LidarError, match=r"Partition LIDAR has 3 slots, but the run needs 4"):
        few.require({"LIDAR": 4})


WRONG = {
    "a list": ("[1]", "contains a list. A cluster file contains"),
    "a misspelt field": (
        GOOD.replace("arguments", "argument"),
        "Unknown field 'argument'. Did you mean 'arguments'?",
    ),
    "no partitions": ("cluster: distributed.SSHCluster", "partitions is required"),
    "a partition of others": (
        GOOD.replace("GPU", "GPUS"),
        "Unknown partition .*mean 'GPU'",
    ),
    "workers": (
        GOOD.replace("workers: 5", "workers: many"),
        "partitions.OTHER.workers must be a whole number, but is 'many'",
    ),
    "a swapped range": (
        GOOD.replace("workers: 5", "adapt: [8, 0]"),
        r"partitions.OTHER.adapt must be .*, but is \[8, 0\]",
    ),
    "two numbers of workers": (
        GOOD.replace("workers: 5", "workers: 5, adapt: [0, 8]"),
        "partitions.OTHER.adapt and workers cannot be combined",
    ),
    "a time without a range": (
        GOOD.replace("workers: 5", "idle_s: 60"),
        "partitions.OTHER.idle_s requires adapt",
    ),
    "room for others without a range": (
        GOOD.replace("workers: 5", "yield_to_others: true"),
        "partitions.OTHER.yield_to_others requires adapt",
    ),
    "no host": (
        GOOD.replace("[a, b], slots: 2", "[]"),
        "partitions.GPU.hosts must have at least 1 item",
    ),
    "no such package": (
        GOOD.replace("distributed.", "dask_jobqueues."),
        r"is not installed.*\.\[clusters\]",
    ),
    "no such class": (
        GOOD.replace("SSHCluster", "SHCluster"),
        "cannot start workers for each partition",
    ),
    "another class": (
        GOOD.replace("distributed.SSHCluster", "subprocess.Popen"),
        "cannot start workers for each partition",
    ),
}


@pytest.mark.parametrize("case", WRONG)
def test_what_is_wrong_with_a_file(tmp_path, case):
    text, says = WRONG[case]
    with pytest.raises(LidarError, match=f"c.yaml.*{says}"):
        load(tmp_path, text)


def test_a_cluster_that_does_not_start(tmp_path):
    file = load(tmp_path, GOOD.replace("hosts: [head]}", "host: head}", 1))
    with (
        pytest.raises(
            LidarError, match=r"c.yaml: distributed.SSHCluster could not be started \(.*"
        ),
        file.start(print),
    ):
        pass


@pytest.mark.parametrize("name", ["slurm.yaml", "ssh.yaml"])
def test_examples_are_enough_for_a_survey(name):
    if name == "slurm.yaml":
        import_jobqueue()
    ClusterFile.load(EXAMPLES / name).require({"GPU": 1, "LIDAR": 4, "OTHER": 1})


@pytest.mark.extended
def test_a_file_leaves_interrupts_to_the_program():
    import_jobqueue()
    script = """
import signal
from pathlib import Path
from lidarpool.run.cluster_file import ClusterFile
ClusterFile.load(Path("slurm.yaml"))
assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
"""
    subprocess.run(
        [sys.executable, "-c", script],
        cwd=EXAMPLES,
        check=True,
    )


@given(cores=st.integers(1, 256), gpus=st.integers(0, 16))
def test_every_machine_gets_workers_and_no_more_than_cores_and_gpus(cores, gpus):
    workers = default_workers(cores, gpus)
    assert workers["GPU"] == gpus or gpus == 0
    assert all(count >= 1 for count in workers.values())
    # Every partition has a worker, also where that makes one more than there are cores.
    assert sum(workers.values()) <= max(cores + 1, gpus + 1)


@pytest.mark.parametrize("given", [{"gpu_workers": 0}, {"lidar_slots": -1}, {"other_workers": -1}])
def test_counts_that_cannot_be(given):
    (count,) = given.values()
    with pytest.raises(PoolError, match=f"value {count} for .*Expected an integer"):
        local_cluster(**given)


@pytest.mark.parametrize(
    ("gpus", "backend", "says"),
    [
        (((), ()), "tiles", ""),
        ((("GPU-1",), ()), "cuda", ""),
        ((("GPU-1",), ()), "tiles", "the GPUs of partition GPU are not used"),
        (((), ("GPU-1",)), "tiles", "partition GPU has no worker with a GPU, so CPU workers cast"),
    ],
)
def test_of_gpus_is_spoken_only_where_there_is_one_that_stays_idle(gpus, backend, says):
    casting, other = (WorkerInfo(str(i), str(i), "host", 1, gpus=g) for i, g in enumerate(gpus))
    note = gpu_note([casting, other], [casting], backend)
    assert note.startswith(says) and bool(note) == bool(says)


def test_the_manifest_is_what_the_operator_takes():
    found = importlib.util.find_spec("dask_kubernetes")
    if found is None:
        pytest.skip("needs dask-kubernetes, for the schemas of its operator")
    folder = next(Path(found.origin).parent.rglob("crds"))
    schemas = {}
    for file in folder.glob("*.yaml"):
        definition = yaml.safe_load(file.read_text())
        (version,) = definition["spec"]["versions"]
        schemas[definition["spec"]["names"]["kind"]] = version["schema"]["openAPIV3Schema"]
    documents = list(yaml.safe_load_all((EXAMPLES / "kubernetes.yaml").read_text()))
    assert [document["kind"] for document in documents] == [
        "DaskCluster",
        "DaskWorkerGroup",
        "DaskWorkerGroup",
    ]
    for document in documents:
        schema = schemas[document["kind"]]
        schema["properties"] |= dict.fromkeys(("apiVersion", "kind", "metadata"), True)
        Draft7Validator(_strict(schema)).validate(document)


def _strict(schema: object) -> object:
    """Refuse fields that a schema does not have, which Kubernetes would drop."""
    if isinstance(schema, list):
        return [_strict(one) for one in schema]
    if not isinstance(schema, dict):
        return schema
    strict = {key: _strict(value) for key, value in schema.items()}
    if isinstance(strict.get("properties"), dict) and strict.get("type") == "object":
        strict.setdefault("additionalProperties", False)
    return strict
