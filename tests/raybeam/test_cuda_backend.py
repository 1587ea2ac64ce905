"""Around the walk on a device: hits closed up in order, arrays kept until they were read."""

import weakref
from types import SimpleNamespace

import numpy as np
import pytest

from raybeam import Pattern, device
from raybeam.device import CopyQueue
from raybeam.instances import single_mesh_scene
from raybeam.mesh import local_mesh
from raybeam.scan import check_scan


def test_arrays_are_kept_until_the_device_has_read_them(source_backend, shapes, monkeypatch):
    """Some devices read the host's memory only when the stream comes to it."""
    mesh = local_mesh(*shapes["soup"]("random", count=3000))
    unread = []
    read = []

    def synchronize(self):
        read.extend(given() is not None for given in unread)
        unread.clear()

    def copy(self, values):
        unread.append(weakref.ref(values))
        self[...] = values

    cupy = source_backend.load_cupy()
    monkeypatch.setattr(type(cupy.empty(1)), "set", copy)
    monkeypatch.setattr(cupy.cuda.Stream, "synchronize", synchronize)
    engine = source_backend(single_mesh_scene(mesh))
    engine.scan(check_scan(Pattern(np.eye(3)), [0, 0, 0]))
    assert len(read) > 1
    assert all(read)
    assert not unread


def test_page_locked_memory_is_bounded_and_comes_back(source_backend, monkeypatch):
    cupy = source_backend.load_cupy()
    monkeypatch.setattr(device, "_pinned", device._Pinned())
    monkeypatch.setattr(device, "PINNED_BYTES", 2500)
    locked = []

    def allocate(size):
        locked.append(size)
        return bytearray(size)

    monkeypatch.setattr(cupy.cuda, "alloc_pinned_memory", allocate)
    outbox = CopyQueue(cupy)
    rooms = [device.pinned_array(cupy, 1000, np.uint8) for _ in range(3)]
    assert locked == [1000, 1000]
    sent = [cupy.asarray(np.full(1000, number, np.uint8)) for number in range(3)]
    outbox.send([*zip(sent, rooms, strict=True)])
    outbox.wait()
    assert [room[0] for room in rooms] == [0, 1, 2]  # the third, too
    view = rooms[0][:10]
    del rooms
    assert device.pinned_array(cupy, 1000, np.uint8).nbytes == 1000
    assert len(locked) == 3  # of the two that were read, one is held by a view
    del view


def test_an_error_after_which_all_calls_fail_is_told_from_others(source_backend, monkeypatch):
    cupy = source_backend.load_cupy()
    engine = source_backend(single_mesh_scene(local_mesh(np.eye(3), np.array([[0, 1, 2]]))))
    assert not engine.device_lost

    def synchronize(self):
        raise cupy.cuda.runtime.CUDARuntimeError("cudaErrorIllegalAddress")

    monkeypatch.setattr(cupy.cuda.Device, "synchronize", synchronize)
    assert engine.device_lost


@pytest.mark.parametrize(
    ("share", "environment", "limits"),
    [(1, {}, []), (0.25, {}, [0.25]), (0.25, {"CUPY_GPU_MEMORY_LIMIT": "50%"}, [])],
)
def test_a_process_takes_its_share_of_the_memory(
    source_backend, monkeypatch, share, environment, limits
):
    cupy = source_backend.load_cupy()
    set_limits = []
    pool = SimpleNamespace(set_limit=lambda fraction: set_limits.append(fraction))
    monkeypatch.setattr(cupy, "get_default_memory_pool", lambda: pool)
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    source_backend.limit_memory(0, share)
    assert set_limits == limits
