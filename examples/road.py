"""Create road.glb, a road whose lane markings are part of the base color texture."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import trimesh
from PIL import Image
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

LENGTH_M = 48.0
WIDTH_M = 9.6
PIXEL_M = 0.05
ASPHALT = (88, 88, 90)
WHITE = (236, 236, 230)
YELLOW = (222, 176, 40)
TURN = trimesh.transformations.rotation_matrix(-np.pi / 2, [1, 0, 0])  # from z-up to y-up


def markings() -> Image.Image:
    """Draw the road from above, with edge lines, a dashed center line and a crosswalk."""
    image = np.full((round(WIDTH_M / PIXEL_M), round(LENGTH_M / PIXEL_M), 3), ASPHALT, np.uint8)
    for edge in (8, -12):
        image[edge : edge + 4] = WHITE
    middle = len(image) // 2
    for begin in range(0, image.shape[1], 180):  # 3 m of every 9 m
        image[middle - 2 : middle + 2, begin : begin + 60] = YELLOW
    for begin in range(16, len(image) - 20, 20):  # 50 cm of every meter
        image[begin : begin + 10, 560:620] = WHITE
    return Image.fromarray(image)


def slab(lower: tuple[float, ...], upper: tuple[float, ...], color: list[float]) -> trimesh.Trimesh:
    """Return a box with a uniform linear RGB color."""
    box = trimesh.creation.box(bounds=[lower, upper])
    box.visual = TextureVisuals(material=PBRMaterial(baseColorFactor=[*color, 1.0]))
    return box


def road() -> trimesh.Scene:
    """Return a road with a sidewalk on each side and a parked van."""
    x = LENGTH_M / 2
    y = WIDTH_M / 2
    corners = [[-x, -y, 0], [x, -y, 0], [x, y, 0], [-x, y, 0]]
    visual = TextureVisuals(
        [[0, 0], [1, 0], [1, 1], [0, 1]], PBRMaterial(baseColorTexture=markings())
    )
    scene = trimesh.Scene()
    parts = {
        "Road": trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], visual=visual, process=False),
        "Pavement left": slab((-x, y, 0), (x, y + 2, 0.12), [0.4, 0.38, 0.35]),
        "Pavement right": slab((-x, -y - 2, 0), (x, -y, 0.12), [0.4, 0.38, 0.35]),
        "Van": slab((9, 2.2, 0.0), (14, 4.2, 2.2), [0.05, 0.12, 0.45]),
    }
    for name, part in parts.items():
        scene.add_geometry(part.apply_transform(TURN), name, name)
    return scene


if __name__ == "__main__":
    target = sys.argv[1] if len(sys.argv) > 1 else Path(__file__).with_name("road.glb")
    Path(target).write_bytes(road().export(file_type="glb"))
