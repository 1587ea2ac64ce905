"""Estimate the memory that a rig occupies on a worker, and the memory for casting scans."""

from __future__ import annotations

from bisect import bisect_right
from functools import partial

import numpy as np

from ..casting.ray_chunks import CHUNK_RAYS as VISIBILITY_RAYS
from ..casting.visibility import static_key, unseen_objects
from ..numerics.elementary import exp
from ..pulses.pulses import CHUNK_RAYS
from ..pulses.steps.step import Memory, Setup, Sizes
from ..pulses.steps.step_list import setup_of, steps_of
from ..scene.actors import distinct_meshes
from ..scene.scene import Scene
from ..sensor.optics import TWO_RETURNS
from ..survey.survey import Survey
from .points.device_columns import needs_hits
from .rig import PATTERN_RAYS, rays_repeat

MB = 1_000_000

# The sizes are in bytes and were measured as the tracemalloc peak in `Rig.cast` and `columns_of`
# for a million rays that all hit a sphere of 20,480 triangles. The measurement covered sensors with
# 128 beams and with a single beam, a prism, static and moving platforms, all columns and none, 1 to
# 19 sub-rays, and a glass sphere around the sensor. The "tiles" and "numpy" backends differed by at
# most 30 MB (2026-11-22, Linux, NumPy 2.4). The estimate was 1.02 to 1.5 times the measured peak.
# If up to two returns may be reported, it was 1.64 times the peak for pulses with one return, and
# 0.8 times the peak for pulses with two. The process peak (VmHWM) was mostly below the tracemalloc
# peak, and at most 16 % above it. tests/lidarsim/test_memory.py repeats a part of the measurement.
# The steps estimate their memory on the same basis.
RAY = 28  # bytes per ray for its hit
# Bytes per ray that is not cast repeatedly, while it is computed and afterwards.
COMPUTED_RAY = 92
COMPUTED_RAY_RETAINED = 32
RAY_AMONG_BODIES = 70  # bytes per ray in a scene with instances or actors
# Bytes per pose of a firing, while it is computed and afterwards.
POSE = 140
POSE_RETAINED = 100
RETURNS = 1.5  # returns per pulse if all or two are reported; 1.1 to 1.6 in generated woods
RETURNS_LEAFY = 3.8  # same if all are reported and sub-rays meet leaves; 3.3 in a canopy
# Bytes per point, and per byte of its columns, because column sources are float64.
POINT = 64
POINT_BYTE = 3.2
VISIBILITY = 160  # bytes per ray that is cast at a time to determine the visibility of actors
COLOR = 16  # bytes per ray if reflectance comes from colors
# Bytes per point that is georeferenced by the measured trajectory (2026-11-30).
GEOREFERENCED = 450
# Copies of the columns that come from a device: CuPy rounds page-locked memory up to a power of
# two, and columns of several groups of scans are concatenated.
PAGE_LOCKED = 2
JOINED = 1
# Bytes for descriptions, poses and small arrays.
SCAN = 500
STATION = 6000
HIT_COUNTER = 16  # bytes per hit counter (`Scene.counters`), for two counts

# Bytes of a rig, measured on Linux.
SCENE_TRIANGLE = 80  # bytes per triangle, in every process that holds the scene
# Bytes per triangle while a caster is built: tiles 250, NumPy 310 (2026-11-28), CUDA 360.
CASTER_TRIANGLE = 360
COLORED_TRIANGLE = 160  # bytes per triangle with colors
IMAGE_BYTE = 4  # bytes per byte of a texture image
INSTANCE = 2000  # bytes per instance, in every process that holds the scene
POSED_TRIANGLE = 40  # bytes per triangle and animation frame, for the boxes of the tree
PATTERN_RAY = 48  # bytes per ray in a period of the head, including its pattern


def rig_bytes(scene: Scene, survey: Survey) -> int:
    """Estimate the memory in bytes of a rig's scene, trees, and stored ray patterns."""
    # Sensors for which different static objects are visible have separate trees.
    trees = len({static_key(scene, mask) for mask in unseen_objects(scene, survey)})
    triangles = (SCENE_TRIANGLE + CASTER_TRIANGLE * trees) * scene.kept_triangles
    images = {id(image): image.nbytes for mesh in scene.all_colors for image in mesh.images}
    colors = COLORED_TRIANGLE * sum(map(len, scene.all_colors)) + IMAGE_BYTE * sum(images.values())
    instances = INSTANCE * len(scene.instances or ())
    patterns = 0
    for carried in survey.mounted_sensors:
        sensor = carried.sensor
        rays = (sensor.period or 0) * sensor.channels
        patterns += PATTERN_RAY * min(rays, PATTERN_RAYS)
    poses = 0
    meshes, _ = distinct_meshes(actor.mesh for actor in scene.actors)
    for mesh in meshes:
        if mesh.animation is not None:
            vertices = mesh.animation.vertices
            poses += vertices.nbytes + POSED_TRIANGLE * len(vertices) * len(mesh.faces)
    return triangles + colors + instances + patterns + poses


