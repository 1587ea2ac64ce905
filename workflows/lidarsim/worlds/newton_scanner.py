"""Lidars in the worlds of a Newton model."""

from __future__ import annotations

import logging
from collections.abc import Hashable, Sequence
from dataclasses import replace
from typing import Any, Literal, NamedTuple

import numpy as np

from ..columns.cloud import Cloud
from ..errors import LidarError
from ..numerics.arrays import Floats, Floats32, Indices
from ..numerics.vectors import matmul
from ..scene.object_names import unique_names
from ..schema.checks import check_choice
from ..sensor import Sensor
from ..survey.survey import Mounted
from .follower import Follower
from .newton_model import Geometry, NewtonModel, as_numpy, matrices_of
from .newton_worlds import ObjectMeshes, Objects, WorldView, equal_matrices
from .shape_meshes import SAG_M

_log = logging.getLogger(__name__)


class _Lidars(NamedTuple):
    """Frames of the lidars."""

    body: Indices  # (lidars,): -1 for a lidar that belongs to no body
    matrix: Floats  # (lidars, 4, 4): from the lidar frames to the body frames or to the world
    world: Indices  # (lidars,)


class _ScannedWorld(NamedTuple):
    """A world, or all worlds together, with the lidars in it."""

    follower: Follower  # shared by worlds with the same objects
    view: WorldView
    lidars: list[int]  # indices of the lidars
    fixed_moves: bool  # whether stationary objects have different poses in the follower's worlds

    def matrices(self, bodies: Floats) -> Floats:
        """Return the poses of the follower's bodies, given those of all bodies of the model."""
        moving = bodies[self.view.bodies]
        return np.concatenate([self.view.fixed_matrices, moving]) if self.fixed_moves else moving


