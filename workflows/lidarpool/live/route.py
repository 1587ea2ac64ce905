"""The planned path on a page, and the discs that it goes around."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .page import LivePage

_PATH = (20, 150, 90)
_DISC = (120, 130, 150)


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
