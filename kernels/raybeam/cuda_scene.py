"""A scene's tables on the CUDA device: who builds them, and whether there is room."""

from __future__ import annotations

from typing import Any

from numpy.typing import NDArray

from . import cuda_build
from .cuda_build import Tables
from .layout import Layout, lay_out
from .memory import require
from .mesh import LocalMesh

# Bytes left free for a chunk of rays and for the walk's stacks, of which each resident thread has
# one: 2048 for each of 132 multiprocessors, 64 places of 8 bytes, are 138 MB.
WORK = 3 << 28
_LAYOUT_BYTES = 330  # on the host a triangle, at the peak of a build by NumPy, the mesh apart
_TABLE_BYTES = 124  # on the device a triangle in the finished tables, the nodes apart


def make(cupy: Any, device: int, mesh: LocalMesh, device_build: int) -> Tables:
    """Build a scene on the current device where that is faster, and where there is memory for it.

    Parameters
    ----------
    cupy
        CuPy, or what stands in for it.
    device
        Number of the current device.
    mesh
        Any number of triangles.
    device_build
        Triangles from which the device builds.

    Raises
    ------
    MemoryError
        If even the finished tables do not fit the device, or their making the host.
    """
    n = len(mesh.corners)
    if n >= max(device_build, 1) and cuda_build.BYTES * n + WORK <= free(cupy):
        tables = cuda_build.build(cupy, device, mesh)
        cupy.get_default_memory_pool().free_all_blocks()  # several times what is kept
        return tables
    _require(cupy, _TABLE_BYTES * n + WORK)  # before NumPy builds for minutes
    require(_LAYOUT_BYTES * n, f"The tree over {n:,} triangles", "use a smaller mesh")
    layout = lay_out(mesh)
    _require(cupy, layout.nbytes + WORK)
    return _copied(cupy, layout)


def free(cupy: Any) -> int:
    """Bytes that can be had on the current device."""
    there = cupy.cuda.runtime.memGetInfo()[0] + cupy.get_default_memory_pool().free_bytes()
    return int(there)


def sent(cupy: Any, array: NDArray[Any]) -> Any:
    """Copy an array to the current device, and wait for that.

    A device that reads ordinary memory itself, as Grace Hopper does, may still be about to read
    when `set` returns: the caller may let go of the array once this has returned.

    Not by `asarray`, which copies by way of page-locked memory as large as the array and keeps
    that: right for the rays of a chunk, too much for a scene.
    """
    copy = cupy.empty(array.shape, array.dtype)
    if array.size:
        copy.set(array)
        cupy.cuda.get_current_stream().synchronize()
    return copy


def _require(cupy: Any, need: int) -> None:
    """Raise MemoryError when a mesh needs more than is free on the device."""
    there = free(cupy)
    if need > there:
        raise MemoryError(
            f"The mesh needs {need / 2**20:.0f} MiB on the CUDA device and "
            f"{there / 2**20:.0f} MiB are free: use a smaller mesh or backend 'embree'."
        )


def _copied(cupy: Any, layout: Layout) -> Tables:
    """Tables that NumPy built, on the device."""
    given = (layout.nodes, layout.triangles, layout.corners, layout.faces, layout.frame)
    nodes, triangles, corners, faces, frame = (sent(cupy, array) for array in given)
    return Tables(nodes, triangles, corners, faces, frame, layout.stack)