def cast_bytes(scene: Scene, survey: Survey, scans: int = 1, *, on_device: bool = False) -> int:
    """Estimate the peak memory, in bytes, for casting scans and computing their columns.

    The estimate assumes that all rays hit, and that all scans come from the sensor that needs the
    most memory. Columns computed by user functions count like built-in columns. Set `on_device` if
    a CUDA device casts the rays. Device memory, about 300 MB, is not included.
    """
    setups = [setup_of(scene, survey, number) for number in range(len(survey.mounted_sensors))]
    on_device = on_device and not any(map(steps_of, setups))
    peak = max(_bytes(setup, scans, on_device) for setup in setups)
    return int(peak) + HIT_COUNTER * scene.counters


def _bytes(setup: Setup, scans: int, on_device: bool) -> float:
    """Estimate the peak memory in bytes of scans of one sensor, without hit counters."""
    survey = setup.survey
    sensor = setup.sensor
    first, stop = sensor.firings(0)
    firings = (stop - first) * scans
    rays = firings * sensor.channels
    subrays = min(rays * setup.reporting.subrays, CHUNK_RAYS)
    returns = rays * _returns_per_pulse(setup)
    beams = subrays / setup.reporting.subrays
    sizes = Sizes(rays, beams, subrays, returns, returns / survey.keep_every)
    memory = _casting_memory(setup, sizes, firings, on_device)
    casting = memory.casting + memory.counting
    point = _point_bytes(setup, scans, on_device)
    visibility = VISIBILITY * min(rays, VISIBILITY_RAYS) * survey.actor_visibility
    small = SCAN * scans + STATION * (1 + scans // survey.steps_each[setup.number])
    return memory.retained + max(casting, point * sizes.points, visibility) + small


def _casting_memory(setup: Setup, sizes: Sizes, firings: int, on_device: bool) -> Memory:
    """Estimate the memory that rays, poses and steps require.

    In the result, `retained` is the memory that stays in use until columns are computed, `casting`
    is the additional memory of rays and poses during casting, and `counting` is the largest
    additional memory of any step.
    """
    scene = setup.scene
    survey = setup.survey
    repeats, by_head = rays_repeat(setup.sensor, survey.path.moves)
    poses = firings if survey.path.moves or by_head else 0
    host_rays = 0 if on_device else sizes.rays  # rays whose hits are on the host
    computed_rays = 0 if repeats else sizes.rays
    textured = any(material.reflectance == "texture" for material in survey.materials)
    bodies = RAY_AMONG_BODIES * bool(scene.actors or scene.instances)
    rig_memory = Memory(
        retained=(RAY + COLOR * textured) * host_rays
        + POSE_RETAINED * poses
        + COMPUTED_RAY_RETAINED * computed_rays
    )
    steps = steps_of(setup)
    total = Memory(
        *map(sum, zip(rig_memory, *(step.memory(setup, sizes) for step in steps), strict=True))
    )
    casting: float = (
        POSE * poses
        + COMPUTED_RAY * computed_rays
        + bodies * (sizes.rays if scene.actors else host_rays)
    )
    return Memory(total.retained, casting, max(total.casting, total.counting))


def _point_bytes(setup: Setup, scans: int, on_device: bool) -> float:
    """Estimate the memory, in bytes, that a return requires while its columns are computed."""
    survey = setup.survey
    columns = sum(np.dtype(column.dtype).itemsize for column in survey.stored_columns)
    if on_device and not needs_hits(setup.scene, survey):
        single_run = scans <= survey.steps_each[setup.number] and len(survey.mounted_sensors) == 1
        return (PAGE_LOCKED + (0 if single_run else JOINED)) * columns
    # NumPy computes all columns. Columns that are copied from the device count once more.
    georeferenced = GEOREFERENCED * (survey.georeferencing == "measured")
    return POINT + POINT_BYTE * columns + columns * on_device + georeferenced


def _returns_per_pulse(setup: Setup) -> float:
    """Estimate the mean number of reported returns for a pulse that hits a surface."""
    subrays = setup.reporting.subrays
    mode = setup.reporting.mode
    added_by_step = [step.added_returns(setup) for step in steps_of(setup)]
    reports_two = mode in TWO_RETURNS
    added = 0.0
    if mode == "all":
        added = sum(added_by_step)
    elif reports_two:
        # The fraction of pulses to which a step adds a return, if returns are added independently.
        added = sum(1 - float(exp(-count)) for count in added_by_step)
    if not (mode == "all" or reports_two) or not (subrays > 1 or setup.has_onward_light):
        return 1 + added
    in_leaves = setup.leafy and subrays > 1 and mode == "all"
    return max(RETURNS_LEAFY if in_leaves else RETURNS, 1 + added)


def scans_that_fit(scene: Scene, survey: Survey, limit: float, *, on_device: bool = False) -> int:
    """Return the number of scans that can be cast together within `limit` bytes, at least 1.

    For a small survey, the result may exceed the number of its scans. The memory is estimated by
    `cast_bytes`, without the hit counters, whose size does not depend on the number of scans.
    """
    limit += HIT_COUNTER * scene.counters
    memory_of = partial(cast_bytes, scene, survey, on_device=on_device)
    if (survey_bytes := memory_of(survey.scan_count)) <= limit:
        return int(survey.scan_count * limit / survey_bytes)
    return max(1, bisect_right(range(1, survey.scan_count + 1), limit, key=memory_of))
