"""The tree built by build.cu: bit for bit the one that NumPy builds."""

from __future__ import annotations

import weakref
from types import SimpleNamespace

import numpy as np
import pytest

from raybeam import Pattern, cuda_backend, cuda_build, ploc
from raybeam.cuda_backend import CudaBackend
from raybeam.layout import lay_out
from raybeam.mesh import local_mesh
from raybeam.scan import check_scan

pytest.importorskip("hypothesis")
from hypothesis import HealthCheck, given, reject, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

TABLES = ("nodes", "triangles", "corners", "faces", "frame")

# Few values: many equal boxes, equal codes and ties between partners.
coarse = st.integers(1, 40).flatmap(
    lambda n: hnp.arrays(np.float64, (3 * n, 3), elements=st.integers(-2, 2))
)
fine = st.integers(1, 40).flatmap(
    lambda n: hnp.arrays(np.float64, (3 * n, 3), elements=st.floats(-9, 9, width=32))
)


@pytest.fixture
def built(kernels, source_backend):
    """Build a mesh with build.cu: arrays by name."""
    library = source_backend._library() if kernels == "source" else CudaBackend._library()

    def build(mesh):
        tables = cuda_build.build(library, 0, mesh)
        arrays = {name: library.asnumpy(getattr(tables, name)) for name in TABLES}
        return {**arrays, "stack": tables.stack}

    return build


def assert_same_as_numpy(built, mesh):
    got, want = built(mesh), lay_out(mesh)
    assert got["stack"] == want.stack
    for name in TABLES:
        np.testing.assert_array_equal(
            got[name].view(np.uint8), getattr(want, name).view(np.uint8), err_msg=name
        )


@pytest.mark.parametrize("name", ["cube", "sphere", "vase", "terrain box"])
def test_shapes(built, shapes, name):
    points, faces = shapes[name]()
    for offset in (0, np.array([5e5, 4e6, 100])):
        assert_same_as_numpy(built, local_mesh(points + offset, faces))


@pytest.mark.parametrize("kind", ["random", "sliver", "huge", "tiny"])
def test_soups(built, shapes, kind):
    assert_same_as_numpy(built, local_mesh(*shapes["soup"](kind, count=5000)))


@pytest.mark.parametrize("left", [1, 7, 500])
def test_with_any_number_of_clusters_left_to_the_host(built, shapes, monkeypatch, left):
    """As in meshes that are much larger, of which few clusters are left."""
    monkeypatch.setattr(ploc, "_MOST", left)
    monkeypatch.setattr(ploc, "_ENOUGH", left)
    assert_same_as_numpy(built, local_mesh(*shapes["soup"]("random", count=3000)))
    assert_same_as_numpy(built, local_mesh(*shapes["vase"]()))


@pytest.mark.parametrize("copies", [2, 5, 64, 1000])
def test_copies_of_one_triangle(built, copies):
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]])
    assert_same_as_numpy(built, local_mesh(points, np.tile([[0, 1, 2]], (copies, 1))))


def test_chain_of_ever_better_partners(built):
    """Each triangle's best partner is the next one: pairs are made by force."""
    x = 1.2 ** -np.arange(300.0)
    zero = np.zeros_like(x)
    points = np.stack([x, zero, zero, x, zero, 0.1 * x, x, 0.1 * x, zero], axis=-1)
    assert_same_as_numpy(
        built, local_mesh(points.reshape(-1, 3), np.arange(3 * len(x)).reshape(-1, 3))
    )


@settings(
    max_examples=80,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(points=st.one_of(coarse, fine))
def test_any_triangles(built, points):
    try:
        mesh = local_mesh(points, np.arange(len(points)).reshape(-1, 3))
    except ValueError:  # no triangle has an area
        reject()
    assert_same_as_numpy(built, mesh)


@pytest.mark.parametrize(
    ("pays_from", "lacking", "called"), [(301, 0, 0), (300, 0, 1), (300, 1, 0)]
)
def test_device_builds_where_it_pays_and_has_room(
    source_backend, shapes, monkeypatch, pays_from, lacking, called
):
    mesh = local_mesh(*shapes["soup"]("random", count=300))
    room = cuda_build.BYTES * 300 + cuda_backend._WORK - lacking
    runtime = source_backend._library().cuda.runtime
    monkeypatch.setattr(runtime, "memGetInfo", lambda: (room, 1 << 35))
    monkeypatch.setattr(source_backend, "device_build", pays_from)
    calls = []
    build = cuda_build.build
    monkeypatch.setattr(cuda_build, "build", lambda *given: calls.append(given) or build(*given))
    assert len(source_backend(mesh)._faces) == 300
    assert len(calls) == called


@pytest.mark.parametrize("least", [1, 1 << 20], ids=["device builds", "host builds"])
def test_arrays_are_kept_until_the_device_has_read_them(source_backend, shapes, monkeypatch, least):
    """Some devices read the host's memory only when the stream comes to it."""
    mesh = local_mesh(*shapes["soup"]("random", count=3000))
    unread, read = [], []

    def synchronize():
        read.extend(given() is not None for given in unread)
        unread.clear()

    def copy(self, values):
        unread.append(weakref.ref(values))
        self[...] = values

    cuda = source_backend._library().cuda
    monkeypatch.setattr(type(source_backend._library().empty(1)), "set", copy)
    stream = SimpleNamespace(synchronize=synchronize)
    monkeypatch.setattr(cuda, "get_current_stream", lambda: stream)
    monkeypatch.setattr(source_backend, "device_build", least)
    engine = source_backend(mesh)
    engine.scan(check_scan(Pattern(np.eye(3)), [0, 0, 0]))
    assert len(read) > 1
    assert all(read)
    assert not unread
