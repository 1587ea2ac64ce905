"""Compiled loops over hits that compute surfaces, normals, and reflected or transmitted light."""

# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from raybeam.compiled import compiled, inlined
from raybeam.rays import UNIT_SLACK

from ..media.materials import GLASS_INDEX, NEAREST_M, REFERENCE_M, RETRO_GAIN, WATER_INDEX
from ..media.materials import fresnel as fresnel_of_arrays
from ..media.materials import water_film_factor as water_film_factor_of_arrays
from ..numerics.arrays import Bools, Floats, Floats32, Ints, Ints32
from ..numerics.elementary_loops import exp, sin_cos

fresnel = inlined(fresnel_of_arrays)
water_film_factor = inlined(water_film_factor_of_arrays)


class TriangleNumbers(NamedTuple):
    """Numbering of a scene's triangles, in the order of faces, instances and actors."""

    instance_starts: Ints  # (i + 1,): first triangle of each instance, then of the actors
    # (f + a + 1,): objects of the triangles of faces and actors; the last is -1, for `NO_SURFACE`
    owners: Ints32
    instance_objects: Ints32  # (i,)
    instance_rows: Ints  # (i,): stored row of each instance's first triangle
    actor_shifts: Ints  # (actors,): offset from an actor's triangle numbers to stored rows
    static_objects: int  # number of objects that are not actors


class TriangleOwners(NamedTuple):
    """Objects and instances to which n triangles belong."""

    row: Ints  # row of the stored triangles, which actors and instances share
    object: Ints32
    instance: Ints  # -1 if the triangle does not belong to an instance


class HitSurfaces(NamedTuple):
    """Surfaces at n hits."""

    row: Ints  # row of the normal in `NormalTables.stored`, or `~row` in `NormalTables.deformed`
    kind: Ints32  # kind of surface, a number of a material of an object (`Scene.surface_kinds`)
    instance: Ints  # -1 if the surface does not belong to an instance
    run: Ints  # column of the actor's pose in `NormalTables.poses`, or -1; empty without actors


class NormalTables(NamedTuple):
    """Normals of triangles, and rotations of instances and actors."""

    stored: Floats32  # (f, 3): unit normals of stored triangles
    deformed: Floats32  # (d, 3): unit normals of triangles of deforming actors
    # (i, 3, 3): from normals of an instance's mesh to unnormalized normals in the scene.
    instances: Floats
    # (12, m): poses of actors as position and row-major rotation; one column for each run of
    # consecutive hits with the same actor and time.
    poses: Floats


class Incidence(NamedTuple):
    """Normals, incidence cosines and returned energies of rays at surfaces."""

    normals: Floats  # (3, n): unit normals in the scene frame
    cosines: Floats  # (n,): dot products of normals and directions, of either sign
    back: Floats  # (n,): energy that the sensor would receive from a distance of 10 m


class WaterFilm(NamedTuple):
    """Film of water on surfaces."""

    level: float  # smallest z of a normal, on the visible side, for surfaces that hold water
    wet: float  # fraction of these surfaces that is covered by water
    dry: Bools  # (kinds,): whether a kind of surface stays dry


class OnwardOptics(NamedTuple):
    """Optical properties of surfaces that determine how light continues beyond a hit.

    All arrays have shape (n,), where n is the number of surface kinds.
    """

    specular: Floats  # fraction of light that is reflected specularly at normal incidence
    passes: Bools  # whether light passes through, as through glass
    # Whether light is not refracted because the surface bounds no refracting medium.
    straight: Bools
    leafy: Bools  # whether the surface bounds leaves and reflects nothing itself


class OnwardHits(NamedTuple):
    """Hits at which light continues.

    All arrays have shape (n,).
    """

    kind: Ints32
    cosines: Floats  # cosines of incidence, of either sign
    film: Bools  # whether there may be water; empty without water
    share: Floats  # fraction of the energy that is left, because light crosses each surface twice
    distance: Floats  # optical path length from the sensor, meters


