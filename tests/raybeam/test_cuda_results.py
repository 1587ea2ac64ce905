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
    """Counts what is page-locked; the system locks no more than 2 MiB."""

    now = 0

    def __init__(self, size):
        if Locked.now + size > 1 << 21:
            raise RefusedError(size)
        self._bytes = np.empty(size, np.uint8)
        self.ptr, self.size = self._bytes.ctypes.data, size
        Locked.now += size

    def __del__(self):
        Locked.now -= getattr(self, "size", 0)


class RefusedError(RuntimeError):
    pass


@pytest.fixture
def room():
    Locked.now = 0
    return made(1 << 20)


def made(limit):
    runtime = SimpleNamespace(CUDARuntimeError=RefusedError)
    cuda = SimpleNamespace(PinnedMemory=Locked, runtime=runtime)
    return PinnedRoom(SimpleNamespace(cuda=cuda), limit)


def is_locked(array):
    return array.base is not None


def test_arrays_are_what_was_asked_for_and_do_not_overlap(room):
    kept = []
    for number, dtype in enumerate((np.int64, np.float64, np.int32)):
        array = room.empty(1000, dtype)
        assert (array.dtype, array.shape, is_locked(array)) == (dtype, (1000,), True)
        array[:] = number
        kept.append(array)
    assert [array.sum() for array in kept] == [0, 1000, 2000]
    assert len(room.empty(0, np.int64)) == 0
    assert Locked.now == 3 << 16
    assert repr(room) == f"PinnedRoom({3 << 16} of {1 << 20} bytes held)"


def test_what_is_let_go_is_used_again_but_not_while_a_view_is_left(room):
    for n in range(7000, 7100):
        view = room.empty(n, np.float64)[10:20]
    assert Locked.now == 2 << 16  # the view of one turn is let go when the next has its array
    view[:] = 7
    room.empty(100, np.int32)[:] = 8
    assert (view == 7).all()


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


def test_ordinary_memory_when_the_system_locks_no_more():
    Locked.now = 0
    assert not is_locked(made(1 << 30).empty(1 << 22, np.int64))


@pytest.mark.parametrize(("limit", "chunk"), [(0, 7), (1, 4096), (1 << 30, 1)])
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
