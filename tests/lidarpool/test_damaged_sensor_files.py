"""Damaged and hostile calibrations and files of sensors: one sentence that names the file."""

from __future__ import annotations

import io
import json
import re
import resource
import struct
import zipfile

import numpy as np
import pytest
import yaml
from click.testing import CliRunner

from lidarfiles.recordings.opening import open_recording
from lidarpool.cli.commands import cli
from lidarsim import LidarError, load_sensor

DEEP = 100_000
RAYS = {"azimuth_deg": np.arange(9.0), "elevation_deg": np.zeros(9)}


def npy(array):
    file = io.BytesIO()
    np.lib.format.write_array(file, np.asarray(array), allow_pickle=True)
    return file.getvalue()


def npz(method=zipfile.ZIP_DEFLATED, **arrays):
    """Return an .npz of arrays, or of bytes in their place."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", method) as archive:
        for name, array in {**RAYS, **arrays}.items():
            if array is not None:
                content = array if isinstance(array, bytes) else npy(array)
                archive.writestr(f"{name}.npy", content)
    return file.getvalue()


def patched(content, signature, offset, value):
    """Return an archive with a number of 16 bits replaced in each record with a signature."""
    data = bytearray(content)
    start = data.find(signature)
    while start >= 0:
        struct.pack_into("<H", data, start + offset, value)
        start = data.find(signature, start + 4)
    return bytes(data)


def with_method(method):
    return patched(patched(npz(), b"PK\1\2", 10, method), b"PK\3\4", 8, method)


def encrypted():
    return patched(patched(npz(), b"PK\1\2", 8, 1), b"PK\3\4", 6, 1)


def flipped(content, at):
    data = bytearray(content)
    for position in range(at, at + 8):
        data[position] ^= 0xFF
    return bytes(data)


def long_header():
    """Return an array whose header is far too long."""
    text = b"{'descr': '<f8', 'fortran_order': False, 'shape': (9,), }".ljust(1 << 20) + b"\n"
    return b"\x93NUMPY\2\0" + struct.pack("<I", len(text)) + text + bytes(72)


def nested_header():
    """Return an array whose header nests deeply."""
    text = b"(" * 9_000 + b")" * 900 + b"\n"
    return b"\x93NUMPY\1\0" + struct.pack("<H", len(text)) + text + bytes(72)


def huge_shape():
    text = b"{'descr': '<f8', 'fortran_order': False, 'shape': (999999999999999,), }\n"
    return b"\x93NUMPY\1\0" + struct.pack("<H", len(text)) + text + bytes(72)


STRUCTURED = np.zeros(9, [("a", "<f8"), ("b", "<i4")])
NESTED_JSON = "[" * DEEP + "]" * DEEP
OUSTER = {"beam_altitude_angles": [1.0, 2.0], "beam_azimuth_angles": [0.0, 0.0]}

NPZ = {
    "empty": (b"", "not a valid .npz"),
    "text": (b"dear reader", "not a valid .npz"),
    "cut": (npz()[:-30], "not a valid .npz"),
    "no arrays": (b"PK\5\6" + bytes(18), "expected a text file|contains no rays"),
    "encrypted": (encrypted(), "it is encrypted. Write it again without a password"),
    "unknown method": (with_method(97), "compression method"),
    "damaged lzma": (flipped(npz(zipfile.ZIP_LZMA), 70), "."),
    "lzma without content": (with_method(zipfile.ZIP_LZMA), "."),
    "bzip2 without content": (with_method(zipfile.ZIP_BZIP2), "."),
    "damaged deflate": (flipped(npz(), 60), "."),
    "damaged numbers": (flipped(npz(zipfile.ZIP_STORED), 190), "Bad CRC-32"),
    "structured": (npz(azimuth_deg=STRUCTURED), "azimuth_deg must contain real numbers"),
    "structured time": (npz(time_offset_ns=STRUCTURED), "time_offset_ns must contain real"),
    "words": (npz(azimuth_deg=np.array(["a"] * 9)), "real numbers, but has the type <U1"),
    "complex": (npz(azimuth_deg=np.zeros(9, complex)), "but has the type complex128"),
    "times": (npz(time_offset_ns=np.zeros(9, "M8[s]")), "but has the type datetime64"),
    "objects": (npz(azimuth_deg=np.array([{}] * 9)), "[Oo]bject arrays cannot be loaded"),
    "no .npy": (npz(azimuth_deg=b"x" * 99), "."),
    "long header": (npz(azimuth_deg=long_header()), "[Hh]eader"),
    "nested array header": (npz(azimuth_deg=nested_header()), "."),
    "huge shape": (npz(azimuth_deg=huge_shape()), "."),
    "nested header": (npz(header=np.array(NESTED_JSON)), "header is not JSON .*nested too deeply"),
    "header of numbers": (npz(header=np.arange(3)), "its header is not JSON"),
    "structured header": (npz(header=STRUCTURED), "its header is not JSON"),
    "header a list": (npz(header=np.array("[1]")), "its header is not a JSON object"),
    "header null": (npz(header=np.array("null")), "its header is not a JSON object"),
    "range a list": (
        npz(header=np.array('{"min_range_m": [1]}')), r"min_range_m .* 0 or greater, but is \[1\]",
    ),
    "negative range": (npz(header=np.array('{"min_range_m": -1}')), "0 or greater, but is -1"),
    "range NaN": (npz(header=np.array('{"max_range_m": NaN}')), "max_range_m .* but is nan"),
    "rate null": (npz(header=np.array('{"rate_hz": null}')), "rate_hz .* but is None"),
    "rgl of words": (npz(rays=np.zeros((2, 3, 4), "U1")), "rays must contain real numbers"),
    "angles of words": (
        npz(**dict.fromkeys(RAYS), theta=np.array(["a"]), phi=np.zeros(1)),
        "theta must contain real numbers, but has the type <U1",
    ),
}  # fmt: skip
TEXTS = {
    "nested.json": (NESTED_JSON, "nested too deeply"),
    "nested.yaml": ("[" * DEEP, "nested too deeply"),
    "list.json": ("[1]", "not an Ouster metadata file"),
    "null.json": ("null", "not an Ouster metadata file"),
    "angle-lists.json": (json.dumps({**OUSTER, "beam_azimuth_angles": [[0], 1]}), "."),
    "angle-objects.json": (json.dumps({**OUSTER, "beam_azimuth_angles": {}}), "."),
    "poses.json": (json.dumps({**OUSTER, "beam_to_lidar_transform": "none"}), "."),
    "huge.json": (json.dumps(OUSTER)[:-1] + ', "lidar_mode": ' + "9" * 5_000 + "}", "."),
    "lasers.yaml": ("lasers: [1, 2]", "."),
    "ids.yaml": ("lasers: [{laser_id: a}, {laser_id: 1}]", "."),
    "empty.csv": ("", "."),
    "nul.csv": ("\0" * 99, "."),
    "remarks.csv": (f"# rate_hz: {NESTED_JSON}\nazimuth [deg],time_offset_ns\n1,2", "."),
    "range.csv": ("# min_range_m: [1]\ntime_offset_ns,azimuth_deg,elevation_deg\n0,1,2",
                  r"min_range_m .* must be 0 or greater, but is \[1\]"),
    "wide.csv": ("elevation_deg" + ",azimuth_deg" * 9 + "\n1", "twice"),
}  # fmt: skip


def refusals(path, tmp_path):
    """Return the messages of reading a file as a calibration, and of importing it."""
    with pytest.raises(LidarError) as raised:
        load_sensor(calibration=path)
    messages = [str(raised.value)]
    if path.suffix != ".json" and path.suffix != ".yaml":
        outcome = CliRunner().invoke(cli, ["import", str(path), "-o", str(tmp_path / "out")])
        assert isinstance(outcome.exception, LidarError), outcome.exception
        messages.append(str(outcome.exception))
    return messages


def check_refusals(path, says, tmp_path, capfd):
    for message in refusals(path, tmp_path):
        assert path.name in message
        assert len(message.splitlines()) == 1 and len(message) < 700
        assert re.search(says, message), message
    assert "Traceback" not in capfd.readouterr().err


@pytest.mark.extended(every=4)
@pytest.mark.parametrize("name", NPZ)
def test_damaged_npz(name, tmp_path, capfd):
    content, says = NPZ[name]
    path = tmp_path / "rays.npz"
    path.write_bytes(content)
    check_refusals(path, says, tmp_path, capfd)


@pytest.mark.extended(every=4)
@pytest.mark.parametrize("name", TEXTS)
def test_damaged_texts(name, tmp_path, capfd):
    text, says = TEXTS[name]
    path = tmp_path / name
    path.write_text(text)
    check_refusals(path, says, tmp_path, capfd)


def parquet(header=None, rows=9, **columns):
    pa = pytest.importorskip("pyarrow", reason="the extra parquet is not installed")
    table = pa.table({**RAYS, **columns})
    if header is not None:
        table = table.replace_schema_metadata({b"lidarpool": header})
    file = io.BytesIO()
    pytest.importorskip("pyarrow.parquet").write_table(table, file)
    return file.getvalue()


PARQUET = {
    "empty": (lambda: b"", "Parquet"),
    "text": (lambda: b"dear reader" * 9, "Parquet"),
    "cut": (lambda: parquet()[:-9], "Parquet"),
    "damaged page": (lambda: flipped(parquet(), 20), "."),
    "damaged metadata": (lambda: flipped(parquet(), len(parquet()) - 200), "."),
    "header a list": (lambda: parquet(b"[1]"), "its header is not a JSON object"),
    "header a number": (lambda: parquet(b"7"), "its header is not a JSON object"),
    "header null": (lambda: parquet(b"null"), "its header is not a JSON object"),
    "header not JSON": (lambda: parquet(b"{"), "its header is not JSON"),
    "header not text": (lambda: parquet(b"\xff\xfe\xff"), "its header is not JSON"),
    "nested header": (lambda: parquet(NESTED_JSON.encode()), "nested too deeply"),
    "words": (lambda: parquet(channel=["a"] * 9), "channel must contain real numbers, .* string"),
    "lists": (lambda: parquet(channel=[[1]] * 9), "channel must contain real numbers, .* list<"),
    "records": (
        lambda: parquet(channel=[{"a": 1}] * 9),
        "channel must contain real numbers, .* struct<",
    ),
    "missing": (lambda: parquet(channel=[None, *[1] * 8]), "channel of ray 1 is NaN or infinite"),
    "unknown column": (lambda: parquet(color=[1] * 9), "unknown columns: color"),
}


@pytest.mark.extended(every=4)
@pytest.mark.parametrize("name", PARQUET)
def test_damaged_parquet(name, tmp_path, capfd):
    pytest.importorskip("pyarrow.parquet", reason="the extra parquet is not installed")
    make, says = PARQUET[name]
    path = tmp_path / "rays.parquet"
    path.write_bytes(make())
    check_refusals(path, says, tmp_path, capfd)


def test_a_damaged_cloud_of_parquet_is_refused_in_a_line(tmp_path):
    pa = pytest.importorskip("pyarrow", reason="the extra parquet is not installed")
    path = tmp_path / "cloud.parquet"
    table = pa.table({axis: np.arange(9.0) for axis in "xyz"})
    pytest.importorskip("pyarrow.parquet").write_table(table, path)
    path.write_bytes(flipped(path.read_bytes(), 4))  # the head of the first page
    with pytest.raises(
        LidarError, match=r"cloud\.parquet cannot be read: .* page header"
    ) as raised:
        open_recording(path)[0]
    assert len(str(raised.value).splitlines()) == 1


@pytest.mark.extended
def test_the_rows_of_parquet_are_limited_before_they_are_read(tmp_path):
    """A file of 6 kB with 40 million rows, which took gigabytes."""
    pa = pytest.importorskip("pyarrow", reason="the extra parquet is not installed")
    pq = pytest.importorskip("pyarrow.parquet")
    path = tmp_path / "rays.parquet"
    batch = pa.table({name: np.zeros(1_000_000) for name in RAYS})
    with pq.ParquetWriter(path, batch.schema) as writer:
        for _ in range(40):
            writer.write_table(batch)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(LidarError, match=r"rays\.parquet .*would unpack to at least 610\.35 MiB"):
        load_sensor(calibration=path)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 100 * 1024  # kiB


def test_a_model_that_is_nested_deeply_is_refused_in_a_sentence(tmp_path):
    path = tmp_path / "model.yaml"
    path.write_text(yaml.safe_dump({"name": "a"}) + "beams: " + "[" * DEEP)
    with pytest.raises(
        LidarError, match=r"model\.yaml is not a valid sensor model: .*nested too deeply"
    ):
        load_sensor(path)