class OnwardLimits(NamedTuple):
    """Thresholds for light that continues beyond a hit."""

    wet: float  # fraction of surfaces with a film that is covered by water
    brightest: float  # largest energy that any surface returns from a distance of 10 m
    extinction: float  # 1/m
    faintest: float  # light is dropped if it cannot return more energy than this


class ActorTriangles(NamedTuple):
    """Numbering of the actors' triangles.

    A shape is a distinct mesh, which several actors may share. Its parts are cast separately.
    """

    # (shapes, parts): first triangle of each part of a shape, numbered within the shape
    part_starts: Ints32
    shape: Ints  # (actors,): row of `part_starts`
    firsts: Ints32  # (actors,): first triangle of each actor


class JoinedHits(NamedTuple):
    """Output arrays for the nearest hits.

    Each array has shape (n,).
    """

    ray: Ints
    distance: Floats  # meters
    triangle: Ints32


class TrackTable(NamedTuple):
    """Tracks of piecewise linear trajectories, with their segments sorted by track."""

    member: Ints  # (w,): track of each trajectory, from 0 to t - 1; -1 for curved trajectories
    first: Ints  # (t,): first segment of each track
    segments: Ints  # (t,): number of segments of each track
    # (4, t), seconds: start on the track's clock, first and last time of its poses, and the
    # tolerance for times outside this interval; inf if any time is valid.
    limits: Floats
    times: Floats  # (s,): start of each segment, seconds
    start: Floats  # (3, s): position at the start of each segment, meters
    speed: Floats  # (3, s): velocity, m/s
    # (3, 9, s): terms of the row-major rotation, which is term 0 + sin(a) term 1 + cos(a) term 2; a
    # is the angle since the start of the segment (`Segments`).
    rotation: Floats
    rates: Floats  # (s,): derivative of the angle a, rad/s


@inlined
def _product(x, y, z, a, b, c):
    """Return a dot product, with the same order of operations as `vectors.dot`."""
    return (x * a + y * b) + z * c


@inlined
def _instance_of(t, instance_starts):
    """Find the instance that contains a triangle by binary search."""
    lower = 0
    upper = len(instance_starts) - 1
    while upper - lower > 1:
        middle = (lower + upper) // 2
        if instance_starts[middle] <= t:
            lower = middle
        else:
            upper = middle
    return lower


@compiled()
def find_owners(triangle, numbers, output):
    """Write each triangle's object, instance and row in the stored triangles to `output`.

    `numbers` is a `TriangleNumbers`, and `output` a `TriangleOwners`.
    """
    starts = numbers.instance_starts
    owners = numbers.owners
    row_indices = output.row
    objects = output.object
    instances = output.instance
    face_count = starts[0]
    actors_start = starts[-1]
    for k in range(len(triangle)):
        t = np.int64(triangle[k])
        instances[k] = -1
        if t < face_count:
            row_indices[k] = t
            objects[k] = owners[t]
        elif t >= actors_start:
            owner = owners[t - (actors_start - face_count)]
            row_indices[k] = t + numbers.actor_shifts[owner - numbers.static_objects]
            objects[k] = owner
        else:
            i = _instance_of(t, starts)
            row_indices[k] = numbers.instance_rows[i] + t - starts[i]
            objects[k] = numbers.instance_objects[i]
            instances[k] = i


@inlined
def _instance_normal(matrices, i, x, y, z):
    """Return an instance's unit normal, with operations in the same order as in columns.cu."""
    a = _product(matrices[i, 0, 0], matrices[i, 0, 1], matrices[i, 0, 2], x, y, z)
    b = _product(matrices[i, 1, 0], matrices[i, 1, 1], matrices[i, 1, 2], x, y, z)
    c = _product(matrices[i, 2, 0], matrices[i, 2, 1], matrices[i, 2, 2], x, y, z)
    length = np.sqrt((a * a + b * b) + c * c)
    return a / length, b / length, c / length


