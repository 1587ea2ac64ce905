"""Archives of arrays: read as NumPy writes them, without Python's parser, and within a limit."""

from __future__ import annotations

import io
import re
import zipfile

import numpy as np
import pytest

from lidarpool import LidarpoolError
from lidarpool.base import allowance
from lidarpool.base.archives import open_archive
from lidarpool.export.sweeps import Sweeps

ARRAYS = {
    "number": np.float64(3.5),
    "yes": np.bool_(True),
    "none": np.zeros((0, 3), np.float32),
    "turned": np.arange(24, dtype=">i2").reshape(2, 3, 4).T,
    "rows": np.arange(6, dtype=np.uint8).reshape(3, 2),
    "bytes": np.array([b"ab\0", b"cde"]).view("V3"),
}


def packed(arrays, method=zipfile.ZIP_DEFLATED):
    memory = io.BytesIO()
    with zipfile.ZipFile(memory, "w", method) as archive:
        for name, array in arrays.items():
            with archive.open(f"{name}.npy", "w") as file:
                np.save(file, array) if isinstance(array, np.ndarray) else file.write(array)
    return memory.getvalue()


@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
def test_arrays_are_those_that_numpy_reads(tmp_path, monkeypatch, save):
    save(tmp_path / "a.npz", **ARRAYS)
    (tmp_path / "b.npz").write_bytes((tmp_path / "a.npz").read_bytes())
    with np.load(tmp_path / "a.npz") as archive:
        plain = dict(archive)

    def fail(*_):
        raise SystemError("AST constructor recursion depth mismatch (before=45, after=42)")

    monkeypatch.setattr("ast.literal_eval", fail)
    with pytest.raises(SystemError):
        np.load(tmp_path / "b.npz")["rows"]
    with open_archive(tmp_path / "b.npz") as arrays:
        assert [*arrays] == [*ARRAYS]
        for name, array in arrays.items():
            assert (array.dtype, array.shape) == (plain[name].dtype, plain[name].shape)
            assert array.tobytes() == plain[name].tobytes() and array.flags.writeable
            assert array.flags.f_contiguous == plain[name].flags.f_contiguous


def header(shape):
    head = io.BytesIO()
    told = {"descr": "<f8", "fortran_order": False, "shape": shape}
    np.lib.format.write_array_header_1_0(head, told)
    return head.getvalue()


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (packed({"x": header((400_000_000,)) + bytes(2**20)}), "would unpack to 2.98 GiB or more"),
        (packed({f"x{k}": np.zeros(2**16) for k in range(4)}), "would unpack to 1.50 MiB or more"),
        (packed({"x": header((1,)) + bytes(2**24)}), "damaged .*x.npy is longer than its array"),
        (packed({"x": np.zeros(9)}, zipfile.ZIP_LZMA), "a method other than Deflate"),
        (packed({"x": np.array([{}])}), "x.npy is not an array of numbers"),
        (packed({"x": b"none"}), "x.npy is not an array of numbers"),
        (packed(ARRAYS)[:-9], "damaged or not of this version"),
        (b"", "damaged or not of this version"),
    ],
    ids=range(8),
)
def test_others_are_refused_in_a_line(tmp_path, monkeypatch, data, words):
    monkeypatch.setattr(allowance, "LEAST", 2**20)
    path = tmp_path / "0000.npz"
    path.write_bytes(data)
    for read in (None, path.read_bytes):
        with pytest.raises(LidarpoolError, match=words) as told:
            Sweeps.load(path, read)
        assert re.match(rf"{path}\b[^\n]*\.$", str(told.value))
