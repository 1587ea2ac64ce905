"""Compute the columns of a batch from its returns, with NumPy."""

from __future__ import annotations

from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from raybeam import Pattern

from ...casting.motion import CastPoses, Firings
from ...casting.surfaces import SceneSurfaces, sensor_light_of
from ...columns.actor_rays import NO_ACTOR_RAYS
from ...columns.table import Column
from ...columns.waveforms import column_type
from ...errors import LidarError
from ...media.materials import normal_incidence_energy
from ...numerics.arrays import AnyArray, Bytes, Floats, Ints, Ints32, Records, UInts32
from ...numerics.elementary import arccos, arcsin, arctan2, power
from ...numerics.random_numbers import normal
from ...numerics.vectors import dot, rotate
from ...pulses.pulses import ScannedReturns
from ...pulses.returns import require_column
from ...pulses.steps.cast import GHOST
from ...pulses.steps.doppler import VELOCITY, radial_velocities
from ...pulses.steps.step_list import received_causes
from ...scene.colors import unpack_colors
from ...scene.scene import Scene
from ...sensor.optics import LIGHT_M_NS, MIN_COSINE
from ...sensor.reflectivity import COUNTS, SCALES
from ...survey.survey import ScanSpec, Survey
from .scene_flow import SceneFlow, SurfacePoints, compute_flow

BLOCK_HITS = 1 << 16  # number of hits whose normals are computed at a time
MIN_REMAINING = (
    1e-30  # smallest fraction of light, which keeps quotients finite in single precision
)