@inlined
def _actor_normal(poses, run, x, y, z):
    """Rotate a normal by the rotation in column `run` of `poses`."""
    a = _product(poses[3, run], poses[4, run], poses[5, run], x, y, z)
    b = _product(poses[6, run], poses[7, run], poses[8, run], x, y, z)
    c = _product(poses[9, run], poses[10, run], poses[11, run], x, y, z)
    return a, b, c


@compiled()
def compute_incidence(hits, directions, tables, reflectance, retro, output):  # noqa: PLR0914 - a compiled loop
    """Write the normals, incidence cosines and returned energies of hits to `output`.

    `hits` is a `HitSurfaces`, `tables` a `NormalTables`, and `output` an `Incidence`. `reflectance`
    and `retro` have one value per kind of surface. The reflected light is computed for surfaces
    that are neither textured nor rough. The loop creates no array views, because reference counting
    for a view would take five times as long as the rest of the loop.
    """
    row_indices = hits.row
    kinds = hits.kind
    instances = hits.instance
    run = hits.run
    stored = tables.stored
    deformed = tables.deformed
    matrices = tables.instances
    poses = tables.poses
    normals = output.normals
    cosines = output.cosines
    back = output.back
    for k in range(len(row_indices)):
        row = row_indices[k]
        i = instances[k]
        kind = kinds[k]
        if row >= 0:
            x = stored[row, 0]
            y = stored[row, 1]
            z = stored[row, 2]
        else:
            x = deformed[~row, 0]
            y = deformed[~row, 1]
            z = deformed[~row, 2]
        x = np.float64(x)
        y = np.float64(y)
        z = np.float64(z)
        if i >= 0:
            x, y, z = _instance_normal(matrices, i, x, y, z)
        if len(run) and run[k] >= 0:
            x, y, z = _actor_normal(poses, run[k], x, y, z)
        cosine = _product(x, y, z, directions[0, k], directions[1, k], directions[2, k])
        normals[0, k] = x
        normals[1, k] = y
        normals[2, k] = z
        cosines[k] = cosine
        back[k] = reflectance[kind] * (RETRO_GAIN if retro[kind] else abs(cosine))


@inlined
def normal_incidence_energy(distance, extinction):
    """Return the energy received from a white surface at normal incidence.

    This is the scalar version of `materials.normal_incidence_energy`.
    `distance` is in meters, and `extinction` in 1/m.
    """
    range_m = max(distance, NEAREST_M)
    nearer = REFERENCE_M / range_m
    nearer = nearer * nearer
    return nearer * exp(-2 * extinction * range_m) if extinction else nearer


@compiled()
def attenuate_energies(distance, extinction, energy):
    """Multiply energies by `normal_incidence_energy` at the given distances."""
    for k in range(len(energy)):
        energy[k] *= normal_incidence_energy(distance[k], extinction)


@compiled()
def apply_water_film(normals_z, cosines, kinds, shares, water, film, back):
    """Reduce the energies of hits on wet surfaces, and mark these hits in `film`.

    `normals_z` are the z components of the normals, `shares` are the fractions of light that
    surfaces scatter, and `back` are the received energies, each of shape (n,). `water` is a
    `WaterFilm`. The fraction `WaterFilm.wet` of each marked surface scatters light through water,
    whose surface reflects part of the light on the way in and on the way out.
    """
    level = water.level
    wet = water.wet
    dry = water.dry
    for k in range(len(normals_z)):
        visible_z = normals_z[k] if cosines[k] < 0 else -normals_z[k]
        film[k] = visible_z >= level and not dry[kinds[k]]
        if film[k]:
            mirrored = fresnel(abs(cosines[k]), WATER_INDEX)
            back[k] *= 1 - wet * (1 - water_film_factor(mirrored, shares[k]))


