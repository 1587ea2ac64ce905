"""Addresses of schedulers: checked before anything else, or read from a scheduler file."""

import json
import threading

import dask
import pytest
from tests.clusters import thread_cluster

from lidarpool import LidarError
from lidarpool.connection import scheduler_address
from lidarpool.connection.scheduler_address import (
    check_address,
    check_certificates,
    is_scheduler_file,
    read_scheduler_file,
)
from lidarpool.connection.tls_files import TlsFiles


@pytest.mark.extended(every=2)
@pytest.mark.parametrize("option", ["--scheduler", "--scheduler-file"])
def test_doctor_finds_the_workers_by_a_scheduler_file(lidarpool, tmp_path, option):
    with thread_cluster({"GPU": 1}) as cluster:
        file = tmp_path / "sched.json"
        file.write_text(json.dumps(cluster.scheduler.identity()))
        outcome = lidarpool("doctor", option, str(file))
    assert outcome.code == 0 and "cluster: 1 worker on 1 host" in outcome.out


@pytest.mark.extended(every=2)
@pytest.mark.parametrize(
    ("slots", "fault"),
    [
        (4, ""),
        (
            3,
            "Partition 'LIDAR' has 3 of the 4 required slots (for a run with default options). "
            "Start workers with ",
        ),
    ],
)
def test_doctor_reports_a_cluster_with_too_few_slots(lidarpool, slots, fault):
    with thread_cluster({"GPU": 1}, {"LIDAR": slots}) as cluster:
        told = json.loads(
            lidarpool("doctor", "--json", "--scheduler", cluster.scheduler_address).out
        )
    assert told["cluster_fault"][: len(fault) or None] == fault
    assert told["fix_first"] or not fault


def test_a_file_that_is_written_later_is_waited_for(tmp_path, monkeypatch):
    monkeypatch.setattr(scheduler_address, "_LOOK_EVERY_S", 0.01)
    file = tmp_path / "sched.json"
    told = []

    def write_and_tell(text):
        told.append(text)
        threading.Timer(0.05, file.write_text, ['{"address": "tcp://10.0.0.1:8786"}']).start()

    assert read_scheduler_file(file, 60.0, write_and_tell) == "tcp://10.0.0.1:8786"
    assert told == [f"waiting for the scheduler file {file}"]


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"address": 5}', '{"address": "host"}', "{"])
def test_another_file_is_refused(tmp_path, text):
    file = tmp_path / "sched.json"
    file.write_text(text)
    with pytest.raises(LidarError, match="cannot be read"):
        read_scheduler_file(file)


def test_what_is_a_file(tmp_path):
    file = tmp_path / "written by dask"
    assert not is_scheduler_file(str(file))
    file.touch()
    assert is_scheduler_file(str(file)) and is_scheduler_file("later.json")
    assert not is_scheduler_file("tcp://host.json:8786")


@pytest.mark.parametrize("address", ["tcp://host:1", "tls://[::1]:8786", "wss://h:1", "host:8786"])
def test_addresses(address):
    check_address(address)


def test_certificates_of_an_encrypted_cluster(tmp_path):
    ca = tmp_path / "ca.pem"
    with pytest.raises(LidarError, match="uses TLS, but `--tls-cert` is missing"):
        check_certificates("tls://host:8786", TlsFiles(ca=ca))
    check_certificates("tls://host:8786", TlsFiles(ca, ca))
    check_certificates("tcp://host:8786", TlsFiles())
    names = ("ca-file", "client.cert")
    with dask.config.set({f"distributed.comm.tls.{name}": str(ca) for name in names}):
        check_certificates("tls://host:8786", TlsFiles())
