"""A lidar on a body or site of a MuJoCo model."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import Any

import numpy as np

from ..columns.cloud import Cloud
from ..errors import LidarError
from ..numerics.arrays import Floats, Floats32, Indices
from ..sensor import Sensor
from ..survey.survey import Mounted
from .follower import Follower
from .mujoco_bodies import (
    BodySelection,
    Objects,
    create_bodies,
    describe_soft_bodies,
    find_excluded,
    require_id,
)
from .shape_meshes import SAG_M

_log = logging.getLogger(__name__)


class MujocoScanner:
    """A lidar in a MuJoCo world.

    The lidar does not see the body on which it is mounted, as is the case for MuJoCo rangefinders.
    The class only reads the arrays of the model and the data, which must come from MuJoCo 3.2 or
    later. It does not import MuJoCo.

    Parameters
    ----------
    model
        An `mjModel`. Later changes to its geoms have no effect.
    sensor
        The lidar, or a `Mounted` lidar on the body or site.
    body, site
        Name or ID of the body or site whose frame is the frame of the lidar (x forward, z up). To
        simulate several lidars of the same model with `ranges`, pass a list.
    groups
        Geom groups that are visible to the lidar. Group 3 usually contains duplicates for collision
        detection.
    exclude
        Names of bodies and geoms, or IDs of bodies, that are invisible to the lidar.
    objects
        Whether the column `object` distinguishes bodies ("body") or geoms ("geom"). Sweeps take
        longer with "geom".
    sag_m
        Maximum distance in meters between the triangles and the surface of cylinders and capsules.
        For spheres and ellipsoids, the maximum distance is twice as large.
    **options
        Options of `Scanner`, such as columns, materials, noise and threads.

    Raises
    ------
    LidarError
        If the model does not contain a body, site or geom, or if no geoms are visible.

    Examples
    --------
    >>> from lidarpool import MujocoScanner, load_sensor
    >>> sensor = load_sensor("velodyne/vlp16")
    >>> scanner = MujocoScanner(model, sensor, site="lidar")  # doctest: +SKIP
    >>> mujoco.mj_step(model, data)  # doctest: +SKIP
    >>> scanner.sweep(data)  # doctest: +SKIP
    <Cloud of 21,316 points: x, y, z, scan, channel, object>
    """

    def __init__(
        self,
        model: Any,
        sensor: Sensor | Mounted,
        *,
        body: str | int | Sequence[str | int] | None = None,
        site: str | int | Sequence[str | int] | None = None,
        groups: Sequence[int] = (0, 1, 2),
        exclude: Sequence[str | int] = (),
        objects: Objects = "body",
        sag_m: float = SAG_M,
        **options: Any,
    ) -> None:
        if (body is None) == (site is None):
            raise LidarError(
                "Set either the body or the site of the lidar, with body=NAME or site=NAME, but "
                "not both."
            )
        self._kind = "body" if site is None else "site"
        names = body if site is None else site
        self._is_single = isinstance(names, str | int)
        listed: Any = [names] if self._is_single else names
        self._frames: Indices = np.array(
            [require_id(model, self._kind, name) for name in listed], np.intp
        )
        mount_bodies = self._frames
        if self._kind == "site":
            mount_bodies = np.asarray(model.site_bodyid)[self._frames]
        if objects not in ("body", "geom"):
            raise LidarError(f"objects must be 'body' or 'geom', but is {objects!r}.")
        if not sag_m > 0:
            raise LidarError(f"sag_m must be greater than 0, but is {sag_m}.")
        excluded_bodies, excluded_geoms = find_excluded(model, exclude)
        # A lidar that is mounted on the world, body 0, still sees the world.
        unseen = [*excluded_bodies, *(body for body in mount_bodies.tolist() if body)]
        selection = BodySelection(tuple(groups), unseen, excluded_geoms, objects, sag_m)
        if soft := describe_soft_bodies(model):
            _log.warning("the model has %s, which the lidar ignores", soft)
        bodies = create_bodies(model, selection)
        self._bodies: Indices = np.array([item.body for item in bodies.moving], np.intp)
        if not bodies.static and not bodies.moving:
            raise LidarError(
                f"None of the geoms in the model belongs to the groups {tuple(groups)}."
            )
        self.follower = Follower(
            [item.mesh for item in bodies.moving],
            sensor,
            static=bodies.static,
            **options,
        )

    def __repr__(self) -> str:
        return f"<MujocoScanner: {self.follower!r}>"

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the objects, in the order of the values in the column `object`."""
        return self.follower.names

    def sweep(self, data: Any, *, number: int | None = None) -> Cloud:
        """Simulate a sweep of the world in the state of an `mjData`.

        Parameters
        ----------
        data
            State after `mj_forward` or `mj_step`.
        number
            Number of the sweep, as in `Scanner.sweep`. By default, each call has new noise.

        Raises
        ------
        LidarError
            If there are several lidars.
        """
        return self.follower.sweep(self._pose(data), self._matrices(data), number=number)

    def ranges(self, data: Any, *, number: int | None = None) -> Floats32:
        """Simulate the range images that the lidars measure in the state of an `mjData`.

        The parameters are the same as in `sweep`.

        Returns
        -------
        float32 array of shape (firings, channels) or (lidars, firings, channels)
            Ranges in meters, or inf if there is no return. The axis of lidars exists only if `body`
            or `site` is a list.
        """
        poses = self._poses(data)
        images = self.follower.ranges(poses, self._matrices(data), number=number)
        return images[0] if self._is_single else images

    def step(self, data: Any) -> list[Cloud]:
        """Record a simulation step. Return the sweeps completed since the last step.

        Call `step` after each `mj_step`. Each beam uses the poses of the lidar and of the bodies at
        its firing time. If the time is before the last step, all earlier steps are discarded and a
        new first sweep starts.

        Raises
        ------
        LidarError
            If there are several lidars, or if the model contains nothing stationary.
        """
        pose = self._pose(data)
        return self.follower.step(float(data.time), pose, self._matrices(data))

    def _pose(self, data: Any) -> Floats:
        """Return the transformation matrix of the only lidar.

        Raise LidarError if there are several lidars.
        """
        if len(self._frames) != 1:
            raise LidarError(
                f"There are {len(self._frames)} lidars, but `sweep` and `step` require a single "
                "body or site. Create a scanner for each, or use `ranges`."
            )
        return np.asarray(self._poses(data)[0])

    def _poses(self, data: Any) -> Floats:
        """Return the transformation matrices of the lidars.

        The shape is (s, 4, 4).
        """
        if not hasattr(data, "site_xpos"):
            raise LidarError(
                f"Expected an mjData, but got an object of type {type(data).__name__!r}. For "
                "example, pass `mujoco.MjData(model)`."
            )
        if self._kind == "site":
            return _matrices(data.site_xpos, data.site_xmat, self._frames)
        return _matrices(data.xpos, data.xmat, self._frames)

    def _matrices(self, data: Any) -> Floats:
        """Return the transformation matrices of the moving bodies.

        The shape is (k, 4, 4).
        """
        return _matrices(data.xpos, data.xmat, self._bodies)


def _matrices(positions: Any, rotations: Any, row_indices: Indices) -> Floats:
    """Create transformation matrices from selected rows of positions and rotations.

    The positions have 3 columns, the rotations have 9 columns, and the result has shape (k, 4, 4).
    """
    matrices = np.zeros((len(row_indices), 4, 4))
    matrices[:, :3, 3] = np.asarray(positions).reshape(-1, 3)[row_indices]
    matrices[:, :3, :3] = np.asarray(rotations).reshape(-1, 3, 3)[row_indices]
    matrices[:, 3, 3] = 1
    return matrices
