"""Recordings that several modules augment."""

from __future__ import annotations

import pytest
from tests.drives import points_of, the_scene, the_sweeps

from lidarfiles.clouds.writing import ExportSpec


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """Return a function that writes a drive, once for each format and its options."""
    scene = the_scene()
    sweeps = the_sweeps(scene)
    cloud = points_of(scene, 0)
    paths = {}

    def write(name, **options):
        key = name, *options.items()
        if key not in paths:
            paths[key] = tmp_path_factory.mktemp("drive") / ExportSpec(name).row.file
            ExportSpec(name, **options).write(paths[key], cloud, sweeps)
        return paths[key]

    return write
