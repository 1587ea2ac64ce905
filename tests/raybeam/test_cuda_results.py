"""Room for results: page-locked within a limit, lent and taken back; hits closed up in order."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from raybeam import Pattern, cuda_backend
from raybeam.cuda_results import PinnedRoom
from raybeam.mesh import local_mesh
from raybeam.scan import check_scan


class Locked:
    """Counts what is page-locked."""

    now = 0

    def __init__(self, size):
        self._bytes = np.empty(size, np.uint8)
        self.ptr, self.size = self._bytes.ctypes.data, size
        Locked.now += size

    def __del__(self):
        Locked.now -= self.size


class RefusedError(RuntimeError):
    pass


@pytest.fixture
def room():
    Locked.now = 0
    return made(Locked)


def made(memory):
    runtime = SimpleNamespace(CUDARuntimeError=RefusedError)
    cuda = SimpleNamespace(PinnedMemory=memory, runtime=runtime)
    return PinnedRoom(SimpleNamespace(cuda=cuda), limit=1 << 20)


def is_locked(array):
    return array.base is not None


def test_array_is_what_was_asked_for(room):
    for dtype in (np.int64, np.float64, np.int32):
        array = room.empty(1000, dtype)
        assert array.dtype == dtype
        assert array.shape == (1000,)
        assert is_locked(array)
        array[:] = np.arange(1000)
        assert array.flags.writeable
        np.testing.assert_array_equal(array, np.arange(1000))


def test_arrays_do_not_overlap(room):
    one, other = room.empty(5000, np.int64), room.empty(5000, np.int64)
    one[:], other[:] = 1, 2
    assert one.sum() == 5000


def test_what_is_let_go_is_used_again(room):
    for n in range(7000, 8000):
        array = room.empty(n, np.float64)
        assert is_locked(array)
        del array
    assert Locked.now == 1 << 16


def test_a_view_keeps_the_memory(room):
    view = room.empty(100, np.int32)[10:20]
    view[:] = 7
    room.empty(100, np.int32)[:] = 8
    assert (view == 7).all()
    assert Locked.now == 2 << 16


def test_ordinary_memory_beyond_the_limit(room):
    kept = [room.empty(1 << 15, np.float64) for _ in range(6)]
    assert [is_locked(array) for array in kept] == [True] * 4 + [False] * 2
    assert Locked.now == 1 << 20
    del kept[0]
    assert is_locked(room.empty(1 << 15, np.float64))
    assert not is_locked(room.empty(1 << 20, np.float64))


def test_free_blocks_make_way_for_other_sizes(room):
    many = [room.empty(1 << 13, np.float64) for _ in range(16)]
    assert Locked.now == 1 << 20
    del many
    assert is_locked(room.empty(1 << 17, np.float64))
    assert Locked.now == 1 << 20


def test_nothing_needs_no_room(room):
    assert len(room.empty(0, np.int64)) == 0
    assert Locked.now == 0


def test_ordinary_memory_when_the_system_locks_no_more():
    def refuse(size):
        raise RefusedError(size)

    room = made(refuse)
    array = room.empty(100, np.int64)
    assert not is_locked(array)
    assert repr(room) == f"PinnedRoom(0 of {1 << 20} bytes held)"


def test_repr(room):
    room.empty(1, np.int32)
    assert repr(room) == f"PinnedRoom({1 << 16} of {1 << 20} bytes held)"


@pytest.mark.parametrize("limit", [0, 1, 1 << 30])
@pytest.mark.parametrize("chunk", [1, 7, 4096])
def test_hits_stay_in_ray_order(source_backend, shapes, monkeypatch, limit, chunk):
    """However often hits are fetched, and in however many casts they were found."""
    engine = source_backend(local_mesh(*shapes["soup"]("random")))
    pattern = Pattern(np.random.default_rng(0).normal(size=(600, 3)))
    scan = check_scan(pattern, [1.0, 2.0, 3.0], window=(50, 550))
    want = engine.scan(scan)
    engine._keep = limit
    monkeypatch.setattr(source_backend, "chunk", chunk)
    got = engine.scan(scan)
    assert len(got) > 50
    assert (np.diff(got.ray) > 0).all()
    for name in ("ray", "distance", "triangle"):
        mine, other = getattr(got, name), getattr(want, name)
        assert mine.dtype == other.dtype
        np.testing.assert_array_equal(mine, other)


def test_pattern_that_does_not_fit_goes_chunk_by_chunk(source_backend, shapes, monkeypatch):
    engine = source_backend(local_mesh(*shapes["vase"]()))
    directions = np.random.default_rng(0).normal(size=(3000, 3))
    pattern = Pattern(directions, 0.01 * directions[::-1])
    scan = check_scan(pattern, [0.05, 0.1, 0.4], window=(5, 4990))
    runtime = source_backend._library().cuda.runtime
    room = cuda_backend._WORK + engine._keep
    monkeypatch.setattr(source_backend, "chunk", 500)
    with monkeypatch.context() as patch:
        patch.setattr(runtime, "memGetInfo", lambda: (room + 3000 * 48 - 1, 1 << 35))
        got = engine.scan(scan)
        assert pattern not in engine._patterns
    want = engine.scan(scan)
    assert pattern in engine._patterns
    assert len(got) > 2000
    np.testing.assert_array_equal(got.ray, want.ray)
    np.testing.assert_array_equal(got.distance, want.distance)
