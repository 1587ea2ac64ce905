"""Encrypted clusters: who may connect, and what the others are told."""

from __future__ import annotations

import datetime
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import dask
import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID
from distributed import Client, Security
from tests.clusters import thread_cluster

from lidarpool import LidarpoolError
from lidarpool.run.connection import TlsFiles, connected
from lidarpool.run.local import local_cluster
from poolpart import Pool


class Authority:
    """Somebody who signs certificates, and the folder where the files are."""

    def __init__(self, folder: Path, name: str) -> None:
        self.folder, self.name = folder, name
        self.key = ec.generate_private_key(ec.SECP256R1())
        self.subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])
        certificate = self._certificate(self.subject, self.key, authority=True)
        self.file = folder / f"{name}.pem"
        self.file.write_bytes(certificate.public_bytes(serialization.Encoding.PEM))

    def _certificate(
        self, subject: x509.Name, key: Any, *, authority: bool = False
    ) -> x509.Certificate:
        now = datetime.datetime.now(datetime.UTC)
        return (
            x509.CertificateBuilder(self.subject, subject, key.public_key())
            .serial_number(x509.random_serial_number())
            .not_valid_before(now - datetime.timedelta(days=2))
            .not_valid_after(now + datetime.timedelta(days=1))
            .add_extension(x509.BasicConstraints(authority, None), critical=True)
            .sign(self.key, hashes.SHA256())
        )

    def signed(self, name: str) -> TlsFiles:
        """Files with a certificate."""
        key = ec.generate_private_key(ec.SECP256R1())
        subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])
        cert_file, key_file = (self.folder / f"{self.name}-{name}.{end}" for end in ("crt", "key"))
        pem = serialization.Encoding.PEM
        cert_file.write_bytes(self._certificate(subject, key).public_bytes(pem))
        plain = serialization.NoEncryption()
        key_file.write_bytes(key.private_bytes(pem, serialization.PrivateFormat.PKCS8, plain))
        return TlsFiles(self.file, cert_file, key_file)


@pytest.fixture(scope="module")
def ours(tmp_path_factory) -> Authority:
    return Authority(tmp_path_factory.mktemp("ours"), "ours")


@pytest.fixture(scope="module")
def encrypted(ours) -> Iterator[str]:
    """Address of a cluster with certificates of ours, whose workers are threads."""
    files = ours.signed("scheduler")
    security = Security(
        require_encryption=True,
        tls_ca_file=str(files.ca),
        **{
            f"tls_{role}_{part}": str(getattr(files, part))
            for role in ("scheduler", "client", "worker")
            for part in ("cert", "key")
        },
    )
    slots = ({"GPU": 1}, {"LIDAR": 4}, {"OTHER": 1})
    with thread_cluster(*slots, security=security) as cluster:
        yield str(cluster.scheduler_address)


def told(address: str, files: TlsFiles | None = None) -> str:
    with pytest.raises(LidarpoolError) as refused, connected(address, files):
        pytest.fail("it let us in")
    assert "\n" not in str(refused.value)
    return str(refused.value)


def test_the_right_certificate_is_let_in(encrypted, ours, tmp_path):
    files = ours.signed("me")
    with connected(encrypted, files) as client:
        assert client.scheduler_info()["address"] == encrypted
    both = tmp_path / "both.pem"
    both.write_bytes(files.cert.read_bytes() + files.key.read_bytes())
    with connected(encrypted, TlsFiles(files.ca, both)) as client:
        assert client.scheduler_info()["address"] == encrypted
    configured = {
        "distributed.comm.tls.ca-file": str(files.ca),
        "distributed.comm.tls.client.cert": str(files.cert),
        "distributed.comm.tls.client.key": str(files.key),
    }
    with dask.config.set(configured), connected(encrypted) as client:
        assert client.scheduler_info()["address"] == encrypted


def test_others_are_told_what_is_wrong(encrypted, ours, tmp_path):
    stranger = Authority(tmp_path, "stranger").signed("me")
    assert "CERTIFICATE_VERIFY_FAILED" in told(encrypted, stranger)
    mixed = TlsFiles(ours.file, ours.signed("one").cert, ours.signed("another").key)
    assert "KEY_VALUES_MISMATCH" in told(encrypted, mixed)
    for said in (told(encrypted), told(encrypted.replace("tls:", "tcp:"))):
        assert "of an encrypted one as tls://host:8786, with --tls-ca" in said


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


def test_a_survey_on_an_encrypted_cluster(lidarpool, encrypted, ours, tmp_path, no_pictures):
    (tmp_path / "s.yaml").write_text("sensor: {layers: 4}\nplanning: {trials: 2}\n")
    mine = ours.signed("me")
    given = ["--scheduler", encrypted]
    given += ["--tls-ca", mine.ca, "--tls-cert", mine.cert, "--tls-key", mine.key]
    outcome = lidarpool("run", tmp_path / "s.yaml", "--out", tmp_path / "out", "-q", *given)
    assert (outcome.code, outcome.err) == (0, "")
    assert json.loads((tmp_path / "out" / "report.json").read_text())["placement_violations"] == 0
    outcome = lidarpool("info", *given)
    assert outcome.code == 0
    assert "3 workers" in outcome.out