@compiled()
def divide_light(row_indices, reflected, hits, shares, optics, limits, onward_share):
    """Compute the transmitted and reflected fractions of light at hits, and drop faint light.

    `row_indices` (k,) are rows of the hits, `reflected` (k,) is True for light that the surface
    reflects and False for light that it transmits, and `shares` (k,) are the fractions of light
    that the surfaces scatter. `hits` is an `OnwardHits`, `optics` an `OnwardOptics`, and `limits`
    an `OnwardLimits`. Surfaces of refracting media do not divide light here, because
    `LightInMedia.cross` does that.

    The function overwrites `row_indices` and `reflected` with the light that is bright enough,
    writes its fraction of the energy to `onward_share`, and returns the number of remaining rows.
    The fraction counts each surface twice, because light crosses it on the way out and back.
    """
    count = 0
    for j in range(len(row_indices)):
        k = row_indices[j]
        kind = hits.kind[k]
        cosine = abs(hits.cosines[k])
        specular = optics.specular[kind]
        grazing = 1 - min(cosine, 1.0)
        square = grazing * grazing
        mirrored = (
            specular + (1 - specular) * (grazing * (square * square)) if specular > 0 else 0.0
        )
        if optics.passes[kind]:
            mirrored = fresnel(cosine, GLASS_INDEX)
        onward = mirrored if reflected[j] else 1 - mirrored if optics.passes[kind] else 1.0
        onward = onward if optics.straight[kind] else 1.0
        onward *= 1.0 if optics.leafy[kind] else 1 - shares[j]
        if len(hits.film) and hits.film[k]:
            onward = (1 - limits.wet) * onward + limits.wet * fresnel(cosine, WATER_INDEX)
        onward = hits.share[k] * (onward * onward)
        brightest = limits.brightest * normal_incidence_energy(hits.distance[k], limits.extinction)
        if onward * brightest > limits.faintest:
            row_indices[count] = k
            reflected[count] = reflected[j]
            onward_share[count] = onward
            count += 1
    return count


@compiled()
def start_behind(origins, directions, step_m, clear_m, starts, onward):
    """Compute the starting points of light beyond surfaces, and normalize its directions.

    The light ends at distances `step_m` (n,) from `origins` along `directions`. It continues from
    `starts` along `onward`, which is normalized in place. Vectors have shape (3, n).
    """
    for k in range(len(step_m)):
        for axis in range(3):
            end = origins[axis, k] + step_m[k] * directions[axis, k]
            starts[axis, k] = end + clear_m[k] * onward[axis, k]
        x = onward[0, k]
        y = onward[1, k]
        z = onward[2, k]
        if abs((x * x + y * y) + z * z - 1) > UNIT_SLACK:  # as `Pattern` does for all rays
            largest = max(max(abs(x), abs(y)), abs(z))
            x = x / largest
            y = y / largest
            z = z / largest
            length = np.sqrt((x * x + y * y) + z * z)
            onward[0, k] = x / length
            onward[1, k] = y / length
            onward[2, k] = z / length


