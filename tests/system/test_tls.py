"""Encrypted clusters: who may connect, and what the others are told."""

from __future__ import annotations

import datetime
import json
import os
import stat
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import dask
import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID
from distributed import Client, Scheduler, Security, SpecCluster

import lidarpool.run.run
from lidarpool import LidarpoolError, Scene, Sensor, Survey
from lidarpool.run.connection import connected
from lidarpool.run.local import local_cluster
from lidarpool.run.tls import NO_FILES, TlsFiles, security_for
from poolpart import Pool, PoolError

ADDRESS = "tls://127.0.0.1:1"


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
        self, subject: x509.Name, key: Any, *, authority: bool = False, days: int = 1
    ) -> x509.Certificate:
        now = datetime.datetime.now(datetime.UTC)
        return (
            x509.CertificateBuilder(self.subject, subject, key.public_key())
            .serial_number(x509.random_serial_number())
            .not_valid_before(now - datetime.timedelta(days=2))
            .not_valid_after(now + datetime.timedelta(days=days))
            .add_extension(x509.BasicConstraints(authority, None), critical=True)
            .sign(self.key, hashes.SHA256())
        )

    def signed(self, name: str, *, days: int = 1, password: bytes | None = None) -> TlsFiles:
        """Files with a certificate for so many days from now."""
        key = ec.generate_private_key(ec.SECP256R1())
        subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])
        cert_file, key_file = (self.folder / f"{self.name}-{name}.{end}" for end in ("crt", "key"))
        pem = serialization.Encoding.PEM
        cert_file.write_bytes(self._certificate(subject, key, days=days).public_bytes(pem))
        hidden: Any = (
            serialization.BestAvailableEncryption(password)
            if password
            else serialization.NoEncryption()
        )
        key_file.write_bytes(key.private_bytes(pem, serialization.PrivateFormat.PKCS8, hidden))
        return TlsFiles(self.file, cert_file, key_file)


@pytest.fixture(scope="module")
def ours(tmp_path_factory) -> Authority:
    return Authority(tmp_path_factory.mktemp("ours"), "ours")


@pytest.fixture(scope="module")
def theirs(tmp_path_factory) -> Authority:
    return Authority(tmp_path_factory.mktemp("theirs"), "theirs")


def refusal(address: str, files: TlsFiles) -> str:
    """What the user is told; one line."""
    with pytest.raises(LidarpoolError) as refused:
        security_for(address, files)
    assert "\n" not in str(refused.value)
    return str(refused.value)


# -- files --------------------------------------------------------------------------------------


def test_good_files(ours):
    files = ours.signed("good")
    security = security_for(ADDRESS, files)
    assert security.require_encryption
    assert security.tls_client_cert == str(files.cert)


def test_a_key_inside_the_certificates_file(ours):
    files = ours.signed("both")
    both = ours.folder / "both.pem"
    both.write_bytes(files.cert.read_bytes() + files.key.read_bytes())
    security = security_for(ADDRESS, TlsFiles(files.ca, both))
    assert security.get_connection_args("client")["ssl_context"] is not None


@pytest.mark.parametrize("which", ["ca", "cert", "key"])
def test_a_file_that_is_not_there(which, ours, tmp_path):
    files = vars(ours.signed("good")) | {which: tmp_path / "none.pem"}
    said = refusal(ADDRESS, TlsFiles(**files))
    assert said.startswith(f"--tls-{which} {tmp_path}/none.pem cannot be read: No such file")


def test_a_folder_in_place_of_a_file(ours, tmp_path):
    said = refusal(ADDRESS, TlsFiles(tmp_path, *list(vars(ours.signed("good")).values())[1:]))
    assert said.startswith(f"--tls-ca {tmp_path} cannot be read: Is a directory")


@pytest.mark.skipif(os.geteuid() == 0, reason="root may read everything")
def test_a_file_that_may_not_be_read(ours):
    files = ours.signed("secret")
    files.key.chmod(stat.S_IWUSR)
    assert refusal(ADDRESS, files).startswith(
        f"--tls-key {files.key} cannot be read: Permission denied"
    )


@pytest.mark.parametrize("content", [b"", b"hello\n", bytes(range(256)), b"-----BEGIN CERT"])
@pytest.mark.parametrize(("which", "kind"), [("ca", "cert"), ("cert", "cert"), ("key", "key")])
def test_a_file_that_is_not_pem(which, kind, content, ours, tmp_path):
    junk = tmp_path / "junk.pem"
    junk.write_bytes(content)
    said = refusal(ADDRESS, TlsFiles(**vars(ours.signed("good")) | {which: junk}))
    assert str(junk) in said
    assert ("no certificate in PEM form" if kind == "cert" else "no private key in PEM") in said


