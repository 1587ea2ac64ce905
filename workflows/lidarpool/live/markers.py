"""What is drawn over scene and cloud: the sensor and its rays, the planned path."""

from __future__ import annotations

from typing import Any

import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray

from .height_cut import lines_below
from .page import LivePage

_PATH = (20, 150, 90)
_DISC = (120, 130, 150)
_RED = (224, 24, 45)
_EARLIER = (232, 140, 150)
_RADIUS = 0.009  # of the ball, as a share of the scene's diagonal
_SMALL = 0.6  # of that have the balls where the sensor stands at other times
MOST_EARLIER = 150  # rays; more of them hide what they hit
MOST_POSES = 1000  # that have a ball


class SensorLayer:
    """A red ball where the sensor is, the rays of its last frame, and paler ones of earlier ones.

    Parameters
    ----------
    page
        Where they are shown.
    size_m
        Diagonal of the scene in metres.
    """

    def __init__(self, page: LivePage, size_m: float) -> None:
        self._page, self._radius = page, _RADIUS * size_m
        self._ball = page.scene.add_icosphere(
            "/sensor", self._radius, _RED, visible=False, cast_shadow=False
        )
        page.scene.add_label("/sensor/label", "sensor", anchor="bottom-left")
        self._rays: dict[str, Any] = {}  # {name: node}; viser shows no empty ones
        with page.gui.add_folder("sensor"):
            self._shown = page.gui.add_checkbox("rays", initial_value=True)

        @self._shown.on_update
        def _show(_: Any) -> None:
            for node in self._rays.values():
                node.visible = self._shown.value

    def place(self, position: ArrayLike) -> None:
        """Show the sensor at a position, (3,) metres."""
        self._ball.position = np.asarray(position, np.float64)
        self._ball.visible = True

    def draw_poses(self, positions: NDArray[np.float64]) -> None:
        """Show small balls at positions (p, 3) in metres, or at some where they are many."""
        count = min(len(positions), MOST_POSES)
        some = positions[np.linspace(0, len(positions) - 1, count).astype(np.int64)]
        ball = trimesh.creation.icosphere(subdivisions=2, radius=_SMALL * self._radius)
        self._page.scene.add_batched_meshes_simple(
            "/poses",
            ball.vertices,
            ball.faces,
            batched_wxyzs=np.tile([1.0, 0.0, 0.0, 0.0], (count, 1)),
            batched_positions=some,
            batched_colors=_RED,
            lod="off",
            cast_shadow=False,
            receive_shadow=False,
        )

    def draw_latest(
        self, position: ArrayLike, ends: NDArray[np.float32], cut: float | None
    ) -> None:
        """Show rays from a position, (3,), to ends (n, 3), below the height `cut`, metres."""
        starts = np.broadcast_to(np.asarray(position, np.float32), ends.shape)
        self._draw_rays("latest", np.stack([starts, ends], axis=1), cut, _RED, 1.6)

    def draw_earlier(self, rays: NDArray[np.float32], cut: float | None) -> None:
        """Show some of the rays (n, 2, 3) of other times, below the height `cut`, metres."""
        rays = rays[:: len(rays) // MOST_EARLIER + 1]
        self._draw_rays("earlier", rays, cut, _EARLIER, 1.0)

    def _draw_rays(
        self,
        name: str,
        rays: NDArray[np.float32],
        cut: float | None,
        colour: tuple[int, int, int],
        width: float,
    ) -> None:
        if cut is not None:
            rays = lines_below(rays, cut)
        if not len(rays):
            if name in self._rays:
                self._rays.pop(name).remove()
        elif name in self._rays:
            self._rays[name].points = rays
        else:
            self._rays[name] = self._page.scene.add_line_segments(
                f"/rays/{name}",
                rays,
                colour,
                thickness=width,
                thickness_units="screen",
                visible=self._shown.value,
            )


def add_route(page: LivePage, path: NDArray[np.float64], level: float, size_m: float) -> None:
    """Show a path, (n, 2) in metres, over the ground at height `level`.

    Parameters
    ----------
    size_m
        Diagonal of the scene, metres.
    """
    z = np.full((len(path), 1), level + 0.004 * size_m)
    corners = np.hstack([path, z])
    page.scene.add_line_segments(
        "/path",
        np.stack([corners[:-1], corners[1:]], axis=1),
        _PATH,
        thickness=4.0,
        thickness_units="screen",
    )
    for name, at in (("start", corners[0]), ("target", corners[-1])):
        page.scene.add_icosphere(
            f"/path/{name}", 0.008 * size_m, _PATH, position=at, cast_shadow=False
        )
        page.scene.add_label(f"/path/{name}/label", name, anchor="bottom-left")


def add_discs(
    page: LivePage,
    centres: NDArray[np.float64],
    radii: NDArray[np.float64],
    level: float,
    size_m: float,
) -> None:
    """Show discs with centres (m, 2) and radii (m,), in metres, on the ground."""
    height = 0.002 * size_m
    for number, ((x, y), radius) in enumerate(zip(centres.tolist(), radii.tolist(), strict=True)):
        page.scene.add_cylinder(
            f"/discs/{number}",
            radius,
            height,
            _DISC,
            radial_segments=48,
            opacity=0.35,
            cast_shadow=False,
            receive_shadow=False,
            position=(x, y, level + height / 2),
        )
