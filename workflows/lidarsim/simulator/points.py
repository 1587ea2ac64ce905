"""The returns of a batch: the sources of columns."""

from __future__ import annotations

from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from raybeam import Pattern

from ..base.arrays import AnyArray, Bytes, Floats, Ints, Ints32, Records, UInts32
from ..base.elementary import arccos, arcsin, arctan2
from ..base.errors import LidarError
from ..base.vectors import products, turned
from ..columns.table import Column
from ..columns.waveforms import column_type
from ..scene.colours import unpacked
from ..scene.scene import Scene
from ..sensor import ScanSpec, Survey
from ..sensor.materials import at_right_angles
from ..sensor.optics import LIGHT_M_NS
from ..sensor.random_numbers import normal
from ..sensor.reflectivity import COUNTS, SCALES
from .doppler import VELOCITY, radial_velocities
from .motion import CastPoses, Firings
from .paths import GHOST
from .pulses import Scanned
from .returns import required
from .steps import received_causes
from .surfaces import Surfaces, light_of

BLOCK_HITS = 1 << 16  # that are looked at a time
LEAST_LEFT = 1e-30  # of the light, so that what is divided by it is finite in single precision


class BatchPoints:
    """Kept returns of some consecutive scans of one station, in (scan, ray) order.

    Its attributes are arrays (n,) with a value for each return, computed on first use: the
    sources of columns (`lidarsim.columns.table`).
    """

    def __init__(
        self,
        scene: Scene,
        survey: Survey,
        surfaces: Surfaces,
        specs: list[ScanSpec],  # the firings of each follow those of the one before
        found: Scanned,  # rays are numbered from 0 at the first firing
        pattern: Pattern,
        start: int,  # number of ray 0 within the pattern
        poses: CastPoses,
    ) -> None:
        self.scene = scene
        self.survey = survey
        self.carried = survey.carried[specs[0].sensor]
        self.sensor = self.carried.sensor
        self.specs = specs
        # Triangles that were hit and their hits, (k,) each: a count for every triangle of the scene
        # would be kept for each station of a batch.
        hits = np.zeros(0, np.int64) if found.tally is None else found.tally
        triangles = np.flatnonzero(hits)
        self.tally = triangles, hits[triangles]
        # (scans,): of each, kept or not
        self.found = found.returns
        self.hits = found.hits
        self._surfaces = surfaces
        self._pattern = pattern
        self._start = start
        self._poses = poses
        self._fired = Firings.of(self.sensor, specs)

    def __len__(self) -> int:
        return len(self.found.ray)

    def column(self, column: Column) -> AnyArray:
        """Values of a column."""
        return column.make(self)

    def ends(self, rows: Ints) -> Floats:
        """Positions of some returns (k,): (k, 3)."""
        return self.positions[rows]

    # -- the ray -----------------------------------------------------------------------------

    @cached_property
    def _first_rays(self) -> Ints:
        """Number of the first ray of each scan."""
        begin = self.specs[0].firings[0]
        firsts = [spec.firings[0] - begin for spec in self.specs]
        return np.array(firsts, np.int64) * self.sensor.channels

    @cached_property
    def counts(self) -> Ints:
        """Returns of each scan: (scans,)."""
        cuts = np.searchsorted(self.found.ray, self._first_rays)
        return np.diff(np.append(cuts, len(self))).astype(np.int64)

    @cached_property
    def scan(self) -> Ints32:
        """Number of the scan."""
        first = self.specs[0].scan
        return np.repeat(np.arange(first, first + len(self.specs), dtype=np.int32), self.counts)

    @cached_property
    def ray(self) -> Ints:
        """Number of the ray within its scan."""
        return self.found.ray.astype(np.int64) - np.repeat(self._first_rays, self.counts)

    @cached_property
    def channel(self) -> UInts32:
        """Beam of the sensor."""
        return np.asarray(self.found.ray % np.uint32(self.sensor.channels), np.uint32)

    @cached_property
    def firing(self) -> Ints:
        """Number of the firing, from the beginning of the station."""
        return self.specs[0].firings[0] + self._number

    @property
    def sensor_number(self) -> Bytes:
        """Number of the sensor."""
        return np.full(len(self), self.specs[0].sensor, np.uint8)

    @cached_property
    def _fired_ns(self) -> Ints:
        return self._fired.times(self.found.ray)

    @cached_property
    def time(self) -> Ints:
        """Time of the ray as the sensor states it, nanoseconds since the survey's start."""
        spec = self.specs[0]
        stamp = self._fired_ns
        if spec.repeats is not None:
            before, now = map(self.survey.begins_ns, spec.repeats)
            stamp = stamp + round(now - before)
        jumps = self.survey.faults_of(spec.sensor, "time_jump").values()
        return sum((one.jumps_ns(stamp) for one in jumps), stamp)

    @property
    def _times(self) -> Ints:
        """Firing times, where they matter, for actors."""
        return self._fired_ns if self._poses.ways else np.zeros(len(self), np.int64)

    @cached_property
    def _number(self) -> Ints:
        """Number of the firing, from that of the first scan."""
        return self.found.ray // np.int64(self.sensor.channels)

    # -- positions ---------------------------------------------------------------------------

    @cached_property
    def _rays(self) -> tuple[Floats, Floats]:
        return self._poses.rays(self._pattern, self.found.ray, self._start)

    @property
    def origins(self) -> Floats:
        """Starts of the rays, metres, the scene's local coordinates: (n, 3)."""
        return np.broadcast_to(self._rays[0], (len(self), 3))

    @property
    def directions(self) -> Floats:
        """Unit directions in the scene's axes: (n, 3)."""
        return self._rays[1]

    @property
    def range(self) -> Floats:
        """Distance from the start of the ray, metres, with noise."""
        return required(self.found.reported)

    @cached_property
    def positions(self) -> Floats:
        """Ends of the rays, metres, the scene's local coordinates: (n, 3).

        A frozen sensor's points stay in its axes, and move with it.
        """
        return self._moved(self._ends)

    def _moved(self, points: Floats) -> Floats:
        """Move points (n, 3) with the axes of a frozen sensor, since the sweep that it repeats."""
        if self.specs[0].repeats is None:
            return points
        before, now = map(self.survey.pose, self.specs[0].repeats)
        if before == now:
            return points
        inside = turned(np.subtract(points, before.position), before.turn.T)
        return turned(inside, now.turn) + now.position

    @cached_property
    def ray_origins(self) -> Floats:
        """Starts of the rays in the coordinates of the survey's points, metres: (n, 3)."""
        if self.survey.coordinates == "sensor":
            return self._in_sensor(np.zeros(len(self)))
        return self._moved(self.origins) + self.scene.origin

    @property
    def origin_x(self) -> Floats:
        """Return x of the starts of the rays, see `ray_origins`."""
        return self.ray_origins[:, 0]

    @property
    def origin_y(self) -> Floats:
        """Return y of the starts of the rays, see `ray_origins`."""
        return self.ray_origins[:, 1]

    @property
    def origin_z(self) -> Floats:
        """Return z of the starts of the rays, see `ray_origins`."""
        return self.ray_origins[:, 2]

    @cached_property
    def _ends(self) -> Floats:
        origins, directions = self._rays
        out = directions * self.range[:, None]
        return np.add(out, origins, out=out)

    @cached_property
    def cells(self) -> Ints32:
        """Positions as whole multiples of the survey's precision: (3, n)."""
        world = self.survey.coordinates == "world"
        scaled = (self.positions if world else self.sensor_positions) / self.survey.precision_m
        cells = np.empty((3, len(self)), np.int32)
        try:
            with np.errstate(invalid="raise"):
                cells[:] = np.rint(scaled, out=scaled).T
        except FloatingPointError:
            far = np.abs(scaled).max() * self.survey.precision_m
            step = self.survey.precision_m
            raise LidarError(
                f"precision_m {step} is too fine for points {far:.0f} m from the "
                f"origin: use at least {far / 2e9:.2g}."
            ) from None
        return cells

    @property
    def cell_x(self) -> Ints32:
        """Quantised x of each return, multiples of the precision from the local origin."""
        return self.cells[0]

    @property
    def cell_y(self) -> Ints32:
        """Quantised y of each return, multiples of the precision from the local origin."""
        return self.cells[1]

    @property
    def cell_z(self) -> Ints32:
        """Quantised z of each return, multiples of the precision from the local origin."""
        return self.cells[2]

    @cached_property
    def _rows(self) -> Ints:
        """Of the pattern."""
        return (self._start + self.found.ray.astype(np.int64)) % len(self._pattern)

    @cached_property
    def _sensor_directions(self) -> Floats:
        return self._to_sensor(self._pattern.directions[self._rows])

    @cached_property
    def sensor_positions(self) -> Floats:
        """Ends of the rays in the axes of the sensor at their firing, metres: (n, 3)."""
        return self._in_sensor(self.range)

    def _in_sensor(self, distance: Floats) -> Floats:
        """Points of the rays at distances (n,), in the axes of the sensor, metres: (n, 3)."""
        origins = self._pattern.origins
        ends = self._pattern.directions[self._rows] * distance[:, None]
        if origins is not None:
            ends += origins[self._rows]
        if not self._poses.by_head:
            ends -= self.carried.mount.position
        elif self.sensor.centre is not None:
            ends += self.sensor.centre
        return self._to_sensor(ends)

    def _to_sensor(self, vectors: Floats) -> Floats:
        """Turn vectors (n, 3) in the axes of the carrier, or the head, to those of the sensor."""
        if self._poses.by_head:
            spins = self.sensor.spins(self._fired.numbers)
            assert spins is not None  # or the rig would not cast by head
            (cos, sin), (x, y, z) = (a.take(self._number) for a in spins), vectors.T
            looks = np.stack([x * cos - y * sin, x * sin + y * cos, z], axis=1)
            return turned(looks, self.sensor.axes)
        mount = self.carried.mount.rotation
        return turned(vectors, None if mount is None else mount.T)

    def _world_to_sensor(self, vectors: Floats) -> Floats:
        """Turn vectors (n, 3) in the scene's axes to those of the sensor at the firing."""
        inside = np.empty(vectors.shape[::-1])
        for axis, unit in enumerate(np.eye(3)):
            _, axes = self._poses.rays(Pattern(unit[None]), self.found.ray, self._start)
            inside[axis] = products(vectors.T, axes.T)
        return self._to_sensor(inside.T)

    @cached_property
    def azimuth(self) -> Floats:
        """Angle of the ray about the sensor's z axis, degrees, from 0 to 360."""
        x, y, _ = self._sensor_directions.T
        return np.degrees(arctan2(y, x)) % 360

    @cached_property
    def elevation(self) -> Floats:
        """Angle of the ray above the sensor's xy plane, degrees."""
        return np.degrees(arcsin(np.clip(self._sensor_directions[:, 2], -1, 1)))

    # -- the surface -------------------------------------------------------------------------

    @property
    def triangle(self) -> Ints32:
        """Triangle of the scene."""
        return self.found.triangle

    @cached_property
    def object(self) -> Ints32:
        """Object of the scene."""
        return self._surfaces.objects(self.found.triangle)

    @cached_property
    def _kinds(self) -> Ints32:
        """Kinds of surfaces, rows of the table of materials."""
        if not self.scene.has_mixed_objects:
            return self.object
        return self._surfaces.kinds(self.found.triangle)

    @cached_property
    def cosine(self) -> Floats:
        """Cosine of the angle between the ray and the normal of its triangle, 0 to 1.

        It means nothing where there is no surface.
        """
        return np.abs(self._lit[0])

    @cached_property
    def _facing(self) -> tuple[Floats, Floats]:
        """Unit normals (n, 3), scene's axes, on the side that was hit, and cosines of incidence.

        NaN where there is no surface, of leaves within a crown, and of ghosts, whose rays arrive
        from elsewhere.
        """
        triangle = self.found.triangle
        surfaces = self._surfaces
        normals = np.full((len(self), 3), np.nan)
        cosines = np.full(len(self), np.nan)
        on_surface = triangle >= 0
        if self.found.cause is not None:
            on_surface &= self.found.cause != GHOST
        if surfaces.materials.leafy.any():
            on_surface &= ~surfaces.materials.leafy[self._kinds]
        rows = np.flatnonzero(on_surface)
        for begin in range(0, len(rows), BLOCK_HITS):
            block = rows[begin : begin + BLOCK_HITS]
            facing = surfaces.normals(triangle[block], self._times[block], self._poses.ways)
            along = products(facing.T, self.directions[block].T)
            facing[along > 0] *= -1
            normals[block] = facing
            cosines[block] = np.abs(along)
        return normals, cosines

    @cached_property
    def normals(self) -> Floats:
        """Unit normals on the side that was hit, in the axes of the survey's points: (n, 3)."""
        normals, _ = self._facing
        if self.survey.coordinates == "sensor":
            return self._world_to_sensor(normals)
        return self._moved(normals) - self._moved(np.zeros((1, 3)))

    @property
    def normal_x(self) -> Floats:
        """Return x of the normals, see `normals`."""
        return self.normals[:, 0]

    @property
    def normal_y(self) -> Floats:
        """Return y of the normals, see `normals`."""
        return self.normals[:, 1]

    @property
    def normal_z(self) -> Floats:
        """Return z of the normals, see `normals`."""
        return self.normals[:, 2]

    @property
    def incidence_deg(self) -> Floats:
        """Angle between the ray and the normal of its surface, degrees; NaN as of `normals`."""
        return np.degrees(arccos(np.minimum(self._facing[1], 1.0)))

    @cached_property
    def _lit(self) -> tuple[Floats, Floats]:
        """Cosines of incidence, of either sign, and energies; in blocks, for normals take room."""
        light, (along, energy) = light_of(self.survey, self.sensor), np.empty((2, len(self)))
        colours = self._colours if self._surfaces.materials.textured else None
        for begin in range(0, len(self), BLOCK_HITS):
            some = slice(begin, begin + BLOCK_HITS)
            found = self.found.triangle[some], self.directions[some], self.found.distance[some]
            more = None if colours is None else colours[some]
            lit = self._surfaces.lit(*found, light, self._times[some], self._poses.ways, more)
            along[some] = lit.along
            energy[some] = lit.energy
        return along, energy

    @cached_property
    def intensity(self) -> Floats:
        """Received energy, see `Surfaces.energy`."""
        if self.found.energy is not None:
            return self.found.energy
        return self._lit[1]

    @cached_property
    def _colours(self) -> UInts32:
        """Packed colours."""
        if self.found.colour is not None:
            return self.found.colour
        points = self._ends
        if self.found.reported is not self.found.distance:
            points = self.directions * self.found.distance[:, None] + self._rays[0]
        return self._surfaces.colours(self.found.triangle, points, self._times, self._poses.ways)

    @property
    def red(self) -> Bytes:
        """Red of the surface, sRGB."""
        return unpacked(self._colours)[:, 0]

    @property
    def green(self) -> Bytes:
        """Green of the surface, sRGB."""
        return unpacked(self._colours)[:, 1]

    @property
    def blue(self) -> Bytes:
        """Blue of the surface, sRGB."""
        return unpacked(self._colours)[:, 2]

    @property
    def _recorded(self) -> Floats:
        """Received energy, at most what fills the receiver."""
        return np.minimum(self.intensity, self.survey.noise_each[self.specs[0].sensor].full)

    @property
    def signal(self) -> NDArray[np.uint16]:
        """Counts in proportion to the recorded energy."""
        return np.minimum(np.rint(self._recorded * COUNTS), 65_535).astype(np.uint16)

    @property
    def reflectivity(self) -> Bytes:
        """Recorded energy without the loss by distance, on the scale of the sensor's maker."""
        lost = at_right_angles(self.found.distance)
        return SCALES[self.sensor.optics.reflectivity].codes(self._recorded / lost)

    @property
    def reflectance(self) -> Floats:
        """Intensity without the loss by distance and air."""
        lost = at_right_angles(self.found.distance, self.survey.extinction(self.sensor))
        # In thick fog or dust nothing is left of the light from where a false alarm seems to be.
        return np.asarray(self.intensity / np.maximum(lost, LEAST_LEFT))

    @cached_property
    def radial_velocity(self) -> Floats:
        """How fast the range grows, m/s, with noise; NaN of what no light returned from."""
        found = self.found
        velocity = self.found.velocity
        if velocity is None:
            velocity = radial_velocities(
                self._surfaces,
                self._poses,
                found.ray.astype(np.int64),
                self._rays,
                found.distance,
                found.triangle,
                self._times,
            )
            if found.cause is not None:
                velocity[np.isin(found.cause, received_causes())] = np.nan
        noise = self.survey.noise_each[self.specs[0].sensor]
        if noise.velocity_m_s:
            scan = self.scan.astype(np.int64) + self.specs[0].ahead
            drawn = normal(noise.seed, VELOCITY, scan, self.ray, self.return_number)
            velocity = velocity + noise.velocity_m_s * drawn
        return velocity

    @property
    def amplitude(self) -> Floats:
        """Height of the echo in the waveform; without waveforms its energy."""
        return self.intensity if self.found.amplitude is None else self.found.amplitude

    @property
    def pulse_width(self) -> Floats:
        """Full width at half maximum of the echo in the waveform, nanoseconds."""
        if self.found.width is None:
            returns = self.survey.returns_each[self.specs[0].sensor]
            return np.full(len(self), returns.length_ns(self.sensor.optics))
        return self.found.width

    @property
    def waveform(self) -> Records:
        """Recorded waveform, see `lidarsim.columns.waveforms.record`."""
        table = required(self.found.waveform).copy()
        begin_ps = table["begin"] * table["sample_ps"].astype(np.float64)
        table["location_ps"] = self.range * (2000 / LIGHT_M_NS) - begin_ps
        world = self.survey.coordinates == "world"
        ahead = self.directions if world else self._sensor_directions
        table["toward"] = -ahead * (LIGHT_M_NS / 2000)
        return table.view(column_type(table.dtype["samples"].shape[0]))

    @property
    def return_number(self) -> Bytes:
        """Number among the reported returns of its pulse."""
        return required(self.found.number)

    @property
    def returns(self) -> Bytes:
        """Number of reported returns of its pulse."""
        return required(self.found.returns)

    @property
    def cause(self) -> Bytes:
        """Why the return is there, see `CAUSES` of the table of columns."""
        if self.found.cause is None:
            return np.zeros(len(self), np.uint8)
        return self.found.cause

    @property
    def semantic_class(self) -> NDArray[np.uint16]:
        """Class of the material."""
        classes = self._surfaces.materials.semantic_class[self._kinds]
        return classes if self.found.cause is None else np.where(self._kinds < 0, 0, classes)

    @property
    def material_number(self) -> Ints32:
        """Number of the material's name among those of the scene; -1 for none."""
        return self._surfaces.material_numbers(self.found.triangle)
