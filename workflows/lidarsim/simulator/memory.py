"""Estimates of the memory that a rig takes on a worker, and that casting scans takes beside it."""

from __future__ import annotations

from bisect import bisect_right
from functools import partial

import numpy as np

from ..scene.actors import shapes_of
from ..scene.scene import Scene
from ..sensor import Survey
from .device import needs_hits
from .pulses import CHUNK_RAYS
from .rig import PATTERN_RAYS, rays_repeat
from .step import Memory, Setup, Sizes
from .steps import setup_of, steps_of

MB = 1_000_000

# Bytes, measured in `Rig.cast` and `columns_of` as the peak of tracemalloc, at a million rays that
# all hit a sphere of 20,480 triangles: 128 beams and one, a prism, standing and moving, with all
# columns and none, 1 to 19 sub-rays, a glass sphere around the sensor, with Embree and NumPy, which
# differ by 30 MB at most (2026-11-22, Linux, NumPy 2.4). The estimate was 1.02 to 1.5 times that;
# 1.64 if two returns of a pulse may be reported and there is one, 0.8 if there are always two. The
# peak of the process (VmHWM) was 16 % above tracemalloc's at most, and mostly below.
# tests/lidarsim/test_memory.py measures some of it again. Steps say their own, of that.
RAY = 28  # its hit
# if it is not repeated: while it is made, and after that
COMPUTED_RAY = 92
COMPUTED_RAY_RETAINED = 32
RAY_AMONG_BODIES = 70  # in a scene with instances or actors
# of a firing that has its own: while it is made, and after that
POSE = 140
POSE_RETAINED = 100
RETURNS = 1.5  # of a pulse, where all or two are reported; 1.1 to 1.6 in generated woods
RETURNS_LEAFY = 3.8  # where all are, and each sub-ray meets a leaf by itself; 3.3 in a high canopy
# a point, and each byte of its columns: their sources are float64
POINT = 64
POINT_BYTE = 3.2
COLOUR = 16  # of a ray, where its colour is its reflectance
# Copies of what a device has made: CuPy rounds page-locked memory up to powers of two, and columns
# of several runs of scans, by station and sensor, are joined.
PAGE_LOCKED = 2
JOINED = 1
# their descriptions, poses and small arrays
SCAN = 500
STATION = 6000
TRIANGLE = 16  # a count of hits, twice

# Bytes of a rig, measured on Linux.
SCENE_TRIANGLE = 80  # of a triangle, in every process that knows the scene
# The most that a triangle takes while a caster is built: Embree 300, NumPy 350, CUDA 360.
CASTER_TRIANGLE = 360
COLOURED_TRIANGLE = 160  # of a triangle with colours
IMAGE_BYTE = 4  # of each byte of an image
INSTANCE = 2000  # of an instance, in every process that knows the scene
POSED_TRIANGLE = 40  # of a triangle in each pose of an animation, beside its vertices: tree's boxes
PATTERN_RAY = 48  # of a ray of a revolution, and of the pattern made of it


def rig_bytes(scene: Scene, survey: Survey) -> int:
    """Estimate the memory of a rig, in bytes: scene, tree of the caster, patterns of rays."""
    triangles = (SCENE_TRIANGLE + CASTER_TRIANGLE) * scene.kept_triangles
    images = {id(image): image.nbytes for mesh in scene.coloured for image in mesh.images}
    colours = COLOURED_TRIANGLE * sum(map(len, scene.coloured)) + IMAGE_BYTE * sum(images.values())
    instances = INSTANCE * len(scene.instances or ())
    patterns = 0
    for carried in survey.carried:
        sensor = carried.sensor
        rays = (sensor.period or 0) * sensor.channels
        patterns += PATTERN_RAY * min(rays, PATTERN_RAYS)
    poses = 0
    meshes, _ = shapes_of(scene.actors)
    for mesh in meshes:
        if mesh.animation is not None:
            vertices = mesh.animation.vertices
            poses += vertices.nbytes + POSED_TRIANGLE * len(vertices) * len(mesh.faces)
    return triangles + colours + instances + patterns + poses