def test_no_key_at_all(ours):
    files = ours.signed("good")
    said = refusal(ADDRESS, TlsFiles(files.ca, files.cert))
    assert "holds no private key" in said
    assert "(--tls-key is not given)" in said


def test_a_key_of_another_certificate(ours):
    files = ours.signed("one")
    said = refusal(ADDRESS, TlsFiles(files.ca, files.cert, ours.signed("another").key))
    assert "does not belong to the certificate" in said


def test_a_key_with_a_password_asks_nobody(ours):
    said = refusal(ADDRESS, ours.signed("hidden", password=b"open sesame"))
    assert "is protected by a password" in said


def test_a_certificate_that_has_expired(ours):
    said = refusal(ADDRESS, ours.signed("old", days=-1))
    assert "(certificate has expired): one of them is too old" in said


def test_a_certificate_of_another_authority(ours, theirs):
    files = theirs.signed("stranger")
    said = refusal(ADDRESS, TlsFiles(ours.file, files.cert, files.key))
    assert f"cannot be used with the authority in {ours.file}" in said
    assert "give two that belong together" in said


# -- address and files --------------------------------------------------------------------------


@pytest.mark.parametrize("address", ["tcp://127.0.0.1:8786", "127.0.0.1:8786"])
def test_certificates_for_an_address_without_encryption(address, ours):
    said = refusal(address, ours.signed("good"))
    assert f"{address!r} is not encrypted" in said
    assert "tls://host:8786" in said


def test_an_encrypted_address_without_certificates():
    said = refusal(ADDRESS, NO_FILES)
    assert "give --tls-ca, --tls-cert, --tls-key, or set distributed.comm.tls" in said


@pytest.mark.parametrize(("left_out", "says"), [("ca", "--tls-ca is"), ("cert", "--tls-cert is")])
def test_some_of_the_certificates(left_out, says, ours):
    files = TlsFiles(**vars(ours.signed("good")) | {left_out: None})
    assert refusal(ADDRESS, files).startswith(f"{says} missing")


def configured(files: TlsFiles, **more: Any) -> Any:
    return dask.config.set(
        {
            "distributed.comm.tls.ca-file": str(files.ca),
            "distributed.comm.tls.client.cert": str(files.cert),
            "distributed.comm.tls.client.key": str(files.key),
            **more,
        }
    )


def test_certificates_of_dasks_configuration(ours, tmp_path):
    files = ours.signed("good")
    with configured(files):
        assert security_for(ADDRESS, NO_FILES).tls_client_key == str(files.key)
        assert security_for("tcp://127.0.0.1:1", NO_FILES) is not None
    with configured(files, **{"distributed.comm.require-encryption": True}):
        assert "configuration requires encryption" in refusal("tcp://127.0.0.1:1", NO_FILES)
    with configured(TlsFiles(files.ca, tmp_path / "none", files.key)):
        assert refusal(ADDRESS, NO_FILES).startswith("distributed.comm.tls.client.cert /")


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["run", "x.yaml", "--tls-ca", "ca.pem"], "are for the cluster of --scheduler"),
        (["info", "--tls-key", "ca.pem"], "are for the cluster of --scheduler"),
        (["run", "x.yaml", "--tls", "--scheduler", ADDRESS], "--tls is for a cluster of this"),
        (["run", "x.yaml", "--scheduler", ADDRESS], "x.yaml does not exist"),
    ],
)
def test_options_that_do_not_go_together(arguments, says, lidarpool):
    outcome = lidarpool(*arguments)
    assert (outcome.code, outcome.out) == (2, "")
    assert says in outcome.err


# -- schedulers ---------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def scheduler(ours) -> Iterator[Callable[..., str]]:
    """Start schedulers with these files, or without encryption; the address of each."""
    started: list[SpecCluster] = []

    def start(files: TlsFiles | None) -> str:
        security = Security()
        if files is not None:
            security = Security(
                require_encryption=True,
                tls_ca_file=str(files.ca),
                **{
                    f"tls_{role}_{part}": str(getattr(files, part))
                    for role in ("scheduler", "client", "worker")
                    for part in ("cert", "key")
                },
            )
        options = {"host": "127.0.0.1", "port": 0, "dashboard": False, "security": security}
        options["dashboard_address"] = "127.0.0.1:0"
        scheduler = {"cls": Scheduler, "options": options}
        started.append(SpecCluster(scheduler=scheduler, security=security, silence_logs=50))
        return str(started[-1].scheduler_address)

    yield start
    for each in started:
        each.close()


@pytest.fixture(scope="module")
def encrypted(scheduler, ours) -> str:
    """Address of a scheduler with certificates of ours."""
    return scheduler(ours.signed("scheduler"))


