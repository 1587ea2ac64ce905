"""The copy of Embree that embreex ships, through its C API."""

from __future__ import annotations

import ctypes
import math
import os
from functools import cache
from importlib.metadata import PackageNotFoundError, files, version
from pathlib import Path
from weakref import finalize

import numpy as np

from .arrays import AnyArray, Floats
from .instances import Scene
from .mesh import LocalMesh

# Constants of rtcore.h.
_TRIANGLES = 0
_INSTANCE = 121
_FLOAT3 = 0x9003
_FLOAT3X4_ROWS = 0x9134
_UINT3 = 0x5003
_INDEX = 0
_VERTEX = 1
_HIGH_QUALITY = 2
_ROBUST = 1 << 2  # rays between two triangles hit one of them
_FILTER_IN_ARGUMENTS = 1 << 3
# RTC_DEVICE_PROPERTY_NATIVE_RAY…_SUPPORTED, and the rays of a packet.
_WIDTHS = ((34, 16), (33, 8), (32, 4))

# Grids of direction components, see `direction_grid`.
_FINE_GRID = 2.0**-58  # above 1e-18, below which Embree replaces a component
_COARSE_GRID = 2.0**-30
_MAX_GRID = 2.0**-27  # an eighth of the rounding errors of directions in float32
_SMALL_ELEMENT = 2.0**-26  # share of the largest element that counts as zero, see `_remove_small`

# What embreex names the library on Linux, macOS and Windows.
_ENDINGS = (".dylib", ".dll")


def find_library() -> Path:
    """Return the path of the library; ImportError if not installed."""
    try:
        shipped = files("embreex") or []
    except PackageNotFoundError:
        raise ImportError("embreex is not installed") from None
    for file in shipped:
        if "embree4" in file.name and (file.name.endswith(_ENDINGS) or ".so" in file.suffixes):
            return Path(str(file.locate()))
    raise ImportError("embreex has no libembree4")


@cache
def load_library() -> ctypes.CDLL:
    """Load the library, once, with the signatures of its functions."""
    loaded = ctypes.CDLL(str(find_library()))
    pointer = ctypes.c_void_p
    number = ctypes.c_uint
    signatures: dict[str, tuple[object, list[object]]] = {
        "rtcNewDevice": (pointer, [ctypes.c_char_p]),
        "rtcGetDeviceProperty": (ctypes.c_ssize_t, [pointer, ctypes.c_int]),
        "rtcGetDeviceError": (ctypes.c_int, [pointer]),
        "rtcGetDeviceLastErrorMessage": (ctypes.c_char_p, [pointer]),
        "rtcNewScene": (pointer, [pointer]),
        "rtcSetSceneFlags": (None, [pointer, ctypes.c_int]),
        "rtcSetSceneBuildQuality": (None, [pointer, ctypes.c_int]),
        "rtcNewGeometry": (pointer, [pointer, ctypes.c_int]),
        "rtcSetNewGeometryBuffer": (
            pointer,
            [pointer, ctypes.c_int, number, ctypes.c_int, ctypes.c_size_t, ctypes.c_size_t],
        ),
        "rtcSetGeometryInstancedScene": (None, [pointer, pointer]),
        "rtcSetGeometryTransform": (None, [pointer, number, ctypes.c_int, pointer]),
        "rtcCommitGeometry": (None, [pointer]),
        "rtcAttachGeometry": (number, [pointer, pointer]),
        "rtcAttachGeometryByID": (None, [pointer, pointer, number]),
        "rtcGetGeometry": (pointer, [pointer, number]),
        "rtcReleaseGeometry": (None, [pointer]),
        "rtcCommitScene": (None, [pointer]),
        "rtcReleaseScene": (None, [pointer]),
    }
    for name, (result, arguments) in signatures.items():
        function = getattr(loaded, name)
        function.restype = result
        function.argtypes = arguments
    return loaded


def device(threads: int | None = None) -> int:
    """Return the address of the RTCDevice of this process, for a number of threads.

    The device builds trees on the CPU; None for Embree's default number of threads.

    A forked process has a new device, since threads do not survive a fork.
    """
    return _device(os.getpid(), threads, os.environ.get("RAYBEAM_EMBREE_ISA", ""))


@cache
def _device(process: int, threads: int | None, isa: str) -> int:
    """Create an RTCDevice, one for each process, and return its address.

    `isa` limits the vector instructions, for tests; "" for the best of the processor.
    """
    options = [f"threads={threads}"] if threads else []
    options += [f"isa={isa}"] if isa else []
    device: int | None = load_library().rtcNewDevice(",".join(options).encode())
    if device is None:
        raise RuntimeError(f"Embree makes no device ({','.join(options) or 'default'}).")
    return device


def packet_width() -> int:
    """Return the rays of the widest packet that Embree casts on this processor; 1 for none."""
    ask = load_library().rtcGetDeviceProperty
    return next((width for number, width in _WIDTHS if ask(device(), number)), 1)


def build() -> str:
    """Return embreex's version, its Embree's hash, and a note if there is no fused multiply-add.

    Without fused multiply-add, on processors before AVX2, the rays that Embree misses at open rims
    are different rays. Wider vectors change nothing.
    """
    from llvmlite.binding import get_host_cpu_features  # takes long to import

    [shipped] = [file for file in files("embreex") or () if file.name == find_library().name]
    digest = shipped.hash.value[:8] if shipped.hash else ""
    fused = packet_width() > 4 and get_host_cpu_features().get("avx2", True)
    return f"{version('embreex')} ({digest}{'' if fused else ', without FMA'})"


