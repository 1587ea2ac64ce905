"""Meshes and files that several tests of lidarpool use."""

import numpy as np
import pytest
import trimesh


@pytest.fixture
def two_objects():
    """Return a trimesh scene: a box at x = 10 of 1 x 2 x 3 m, and a ball at the origin."""
    scene = trimesh.Scene()
    scene.add_geometry(
        trimesh.creation.box((1, 2, 3)),
        node_name="Box A",
        geom_name="box",
        transform=trimesh.transformations.translation_matrix((10, 0, 0)),
    )
    scene.add_geometry(trimesh.creation.icosphere(1), node_name="Ball", geom_name="ball")
    return scene


@pytest.fixture
def tetrahedron():
    """Return vertices and faces of the simplest closed mesh, 1 x 2 x 3 m."""
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3]], dtype=np.float64)
    return vertices, np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
