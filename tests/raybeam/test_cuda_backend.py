"""Around the walk on a device: hits closed up in order, arrays kept until they were read."""

import weakref

import numpy as np

from raybeam import Pattern
from raybeam.instances import plain
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
    engine = source_backend(plain(mesh))
    engine.scan(check_scan(Pattern(np.eye(3)), [0, 0, 0]))
    assert len(read) > 1
    assert all(read)
    assert not unread
