"""Clouds on disk: in order whatever way their parts came, the same bytes in any pieces."""

import os
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lidarpool import LidarpoolError, ply
from lidarpool.cloud import Cloud, counts_by_object
from lidarpool.ply import read_cloud, save_cloud
from lidarpool.scan.builder import CloudBuilder
from lidarpool.scan.messages import POINT, Part

ROOT = Path(__file__).parents[2]


def table(scan, count):
    rng = np.random.default_rng(scan)
    points = np.zeros(count, POINT)
    points["cell"] = rng.integers(-5000, 5000, (count, 3))
    points["scan"], points["ray"] = scan, np.arange(count)
    points["object"], points["ring"] = rng.integers(0, 6, count), rng.integers(0, 40, count)
    return points


def build(counts, parts):
    """Builder with these scans, delivered in these parts."""
    builder = CloudBuilder(len(counts))
    for scans in parts:
        tables = [table(scan, counts[scan]) for scan in scans]
        builder.add(Part(tuple(scans), tuple(map(len, tables)), np.concatenate(tables)))
    return builder


def expected(counts):
    """The merged points as they would be in memory."""
    tables = [table(scan, count) for scan, count in enumerate(counts)]
    return np.concatenate([np.empty(0, POINT), *tables])


@st.composite
def deliveries(draw):
    counts = draw(st.lists(st.integers(0, 9), min_size=1, max_size=12))
    order = draw(st.permutations(range(len(counts))))
    cuts = sorted(draw(st.sets(st.integers(1, len(counts)), max_size=4)))
    parts = [list(p) for p in np.split(order, cuts) if len(p)]
    return counts, parts + draw(st.lists(st.sampled_from(parts), max_size=2))


@settings(max_examples=60)
@given(deliveries(), st.integers(1, 20))
def test_chunks_of_any_size_are_the_points_in_order(delivered, size):
    counts, parts = delivered
    cloud = build(counts, parts).merge(0.5, np.zeros(3))
    whole = expected(counts)
    chunks = list(cloud.chunks(size))
    assert [len(chunk) for chunk in chunks[:-1]] == [size] * (len(chunks) - 1)
    assert sum(map(len, chunks)) == len(cloud) == len(whole)
    for name in ("scan", "ring", "object"):
        found = np.concatenate([np.empty(0, int), *(getattr(c, name) for c in chunks)])
        assert (found == whole[name]).all()
    loaded = cloud.load()
    assert (loaded.positions == whole["cell"] * 0.5).all()
    assert (loaded.scan == whole["scan"]).all() and (loaded.ring == whole["ring"]).all()
    if len(whole):
        assert (
            cloud.bounds == np.stack([f(loaded.positions, axis=0) for f in (np.min, np.max)])
        ).all()
    else:
        assert (cloud.bounds == 0).all()
    assert (counts_by_object(cloud, 6) == np.bincount(whole["object"], minlength=6)).all()


def test_scans_that_came_together_are_read_together():
    counts = [10] * 100
    builder = build(counts, [range(50), range(50, 100)])
    reads = []
    read_into = builder._store.read_into
    builder._store.read_into = lambda offset, buffer: (
        reads.append(len(buffer)), read_into(offset, buffer),
    )  # fmt: skip
    assert len(builder.merge(0.01, np.zeros(3)).load()) == 1000
    assert reads == [1000 * POINT.itemsize]


@pytest.mark.parametrize("origin", [0.0, 5_000_000.0])
@pytest.mark.parametrize("piece", [1, 7, 50, 999, 1000, 5000])
def test_pieces_have_the_bytes_that_open3d_writes_at_once(origin, piece, tmp_path, monkeypatch):
    cloud = build([100] * 10, [[5, 6], [0, 1, 2, 3, 4], [9, 8, 7]]).merge(0.01, np.full(3, origin))
    whole = cloud.load()
    real = np.float64 if origin else np.float32
    narrow = Cloud(whole.positions.astype(real), whole.scan, whole.ring, whole.object)
    ply._write_open3d(tmp_path / "open3d.ply", narrow)
    chunks = cloud.chunks
    monkeypatch.setattr(cloud, "chunks", lambda: chunks(piece))
    size = save_cloud(tmp_path / "c.ply", cloud)
    assert (tmp_path / "c.ply").read_bytes() == (tmp_path / "open3d.ply").read_bytes()
    assert size == (tmp_path / "c.ply").stat().st_size
    assert (read_cloud(tmp_path / "c.ply").positions.dtype == np.float64) == bool(origin)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["c.ply", "open3d.ply"]


