"""Reader for .boxes files.

Each line has a name, the center of the underside, and the size of a box, in meters.
"""

from pathlib import Path

import numpy as np

from lidarsim.plugins import Content, MeshFileError, MeshFormat, ReadOptions, SceneMesh

CORNERS = np.array([(x, y, z) for z in (0, 1) for y in (-0.5, 0.5) for x in (-0.5, 0.5)])
SIDES = np.array(
    [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)]
)
FACES = np.concatenate([SIDES[:, [0, 1, 2]], SIDES[:, [0, 2, 3]]])


def read(data: bytes, path: Path, options: ReadOptions) -> Content:
    """Return one box per line."""
    meshes = []
    for number, line in enumerate(data.decode().splitlines(), 1):
        name, *figures = line.split()
        if len(figures) != 6:
            raise MeshFileError(f"has {len(figures)} numbers in line {number}, not 6")
        position, size = np.array(figures, np.float64).reshape(2, 3)
        meshes.append(SceneMesh(name, CORNERS * (size + options.own.grow_m) + position, FACES))
    return Content(meshes, unit_m=1.0, up_axis="z")


FORMAT = MeshFormat((".boxes",), read, options="lidar_example.mesh_options:BoxesOptions")