@compiled()
def firing_times(ray, start, subrays, firing_starts, delays, times):
    """Write the firing times of the sub-rays in `ray` to `times`, in nanoseconds.

    Each beam has `subrays` sub-rays, and sub-ray 0 belongs to beam `start`. `firing_starts` are the
    start times of firings, and `delays` are the delays of beams within a firing.
    """
    first_beam = 0
    firing = -1
    channels = len(delays)
    for k in range(len(ray)):  # rays are mostly consecutive
        beam = start + ray[k] // subrays
        if firing < 0 or not first_beam <= beam < first_beam + channels:
            firing = int(beam // channels)
            first_beam = firing * channels
        times[k] = firing_starts[firing] + delays[beam - first_beam]


@compiled()
def merge_hits(ray, triangle, nearest, actors, output):
    """Merge hits on static bodies with hits on actors, and return the number of hits.

    The nearest hit of each ray is written to `output`, which is a `JoinedHits`. `ray` and
    `triangle` (k,) are the hits on static bodies, in ray order. `nearest` is a
    `raybeam.body_rays.NearestHits` with one entry per ray. In `nearest`, the body is the actor, or
    negative if the ray hits no actor or hits a static body first. For such rays, the distance is
    the distance to the static body. `actors` is an `ActorTriangles`.
    """
    hit_actors = nearest.body
    i = 0
    count = 0
    for k in range(len(hit_actors)):
        actor = hit_actors[k]
        hit = i < len(ray) and ray[i] == k
        if actor >= 0:
            part_triangle = actors.part_starts[actors.shape[actor], nearest.instance[k]]
            output.triangle[count] = nearest.triangle[k] + part_triangle + actors.firsts[actor]
        elif hit:
            output.triangle[count] = triangle[i]
        i += int(hit)
        if hit or actor >= 0:
            output.ray[count] = k
            output.distance[count] = nearest.distance[k]
            count += 1
    return count


@compiled()
def find_runs(trajectory, times, first_rows, run_numbers):
    """Group rows into runs, and return the number of runs.

    The run of each row is written to `run_numbers`, and the first row of each run to `first_rows`.
    The rows of a run have the same trajectory and time. `trajectory` (n,) are trajectory numbers.
    Rows with a negative number get run -1 and do not interrupt a run.
    """
    count = 0
    last = -1
    for k in range(len(trajectory)):
        run_numbers[k] = -1
        if trajectory[k] < 0:
            continue
        if last < 0 or trajectory[k] != trajectory[last] or times[k] != times[last]:
            first_rows[count] = k
            count += 1
        run_numbers[k] = count - 1
        last = k
    return count


@inlined
def _segment_at(tracks, track, time_s):
    """Find a track's last segment that starts no later than `time_s`, by binary search."""
    segment = tracks.first[track]
    later_segments = tracks.segments[track] - 1
    while later_segments:
        half = (later_segments + 1) // 2
        if tracks.times[segment + half] <= time_s:
            segment = segment + half
            later_segments = later_segments - half
        else:
            later_segments = half - 1
    return segment


@inlined
def _write_pose(tracks, segment, elapsed_s, poses, k):
    """Write the pose `elapsed_s` after the start of a segment to column `k` of `poses`."""
    for axis in range(3):
        poses[axis, k] = tracks.speed[axis, segment] * elapsed_s + tracks.start[axis, segment]
    sine, cosine = sin_cos(elapsed_s * tracks.rates[segment])
    for part in range(9):
        poses[3 + part, k] = (
            tracks.rotation[0, part, segment] + sine * tracks.rotation[1, part, segment]
        ) + cosine * tracks.rotation[2, part, segment]


@compiled()
def poses_on_tracks(trajectory, times_ns, tracks, poses):
    """Write the poses of piecewise linear trajectories at the given times to `poses`.

    The operations are those of `Track.poses`. `trajectory` (n,) are trajectory numbers, and
    `tracks` is a `TrackTable`. Columns of curved trajectories are not written. Returns the first
    row whose time is outside its track, or -1.
    """
    limits = tracks.limits
    for k in range(len(trajectory)):
        track = tracks.member[trajectory[k]]
        if track < 0:
            continue
        if k and trajectory[k] == trajectory[k - 1] and times_ns[k] == times_ns[k - 1]:
            for part in range(12):
                poses[part, k] = poses[part, k - 1]
            continue
        time_s = times_ns[k] / 1e9 + limits[0, track]
        first_s = limits[1, track]
        last_s = limits[2, track]
        slack_s = limits[3, track]
        if max(first_s - time_s, time_s - last_s) > slack_s:
            return k
        if slack_s == np.inf:
            time_s = min(max(time_s, first_s), last_s)
        segment = _segment_at(tracks, track, time_s)
        _write_pose(tracks, segment, time_s - tracks.times[segment], poses, k)
    return -1