def test_one_far_point_makes_all_positions_double(tmp_path):
    """The type is settled before the first piece is written."""
    builder = CloudBuilder(2)
    near, far = table(0, 10), table(1, 1)
    far["cell"] = 2**30
    builder.add(Part((0,), (10,), near))
    builder.add(Part((1,), (1,), far))
    cloud = builder.merge(0.001, np.zeros(3))
    save_cloud(tmp_path / "c.ply", cloud, precision_m=0.001)
    assert read_cloud(tmp_path / "c.ply").positions.dtype == np.float64


def test_bytes_that_change_on_their_way_to_the_disk_are_noticed(tmp_path, monkeypatch):
    cloud = build([100], [[0]]).merge(0.01, np.zeros(3))
    flush = ply._check_whole

    def change(temporary, *rest):
        data = bytearray(temporary.read_bytes())
        data[-3] ^= 1
        temporary.write_bytes(data)
        return flush(temporary, *rest)

    monkeypatch.setattr(ply, "_check_whole", change)
    with pytest.raises(LidarpoolError, match="came back from the disk with other bytes"):
        save_cloud(tmp_path / "c.ply", cloud)
    assert list(tmp_path.iterdir()) == []


def test_the_temporary_folder_is_full(monkeypatch, tmp_path):
    def full(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(tempfile, "TemporaryFile", full)
    builder = CloudBuilder(1)
    with pytest.raises(
        LidarpoolError, match=r"No space left on device\): make room, or let TMPDIR"
    ):
        builder.add(Part((0,), (5,), table(0, 5)))
    assert builder.point_count == 0 and not builder.ledger.delivered


# A survey's deliveries and the writing of its cloud, with less memory than the points take.
BOUNDED = """
import resource, sys
from pathlib import Path
import numpy as np
import open3d
from lidarpool.ply import save_cloud
from lidarpool.scan.builder import CloudBuilder
from lidarpool.scan.messages import POINT, Part

folder, scans, per_scan, extra = Path(sys.argv[1]), *map(int, sys.argv[2:])
words = dict(line.split(":") for line in Path("/proc/self/status").read_text().splitlines())
data = int(words["VmData"].split()[0]) * 1024
resource.setrlimit(resource.RLIMIT_DATA, (data + extra, data + extra))

table = np.zeros(per_scan, POINT)
table["cell"] = np.random.default_rng(1).integers(-90000, 90000, (per_scan, 3))
table["ray"] = np.arange(per_scan)
builder = CloudBuilder(scans)
for scan in np.random.default_rng(2).permutation(scans).tolist():
    table["scan"] = scan
    builder.add(Part((scan,), (per_scan,), table))
cloud = builder.merge(0.01, np.zeros(3))
save_cloud(folder / "c.ply", cloud)
try:
    cloud.load()
except MemoryError:
    print("the whole does not fit")
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024)
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="limits memory as Linux does")
def test_a_cloud_larger_than_memory(tmp_path):
    """2e7 points, 520 MB on disk and 680 MB in memory, in 300 MB besides the libraries."""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path), "TMPDIR": str(tmp_path)}
    scans, per_scan = 2000, 10_000
    done = subprocess.run(
        [sys.executable, "-c", BOUNDED, tmp_path, str(scans), str(per_scan), str(300 << 20)],
        capture_output=True, text=True, env=environment, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("the whole does not fit\n")
    rows = np.memmap(tmp_path / "c.ply", dtype=np.uint8, mode="r")[-22 * scans * per_scan :]
    scan = np.ndarray(scans * per_scan, "<i4", rows, 12, 22)
    assert (scan[::per_scan] == np.arange(scans)).all() and (np.diff(scan) >= 0).all()


@pytest.mark.skipif(sys.platform != "linux", reason="limits memory as Linux does")
def test_the_benchmark_at_toy_size(tmp_path):
    """In a process of its own, since it limits its memory."""
    done = subprocess.run(
        [sys.executable, "-m", "benchmarks.big_cloud", "--points", "1e5", "--folder", tmp_path],
        capture_output=True, text=True, cwd=ROOT, check=False,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)},
    )  # fmt: skip
    assert done.stdout.startswith("100,000 points, 0.00 GB of .ply\n"), done.stderr
    assert list(tmp_path.iterdir()) == []
