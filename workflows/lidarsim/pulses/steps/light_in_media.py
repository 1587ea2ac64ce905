"""Refraction and attenuation of light in closed media, and random hits on leaves.

Directions follow Snell's law. Energies follow Fresnel's equations, the Beer-Lambert law, and the
divergence of the beam, for which ray differentials (Igehy 1999) track the cross-section of a cone
of light. Light hits a leaf after an exponentially distributed optical depth (Ross 1981).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from raybeam import Pattern
from raybeam.sub_rays import perpendicular_axes

from ...casting.actor_trajectories import ActorTrajectories
from ...casting.motion import CastPoses, FiringClock
from ...casting.scene_caster import SceneCaster
from ...casting.surfaces import SceneSurfaces
from ...errors import LidarError
from ...media.leaves import mean_brightness, mean_projection
from ...media.materials import MaterialTable, fresnel
from ...numerics.arrays import AnyArray, Bools, Floats, Indices, Integers, Ints, Ints32
from ...numerics.elementary import exp, log
from ...numerics.elementary_scalars import log_of
from ...numerics.random_numbers import Purpose
from ...numerics.vectors import dot, matvec
from ...scene.scene import Scene
from ..returns import select_rows

LEAF = Purpose(30, "depth to which light penetrates leaves")
CROWN = Purpose(31, "crown that a leaf belongs to, where crowns overlap")
MAX_MEDIA = 8  # number of media around a point that are stored
MAX_PROBES = 256  # number of surfaces that a search for the media around a point can pass
UPWARDS = np.array([0.0123, 0.0345, 0.9993])  # search direction, not parallel to common edges

# Function that returns random bits of rays (n,) for a purpose.
Draw = Callable[[Purpose, Ints], NDArray[np.uint64]]


class MediaRays(NamedTuple):
    """Origins, directions and times of light, and the trajectories of the actors."""

    origins: Floats  # (n, 3): meters, scene frame
    directions: Floats  # (n, 3): unit vectors, scene frame
    times: Floats  # (n,): nanoseconds, which determine the poses of actors
    actor_trajectories: ActorTrajectories


@dataclass
class MediaStack:
    """Media that surround the light of each sub-ray, innermost first.

    The arrays have shape (n, MAX_MEDIA), with -1 for no medium.
    """

    kinds: Ints32  # kinds of the media's surfaces
    triangles: Ints32  # triangles through which the light entered

    @classmethod
    def empty(cls, count: int) -> MediaStack:
        """Return empty stacks, for light in air."""
        return cls(*(np.full((count, MAX_MEDIA), -1, np.int32) for _ in range(2)))

    def __getitem__(self, row_indices: Integers) -> MediaStack:
        """Return the stacks of the selected sub-rays."""
        return MediaStack(self.kinds[row_indices], self.triangles[row_indices])

    def enter(self, row_indices: Indices, kinds: Ints32, triangles: Ints32) -> None:
        """Add a medium inside the current media of each selected row.

        A full stack loses its outermost medium.
        """
        for table, values in ((self.kinds, kinds), (self.triangles, triangles)):
            table[row_indices, 1:] = table[row_indices, :-1]
            table[row_indices, 0] = values

    def surround(self, row_indices: Indices, kinds: Ints32, triangles: Ints32) -> None:
        """Add a medium around the current media of each selected row, unless its stack is full."""
        depth = (self.kinds[row_indices] >= 0).sum(axis=1)
        free = depth < MAX_MEDIA
        self.kinds[row_indices[free], depth[free]] = kinds[free]
        self.triangles[row_indices[free], depth[free]] = triangles[free]

    def leave(self, row_indices: Indices, kinds: Ints32) -> Bools:
        """Remove a medium from each selected row, and return whether the row contained it."""
        matches = self.kinds[row_indices] == kinds[:, None]
        in_stack = matches.any(axis=1)
        row_indices = row_indices[in_stack]
        depth = matches[in_stack].argmax(axis=1)
        column = np.arange(MAX_MEDIA)
        column = column + (column >= depth[:, None])
        for table in (self.kinds, self.triangles):
            padded = np.pad(table[row_indices], ((0, 0), (0, 1)), constant_values=-1)
            table[row_indices] = np.take_along_axis(padded, column, axis=1)
        return in_stack


@dataclass
class RayDifferentials:
    """Refraction, attenuation and divergence of light along sub-rays."""

    index: Floats  # (n,): refractive index at the light's position
    initial_index: Floats  # (n,): refractive index at the light's origin
    attenuation_depth: Floats  # (n,): optical depth of the attenuation, one way
    position_derivatives: Floats  # (n, 2, 3): derivatives with respect to the initial direction
    direction_derivatives: Floats  # (n, 2, 3): derivatives with respect to the initial direction

    @classmethod
    def from_directions(cls, directions: Floats, index: Floats) -> RayDifferentials:
        """Return the initial differentials of light with the given directions."""
        derivatives = np.stack([axis.T for axis in perpendicular_axes(directions.T)], axis=1)
        zeros = np.zeros(len(derivatives))
        return cls(index.copy(), index, zeros, np.zeros_like(derivatives), derivatives)

    def __getitem__(self, row_indices: Integers) -> RayDifferentials:
        """Return the differentials of the selected sub-rays."""
        return RayDifferentials(*select_rows(vars(self).values(), row_indices))

    def advance(self, step: Floats, attenuation: Floats) -> None:
        """Advance light by the given steps in meters, with an attenuation in 1/m."""
        shift = step[:, None, None] * self.direction_derivatives
        self.position_derivatives = self.position_derivatives + shift
        self.attenuation_depth = self.attenuation_depth + attenuation * step

    def energy_factor(self, directions: Floats, distance: Floats, extinction: float) -> Floats:
        """Return the energy relative to light on a straight path of the same length in air.

        Light scattered at the end of a path reaches the receiver in proportion to the receiver's
        area divided by the area of the cone of scattered light there. By reciprocity, the area of
        this cone is the area of the cone of outgoing light times the square of the refractive
        index.
        """
        first_axis, second_axis = self.position_derivatives.transpose(1, 2, 0)
        a, b, c = directions.T
        x, y, z = first_axis
        u, v, w = second_axis
        area = np.abs((y * w - z * v) * a + (z * u - x * w) * b + (x * v - y * u) * c)
        area *= (self.index / self.initial_index) ** 2
        spreading = distance**2 / np.maximum(area, 1e-12)
        # Beyond the limit, the factor of the air alone is already 0.
        exponent = np.minimum(2 * (extinction * distance - self.attenuation_depth), 700.0)
        return np.asarray(spreading * exp(exponent))

    def deflect(
        self, incoming: Floats, outgoing: Floats, normals: Floats, mirrored: Bools, index: Floats
    ) -> None:
        """Update the differentials at flat surfaces that change the direction of light.

        Directions change from `incoming` to `outgoing` (n, 3). `index` (n,) is the refractive index
        behind the surfaces, for light that is not reflected.
        """
        incoming_cosine = _away_from_zero(dot(incoming.T, normals.T))
        outgoing_cosine = _away_from_zero(dot(outgoing.T, normals.T))
        # Neighboring rays cross the plane of the surface before or after the central ray.
        shift = matvec(self.position_derivatives, normals) / incoming_cosine[:, None]
        self.position_derivatives = self.position_derivatives - shift[..., None] * incoming[:, None]
        ratio = np.where(mirrored, 1.0, self.index / index)
        # A mirror reverses the component along the normal, which changes it by twice its size.
        bend = np.where(mirrored, 2.0, ratio - ratio**2 * incoming_cosine / outgoing_cosine)
        slope = bend[:, None] * matvec(self.direction_derivatives, normals)
        derivatives = ratio[:, None, None] * self.direction_derivatives
        self.direction_derivatives = derivatives - slope[..., None] * normals[:, None]
        self.index = np.where(mirrored, self.index, index)


class Media:
    """The media of a scene.

    `table` has the materials at the wavelength of the light, and `air_extinction` is the extinction
    of the scene's air in 1/m.
    """

    def __init__(
        self,
        scene: Scene,
        surfaces: SceneSurfaces,
        table: MaterialTable,
        air_extinction: float = 0.0,
    ) -> None:
        self._surfaces = surfaces
        self.air_extinction = air_extinction
        self.filled = table.leafy | table.refracts  # kinds of surfaces that enclose a medium
        self.leafy = bool(table.leafy.any())
        self.refracts = bool(table.refracts.any())
        self.mirrors = table.refracts & (table.specular > 0)  # refracting and reflecting surfaces
        self.grids = surfaces.grids
        self.instances = surfaces.triangles.instances
        owners = surfaces.triangle_kinds.material_kinds.object
        # (kinds + 1,): whether the leaves are in voxel grids. The last entry is for kind -1.
        self.gridded = np.append(scene.has_voxels[owners], False)
        self._angles = table.leaf_angles
        # The last entry, for kind -1 (no surface), is 0.
        self._area, self._index, self._attenuation = (
            np.append(values, 0.0)
            for values in (table.leaf_area, table.refractive_index, table.attenuation)
        )
        self._angle = np.append(table.leaf_angle, 0)
        closed, self._inwards = surfaces.media_bodies.solids
        for number in np.flatnonzero(table.leafy).tolist():
            if not closed[number]:
                raise LidarError(
                    f"materials: {surfaces.triangle_kinds.material_kinds.describe(number)} has a "
                    "leaf_area_density, but its surface has gaps. Use a closed surface, such as a "
                    "box or a sphere."
                )
        # Boxes in which sensors may be inside media. The surface of water may be an open sheet with
        # water at any depth below it, and an actor that contains a medium may be anywhere.
        is_static = owners < len(scene.object_bounds)
        static_kinds = np.flatnonzero(self.filled & is_static)
        bounds = scene.object_bounds[owners[static_kinds]]
        bounds[~closed[static_kinds], 0, 2] = -np.inf
        if self.filled[~is_static].any():
            bounds = np.append(bounds, [[[-np.inf] * 3, [np.inf] * 3]], axis=0)
        self._bounds = bounds
        if self.leafy:
            for angle in self._angles:
                mean_projection(angle, np.ones(1))  # computes and caches the table for this angle

    def enters(self, kinds: Ints32, cosines: Floats) -> Bools:
        """Return whether light that crosses surfaces enters the bodies that they enclose.

        `cosines` are those between normals and light.
        """
        return np.asarray((cosines < 0) != self._inwards[kinds])

    def stack_at(self, caster: SceneCaster, rays: MediaRays) -> MediaStack:
        """Return the media around the origins of light."""
        stack = MediaStack.empty(len(rays.origins))
        in_bounds = np.zeros(len(rays.origins), np.bool_)
        if not len(in_bounds):
            return stack
        lower = rays.origins.min(axis=0)
        upper = rays.origins.max(axis=0)
        overlapping = ((self._bounds[:, 0] <= upper) & (self._bounds[:, 1] >= lower)).all(axis=1)
        for box_min, box_max in self._bounds[overlapping]:
            in_bounds |= ((rays.origins >= box_min) & (rays.origins <= box_max)).all(axis=1)
        ray_indices = np.flatnonzero(in_bounds)
        if not len(ray_indices):
            return stack
        # Most rays start at the same position and time as the previous ray.
        origins = rays.origins[ray_indices]
        times = rays.times[ray_indices]
        first_of_run = np.ones(len(ray_indices), np.bool_)
        first_of_run[1:] = (np.diff(origins, axis=0) != 0).any(axis=1) | (np.diff(times) != 0)
        searched = self._search(
            caster, origins[first_of_run], times[first_of_run], rays.actor_trajectories
        )
        search_rows = np.cumsum(first_of_run) - 1
        stack.kinds[ray_indices] = searched.kinds[search_rows]
        stack.triangles[ray_indices] = searched.triangles[search_rows]
        return stack

    def _search(
        self,
        caster: SceneCaster,
        origins: Floats,
        times: Floats,
        actor_trajectories: ActorTrajectories,
    ) -> MediaStack:
        """Find the media around origins by casting rays upward.

        If a ray leaves a medium that it has not entered, its origin is inside this medium.
        """
        surrounding = MediaStack.empty(len(origins))
        entered = MediaStack.empty(len(origins))
        up = UPWARDS / np.sqrt((UPWARDS**2).sum())
        probe_indices = np.arange(len(origins))
        skip_m = caster.clear_m / up[2]
        for _ in range(MAX_PROBES):
            if not len(probe_indices):
                break
            light = Pattern(np.broadcast_to(up, origins.shape), origins)
            poses = CastPoses(
                np.zeros(3), clock=FiringClock(times, np.zeros(1), actor_trajectories)
            )
            hits = caster.scan(light, poses)
            probe_indices = probe_indices[hits.ray]
            times = times[hits.ray]
            origins = origins[hits.ray] + (hits.distance[:, None] + skip_m) * up
            normals = self._surfaces.normals(hits.triangle, times, actor_trajectories)
            cosines = dot(normals.T, up[:, None])
            self._cross_probes(entered, surrounding, probe_indices, hits.triangle, cosines)
        return surrounding

    def _cross_probes(
        self,
        entered: MediaStack,
        surrounding: MediaStack,
        probe_indices: Indices,
        triangles: Ints32,
        cosines: Floats,
    ) -> None:
        """Update the search stacks for probes that cross triangles."""
        kinds = self._surfaces.kinds(triangles)
        at_medium = self.filled[kinds]
        entering = self.enters(kinds, cosines) & at_medium
        entered.enter(probe_indices[entering], kinds[entering], triangles[entering])
        leaving = np.flatnonzero(at_medium & ~entering)
        was_entered = entered.leave(probe_indices[leaving], kinds[leaving])
        leaving = leaving[~was_entered]
        surrounding.surround(probe_indices[leaving], kinds[leaving], triangles[leaving])

    def initial_state(
        self, caster: SceneCaster, rays: MediaRays, depths: Floats | None
    ) -> LightInMedia:
        """Return the initial state of light on n rays.

        `depths` (n,) are the optical depths at which light hits a leaf, or None without leaves.
        """
        stack = self.stack_at(caster, rays)
        differentials = (
            RayDifferentials.from_directions(rays.directions, self.index(stack))
            if self.refracts
            else None
        )
        return LightInMedia(self, stack, differentials, depths)

    def index(self, stack: MediaStack) -> Floats:
        """Return the refractive index of the innermost refracting medium."""
        indices = self._index[stack.kinds]
        return _first_masked(indices, indices > 0, 1.0)

    def attenuation(self, stack: MediaStack) -> Floats:
        """Return the extinction, in 1/m, of the innermost refracting medium or of the air."""
        refracts = self._index[stack.kinds] > 0
        return _first_masked(self._attenuation[stack.kinds], refracts, self.air_extinction)

    def stack_behind(
        self, stack: MediaStack, kinds: Ints32, triangles: Ints32, cosines: Floats
    ) -> MediaStack:
        """Return the stacks of media behind surfaces that light crosses.

        `cosines` are those between normals and light.
        """
        behind = stack[np.arange(len(kinds))]
        enters = self.enters(kinds, cosines)
        filled = self.filled[kinds]
        entering = np.flatnonzero(filled & enters)
        leaving = np.flatnonzero(filled & ~enters)
        behind.enter(entering, kinds[entering], triangles[entering])
        behind.leave(leaving, kinds[leaving])
        return behind

    def density(self, stack: MediaStack, upright: Floats) -> Floats:
        """Return the optical depth of leaves per meter in each medium around the light.

        `upright` (n,) are cosines between the light and the vertical, from 0 to 1. The result has
        shape (n, MAX_MEDIA). For voxel grids, the values are for a leaf area density of 1 m²/m³.
        """
        density = self._area[stack.kinds]
        if density.any():
            for number, angle in enumerate(self._angles):
                projected_area = mean_projection(angle, upright)[:, None]
                density *= np.where(self._angle[stack.kinds] == number, projected_area, 1)
        return density

    def leaf_cosines(self, kinds: Ints32, upright: Floats) -> Floats:
        """Return the mean cosine between light and the normals of the leaves that it hits.

        `kinds` (n,) are kinds of crowns (closed surfaces with leaves). `upright` (n,) are cosines
        between the light and the vertical, from 0 to 1.
        """
        cosines = np.ones(len(kinds))
        for number, angle in enumerate(self._angles):
            cosines = np.where(
                self._angle[kinds] == number, mean_brightness(angle, upright), cosines
            )
        return cosines


class LightInGrids(NamedTuple):
    """Light that passes through voxel grids.

    All arrays have shape (k,).
    """

    row_indices: Indices  # rows of the light
    meters: Floats  # distance to the leaf that the light hits, or inf
    remaining_depth: Floats  # optical depth to a leaf after the passage; -inf if light hits a leaf
    # (k, MAX_MEDIA): optical depth per meter; for a grid, in the voxel where light hits a leaf, or
    # 0
    density: Floats


class Refraction(NamedTuple):
    """Result of refracting light at surfaces.

    Arrays have shape (n,), and arrays of vectors have shape (n, 3).
    """

    directions: Floats
    # Fraction of the light, one way: transmitted, or reflected where the light is reflected.
    shares: Floats | float
    totally_reflected: Bools  # whether light is totally reflected; its direction is then unchanged


class Leaves(NamedTuple):
    """Leaves that light hits.

    All arrays have shape (k,).
    """

    row_indices: Indices  # rows of the light
    meters: Floats  # distance from the start of the span to the leaf
    triangles: Ints32  # triangles through which the light entered the crown
    cosines: Floats  # mean cosine between light and leaf normals


@dataclass
class LightInMedia:
    """State of light in media.

    It consists of the media stack, the refraction and the remaining optical depth to a leaf.
    """

    media: Media
    stack: MediaStack
    differentials: RayDifferentials | None  # None if no medium refracts
    remaining_depth: Floats | None  # (n,): optical depth to a leaf; None without leaves

    def __getitem__(self, row_indices: Integers) -> LightInMedia:
        """Return the state of the selected sub-rays."""
        return LightInMedia(
            self.media,
            *select_rows((self.stack, self.differentials, self.remaining_depth), row_indices),
        )

    @property
    def index(self) -> Floats | float:
        """Refractive index at the position of the light."""
        return 1.0 if self.differentials is None else self.differentials.index

    def optical_length(self, step: Floats) -> Floats:
        """Convert the lengths of steps to optical path lengths, both in meters."""
        return step if self.differentials is None else step * self.differentials.index

    def meet_leaves(
        self,
        origins: Floats,
        directions: Floats,
        starts_m: Floats,
        ends_m: Floats,
        ray: Ints,
        draw: Draw,
    ) -> Leaves:
        """Return the leaves that light hits between two distances from its origins.

        The distances `starts_m` and `ends_m` (n,) are in meters, and `ray` (n,) are sub-ray
        numbers. `draw` draws the random bits that choose between overlapping crowns. This reduces
        `remaining_depth`.
        """
        if self.remaining_depth is None:
            no_rows = np.zeros(0, np.intp)
            return Leaves(no_rows, np.zeros(0), np.zeros(0, np.int32), np.zeros(0))
        upright = np.minimum(np.abs(directions[:, 2]), 1)
        density = self.media.density(self.stack, upright)
        length = ends_m - starts_m
        passage = None
        if self.media.grids is not None:
            starts = origins + starts_m[:, None] * directions
            passage = self._pass_grids(starts, directions, length, density)
            density[passage.row_indices] = passage.density
        cumulative = np.cumsum(density, axis=1)
        row_indices, meters = self._advance_to_leaves(cumulative[:, -1], length, passage)
        layer = _crown_layers(draw(CROWN, ray[row_indices]), cumulative[row_indices])
        cosines = self.media.leaf_cosines(
            self.stack.kinds[row_indices, layer], upright[row_indices]
        )
        return Leaves(row_indices, meters, self.stack.triangles[row_indices, layer], cosines)

    def _advance_to_leaves(
        self, density: Floats, length: Floats, passage: LightInGrids | None
    ) -> tuple[Indices, Floats]:
        """Reduce the remaining depth along paths, and find the light that hits leaves.

        The lengths of the paths are in meters, and the densities are in 1/m. The result contains
        the rows of light that hits a leaf, and the distances to the leaves in meters.
        """
        assert self.remaining_depth is not None
        depth = density * length
        if passage is not None:
            in_grids = passage.row_indices
            depth[in_grids] = self.remaining_depth[in_grids] - passage.remaining_depth
        row_indices = np.flatnonzero(depth > self.remaining_depth)
        meters = self.remaining_depth[row_indices] / density[row_indices]
        if passage is not None:
            meters_in_grids = np.full(len(depth), np.nan)
            meters_in_grids[passage.row_indices] = passage.meters
            meters = np.where(
                np.isnan(meters_in_grids[row_indices]), meters, meters_in_grids[row_indices]
            )
        self.remaining_depth = self.remaining_depth - depth
        return row_indices, meters

    def _pass_grids(
        self, starts: Floats, directions: Floats, length: Floats, density: Floats
    ) -> LightInGrids:
        """Follow light through voxel grids, and return the passage with updated densities.

        The light starts at `starts` (n, 3) and travels `length` (n,) meters. `density`
        (n, MAX_MEDIA) is the optical depth per meter. For a grid, it applies to a leaf area density
        of 1 m²/m³.
        """
        grids = self.media.grids
        stack = self.stack
        assert grids is not None and self.remaining_depth is not None
        gridded = self.media.gridded[stack.kinds]
        row_indices = np.flatnonzero(gridded.any(axis=1))
        gridded = gridded[row_indices]
        # Order the columns of the stack with grids first, up to the largest number of grids of any
        # ray.
        grid_layers = np.argsort(~gridded, axis=1, kind="stable")
        grid_layers = grid_layers[:, : gridded.sum(axis=1).max(initial=1)]
        is_grid = np.take_along_axis(gridded, grid_layers, axis=1)
        triangles = np.take_along_axis(stack.triangles[row_indices], grid_layers, axis=1)
        media_density = np.where(gridded, 0, density[row_indices])
        meters, remaining_depth, grid_density = grids.follow(
            np.where(is_grid, self.media.instances(triangles), -1),
            starts[row_indices],
            directions=directions[row_indices],
            projection=np.take_along_axis(density[row_indices], grid_layers, axis=1),
            uniform_density=np.cumsum(media_density, axis=1)[:, -1],
            length=length[row_indices],
            depth=self.remaining_depth[row_indices],
        )
        layer_density = np.where(
            is_grid, grid_density, np.take_along_axis(media_density, grid_layers, 1)
        )
        np.put_along_axis(media_density, grid_layers, layer_density, 1)
        return LightInGrids(row_indices, meters, remaining_depth, media_density)

    def advance(self, step: Floats) -> None:
        """Advance the light by the given steps, in meters."""
        if self.differentials is not None:
            self.differentials.advance(step, self.media.attenuation(self.stack))

    def energy_factor(self, directions: Floats, distance: Floats) -> Floats | float:
        """Return the energy relative to light on a straight path of the same length in air."""
        if self.differentials is None:
            return 1.0
        return self.differentials.energy_factor(directions, distance, self.media.air_extinction)

    def cross(
        self,
        kinds: Ints32,
        triangles: Ints32,
        directions: Floats,
        normals: Floats,
        cosines: Floats,
        reflected: Bools,
    ) -> Refraction:
        """Transmit light through surfaces, or reflect it where `reflected` is True.

        `cosines` are cosines between normals and directions. This updates the media stacks:
        transmitted light enters or leaves a medium, while reflected light stays in its media. The
        direction of reflected light is not changed here. At surfaces in `Media.mirrors`, reflected
        light has its own rows, so totally reflected light in the other rows gets the share 0.
        """
        stack_before = self.stack
        self.stack = self.media.stack_behind(self.stack, kinds, triangles, cosines)
        if self.differentials is None:
            return Refraction(directions, 1.0, np.zeros(len(kinds), np.bool_))
        ratio = self.media.index(self.stack) / self.differentials.index
        refraction = refract(directions, normals, cosines, ratio)
        keeps_media = refraction.totally_reflected | reflected
        self.stack.kinds[keeps_media] = stack_before.kinds[keeps_media]
        self.stack.triangles[keeps_media] = stack_before.triangles[keeps_media]
        mirrors = self.media.mirrors[kinds]
        fractions = np.where(refraction.totally_reflected & mirrors, 0.0, refraction.shares)
        fractions = np.where(reflected, np.where(mirrors, 1 - fractions, 1.0), fractions)
        outgoing = np.where(reflected[:, None], directions, refraction.directions)
        return Refraction(outgoing, fractions, refraction.totally_reflected)

    def deflect(self, incoming: Floats, outgoing: Floats, normals: Floats, mirrored: Bools) -> None:
        """Update the differentials at flat surfaces that change the direction of light."""
        if self.differentials is not None:
            self.differentials.deflect(
                incoming, outgoing, normals, mirrored, self.media.index(self.stack)
            )


def refract(directions: Floats, normals: Floats, cosines: Floats, ratio: Floats) -> Refraction:
    """Refract light at surfaces according to Snell's law.

    `ratio` (n,) is the refractive index behind the surface divided by the index in front of it.
    Totally reflected light keeps the direction and share that it would have without the surface.
    """
    cosine = np.maximum(np.abs(cosines), 1e-9)
    squared_cosine = 1 - (1 - cosine**2) / ratio**2
    bends = ratio != 1
    totally_reflected = bends & (squared_cosine <= 0)
    bends &= ~totally_reflected
    facing = np.where(cosines < 0, 1.0, -1.0)[:, None] * normals
    root = np.sqrt(np.maximum(squared_cosine, 0))
    bent = directions / ratio[:, None] + (cosine / ratio - root)[:, None] * facing
    transmitted = np.where(bends, 1 - fresnel(cosine, ratio), 1.0)
    outgoing = np.where(bends[:, None], bent, directions)
    return Refraction(outgoing, transmitted, totally_reflected)


def _crown_layers(bits: NDArray[np.uint64], cumulative: Floats) -> Indices:
    """Choose a random crown for each leaf, with probabilities proportional to the densities.

    `bits` (k,) are random bits, and `cumulative` (k, MAX_MEDIA) are cumulative sums of the
    densities of the media in the stacks. The result has columns of `MediaStack`.
    """
    fraction = (bits >> np.uint64(11)).astype(np.float64) * 2.0**-53
    return np.asarray((cumulative <= (fraction * cumulative[:, -1])[:, None]).sum(axis=1))


def random_depths(bits: NDArray[np.uint64]) -> Floats:
    """Convert random bits to exponentially distributed numbers with mean 1.

    For speed, the logarithm is computed from the binary exponent and a table of 32,768 logarithms.
    """
    fraction = ((bits >> np.uint64(11)).astype(np.float64) + 0.5) * 2.0**-53
    mantissa, exponent = np.frexp(fraction)
    row = ((mantissa - 0.5) * (2 * len(_logs()))).astype(np.intp)
    return np.asarray(_logs()[row] - exponent * float(np.float32(log_of(2.0))))


@cache
def _logs() -> Floats:
    """Return a table of -log(x) for x from 1/2 to 1, rounded to single precision."""
    steps = (np.arange(1 << 15) + 0.5) / (1 << 16) + 0.5
    return -log(steps).astype(np.float32).astype(np.float64)


def _away_from_zero(cosine: Floats) -> Floats:
    return np.where(np.abs(cosine) > 1e-9, cosine, 1e-9)


def _first_masked(values: Floats, mask: AnyArray, default: float) -> Floats:
    """Return the first value in each row where the mask is True, or a default."""
    column = mask.argmax(axis=1)
    row_indices = np.arange(len(values))
    return np.where(mask[row_indices, column], values[row_indices, column], default)