class NewtonScanner:
    """Lidars in the worlds of a Newton model.

    A Newton model can contain many worlds that are simulated together, such as the environments in
    which a policy is trained. Each lidar sees the bodies of its own world and those that all worlds
    share, except for the bodies that carry a lidar. Results are lists or arrays with one entry for
    each lidar.

    The class only reads the arrays of the model and its states, on the CPU or on a GPU. It does not
    import Newton.

    Parameters
    ----------
    model
        A `newton.Model`. Later changes to its shapes have no effect.
    sensor
        The lidar, or a `Mounted` lidar on the body or site.
    body, site
        Label or index of the body or site whose frame is the frame of the lidar (x forward, z up),
        or a list of them. * and ? are wildcards. A label that occurs in each world selects a lidar
        in each world.
    worlds
        Whether a lidar sees its own world ("own") or all worlds ("all").
    geometry
        Whether the lidar sees the shapes that Newton displays ("visual"), or those that collide
        ("collision"). Sites are invisible.
    exclude
        Labels of bodies and shapes, or indices of bodies, that are invisible to the lidars. * and ?
        are wildcards.
    objects
        Whether the column `object` distinguishes bodies ("body") or shapes ("shape"). A shape that
        belongs to no body is always an object. Sweeps take longer with "shape".
    sag_m
        Maximum distance in meters between the triangles and the surface of cylinders, capsules and
        cones. For spheres and ellipsoids, the maximum distance is twice as large.
    **options
        Options of `Scanner`, such as columns, materials, noise and threads.

    Raises
    ------
    LidarError
        If the model does not contain a body, site or shape, if a shape has an unknown type, or if
        nothing is visible to a lidar.

    Examples
    --------
    >>> from lidarpool import NewtonScanner, load_sensor
    >>> sensor = load_sensor("velodyne/vlp16")
    >>> scanner = NewtonScanner(model, sensor, site="lidar")  # doctest: +SKIP
    >>> solver.step(state, next_state, control, contacts, dt)  # doctest: +SKIP
    >>> scanner.ranges(next_state).shape  # doctest: +SKIP
    (64, 1809, 16)
    """

    def __init__(
        self,
        model: Any,
        sensor: Sensor | Mounted,
        *,
        body: str | int | Sequence[str | int] | None = None,
        site: str | int | Sequence[str | int] | None = None,
        worlds: Literal["own", "all"] = "own",
        geometry: Geometry = "visual",
        exclude: Sequence[str | int] = (),
        objects: Objects = "body",
        sag_m: float = SAG_M,
        **options: Any,
    ) -> None:
        if (body is None) == (site is None):
            raise LidarError(
                "Set either the body or the site of the lidar, with body=LABEL or site=LABEL, but "
                "not both."
            )
        check_choice("worlds", worlds, ("own", "all"))
        check_choice("geometry", geometry, ("visual", "collision"))
        check_choice("objects", objects, ("body", "shape"))
        if not sag_m > 0:
            raise LidarError(f"sag_m must be greater than 0, but is {sag_m}.")
        arrays = NewtonModel.from_model(model)
        if invisible := arrays.describe_invisible(model):
            _log.warning("the model has %s, which the lidar ignores", invisible)
        self._body_labels = arrays.body_labels
        self._lidars = _find_lidars(arrays, body, site)
        if worlds == "own" and arrays.has_worlds and (self._lidars.world < 0).any():
            raise LidarError(
                "A lidar belongs to no world, so it would only see the bodies that all worlds "
                'share. Pass worlds="all", or the label of a body or site in the worlds.'
            )
        shapes = arrays.visible_shapes(geometry, exclude)
        carriers = self._lidars.body[self._lidars.body >= 0]
        shapes = shapes[~np.isin(arrays.shape_body[shapes], carriers)]
        meshes = ObjectMeshes(arrays, shapes, objects, sag_m)
        views: dict[int | None, WorldView] = {None: meshes.view(None)}
        lidars: dict[int | None, list[int]] = {None: [*range(len(self))]}
        if worlds == "own" and arrays.has_worlds:
            numbers = np.unique(self._lidars.world).tolist()
            views = {world: meshes.view(world) for world in numbers}
            lidars = {
                world: np.flatnonzero(self._lidars.world == world).tolist() for world in numbers
            }
        self._scanned = [
            _ScannedWorld(follower, views[world], lidars[world], fixed_moves)
            for world, (follower, fixed_moves) in _create_followers(views, sensor, options).items()
        ]

    def __repr__(self) -> str:
        return f"<NewtonScanner of {len(self)} lidars: {self._scanned[0].follower!r}>"

    def __len__(self) -> int:
        return len(self._lidars.world)

    @property
    def worlds(self) -> tuple[int, ...]:
        """Index of the world of each lidar, or -1 for a lidar that belongs to no world."""
        return tuple(self._lidars.world.tolist())

    @property
    def names(self) -> tuple[tuple[str, ...], ...]:
        """Names of the objects of each lidar, in the order of the values in the column `object`."""
        names = {lidar: item.follower.names for item in self._scanned for lidar in item.lidars}
        return tuple(names[lidar] for lidar in range(len(self)))

    def ranges(self, state: Any, *, number: int | None = None) -> Floats32:
        """Simulate the range images that the lidars measure in a state of the model.

        This is the fastest method, because it does not compute points.

        Parameters
        ----------
        state
            A `newton.State` with the poses of the bodies.
        number
            Number of the sweep, as in `Scanner.sweep`. By default, each call has new noise.

        Returns
        -------
        float32 array of shape (lidars, firings, channels)
            Ranges in meters, or inf if there is no return.

        Raises
        ------
        LidarError
            If `state` is not a state of the model, or if a body has no valid pose.
        """
        bodies = self._body_matrices(state)
        poses = self._poses(bodies)
        images: dict[int, Floats32] = {}
        for item in self._scanned:
            rows = item.follower.ranges(
                poses[item.lidars], item.matrices(bodies), number=number, world=item.lidars[0]
            )
            images |= dict(zip(item.lidars, rows, strict=True))
        return np.stack([images[lidar] for lidar in range(len(self))])

    def sweep(self, state: Any, *, number: int | None = None) -> list[Cloud]:
        """Simulate a sweep of each lidar in a state of the model, without motion.

        The parameters and errors are the same as in `ranges`.

        Returns
        -------
        list of Cloud
            The returns of each lidar. The column `object` contains indices into the names of the
            lidar.
        """
        bodies = self._body_matrices(state)
        poses = self._poses(bodies)
        clouds: dict[int, Cloud] = {}
        for item in self._scanned:
            matrices = item.matrices(bodies)
            for lidar in item.lidars:
                clouds[lidar] = item.follower.sweep(
                    poses[lidar], matrices, number=number, world=lidar
                )
        return [clouds[lidar] for lidar in range(len(self))]

    def step(self, time_s: float, state: Any) -> list[list[Cloud]]:
        """Record a simulation step. Return the sweeps completed since the last step.

        Call `step` after each step of the solver. Each beam uses the poses of the lidar and of the
        bodies at its firing time. If the time is before the last step, all earlier steps are
        discarded and a new first sweep starts.

        Parameters
        ----------
        time_s
            Simulation time in seconds.
        state
            A `newton.State` with the poses of the bodies.

        Returns
        -------
        list of lists of Cloud
            The completed sweeps of each lidar; usually none or one.

        Raises
        ------
        LidarError
            If an argument has the wrong type, if a body has no valid pose, or if nothing is
            stationary in all worlds.
        """
        time_s = _seconds(time_s)
        bodies = self._body_matrices(state)
        poses = self._poses(bodies)
        clouds: dict[int, list[Cloud]] = {}
        for item in self._scanned:
            matrices = item.matrices(bodies)
            for lidar in item.lidars:
                clouds[lidar] = item.follower.step(time_s, poses[lidar], matrices, world=lidar)
        return [clouds[lidar] for lidar in range(len(self))]

    def reset(self, world: int | None = None) -> None:
        """Discard recorded steps, so that the next step starts the first sweep again.

        Call it after a world has been reset, because its bodies have not moved to their new poses
        at a constant velocity.

        Parameters
        ----------
        world
            Index of a world that contains a lidar (default: all worlds).

        Raises
        ------
        LidarError
            If no lidar belongs to the world.
        """
        if world is not None and not (_is_index(world) and world in self.worlds):
            found = ", ".join(map(str, dict.fromkeys(self.worlds)))
            raise LidarError(
                f"No lidar belongs to the world {world!r}. Pass the index of a world with a lidar "
                f"({found}), or no argument to reset all worlds."
            )
        for item in self._scanned:
            for lidar in item.lidars:
                if world in (None, self._lidars.world[lidar]):
                    item.follower.reset(lidar)

    def _body_matrices(self, state: Any) -> Floats:
        """Return the poses of all bodies. The shape is (bodies, 4, 4)."""
        if not hasattr(state, "body_q"):
            raise LidarError(
                f"Expected a single newton.State, but got an object of type "
                f"{type(state).__name__!r}. For example, pass `model.state()`."
            )
        matrices = matrices_of(as_numpy(state.body_q, 7))
        valid = np.isfinite(matrices).all(axis=(1, 2))
        if len(matrices) != len(self._body_labels):
            raise LidarError(
                f"The state has {len(matrices)} bodies, but the model has "
                f"{len(self._body_labels)}. Create the state with `model.state()`."
            )
        if not valid.all():
            body = int(valid.argmin())
            raise LidarError(
                f"The pose of body {body} ({self._body_labels[body]!r}) is not finite. The "
                "simulation may be unstable. Reduce its time step."
            )
        return matrices

    def _poses(self, bodies: Floats) -> Floats:
        """Return the poses of all lidars. The shape is (lidars, 4, 4)."""
        with_world = np.concatenate([bodies, np.eye(4)[None]])  # body -1 is the world
        return matmul(with_world[self._lidars.body], self._lidars.matrix)