def direction_grid(scene: Scene) -> float:
    """Return the spacing, a power of two, to which the directions of packets are rounded.

    Embree loses packets in which a component is negative and above -1e-18, see `_on_grid` of
    embree_packets.py. A component on the grid is zero, or large enough. At an instance, Embree
    computes the components in the axes of the mesh in float32: sums of three products with elements
    of a matrix. For a single product, a grid that is coarser by the smallest element suffices. A
    sum is zero, or at least the grid times the last digit of an element: on the coarse grid, large
    enough for elements above 2^-5. Sums that are nearly zero come from matrices with such elements,
    as of a turn by 45 degrees, at which a direction of (1e-16, 1e-16, 1) lost its packet.

    Returns `inf` if the grid would change directions by more than `_MAX_GRID`: then no packets may
    be cast.
    """
    if scene.matrices is None:
        return _FINE_GRID
    elements = scene.matrices.reshape(-1, 3, 4)[:, :, :3].copy()
    _remove_small(elements)
    used = elements != 0
    grid = _FINE_GRID / min(float(np.abs(elements[used]).min()), 1.0)
    if (used.sum(axis=2) > 1).any():
        grid = max(grid, _COARSE_GRID)
    if grid > _MAX_GRID:
        return np.inf
    mantissa, exponent = math.frexp(grid)
    return 2.0 ** (exponent - (mantissa == 0.5))


def _remove_small(elements: AnyArray) -> None:
    """Set elements of matrices (n, 3, 3), which are small beside others, to zero.

    The cosine of a right angle is 6e-17 in float64. As an element of a matrix, it makes of a
    component of 0.01 a component of 6e-19, for which Embree loses packets, see `direction_grid`.
    An element counts as zero if it is less than `_SMALL_ELEMENT` times the largest of its row, and
    of its column. So a mesh that is flat, or far larger along one axis, keeps its shape, and
    a coordinate to which such an element adds changes by less than float32 rounds.
    """
    sizes = np.abs(elements)
    limits = np.minimum(sizes.max(axis=1, keepdims=True), sizes.max(axis=2, keepdims=True))
    elements[sizes < _SMALL_ELEMENT * limits] = 0


class EmbreeScene:
    """A scene of Embree: a tree over geometries.

    Attributes
    ----------
    address
        Address of the RTCScene, for compiled code.
    """

    def __init__(self, threads: int | None) -> None:
        self._device = device(threads)
        self.address: int = load_library().rtcNewScene(self._device)
        finalize(self, load_library().rtcReleaseScene, self.address)
        load_library().rtcSetSceneFlags(self.address, _ROBUST | _FILTER_IN_ARGUMENTS)
        load_library().rtcSetSceneBuildQuality(self.address, _HIGH_QUALITY)

    def _commit(self, contents: str) -> None:
        """Build the tree; MemoryError, which names the contents, if Embree cannot."""
        embree = load_library()
        embree.rtcCommitScene(self.address)
        if embree.rtcGetDeviceError(self._device):
            message = embree.rtcGetDeviceLastErrorMessage(self._device) or b""
            raise MemoryError(f"Embree cannot build the tree of {contents}: {message.decode()}")


class EmbreeMesh(EmbreeScene):
    """Embree's tree over a mesh; MemoryError if the build fails."""

    def __init__(self, mesh: LocalMesh, threads: int | None) -> None:
        super().__init__(threads)
        embree = load_library()
        geometry = embree.rtcNewGeometry(self._device, _TRIANGLES)
        for kind, layout, rows in (
            (_VERTEX, _FLOAT3, np.ascontiguousarray(mesh.points, np.float32)),
            (_INDEX, _UINT3, np.ascontiguousarray(mesh.rows, np.uint32)),
        ):
            buffer = embree.rtcSetNewGeometryBuffer(geometry, kind, 0, layout, 12, len(rows))
            if buffer:
                ctypes.memmove(buffer, rows.ctypes.data, rows.nbytes)
        embree.rtcCommitGeometry(geometry)
        embree.rtcAttachGeometry(self.address, geometry)
        embree.rtcReleaseGeometry(geometry)
        self._commit(f"{len(mesh.rows):,} triangles")


class EmbreeInstances(EmbreeScene):
    """Embree's tree over the instances of a scene; MemoryError if the build fails.

    The instances have no transforms before `update_scene`.
    """

    def __init__(self, scene: Scene, meshes: list[EmbreeMesh], threads: int | None) -> None:
        super().__init__(threads)
        embree = load_library()
        self._meshes = meshes
        self._transforms: Floats = np.full((len(scene.mesh), 3, 4), np.nan)
        for number, mesh in enumerate(scene.mesh.tolist()):
            geometry = embree.rtcNewGeometry(self._device, _INSTANCE)
            embree.rtcSetGeometryInstancedScene(geometry, meshes[mesh].address)
            embree.rtcAttachGeometryByID(self.address, geometry, number)
            embree.rtcReleaseGeometry(geometry)

    def update_scene(self, scene: Scene) -> None:
        """Set the transforms of the instances to the transforms of a scene, and build the tree."""
        embree = load_library()
        transforms = scene.to_scene
        assert transforms is not None
        changed = np.flatnonzero((transforms != self._transforms).any(axis=(1, 2)))
        matrices = np.ascontiguousarray(transforms[changed], np.float32)
        _remove_small(matrices[:, :, :3])
        address = matrices.ctypes.data
        geometry_of = embree.rtcGetGeometry
        set_transform = embree.rtcSetGeometryTransform
        commit = embree.rtcCommitGeometry
        for number in changed.tolist():
            geometry = geometry_of(self.address, number)
            set_transform(geometry, 0, _FLOAT3X4_ROWS, address)
            commit(geometry)
            address += matrices.strides[0]
        self._transforms = transforms
        self._commit(f"{len(transforms):,} instances")