def cast_bytes(scene: Scene, survey: Survey, scans: int = 1, *, on_device: bool = False) -> int:
    """Most memory that casting so many scans and making their columns takes, if all rays hit.

    They are scans of the sensor for which it is most; columns of a user's functions count as if
    they needed as much as others. `on_device` says that a CUDA device casts the rays; its own
    memory, some 300 MB, does not count.
    """
    setups = [setup_of(scene, survey, number) for number in range(len(survey.carried))]
    on_device = on_device and not any(map(steps_of, setups))
    peak = max(_bytes(setup, scans, on_device) for setup in setups)
    return int(peak) + TRIANGLE * scene.counters


def _bytes(setup: Setup, scans: int, on_device: bool) -> float:
    """Memory that so many scans of one sensor take, without counts of hits."""
    scene = setup.scene
    survey = setup.survey
    sensor = setup.sensor
    steps = steps_of(setup)
    columns = sum(np.dtype(column.dtype).itemsize for column in survey.stored_columns)
    first, stop = sensor.firings(0)
    firings = (stop - first) * scans
    rays = firings * sensor.channels
    chunk = min(rays * setup.reporting.subrays, CHUNK_RAYS)
    returns = rays * _returns(setup)
    beams = chunk / setup.reporting.subrays
    sizes = Sizes(rays, beams, chunk, returns, returns / survey.keep_every)
    repeats, by_head = rays_repeat(sensor, survey.path.moves)
    poses = firings if survey.path.moves or by_head else 0
    host_rays = 0 if on_device else rays  # rays whose hits are on the host
    computed_rays = 0 if repeats else rays
    textured = any(material.reflectance == "texture" for material in survey.materials)
    bodies = RAY_AMONG_BODIES * bool(scene.actors or scene.instances)
    rig_memory = Memory(
        retained=(RAY + COLOUR * textured) * host_rays
        + POSE_RETAINED * poses
        + COMPUTED_RAY_RETAINED * computed_rays
    )
    total = Memory(
        *map(sum, zip(rig_memory, *(step.memory(setup, sizes) for step in steps), strict=True))
    )
    casting: float = (
        POSE * poses + COMPUTED_RAY * computed_rays + bodies * (rays if scene.actors else host_rays)
    )
    casting += max(total.casting, total.counting)
    if on_device and not needs_hits(scene, survey):
        single_run = scans <= survey.steps_each[setup.number] and len(survey.carried) == 1
        point: float = (PAGE_LOCKED + (0 if single_run else JOINED)) * columns
    else:  # as if NumPy made all columns, and once more those of the device
        point = POINT + POINT_BYTE * columns + columns * on_device
    small = SCAN * scans + STATION * (1 + scans // survey.steps_each[setup.number])
    return total.retained + max(casting, point * sizes.points) + small


def _returns(setup: Setup) -> float:
    """Count the reported returns of a pulse that hits something, on average."""
    subrays = setup.reporting.subrays
    mode = setup.reporting.mode
    added_by_step = [step.added(setup) for step in steps_of(setup)]
    added = {
        "all": sum(added_by_step),
        "dual": sum(min(count, 1.0) for count in added_by_step),
    }.get(mode, 0.0)
    if mode not in ("all", "dual") or not (subrays > 1 or setup.has_onward_light):
        return 1 + added
    in_leaves = setup.leafy and subrays > 1 and mode == "all"
    return max(RETURNS_LEAFY if in_leaves else RETURNS, 1 + added)


def scans_that_fit(scene: Scene, survey: Survey, limit: float, *, on_device: bool = False) -> int:
    """Find how many scans can be cast at a time in so many bytes, at least 1; see `cast_bytes`.

    Of a small survey these may be more than it has. The counts of hits do not count: each cast
    takes them, and smaller ones would take no less.
    """
    limit += TRIANGLE * scene.counters
    memory_of = partial(cast_bytes, scene, survey, on_device=on_device)
    if (survey_bytes := memory_of(survey.scan_count)) <= limit:
        return int(survey.scan_count * limit / survey_bytes)
    return max(1, bisect_right(range(1, survey.scan_count + 1), limit, key=memory_of))
