"""What does not fit is refused before it is begun, and the message names both numbers."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest

from raybeam import (
    Pattern,
    RayCaster,
    cuda_build,
    cuda_scene,
    embree_backend,
    memory,
    mesh,
    numpy_backend,
)
from raybeam.backend import Found
from raybeam.cuda_backend import CudaBackend
from raybeam.cuda_results import Packer, PinnedRoom
from raybeam.layout import lay_out
from raybeam.numpy_backend import NumpyBackend
from raybeam.rays import Rays
from raybeam.scan import check_scan

MANY = 2**31 + 5


@pytest.fixture
def scarce(monkeypatch):
    """Make a machine with so many MiB left that is asked for everything."""

    def make(mebibytes):
        monkeypatch.setattr(memory, "ASK", 1)
        monkeypatch.setattr(memory, "available", lambda: mebibytes << 20)

    return make


# ---- asking the system ----


@pytest.fixture
def system(tmp_path, monkeypatch):
    """Write files of /proc and of control groups; none is there to begin with."""
    monkeypatch.setattr(memory, "_PROC", tmp_path / "proc")
    monkeypatch.setattr(memory, "_GROUPS", tmp_path / "groups")

    def write(**files):
        for name, text in files.items():
            path = tmp_path / name.replace("__", "/").replace("--", ".")
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text)

    return write


def group(limit, used, cached, version):
    names = memory._FILES[version]
    stat = f"other 5\n{names[2]} {cached}\n"
    return {names[0].replace(".", "--"): f"{limit}\n", names[1].replace(".", "--"): f"{used}\n",
            "memory--stat": stat}  # fmt: skip


def test_systems_that_do_not_tell(system):
    assert memory.available() is None
    memory.require(1 << 60, "It", "do not")


def test_what_the_machine_has(system):
    system(proc__meminfo="MemTotal: 9000 kB\nMemAvailable:    4000 kB\n")
    assert memory.available() == 4000 * 1024


@pytest.mark.parametrize(("version", "line"), [(1, "4:memory:/a/b"), (2, "0::/a/b")])
def test_least_of_machine_and_groups(system, version, line):
    """A group without a limit, one within it that has one, and files that could be let go."""
    root = "groups__memory__" if version == 1 else "groups__"
    system(
        proc__meminfo="MemAvailable: 4000 kB\n",
        proc__self__cgroup=f"9:cpu:/elsewhere\n{line}\n",
        **{f"{root}a__{k}": v for k, v in group(3_000_000, 1_000_000, 500_000, version).items()},
        **{f"{root}{k}": v for k, v in group("max", 0, 0, 2).items() if version == 2},
    )
    assert memory.available() == 2_500_000


def test_less_than_is_worth_asking(monkeypatch):
    monkeypatch.setattr(memory, "available", lambda: pytest.fail("asked"))
    memory.require(memory.ASK - 1, "It", "do not")


def test_message_names_both_numbers(monkeypatch):
    monkeypatch.setattr(memory, "available", lambda: 1 << 30)
    memory.require(1 << 30, "It", "do not")
    with pytest.raises(MemoryError, match=r"^It needs 2,048 MiB and 1,024 MiB are free: do not\.$"):
        memory.require(2 << 30, "It", "do not")


def test_meter_asks_as_it_grows(monkeypatch):
    asked = []
    monkeypatch.setattr(memory, "require", lambda need, what, instead: asked.append(need))
    meter = memory.Meter("It", "do not")
    for _ in range(10):
        meter.add(memory.ASK // 2)
    assert asked == [memory.ASK * k for k in (1, 2, 3, 4, 5)]
    assert repr(meter) == f"Meter('It', {5 * memory.ASK} bytes)"


# ---- what is refused ----


def test_fifty_million_triangles_where_there_is_no_room(backend, scarce):
    scarce(1024)
    faces = np.broadcast_to(np.array([0, 1, 2]), (50_000_000, 3))
    with pytest.raises(MemoryError, match=r"of 50,000,000 triangles needs 8,583 MiB and 1,024 MiB"):
        RayCaster(np.eye(3), faces, backend)


def test_more_triangles_than_numbers(backend):
    faces = np.broadcast_to(np.array([0, 1, 2], np.int8), (2**28, 3))
    with pytest.raises(ValueError, match="268435456 triangles are too many: the limit is 2684354"):
        RayCaster(np.eye(3), faces, backend)


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
    need = cuda_scene._TABLE_BYTES * len(local.corners) + cuda_scene.WORK
    runtime = source_backend._library().cuda.runtime
    monkeypatch.setattr(runtime, "memGetInfo", lambda: (need - 1, 1 << 35))
    monkeypatch.setattr(cuda_scene, "lay_out", lambda mesh: pytest.fail("built"))
    with pytest.raises(MemoryError, match=r"needs 769 MiB on the CUDA device and 769 MiB are free"):
        source_backend(local)


def test_device_that_is_full_when_casting(source_backend, shapes, monkeypatch):
    engine = source_backend(mesh.local_mesh(*shapes["cube"]()))
    library = source_backend._library()

    def refuse(*given):
        raise library.cuda.memory.OutOfMemoryError("CuPy's own words")

    rays = Rays(np.zeros((1, 3)), np.eye(3), 0.0, np.inf)
    scan = check_scan(Pattern(np.eye(3)), [0, 0, 0])
    monkeypatch.setattr(library, "empty", refuse)
    monkeypatch.setattr(library, "zeros", refuse)
    calls = (
        lambda: engine.cast(rays), lambda: engine.returns(rays), lambda: engine.scan(scan),
        lambda: engine.count(rays, True),
    )  # fmt: skip
    for call in calls:
        with pytest.raises(
            MemoryError, match=r"cast of 3 rays needs [\d,]+ MiB and 16,384 MiB are"
        ):
            call()


def test_answer_that_does_not_fit(backend, shapes, scarce):
    caster = RayCaster(*shapes["cube"](), backend)
    scarce(1024)
    rays = Rays(np.zeros((1, 3)), np.broadcast_to([0.0, 0.0, 1.0], (MANY, 3)), 0.0, np.inf)
    with pytest.raises(MemoryError, match=r"for 2,147,483,653 rays needs 57,344 MiB and 1,024 MiB"):
        caster._engine.cast(rays)


@pytest.mark.parametrize("call", ["returns", "scan"])
def test_hits_that_could_not_be_joined(caster, shapes, scarce, call):
    cube = caster(*shapes["cube"]())
    directions = np.tile([0.25, 0.5, 1.0], (100_000, 1))
    pattern = Pattern(directions)
    scarce(1)
    with pytest.raises(MemoryError, match=r"Joining the hits needs \d MiB and 1 MiB are free: "):
        cube.returns([0, 0, 0], directions) if call == "returns" else cube.scan(pattern, [0, 0, 0])


def test_pattern_that_does_not_fit(scarce):
    scarce(1)
    with pytest.raises(MemoryError, match=r"100,000 directions needs 2 MiB and 1 MiB are free"):
        Pattern(np.tile([0.0, 0.0, 1.0], (100_000, 1)))


# ---- rays beyond 2**31 ----


@pytest.fixture
def untouched(monkeypatch):
    """Rays as a view that takes no memory, however many: parts are cut, not made."""
    monkeypatch.setattr(
        Rays, "part", lambda self, a, b: Rays(self.origins, self.directions[a:b], 0.0, np.inf)
    )
    return Rays(np.zeros((1, 3)), np.broadcast_to([0.0, 0.0, 1.0], (MANY, 3)), 0.0, np.inf)


def test_rays_are_numbered_beyond_32_bits(shapes, monkeypatch, untouched):
    engine = NumpyBackend(mesh.local_mesh(*shapes["cube"]()))
    monkeypatch.setattr(NumpyBackend, "chunk", 1 << 29)

    def last(rays, weights):
        one, none = np.array([len(rays) - 1]), np.zeros(0)
        return Found(one, np.ones(1), np.zeros(1, np.int32), none, none)

    monkeypatch.setattr(engine, "closest", last)
    hits = engine.returns(untouched)
    assert hits.ray.tolist() == [2**29 - 1, 2**30 - 1, 3 * 2**29 - 1, 2**31 - 1, MANY - 1]
    assert engine.count(untouched, every=False).tolist() == [5] + [0] * 11


def test_packed_hits_are_numbered_beyond_32_bits(source_backend, shapes):
    engine = source_backend(mesh.local_mesh(*shapes["cube"]()))
    library = source_backend._library()
    packer = Packer(library, engine._kernels, engine._faces, PinnedRoom(library), 1)
    place = library.asarray(np.array([-1, 3, -1, 0], np.int32))
    packer.add(library.asarray(np.arange(4.0)), place, MANY, 1.0)
    assert packer.returns().ray.tolist() == [MANY + 1, MANY + 3]


def test_no_number_of_a_chunk_needs_more_than_32_bits():
    """What intersect.cu and build.cu hold in an int, at the greatest mesh and chunk."""
    most = 2**28 - 1  # triangles
    assert CudaBackend.chunk < 2**31  # sums of hits
    assert 2 * most - 1 < 2**31  # nodes of the binary tree
    place = np.int64(most - 1) << 3 | 3  # the last triangle, in a leaf of four
    assert ~place > -(2**31)  # not DONE
    assert -(-2 * most // 128) < 2**31  # blocks of a grid


# ---- the figures that are asked for ----


def sorts(shapes):
    yield shapes["soup"]("random", 40_000)
    yield shapes["terrain box"](140)
    yield shapes["cube"]()[0], np.tile(shapes["cube"]()[1], (3000, 1))


def peak(make):
    """Bytes at the peak of a call, and what it returns."""
    tracemalloc.start()
    made = make()
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return most, made


def test_bytes_of_builds_are_no_less_than_what_they_take(shapes, source_backend, monkeypatch):
    monkeypatch.setattr(mesh, "_BLOCK", 1 << 10)
    for vertices, faces in sorts(shapes):
        most, local = peak(lambda: mesh.local_mesh(vertices, faces))  # noqa: B023
        n = len(local.corners)
        assert n >= 36_000
        assert 0.4 < most / (mesh._VERTEX_BYTES * len(vertices) + mesh._FACE_BYTES * n) < 1
        assert 0.5 < peak(lambda: NumpyBackend(local))[0] / n / numpy_backend._BYTES < 1  # noqa: B023
        assert 0.5 < peak(lambda: lay_out(local))[0] / n / cuda_scene._LAYOUT_BYTES < 1  # noqa: B023
        library = source_backend._library()
        most, tables = peak(lambda: cuda_build.build(library, 0, local))  # noqa: B023
        assert 0.5 < most / n / cuda_build.BYTES < 1
        finished = (tables.triangles, tables.corners, tables.faces)
        assert sum(table.nbytes for table in finished) == cuda_scene._TABLE_BYTES * n
