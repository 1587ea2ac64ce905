"""A lidar on a body or site of a model of MuJoCo."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import Any

import numpy as np

from ..base.arrays import Floats, Floats32, Indices
from ..base.errors import LidarError
from ..base.signatures import ReadableSignature
from ..columns.cloud import Cloud
from ..sensor import Sensor
from ..survey.survey import Mounted
from .follower import Follower
from .mujoco_bodies import Choice, Objects, bodies_of, excluded, required_number, soft_bodies
from .mujoco_geoms import SAG_M

_log = logging.getLogger(__name__)


class MujocoScanner:
    """A lidar that scans a world of MuJoCo.

    The body that carries the lidar is not seen, as with MuJoCo's rangefinders. Arrays of the model
    and the data are read; MuJoCo 3.2 or later is not imported.

    Parameters
    ----------
    model
        An `mjModel`. Changes of its geoms after this call are not seen.
    sensor
        The lidar, or the lidar `Mounted` on the body or site.
    body, site
        Name or number of the body or site whose frame the lidar has: x ahead, z up. Several names
        are several lidars of the same kind, for `ranges`.
    groups
        Groups of the geoms that the lidar sees; group 3 has mostly doubles for collisions.
    exclude
        Names of bodies and geoms, or numbers of bodies, that the lidar does not see.
    objects
        What the column `object` tells apart: bodies, or geoms, which takes longer.
    sag_m
        Largest distance of the triangles of cylinders and capsules from the surface, meters; of
        balls and ellipsoids twice that.
    options
        Options of `Scanner`, such as columns, materials, noise and threads.

    Raises
    ------
    LidarError
        If the model has no such body, site or geom, or nothing is left to see.

    Examples
    --------
    >>> from lidarpool import MujocoScanner, load_sensor
    >>> sensor = load_sensor("velodyne/vlp16")
    >>> scanner = MujocoScanner(model, sensor, site="lidar")  # doctest: +SKIP
    >>> mujoco.mj_step(model, data)  # doctest: +SKIP
    >>> scanner.sweep(data)  # doctest: +SKIP
    <Cloud of 21,316 points: x, y, z, scan, channel, object>
    """

    __signature__ = ReadableSignature()

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
            raise LidarError("Set the body or the site of the lidar with body=NAME or site=NAME.")
        self._kind = "body" if site is None else "site"
        names = body if site is None else site
        self._is_single = isinstance(names, str | int)
        listed: Any = [names] if self._is_single else names
        self._frames: Indices = np.array(
            [required_number(model, self._kind, name) for name in listed], np.intp
        )
        carriers = self._frames
        if self._kind == "site":
            carriers = np.asarray(model.site_bodyid)[self._frames]
        if objects not in ("body", "geom"):
            raise LidarError(f"objects must be 'body' or 'geom', but is {objects!r}.")
        if not sag_m > 0:
            raise LidarError(f"sag_m must be above 0, but is {sag_m}.")
        excluded_bodies, excluded_geoms = excluded(model, exclude)
        # The world, body 0, cannot carry a lidar that would not see it.
        unseen = [*excluded_bodies, *(carrier for carrier in carriers.tolist() if carrier)]
        choice = Choice(tuple(groups), unseen, excluded_geoms, objects, sag_m)
        if soft := soft_bodies(model):
            _log.warning("the model has %s, which the lidar does not see", soft)
        bodies = bodies_of(model, choice)
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
        """Names of the objects, by the numbers of the column `object`."""
        return self.follower.names

    def sweep(self, data: Any, *, number: int | None = None) -> Cloud:
        """Scan a sweep of the world as it stands in an `mjData`.

        Parameters
        ----------
        data
            After `mj_forward` or `mj_step`.
        number
            Number of the sweep, as of `Scanner.sweep`; by default each call has new noise.

        Raises
        ------
        LidarError
            If there are several lidars.
        """
        return self.follower.sweep(self._pose(data), self._matrices(data), number=number)

    def ranges(self, data: Any, *, number: int | None = None) -> Floats32:
        """Return the ranges that the lidars measure in the world as it stands in an `mjData`.

        Returns
        -------
        float32 (firings, channels), or (lidars, firings, channels)
            Meters; inf without a return. With the lidars' axis if `body` or `site` is a list.
        """
        poses = self._poses(data)
        images = self.follower.ranges(poses, self._matrices(data), number=number)
        return images[0] if self._is_single else images

    def step(self, data: Any) -> list[Cloud]:
        """Take note of a step of the simulation, and return the sweeps that ended since the last.

        Call `step` after each `mj_step`: each beam leaves from the pose of the lidar, and meets
        bodies at their poses, at the time of the beam. A time before the last begins anew.

        Raises
        ------
        LidarError
            If there are several lidars, or nothing in the model stands.
        """
        return self.follower.step(float(data.time), self._pose(data), self._matrices(data))

    def _pose(self, data: Any) -> Floats:
        """Return the matrix (4, 4) of the only lidar.

        Raises LidarError if there are several.
        """
        if len(self._frames) != 1:
            raise LidarError(
                f"There are {len(self._frames)} lidars, but `sweep` and `step` require a single "
                "body or site. Create a scanner for each, or use `ranges`."
            )
        return np.asarray(self._poses(data)[0])

    def _poses(self, data: Any) -> Floats:
        """Return the matrices of the lidars (s, 4, 4)."""
        if self._kind == "site":
            return _matrices(data.site_xpos, data.site_xmat, self._frames)
        return _matrices(data.xpos, data.xmat, self._frames)

    def _matrices(self, data: Any) -> Floats:
        """Return the matrices of the bodies (k, 4, 4)."""
        return _matrices(data.xpos, data.xmat, self._bodies)


def _matrices(positions: Any, rotations: Any, row_indices: Indices) -> Floats:
    """Return matrices (k, 4, 4) of positions (n, 3) and rotations (n, 9), selected by rows (k,)."""
    matrices = np.zeros((len(row_indices), 4, 4))
    matrices[:, :3, 3] = np.asarray(positions).reshape(-1, 3)[row_indices]
    matrices[:, :3, :3] = np.asarray(rotations).reshape(-1, 3, 3)[row_indices]
    matrices[:, 3, 3] = 1
    return matrices