class BatchPoints:
    """Reported returns of consecutive scans at one station, sorted by scan and ray.

    The properties are the sources of columns (`lidarsim.columns.table`). Each is an array with one
    value per return (n,), and expensive ones are computed on first use.
    """

    def __init__(
        self,
        scene: Scene,
        survey: Survey,
        surfaces: SceneSurfaces,
        specs: list[ScanSpec],  # scans with consecutive firings
        scanned: ScannedReturns,  # rays are numbered from 0 at the first firing
        *,
        pattern: Pattern,
        start: int,  # row of ray 0 in the pattern
        poses: CastPoses,
        actor_rays: Records = NO_ACTOR_RAYS,
    ) -> None:
        self.scene = scene
        self.survey = survey
        self.carried = survey.mounted_sensors[specs[0].sensor]
        self.sensor = self.carried.sensor
        self.specs = specs
        # Nonzero counters (`StoredTriangles.counter`) and their hits, each of shape (k,). Counts of
        # all triangles would take much memory, because each station of a batch stores them.
        counter_hits = np.zeros(0, np.int64) if scanned.tally is None else scanned.tally
        counters = np.flatnonzero(counter_hits)
        self.tally = counters, counter_hits[counters]
        self.pulse_returns = scanned.returns
        self.actor_rays = actor_rays  # visibility records of actors, of type `ACTOR_RAYS`
        self.hit_counts = scanned.hit_counts  # (scans,): returns of each scan before thinning
        self._surfaces = surfaces
        self._pattern = pattern
        self._start = start
        self._poses = poses
        self._firings = Firings.from_scans(self.sensor, specs)

    def __len__(self) -> int:
        return len(self.pulse_returns.ray)

    def column(self, column: Column) -> AnyArray:
        """Return the values of a column."""
        return column.make(self)

    def positions_of(self, row_indices: Ints) -> Floats:
        """Return the positions of the returns in the given rows."""
        return self.positions[row_indices]

    # -- the ray -----------------------------------------------------------------------------

    @cached_property
    def _first_rays(self) -> Ints:
        """Number of the first ray of each scan."""
        begin = self.specs[0].firings[0]
        firsts = [spec.firings[0] - begin for spec in self.specs]
        return np.array(firsts, np.int64) * self.sensor.channels

    @cached_property
    def counts(self) -> Ints:
        """Number of returns in each scan.

        The shape is (scans,).
        """
        cuts = np.searchsorted(self.pulse_returns.ray, self._first_rays)
        return np.diff(np.append(cuts, len(self))).astype(np.int64)

    @cached_property
    def scan(self) -> Ints32:
        """Scan number of each return."""
        first = self.specs[0].scan
        return np.repeat(np.arange(first, first + len(self.specs), dtype=np.int32), self.counts)

    @cached_property
    def ray(self) -> Ints:
        """Ray number of each return within its scan."""
        return self.pulse_returns.ray.astype(np.int64) - np.repeat(self._first_rays, self.counts)

    @cached_property
    def channel(self) -> UInts32:
        """Sensor channel of each return."""
        return np.asarray(self.pulse_returns.ray % np.uint32(self.sensor.channels), np.uint32)

    @cached_property
    def firing(self) -> Ints:
        """Firing number, starting at the first firing of the station."""
        return self.specs[0].firings[0] + self._firing_in_run

    @property
    def sensor_number(self) -> Bytes:
        """Sensor number of each return."""
        return np.full(len(self), self.specs[0].sensor, np.uint8)

    @cached_property
    def _firing_times_ns(self) -> Ints:
        """Firing times in nanoseconds since the start of the survey."""
        return self._firings.times(self.pulse_returns.ray)

    @cached_property
    def time(self) -> Ints:
        """Time of the ray on the sensor's clock, in nanoseconds since the start of the survey.

        A frozen sensor sends an old sweep again, with the times of the sweep that it replaces.
        """
        stamp = self._sent_times_ns
        jumps = self.survey.sensor_faults(self.specs[0].sensor, "time_jump").values()
        return sum((jump.time_errors_ns(stamp) for jump in jumps), stamp)

    @cached_property
    def _sent_times_ns(self) -> Ints:
        """Time at which each return is sent, in nanoseconds since the start of the survey.

        It differs from the firing time if a frozen sensor resends an old sweep.
        """
        spec = self.specs[0]
        if spec.repeats is None:
            return self._firing_times_ns
        repeated_start_ns, current_start_ns = map(self.survey.begins_ns, spec.repeats)
        return self._firing_times_ns + round(current_start_ns - repeated_start_ns)

    @property
    def _actor_times_ns(self) -> Ints:
        """Firing times in nanoseconds since the start of the survey, or zeros without actors."""
        return (
            self._firing_times_ns
            if self._poses.actor_trajectories
            else np.zeros(len(self), np.int64)
        )

    @cached_property
    def _firing_in_run(self) -> Ints:
        """Firing number, starting at the first firing of the first scan."""
        return self.pulse_returns.ray // np.int64(self.sensor.channels)

    # -- positions ---------------------------------------------------------------------------

    @cached_property
    def _rays(self) -> tuple[Floats, Floats]:
        """Origins and directions of the rays in the scene frame.

        The directions have shape (n, 3), and the origins (n, 3) or (3,).
        """
        return self._poses.rays(self._pattern, self.pulse_returns.ray, self._start)

    @property
    def origins(self) -> Floats:
        """Origins of the rays in the scene frame, in meters.

        The shape is (n, 3).
        """
        return np.broadcast_to(self._rays[0], (len(self), 3))

    @property
    def directions(self) -> Floats:
        """Unit directions in the scene frame.

        The shape is (n, 3).
        """
        return self._rays[1]

    @property
    def range(self) -> Floats:
        """Distance from the ray origin in meters, including noise."""
        return require_column(self.pulse_returns.reported)

    @cached_property
    def positions(self) -> Floats:
        """Reported positions of the points in the scene frame, in meters.

        The shape is (n, 3). They are the true positions unless the points are georeferenced by the
        measured trajectory.
        """
        return self._georeferenced(self.true_positions)

    @cached_property
    def true_positions(self) -> Floats:
        """End points of the rays in the scene frame, in meters.

        The shape is (n, 3). Points that a frozen sensor sends again stay fixed in the sensor frame,
        and so move with the sensor.
        """
        return self._moved_with_frozen_sensor(self._scene_positions)

    def _georeferenced(self, points: Floats) -> Floats:
        """Move points in the scene frame to their positions according to the measured trajectory.

        If the survey reports true positions, the points are returned unchanged.
        """
        measured = self.survey.measured
        if measured is None:
            return points
        reported_mount = self.survey.reported_mounts[self.specs[0].sensor]
        return measured.georeference(
            points, self._sent_times_ns.astype(np.float64), self.carried.mount, reported_mount
        )

    @property
    def true_x(self) -> Floats:
        """The x coordinate of the true positions in world coordinates."""
        return self.true_positions[:, 0] + self.scene.origin[0]

    @property
    def true_y(self) -> Floats:
        """The y coordinate of the true positions in world coordinates."""
        return self.true_positions[:, 1] + self.scene.origin[1]

    @property
    def true_z(self) -> Floats:
        """The z coordinate of the true positions in world coordinates."""
        return self.true_positions[:, 2] + self.scene.origin[2]

    def _moved_with_frozen_sensor(self, points: Floats) -> Floats:
        """Move points along with a frozen sensor, from its old pose to its current pose.

        Points are in the scene frame. If the sensor is not frozen, they are returned unchanged.
        """
        if self.specs[0].repeats is None:
            return points
        frozen_pose, current_pose = map(self.survey.pose, self.specs[0].repeats)
        if frozen_pose == current_pose:
            return points
        in_sensor = rotate(np.subtract(points, frozen_pose.position), frozen_pose.rotation_matrix.T)
        return rotate(in_sensor, current_pose.rotation_matrix) + current_pose.position

    @cached_property
    def ray_origins(self) -> Floats:
        """Origins of the rays in the survey's point coordinates, in meters.

        The shape is (n, 3).
        """
        if self.survey.coordinates == "sensor":
            return self._in_sensor(np.zeros(len(self)))
        origins = self._georeferenced(self._moved_with_frozen_sensor(self.origins))
        return origins + self.scene.origin

    @property
    def origin_x(self) -> Floats:
        """The x coordinate of the ray origins."""
        return self.ray_origins[:, 0]

    @property
    def origin_y(self) -> Floats:
        """The y coordinate of the ray origins."""
        return self.ray_origins[:, 1]

    @property
    def origin_z(self) -> Floats:
        """The z coordinate of the ray origins."""
        return self.ray_origins[:, 2]

    @cached_property
    def _scene_positions(self) -> Floats:
        """End points of the rays at their firing times, in the scene frame, in meters.

        The shape is (n, 3).
        """
        origins, directions = self._rays
        positions = directions * self.range[:, None]
        return np.add(positions, origins, out=positions)

    @cached_property
    def cells(self) -> Ints32:
        """Positions as integer multiples of the survey's precision.

        The shape is (3, n).
        """
        world = self.survey.coordinates == "world"
        scaled = (self.positions if world else self.sensor_positions) / self.survey.precision_m
        cells = np.empty((3, len(self)), np.int32)
        try:
            with np.errstate(invalid="raise"):
                cells[:] = np.rint(scaled, out=scaled).T
        except FloatingPointError:
            extent_m = np.abs(scaled).max() * self.survey.precision_m
            step = self.survey.precision_m
            raise LidarError(
                f"precision_m is {step}, which is too fine for points {extent_m:.0f} m from the "
                f"origin. Use at least {extent_m / 2e9:.2g}."
            ) from None
        return cells

    @property
    def cell_x(self) -> Ints32:
        """Quantized x coordinate, in multiples of the precision from the local origin."""
        return self.cells[0]

    @property
    def cell_y(self) -> Ints32:
        """Quantized y coordinate, in multiples of the precision from the local origin."""
        return self.cells[1]

    @property
    def cell_z(self) -> Ints32:
        """Quantized z coordinate, in multiples of the precision from the local origin."""
        return self.cells[2]

    @cached_property
    def _pattern_rows(self) -> Ints:
        """Row of each return's ray in the repeating pattern."""
        return (self._start + self.pulse_returns.ray.astype(np.int64)) % len(self._pattern)

    @cached_property
    def _sensor_directions(self) -> Floats:
        """Unit directions in the sensor frame.

        The shape is (n, 3).
        """
        return self._to_sensor(self._pattern.directions[self._pattern_rows])

    @cached_property
    def sensor_positions(self) -> Floats:
        """End points of the rays in the sensor frame at the firing time, in meters.

        The shape is (n, 3).
        """
        return self._in_sensor(self.range)

    def _in_sensor(self, distance: Floats) -> Floats:
        """Return points at the given distances along the rays, in the sensor frame."""
        origins = self._pattern.origins
        points = self._pattern.directions[self._pattern_rows] * distance[:, None]
        if origins is not None:
            points += origins[self._pattern_rows]
        if not self._poses.by_head:
            points -= self.carried.mount.position
        elif self.sensor.center is not None:
            points += self.sensor.center
        return self._to_sensor(points)

    def _to_sensor(self, vectors: Floats) -> Floats:
        """Rotate one vector per return from the pattern frame to the sensor frame.

        The pattern is in the head frame if it is a single firing that each pose rotates
        (`CastPoses.by_head`), otherwise in the platform frame.
        """
        if self._poses.by_head:
            spins = self.sensor.spins(self._firings.numbers)
            assert spins is not None  # otherwise the rig would not cast by head
            cos, sin = (values.take(self._firing_in_run) for values in spins)
            x, y, z = vectors.T
            in_head = np.stack([x * cos - y * sin, x * sin + y * cos, z], axis=1)
            return rotate(in_head, self.sensor.axes)
        mount = self.carried.mount.rotation
        return rotate(vectors, None if mount is None else mount.T)

    def _world_to_sensor(self, vectors: Floats) -> Floats:
        """Rotate vectors from the scene frame to the sensor frame at the firing time."""
        in_platform = np.empty(vectors.shape[::-1])
        for axis, unit in enumerate(np.eye(3)):
            _, axes = self._poses.rays(Pattern(unit[None]), self.pulse_returns.ray, self._start)
            in_platform[axis] = dot(vectors.T, axes.T)
        return self._to_sensor(in_platform.T)

    @cached_property
    def azimuth(self) -> Floats:
        """Azimuth of the ray about the sensor's z axis, in degrees from 0 to 360."""
        x, y, _ = self._sensor_directions.T
        return np.degrees(arctan2(y, x)) % 360

    @cached_property
    def elevation(self) -> Floats:
        """Elevation of the ray above the sensor's xy plane, in degrees."""
        return np.degrees(arcsin(np.clip(self._sensor_directions[:, 2], -1, 1)))

    # -- the surface -------------------------------------------------------------------------

    @property
    def triangle(self) -> Ints32:
        """Number of the scene triangle that each return comes from."""
        return self.pulse_returns.triangle

    @cached_property
    def object(self) -> Ints32:
        """Number of the scene object that each return comes from."""
        return self._surfaces.triangles.objects(self.pulse_returns.triangle)

    @cached_property
    def _kinds(self) -> Ints32:
        """Surface kind of each return as a row of the material table, or -1."""
        if not self.scene.has_mixed_objects:
            return self.object
        return self._surfaces.kinds(self.pulse_returns.triangle)

    @cached_property
    def cosine(self) -> Floats:
        """Cosine of the angle between the ray and its triangle's normal, from 0 to 1.

        Undefined for returns without a surface.
        """
        return np.abs(self._lit[0])

    @cached_property
    def _facing_normals(self) -> tuple[Floats, Floats]:
        """Scene-frame unit normals on the side that was hit, and the cosines of incidence.

        Values are NaN for returns without a surface, for leaves within a crown, and for ghosts,
        whose last ray starts at a mirror.
        """
        triangle = self.pulse_returns.triangle
        surfaces = self._surfaces
        normals = np.full((len(self), 3), np.nan)
        cosines = np.full(len(self), np.nan)
        on_surface = triangle >= 0
        if self.pulse_returns.cause is not None:
            on_surface &= self.pulse_returns.cause != GHOST
        if surfaces.materials.leafy.any():
            on_surface &= ~surfaces.materials.leafy[self._kinds]
        row_indices = np.flatnonzero(on_surface)
        for begin in range(0, len(row_indices), BLOCK_HITS):
            block = row_indices[begin : begin + BLOCK_HITS]
            facing = surfaces.normals(
                triangle[block], self._actor_times_ns[block], self._poses.actor_trajectories
            )
            signed_cosines = dot(facing.T, self.directions[block].T)
            facing[signed_cosines > 0] *= -1
            normals[block] = facing
            cosines[block] = np.abs(signed_cosines)
        return normals, cosines

    @cached_property
    def normals(self) -> Floats:
        """Unit normals on the side that was hit, in the frame of the survey's points.

        The shape is (n, 3). Values are NaN for returns without a surface, for leaves within a
        crown, and for ghosts.
        """
        normals, _ = self._facing_normals
        if self.survey.coordinates == "sensor":
            return self._world_to_sensor(normals)
        return self._moved_with_frozen_sensor(normals) - self._moved_with_frozen_sensor(
            np.zeros((1, 3))
        )

    @property
    def normal_x(self) -> Floats:
        """The x component of the normals."""
        return self.normals[:, 0]

    @property
    def normal_y(self) -> Floats:
        """The y component of the normals."""
        return self.normals[:, 1]

    @property
    def normal_z(self) -> Floats:
        """The z component of the normals."""
        return self.normals[:, 2]

    @cached_property
    def scene_flow(self) -> SceneFlow:
        """Displacements of the surface points until the next sweep of the sensor, in meters.

        The displacements are in the frame of the survey's points. They are NaN for returns without
        a surface, for ghosts, for points without a next sweep, and for sweeps that a frozen sensor
        resends.
        """
        flow = SceneFlow(*np.full((2, len(self), 3), np.nan))
        if self.specs[0].repeats is not None:
            return flow
        on_surface = self.pulse_returns.triangle >= 0
        if self.pulse_returns.cause is not None:
            on_surface &= self.pulse_returns.cause != GHOST
        row_indices = np.flatnonzero(on_surface)
        steps = self.directions[row_indices] * self.pulse_returns.distance[row_indices, None]
        points = SurfacePoints(
            self.pulse_returns.triangle[row_indices],
            self.origins[row_indices] + steps,
            self._firing_times_ns[row_indices].astype(np.float64),
            self.scan[row_indices],
        )
        on_actors = self._surfaces.on_actors
        found = compute_flow(
            self.survey, self.specs[0], points, on_actors, self._poses.actor_trajectories
        )
        flow.relative[row_indices] = found.relative
        flow.world[row_indices] = found.world
        return flow

    @property
    def flow_x(self) -> Floats:
        """The x component of the scene flow relative to the sensor."""
        return self.scene_flow.relative[:, 0]

    @property
    def flow_y(self) -> Floats:
        """The y component of the scene flow relative to the sensor."""
        return self.scene_flow.relative[:, 1]

    @property
    def flow_z(self) -> Floats:
        """The z component of the scene flow relative to the sensor."""
        return self.scene_flow.relative[:, 2]

    @property
    def flow_ego_x(self) -> Floats:
        """The x component of the scene flow in the world."""
        return self.scene_flow.world[:, 0]

    @property
    def flow_ego_y(self) -> Floats:
        """The y component of the scene flow in the world."""
        return self.scene_flow.world[:, 1]

    @property
    def flow_ego_z(self) -> Floats:
        """The z component of the scene flow in the world."""
        return self.scene_flow.world[:, 2]

    @property
    def incidence_deg(self) -> Floats:
        """Angle between the ray and the surface normal in degrees. It is NaN without a normal."""
        return np.degrees(arccos(np.minimum(self._facing_normals[1], 1.0)))

    @cached_property
    def _lit(self) -> tuple[Floats, Floats]:
        """Signed cosines of incidence and received energies, computed in blocks to save memory."""
        sensor_light = sensor_light_of(self.survey, self.sensor)
        cosines, energy = np.empty((2, len(self)))
        colors = self._colors if self._surfaces.materials.has_textures else None
        for begin in range(0, len(self), BLOCK_HITS):
            block = slice(begin, begin + BLOCK_HITS)
            lit = self._surfaces.illuminate(
                self.pulse_returns.triangle[block],
                self.directions[block],
                distance=self.pulse_returns.distance[block],
                sensor_light=sensor_light,
                times=self._actor_times_ns[block],
                trajectories=self._poses.actor_trajectories,
                colors=None if colors is None else colors[block],
            )
            cosines[block] = lit.cosines
            energy[block] = lit.energy
        return cosines, energy

    @cached_property
    def intensity(self) -> Floats:
        """Reported energy, which is the received energy times the sensor's response."""
        return self._as_reported(self._energy)

    def _as_reported(self, energy: Floats) -> Floats:
        """Multiply energies by the sensor's response to the beam, the range and the incidence."""
        beams = self.sensor.beams
        if beams.has_intensity_factors:
            energy = energy * beams.intensity_factors(self.channel, self.pulse_returns.distance)
        if self.sensor.optics.incidence_exponent != 1:
            energy = energy * self._incidence_factors
        return energy

    @cached_property
    def _incidence_factors(self) -> Floats:
        """Ratio of reported to received energies due to the angle of incidence.

        It is 1 for returns without a normal, and for retroreflectors, whose received energy does
        not depend on the incidence.
        """
        cosines = self._facing_normals[1]
        diffuse = np.isfinite(cosines) & ~self._surfaces.materials.retro[self._kinds]
        factors = np.ones(len(self))
        exponent = self.sensor.optics.incidence_exponent - 1
        factors[diffuse] = power(cosines[diffuse].clip(MIN_COSINE, 1.0), exponent)
        return factors

    @cached_property
    def _energy(self) -> Floats:
        """Received energy, on the scale of `SceneSurfaces.energy`."""
        if self.pulse_returns.energy is not None:
            return self.pulse_returns.energy
        return self._lit[1]

    @cached_property
    def _colors(self) -> UInts32:
        """Packed colors of the surfaces, from `SceneSurfaces.colors`."""
        if self.pulse_returns.color is not None:
            return self.pulse_returns.color
        points = self._scene_positions
        if self.pulse_returns.reported is not self.pulse_returns.distance:
            points = self.directions * self.pulse_returns.distance[:, None] + self._rays[0]
        return self._surfaces.colors(
            self.pulse_returns.triangle,
            points,
            self._actor_times_ns,
            self._poses.actor_trajectories,
        )

    @property
    def red(self) -> Bytes:
        """Red component of the surface color in sRGB."""
        return unpack_colors(self._colors)[:, 0]

    @property
    def green(self) -> Bytes:
        """Green component of the surface color in sRGB."""
        return unpack_colors(self._colors)[:, 1]

    @property
    def blue(self) -> Bytes:
        """Blue component of the surface color in sRGB."""
        return unpack_colors(self._colors)[:, 2]

    @property
    def _clipped_energy(self) -> Floats:
        """Reported energy, clipped at saturation."""
        saturation = self.survey.noise_each[self.specs[0].sensor].saturation_energy
        return self._as_reported(np.minimum(self._energy, saturation))

    @property
    def signal(self) -> NDArray[np.uint16]:
        """Signal counts, proportional to the clipped energy."""
        return np.minimum(np.rint(self._clipped_energy * COUNTS), 65_535).astype(np.uint16)

    @property
    def reflectivity(self) -> Bytes:
        """Clipped energy corrected for distance, on the manufacturer's reflectivity scale."""
        remaining = normal_incidence_energy(self.pulse_returns.distance)
        return SCALES[self.sensor.optics.reflectivity].encode(self._clipped_energy / remaining)

    @property
    def reflectance(self) -> Floats:
        """Intensity corrected for the losses due to distance and air."""
        remaining = normal_incidence_energy(
            self.pulse_returns.distance, self.survey.extinction(self.sensor)
        )
        # In dense fog or dust, no light returns from the distance of a false alarm.
        return np.asarray(self.intensity / np.maximum(remaining, MIN_REMAINING))

    @cached_property
    def radial_velocity(self) -> Floats:
        """Rate of change of the range in m/s, including noise.

        The rate is NaN for returns that the receiver added.
        """
        returns = self.pulse_returns
        velocity = returns.velocity
        if velocity is None:
            velocity = radial_velocities(
                self._surfaces,
                self._poses,
                ray=returns.ray.astype(np.int64),
                rays=self._rays,
                distance=returns.distance,
                triangle=returns.triangle,
                times=self._actor_times_ns,
            )
            if returns.cause is not None:
                velocity[np.isin(returns.cause, received_causes())] = np.nan
        noise = self.survey.noise_each[self.specs[0].sensor]
        if noise.velocity_m_s:
            # A frozen sensor sends an older scan again, including its random numbers.
            scan = self.scan.astype(np.int64) + self.specs[0].random_offset
            errors = normal(noise.seed, VELOCITY, scan, self.ray, self.return_number)
            velocity = velocity + noise.velocity_m_s * errors
        return velocity

    @property
    def amplitude(self) -> Floats:
        """Height of the pulse in the waveform, or `intensity` if there are no waveforms.

        Both are on the scale of `SceneSurfaces.energy`.
        """
        amplitude = self.pulse_returns.amplitude
        return self.intensity if amplitude is None else self._as_reported(amplitude)

    @property
    def pulse_width(self) -> Floats:
        """Full width at half maximum of the pulse in the waveform, in nanoseconds."""
        if self.pulse_returns.width is None:
            returns = self.survey.returns_each[self.specs[0].sensor]
            return np.full(len(self), returns.length_ns(self.sensor.optics))
        return self.pulse_returns.width

    @property
    def waveform(self) -> Records:
        """Recorded waveform with its location and direction (`columns.waveforms.record`)."""
        table = require_column(self.pulse_returns.waveform).copy()
        begin_ps = table["begin"] * table["sample_ps"].astype(np.float64)
        table["location_ps"] = self.range * (2000 / LIGHT_M_NS) - begin_ps
        world = self.survey.coordinates == "world"
        ray_directions = self.directions if world else self._sensor_directions
        table["toward"] = -ray_directions * (LIGHT_M_NS / 2000)
        return table.view(column_type(table.dtype["samples"].shape[0]))

    @property
    def return_number(self) -> Bytes:
        """Number of the return within its pulse, starting at 1."""
        return require_column(self.pulse_returns.number)

    @property
    def returns(self) -> Bytes:
        """Number of returns that are reported for the pulse."""
        return require_column(self.pulse_returns.return_counts)

    @property
    def cause(self) -> Bytes:
        """Cause of the return, an index into `lidarsim.columns.table.CAUSES`."""
        if self.pulse_returns.cause is None:
            return np.zeros(len(self), np.uint8)
        return self.pulse_returns.cause

    @property
    def semantic_class(self) -> NDArray[np.uint16]:
        """Semantic class of the material."""
        classes = self._surfaces.materials.semantic_class[self._kinds]
        return (
            classes if self.pulse_returns.cause is None else np.where(self._kinds < 0, 0, classes)
        )

    @property
    def material_number(self) -> Ints32:
        """Index of the material's name in `Scene.material_names`, or -1 without a material."""
        return self._surfaces.triangle_kinds.material_numbers(self.pulse_returns.triangle)
