"""What does not fit is refused before it is begun, and the message names both numbers."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest

from raybeam import RayCaster, cuda_backend, cuda_build, embree_backend, memory, mesh, numpy_backend
from raybeam.backend import Found
from raybeam.cuda_results import Packer, PinnedRoom
from raybeam.layout import lay_out
from raybeam.numpy_backend import NumpyBackend
from raybeam.scan import Pattern, check_scan

MANY = 2**31 + 5


@pytest.fixture
def scarce(monkeypatch):
    """Make a machine with so many MiB left that is asked for everything."""

    def make(mebibytes):
        monkeypatch.setattr(memory, "ASK", 1)
        monkeypatch.setattr(memory, "available", lambda: mebibytes << 20)

    return make


@pytest.fixture
def system(tmp_path, monkeypatch):
    """Write files of /proc and of control groups; none is there to begin with."""
    monkeypatch.setattr(memory, "_PROC", tmp_path / "proc")
    monkeypatch.setattr(memory, "_GROUPS", tmp_path / "groups")

    def write(name, text):
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)

    return write


def test_least_of_machine_and_groups(system):
    """A group without a limit, one within it that has one, and files that could be let go."""
    assert memory.available() is None  # a system that does not tell
    memory.require(1 << 60, "It")
    system("proc/meminfo", "MemTotal: 9000 kB\nMemAvailable:    4000 kB\n")
    system("proc/self/cgroup", "9:cpu:/elsewhere\n0::/a/b\n")
    assert memory.available() == 4000 * 1024
    for folder, limit in (("groups", "max"), ("groups/a", "3000000")):
        system(f"{folder}/memory.max", f"{limit}\n")
        system(f"{folder}/memory.current", "1000000\n")
        system(f"{folder}/memory.stat", "other 5\ninactive_file 500000\n")
    assert memory.available() == 2_500_000


def test_fifty_million_triangles_where_there_is_no_room(scarce):
    scarce(1024)
    faces = np.broadcast_to(np.array([0, 1, 2]), (50_000_000, 3))
    with pytest.raises(MemoryError, match=r"of 50,000,000 triangles needs 8,583 MiB and 1,024 MiB"):
        RayCaster(np.eye(3), faces, "numpy")


@pytest.mark.parametrize(("name", "mebibytes"), [("numpy", 3), ("embree", 4), ("source", 4)])
def test_tree_that_does_not_fit(request, shapes, scarce, monkeypatch, name, mebibytes):
    local = mesh.local_mesh(*shapes["vase"]())
    classes = {"numpy": NumpyBackend, "embree": embree_backend.EmbreeBackend}
    engine = classes.get(name) or request.getfixturevalue("source_backend")
    if reason := engine.missing():
        pytest.skip(reason)
    monkeypatch.setattr(engine, "device_build", 1 << 30, raising=False)
    scarce(1)
    words = f"over 12,480 triangles needs {mebibytes} MiB and 1 MiB are free"
    with pytest.raises(MemoryError, match=words):
        engine(local)


def test_tables_that_do_not_fit_the_device_are_not_built(source_backend, shapes, monkeypatch):
    local = mesh.local_mesh(*shapes["vase"]())
    need = cuda_backend._TABLE_BYTES * len(local.corners) + cuda_backend._WORK
    runtime = source_backend._library().cuda.runtime
    monkeypatch.setattr(runtime, "memGetInfo", lambda: (need - 1, 1 << 35))
    monkeypatch.setattr(cuda_backend, "lay_out", lambda mesh: pytest.fail("built"))
    with pytest.raises(MemoryError, match=r"needs 769 MiB on the CUDA device and 769 MiB are free"):
        source_backend(local)


# ---- rays beyond 2**31 ----


def test_rays_are_numbered_beyond_32_bits(shapes, monkeypatch):
    """The last ray of each chunk of a scan hits; rays are not made."""
    engine = NumpyBackend(mesh.local_mesh(*shapes["cube"]()))
    monkeypatch.setattr(NumpyBackend, "chunk", 1 << 29)
    scan = check_scan(Pattern(np.eye(3)), [0, 0, 0], window=(0, MANY))
    monkeypatch.setattr(type(scan), "rays", lambda self, start, stop: stop - start)

    def last(count):
        none = np.zeros(0)
        return Found(np.array([count - 1]), np.ones(1), np.zeros(1, np.int32), none, none)

    monkeypatch.setattr(engine, "closest", last)
    found = engine.scan(scan)
    assert found.ray.tolist() == [2**29 - 1, 2**30 - 1, 3 * 2**29 - 1, 2**31 - 1, MANY - 1]
    assert found.hits.tolist() == [5]


def test_packed_hits_are_numbered_beyond_32_bits(source_backend, shapes):
    engine = source_backend(mesh.local_mesh(*shapes["cube"]()))
    library = source_backend._library()
    packer = Packer(library, engine._kernels, engine._faces, PinnedRoom(library), 1)
    place = library.asarray(np.array([-1, 3, -1, 0], np.int32))
    packer.add(library.asarray(np.arange(4.0)), place, MANY, 1.0)
    assert packer.returns()[0].tolist() == [MANY + 1, MANY + 3]


# ---- the figures that are asked for ----


def peak(make):
    """Bytes at the peak of a call, and what it returns."""
    tracemalloc.start()
    made = make()
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return most, made


@pytest.mark.parametrize("sort", ["soup", "terrain", "copies"])
def test_bytes_of_builds_are_no_less_than_what_they_take(shapes, source_backend, monkeypatch, sort):
    cube = shapes["cube"]()
    vertices, faces = {
        "soup": lambda: shapes["soup"]("random", 40_000),
        "terrain": lambda: shapes["terrain box"](140),
        "copies": lambda: (cube[0], np.tile(cube[1], (3000, 1))),
    }[sort]()
    monkeypatch.setattr(mesh, "_BLOCK", 1 << 10)
    most, local = peak(lambda: mesh.local_mesh(vertices, faces))
    n = len(local.corners)
    assert n >= 36_000
    assert 0.4 < most / (mesh._VERTEX_BYTES * len(vertices) + mesh._FACE_BYTES * n) < 1
    assert 0.5 < peak(lambda: NumpyBackend(local))[0] / n / numpy_backend._BYTES < 1
    assert 0.5 < peak(lambda: lay_out(local))[0] / n / cuda_backend._LAYOUT_BYTES < 1
    library = source_backend._library()
    most, tables = peak(lambda: cuda_build.build(library, 0, local))
    assert 0.5 < most / n / cuda_build.BYTES < 1
    finished = (tables.triangles, tables.corners, tables.faces)
    assert sum(table.nbytes for table in finished) == cuda_backend._TABLE_BYTES * n