def told(address: str, files: TlsFiles = NO_FILES) -> str:
    with pytest.raises(LidarpoolError) as refused, connected(address, files):
        pytest.fail("it let us in")
    assert "\n" not in str(refused.value)
    return str(refused.value)


def test_the_right_certificate_is_let_in(encrypted, ours):
    with connected(encrypted, ours.signed("me")) as client:
        assert client.scheduler_info()["address"] == encrypted


def test_no_certificate_on_the_unencrypted_protocol(encrypted):
    assert "hangs up, as an encrypted one does" in told(encrypted.replace("tls:", "tcp:"))


def test_a_scheduler_of_another_authority(encrypted, theirs):
    said = told(encrypted, theirs.signed("me"))
    assert "shows a certificate that is not signed by the authority given here" in said


def test_a_certificate_that_the_scheduler_does_not_trust(encrypted, ours, theirs):
    # We trust both, it trusts ours alone.
    files = theirs.signed("me")
    trusted = theirs.folder / "both.pem"
    trusted.write_bytes(ours.file.read_bytes() + theirs.file.read_bytes())
    said = told(encrypted, TlsFiles(trusted, files.cert, files.key))
    assert "refuses the certificate given here" in said


def test_a_scheduler_that_does_not_encrypt(scheduler, ours):
    address = scheduler(None).replace("tcp:", "tls:")
    assert "does not encrypt: give its address as tcp://" in told(address, ours.signed("me"))


# -- clusters -----------------------------------------------------------------------------------


def test_an_encrypted_local_cluster():
    with local_cluster(gpu_workers=1, other_workers=1, security=True) as cluster:
        assert cluster.scheduler_address.startswith("tls://127.0.0.1:")
        with Client(cluster, set_as_default=False) as client:
            assert all(worker.address.startswith("tls://") for worker in Pool.from_client(client))
            assert client.submit(pow, 2, 10, resources={"OTHER": 1}).result() == 1024
        said = told(cluster.scheduler_address.replace("tls:", "tcp:"))
        assert "hangs up, as an encrypted one does" in said
        # Another temporary certificate is no better than none.
        stranger = Security.temporary()
        with pytest.raises(OSError, match="TLS certificate does not match"):
            Client(cluster.scheduler_address, security=stranger, timeout=5, set_as_default=False)


def test_without_cryptography_one_is_told_what_to_install(monkeypatch):
    def temporary() -> Security:
        raise ImportError("no cryptography")

    monkeypatch.setattr(Security, "temporary", temporary)
    with pytest.raises(PoolError, match="pip install cryptography"):
        local_cluster(security=True)


def test_simulate_with_tls(monkeypatch):
    seen: list[str] = []
    before = lidarpool.run.checks.survey_pool

    def look(client: Client, *rest: Any) -> Any:
        seen.append(client.scheduler.address)
        return before(client, *rest)

    monkeypatch.setattr(lidarpool.run.checks, "survey_pool", look)
    survey = Survey(poses=[(0, 0, 1)], sensor=Sensor.grid(layers=2, step_deg=30))
    result = lidarpool.simulate(Scene.seed(), survey, gpu_workers=1, other_workers=1, tls=True)
    assert result.rays > 0
    assert seen[0].startswith("tls://")


def test_a_survey_on_an_encrypted_outside_cluster(lidarpool, outside, ours, tmp_path, no_pictures):
    """From the `dask` command line, with a certificate for each role."""
    files = ours.signed("cluster")
    options = ["--tls-ca-file", files.ca, "--tls-cert", files.cert, "--tls-key", files.key]
    cluster = outside(*map(str, options))
    assert cluster.address.startswith("tls://")
    for name, slots in (("GPU", 1), ("LIDAR", 4), ("OTHER", 1)):
        cluster.add(name, slots=slots)
    security = security_for(cluster.address, files)
    with Client(cluster.address, security=security, set_as_default=False) as client:
        client.wait_for_workers(3, timeout=120)
    (tmp_path / "s.yaml").write_text("sensor: {layers: 4}\nplanning: {trials: 2}\n")
    mine = ours.signed("me")
    given = ["--scheduler", cluster.address]
    given += ["--tls-ca", mine.ca, "--tls-cert", mine.cert, "--tls-key", mine.key]
    outcome = lidarpool("run", tmp_path / "s.yaml", "--out", tmp_path / "out", "-q", *given)
    assert (outcome.code, outcome.err) == (0, "")
    assert json.loads((tmp_path / "out" / "report.json").read_text())["placement_violations"] == 0
    outcome = lidarpool("info", *given)
    assert outcome.code == 0
    assert "3 workers" in outcome.out
    outcome = lidarpool("info", *given[:2])
    assert outcome.code == 2
    assert "is encrypted: give --tls-ca" in outcome.err
