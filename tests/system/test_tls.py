"""Encrypted clusters: who may connect, and what the others are told."""

import json
from collections.abc import Iterator
from pathlib import Path

import dask
import pytest
from distributed import Client, Security
from tests.clusters import thread_cluster

from lidarpool import LidarError
from lidarpool.connection.tls_files import TlsFiles
from lidarpool.run.cluster.connection import connect_client, local_cluster
from lidarpool.run.cluster.watch import WaitTimer
from poolpart import Pool


def new_files(folder: Path) -> tuple[Security, TlsFiles]:
    """Make a certificate that is its own authority, and files of it, in a folder."""
    security = Security.temporary()
    parts = (security.tls_ca_file, security.tls_client_cert, security.tls_client_key)
    paths = [folder / name for name in ("ca.pem", "me.pem", "me.key")]
    for path, part in zip(paths, parts, strict=True):
        path.write_text(part)
    return security, TlsFiles(*paths)


@pytest.fixture(scope="module")
def encrypted(tmp_path_factory) -> Iterator[tuple[str, TlsFiles]]:
    """Address of an encrypted cluster whose workers are threads, and files that are let in."""
    security, files = new_files(tmp_path_factory.mktemp("ours"))
    slots = ({"GPU": 1}, {"LIDAR": 4}, {"OTHER": 1})
    with thread_cluster(*slots, security=security) as cluster:
        yield cluster.scheduler_address, files


def told(address: str, files: TlsFiles | None = None) -> str:
    # Waiting would mend none of it, and is not done.
    waiting = WaitTimer(3600)
    with pytest.raises(LidarError) as refused, connect_client(address, files, waiting):
        pytest.fail("it let us in")
    assert "\n" not in str(refused.value)
    return str(refused.value)


def test_the_right_certificate_is_let_in(encrypted, tmp_path):
    address, files = encrypted
    both = tmp_path / "both.pem"
    both.write_bytes(files.cert.read_bytes() + files.key.read_bytes())
    for given in (files, TlsFiles(files.ca, both)):
        with connect_client(address, given) as client:
            assert client.scheduler_info()["address"] == address
    configured = {
        "distributed.comm.tls.ca-file": str(files.ca),
        "distributed.comm.tls.client.cert": str(files.cert),
        "distributed.comm.tls.client.key": str(files.key),
    }
    with dask.config.set(configured), connect_client(address) as client:
        assert client.scheduler_info()["address"] == address


def test_others_are_told_what_is_wrong(encrypted, tmp_path):
    address, files = encrypted
    _, stranger = new_files(tmp_path)
    assert "CERTIFICATE_VERIFY_FAILED" in told(address, stranger)
    mixed = files._replace(key=stranger.key)
    assert "KEY_VALUES_MISMATCH" in told(address, mixed)
    for said in (told(address), told(address.replace("tls:", "tcp:"))):
        assert "pass tls://host:8786 with `--tls-ca`" in said


@pytest.mark.slow
def test_an_encrypted_local_cluster():
    with local_cluster(gpu_workers=1, other_workers=0, security=True) as cluster:
        assert cluster.scheduler_address.startswith("tls://127.0.0.1:")
        with Client(cluster, set_as_default=False) as client:
            assert all(worker.address.startswith("tls://") for worker in Pool.from_client(client))
            assert client.submit(pow, 2, 10, resources={"GPU": 1}).result() == 1024
        # Another temporary certificate is no better than none.
        stranger = Security.temporary()
        with pytest.raises(OSError, match="TLS certificate does not match"):
            Client(cluster.scheduler_address, security=stranger, timeout=5, set_as_default=False)


@pytest.mark.extended
def test_a_survey_on_an_encrypted_cluster(lidarpool, encrypted, tmp_path):
    (tmp_path / "s.yaml").write_text(
        "scene: seed\nsensor: {layers: 4}\n"
        "planning: {start: [25, 25], target: [-30, -20], trials: 2}\n"
    )
    address, files = encrypted
    given = ["--scheduler", address]
    given += ["--tls-ca", files.ca, "--tls-cert", files.cert, "--tls-key", files.key]
    outcome = lidarpool("run", tmp_path / "s.yaml", "--out", tmp_path / "out", "-q", *given)
    assert (outcome.code, outcome.err) == (0, "")
    assert json.loads((tmp_path / "out" / "report.json").read_text())["placement_violations"] == 0
    outcome = lidarpool("doctor", *given)
    assert outcome.code == 0
    assert "3 workers" in outcome.out