def _find_lidars(
    model: NewtonModel,
    body: str | int | Sequence[str | int] | None,
    site: str | int | Sequence[str | int] | None,
) -> _Lidars:
    """Return the frames of the bodies or sites that carry a lidar."""
    names: Any = body if site is None else site
    listed = [names] if isinstance(names, str | int) else [*names]
    if site is None:
        bodies = np.array(model.find_bodies(listed), np.intp)
        return _Lidars(bodies, np.tile(np.eye(4), (len(bodies), 1, 1)), model.body_world[bodies])
    sites = np.array(model.find_sites(listed), np.intp)
    return _Lidars(model.shape_body[sites], model.shape_matrix[sites], model.shape_world[sites])


def _create_followers(
    views: dict[int | None, WorldView], sensor: Sensor | Mounted, options: dict[str, Any]
) -> dict[int | None, tuple[Follower, bool]]:
    """Return the follower of each world, which is shared by worlds with the same objects.

    The second value states whether stationary objects have different poses in these worlds.
    """
    by_signature: dict[Hashable, list[int | None]] = {}
    for world, view in views.items():
        by_signature.setdefault(view.signature, []).append(world)
    followers: dict[int | None, tuple[Follower, bool]] = {}
    for numbers in by_signature.values():
        same = [views[world] for world in numbers]
        fixed_moves = not equal_matrices(same)
        follower = _create_follower(same[0], fixed_moves, sensor, options)
        followers |= dict.fromkeys(numbers, (follower, fixed_moves))
    return followers


def _create_follower(
    view: WorldView, fixed_moves: bool, sensor: Sensor | Mounted, options: dict[str, Any]
) -> Follower:
    """Create the follower of a world.

    Its stationary objects are treated as bodies if they have different poses in other worlds.
    """
    objects = (*view.shared, *view.fixed, *view.moving)
    if not objects:
        raise LidarError(
            "The model contains no shapes that are visible to the lidar. Check the flags of its "
            'shapes, or pass geometry="collision".'
        )
    names = unique_names([item.name for item in objects])
    named = [replace(item.mesh, name=name) for item, name in zip(objects, names, strict=True)]
    count = len(view.shared) + (0 if fixed_moves else len(view.fixed))
    static = [
        mesh.affine_transform(mesh.name, item.matrix[:3, :3], item.matrix[:3, 3])
        for item, mesh in zip(objects[:count], named, strict=False)
    ]
    return Follower(named[count:], sensor, static=static, **options)


def _seconds(time_s: Any) -> float:
    """Convert a time to float, and raise LidarError if it is not a number."""
    try:
        if not isinstance(time_s, str):
            return float(time_s)
    except (TypeError, ValueError):
        pass
    raise LidarError(
        "`step` expects the simulation time in seconds, followed by the state, but the time has "
        f"the type {type(time_s).__name__!r}."
    )


def _is_index(value: Any) -> bool:
    return isinstance(value, int | np.integer) and not isinstance(value, bool)
