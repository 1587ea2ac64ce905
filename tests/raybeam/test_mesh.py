"""Meshes are checked, moved near zero and scaled without losing anything."""

import numpy as np
import pytest

from raybeam import RayCaster

POINTS = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])


@pytest.mark.parametrize(
    ("vertices", "faces", "words"),
    [
        (POINTS, np.empty((0, 3), int), "f > 0"),
        (np.empty((0, 3)), [[0, 1, 2]], "Face 0 contains .* 0 vertices"),
        (POINTS[:, :2], [[0, 1, 2]], r"vertices must be .*\(3, 2\)"),
        (POINTS.ravel(), [[0, 1, 2]], r"vertices must be .*\(9,\)"),
        (POINTS.astype(complex), [[0, 1, 2]], "complex"),
        (POINTS, [0, 1, 2], r"faces must be .* with shape \(f, 3\)"),
        (POINTS, [[0, 1, 2, 2]], r"int64 and shape \(1, 4\)"),
        (POINTS, [[0.0, 1, 2]], "faces must be an integer array"),
        (
            POINTS,
            [[0, 1, 2], [0, 1, 3]],
            r"Face 1 contains .* \[0, 1, 3\], but the mesh has 3 vertices",
        ),
        (POINTS, [[0, 1, -1]], "Face 0 contains"),
        (
            POINTS,
            np.broadcast_to(np.int8(0), (2**28, 3)),
            "268,435,456 triangles, but the limit is",
        ),
        ([[0, 0, 0], [1, 0, 0], [0, np.nan, 0]], [[0, 1, 2]], "Vertex 2 must .*nan"),
        ([[0, 0, 0], [1, 0, 0], [0, np.inf, 0]], [[0, 1, 2]], "Vertex 2 must .*inf"),
        (POINTS, [[0, 1, 1], [2, 2, 2]], "only triangles with zero area"),
    ],
)
def test_refused(vertices, faces, words):
    with pytest.raises(ValueError, match=words):
        RayCaster(vertices, faces, "numpy")
