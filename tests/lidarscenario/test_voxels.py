"""Voxel files (.vox): grids of leaf area density against Beer and Lambert, and broken files."""

from __future__ import annotations

import math
import tracemalloc
from typing import NamedTuple

import numpy as np
import pytest
from tests.lidarsim.test_vegetation import ALL_ON, AT, GROUND, MANY, cast, rays
from tests.shapes import CPU, Cart, ball, box, cast_between

from lidarscenario.prepare import prepare
from lidarscenario.scenario import Scenario
from lidarscenes.writers.scene_file import write_scene
from lidarsim import (
    Actor,
    Beams,
    LidarError,
    Material,
    Pose,
    Scene,
    SceneInstance,
    SceneMesh,
    Sensor,
    Spin,
    Survey,
)
from lidarsim.media.leaves import mean_projection
from lidarsim.scene.actors import join_meshes
from lidarsim.scene.files.meshfile import load_meshes
from lidarsim.scene.scene_mesh import Voxels
from lidarsim.scene.transform import Transform
from lidarsim.simulator.memory import cast_bytes
from lidarsim.simulator.rig import Rig

NAMES = "i j k PadBVTotal angleMean nbSampling"


def written(path, density, low=(0, 0, 0), size=1.0, skip=(), head="", names=NAMES):
    """Write densities (nx, ny, nz) as a file; voxels of the densities `skip` have no row."""
    density = np.asarray(density, float)
    high = np.array(low) + size * np.array(density.shape)
    lines = [
        "VOXEL SPACE",
        "#min_corner: {} {} {}".format(*low),
        "#max_corner: {} {} {}".format(*high),
        "#split: {} {} {}".format(*density.shape),
        f"#res: {size} {head}",
        names,
    ]
    for (i, j, k), value in np.ndenumerate(density):
        if value not in skip:
            lines.append(f"{i} {j} {k} {float(value)!r} 45.5 12")
    path.write_text("\n".join(lines) + "\n")
    return path


def tree(path, *arguments, report=None, **options):
    """Write a file and read it: its only object."""
    (mesh,) = load_meshes(written(path, *arguments, **options), report=report or pytest.fail)
    return mesh


class Grid(NamedTuple):
    """Voxels of leaves, each a cube."""

    density: np.ndarray  # (nx, ny, nz): leaf area, 1/m
    low: np.ndarray  # (3,): corner with the least coordinates
    size: float  # edge of a voxel, meters


def optical_depth(grid, start, way, kind="spherical", steps=200_000, reach=60.0):
    """Integrate the optical depth along rays (n, 3) by the midpoint rule, from one place."""
    density, low, size = grid
    s = (np.arange(steps) + 0.5) * (reach / steps)
    out = []
    for one in np.atleast_2d(way):
        cell = np.floor((start + s[:, None] * one - low) / size).astype(int)
        there = ((cell >= 0) & (cell < density.shape)).all(axis=1)
        area = density[tuple(cell[there].T)].sum() * reach / steps
        out.append(area * mean_projection(kind, np.abs(one[2:]))[0])
    return np.array(out)


# -- files ---------------------------------------------------------------------------------------


def test_a_file_is_a_box_around_its_leaves(tmp_path):
    density = np.zeros((4, 5, 6))
    density[1:3, 2, 4] = [0.5, 1.25]
    mesh = tree(tmp_path / "beech.vox", density, low=(10, 20, 30), size=0.5, skip=(0,))
    assert mesh.name == "beech"
    assert len(mesh.faces) == 12
    assert mesh.voxels.density.dtype == np.float32
    assert mesh.voxels.density.tolist() == [[[0.5]], [[1.25]]]
    assert mesh.voxels.matrix == pytest.approx(
        np.array([[0.5, 0, 0, 10.5], [0, 0.5, 0, 21], [0, 0, 0.5, 32]])
    )
    assert mesh.bounds == pytest.approx(np.array([[10.5, 21, 32], [11.5, 21.5, 32.5]]), abs=0.011)


def test_variants_of_the_format(tmp_path):
    """Spaces and further fields as in HELIOS++'s files; AMAPVox 2; corners that are half off."""
    first = written(
        tmp_path / "a.vox",
        [[[1, 2]]],
        size=2.0,
        head="#nsubvoxel:8 #lad_type:Planophile #max_pad:5",
    )
    text = first.read_text().replace("#max_corner", "  #max_corner").replace("#split", "\t#split")
    first.write_text(text.replace("\n", "\r\n").replace("i j k", " i j k"))
    told = []
    (one,) = load_meshes(first, report=told.append)
    assert told == [
        f"{first} specifies the leaf angle distribution 'Planophile'. Set the same leaf_angle for "
        "its object."
    ]
    assert one.voxels.density.tolist() == [[[1, 2]]]
    second = written(tmp_path / "b.vox", [[[1, 2]]], size=2.0)
    text = second.read_text().replace(NAMES, "i j k ground_distance pad_transmittance n")
    text = text.replace("#res: 2.0", "#res:2.0 2.0 2.0").replace(": 2.0 2.0 4.0", ": 3.0 2.9 1.0")
    second.write_text(text.replace("45.5", "0.25"))
    (one,) = load_meshes(second)
    assert one.voxels.density.tolist() == [[[0.25, 0.25]]]
    assert one.voxels.matrix[:, :3].tolist() == (2 * np.eye(3)).tolist()


def test_unknown_voxels_are_empty_and_told_of(tmp_path):
    told = []
    mesh = tree(tmp_path / "a.vox", [[[np.nan, 1.0, np.nan, 2.0]]], report=told.append)
    assert mesh.voxels.density.tolist() == [[[1, 0, 2]]]
    assert "contains 2 voxels without data (NaN). Voxels without" in told[0]


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("VOXEL SPACE", "PIXELS", "does not begin with VOXEL SPACE"),
        ("VOXEL SPACE", "VOX \x96", "is a MagicaVoxel model"),
        ("i j k", "x y z", "has no header row that begins with i j k"),
        ("PadBVTotal", "Leaves", "has neither a column PadBVTotal nor exactly"),
        ("#min_corner: 0 0 0", "", "has no header line #min_corner with three numbers"),
        ("#max_corner: 2", "#max_corner: nan", "has no header line #max_corner with three numbers"),
        ("#split: 2 1 2", "#split: 2 1.5 2", "has #split 2 1.5 2, but the values must be integers"),
        ("#split: 2 1 2", "#split: 2 1 8", r"is inconsistent\. Its corners span 2 1 2 voxels"),
        ("#res: 1.0", "#res: 0.0", "has voxels without a positive size"),
        (
            "1 0 1 0.4",
            "1 0 2 0.4",
            "contains the voxel 1 0 2, which is outside the grid with #split 2 1 2",
        ),
        ("1 0 1 0.4", "1 0 -1 0.4", "contains the voxel 1 0 -1, which"),
        ("1 0 1 0.4", "1 0 0 0.4", "contains 1 duplicate row"),
        (
            "1 0 1 0.4",
            "1 0 1 -0.4",
            "has a density of -0.4 m²/m³ in voxel 1 0 1, but densities must be between 0 and 10000",
        ),
        ("1 0 1 0.4", "1 0 1 1e9", r"has a density of 1e\+09 m²/m³ in voxel 1 0 1"),
        ("1 0 1 0.4", "1 0 1 leaf", "line 10 has 'leaf' as PadBVTotal, but a number"),
        ("45.5 12\n1 0 1 0.4", "45.5\n1 0 1", "has 5 of 6 numbers"),
    ],
)
def test_broken_files_are_refused(tmp_path, old, new, says):
    path = written(tmp_path / "a.vox", [[[0.1, 0.2]], [[0.3, 0.4]]])
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new), encoding="latin-1", errors="replace")
    with pytest.raises(LidarError, match=says) as refused:
        load_meshes(path)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("cut", [0, 1, 4, 20, 60, 95, 140])
def test_cut_files_are_refused(tmp_path, cut):
    path = written(tmp_path / "a.vox", np.full((3, 1, 1), 0.5))
    content = path.read_bytes()
    path.write_bytes(content[: len(content) - len(b" 12\n") - cut])
    with pytest.raises(LidarError):
        load_meshes(path)


def test_empty_and_huge_grids_are_refused_in_little_memory(tmp_path):
    with pytest.raises(LidarError, match="contains no voxel with PadBVTotal above 0"):
        tree(tmp_path / "a.vox", np.zeros((2, 2, 2)))
    path = tmp_path / "b.vox"
    path.write_text(
        "VOXEL SPACE\n#min_corner:0 0 0\n#max_corner:10000 10000 10000\n#split:10000 10000 10000\n"
        "#res:1\ni j k PadBVTotal\n0 0 0 1\n9999 9999 9999 1\n"
    )
    tracemalloc.start()
    with pytest.raises(LidarError, match=r"would unpack to at least 3\.64 TiB"):
        load_meshes(path)
    assert tracemalloc.get_traced_memory()[1] < 10e6
    tracemalloc.stop()


# -- light ---------------------------------------------------------------------------------------


@pytest.mark.extended
@pytest.mark.slow(keep=("122.0",))
@pytest.mark.parametrize("nadir_deg", (90.0, 73.0, 122.0))
def test_an_even_grid_is_the_box_with_that_density(tmp_path, nadir_deg):
    """Bit for bit the same leaves, but for the rounding of sums of voxels."""
    grid = tree(tmp_path / "T.vox", np.full((5, 24, 24), 0.3), low=(3, -6, -6), size=0.5)
    wall = ball("Sky", 40.0, fineness=2)
    whole = box("T", (3, -6, -6), (5.5, 6, 6))
    sensor = rays(nadir_deg=nadir_deg)
    kind = {"leaf_angle": "planophile"}
    one = cast([grid, wall], sensor, AT, materials=[Material("T", **kind), GROUND])
    other = cast(
        [whole, wall],
        sensor,
        AT,
        materials=[Material("T", leaf_area_density=0.3, **kind), GROUND],
    )
    assert np.array_equal(one["object"], other["object"])
    assert one["range"] == pytest.approx(other["range"], abs=1e-4)
    assert one["intensity"] == pytest.approx(other["intensity"], rel=1e-4)
    assert 0.01 < (one["object"] == 0).mean() < 0.99


@pytest.mark.parametrize("backend", CPU)
def test_gaps_and_depths_of_layers_follow_beer_and_lambert(tmp_path, backend):
    profile = np.array([0.1, 0.0, 0.8, 0.3, 0.0, 0.5])
    density = np.broadcast_to(profile, (40, 40, 6))
    mesh = tree(tmp_path / "T.vox", density, low=(-20, -20, 0))
    floor = box("Floor", (-99, -99, -2), (99, 99, -1))
    materials = [Material("T", leaf_angle="erectophile"), GROUND]
    sensor = rays(nadir_deg=40.0)
    slant = 1 / math.cos(math.radians(40))
    found = cast([mesh, floor], sensor, (-5, 0.02, 10), backend=backend, materials=materials)
    crossing = mean_projection("erectophile", np.array([1 / slant]))[0] * slant
    assert (found["object"] == 1).mean() == pytest.approx(
        math.exp(-crossing * profile.sum()), rel=0.01
    )
    height = 10 - found["range"][found["object"] == 0] / slant
    above = np.append(np.cumsum(profile[::-1])[::-1], 0)  # leaf area above each layer's floor
    gaps = np.exp(-crossing * above)
    counts, _ = np.histogram(height, np.arange(7))
    assert counts.sum() == len(height)
    expected = np.diff(gaps)
    spread = np.sqrt(expected * (1 - expected) / MANY)
    assert (np.abs(counts / MANY - expected) <= 3 * spread + 1e-12).all()
    assert counts[[1, 4]].tolist() == [0, 0]


@pytest.mark.slow
def test_random_grids_stop_what_the_integral_says(tmp_path):
    """From outside and within, in all directions: the mean gap within three standard deviations."""
    draw = np.random.default_rng(4)
    density = draw.uniform(0, 0.6, (7, 5, 6)) * (draw.random((7, 5, 6)) < 0.5)
    low = np.array([-3.0, -2.0, -1.0])
    size = 0.8
    mesh = tree(tmp_path / "T.vox", density, low=low, size=size, skip=(0,))
    grid = Grid(density, low, size)
    sensor = Sensor(Beams(np.radians(np.linspace(-70, 70, 12))), Spin(25, 360))
    ahead = sensor.directions(np.arange(25)).reshape(-1, 3)
    off = 0.0
    variance = 0.0
    for place in [(-6.0, 0.3, 0.7), (0.31, 0.2, 1.3), (1.0, 0.0, 6.0)]:
        tau = optical_depth(grid, np.array(place), ahead, steps=20_000, reach=20)
        survey = Survey(sensor, poses=[place] * 40, steps=1, materials=[GROUND])
        rig = Rig(Scene.from_meshes([mesh, ball("Sky", 30.0, fineness=2)]), survey, CPU[-1])
        for batch in rig.cast(0, 40):
            assert len(batch.object) == len(ahead)
            off += (batch.object == 1).sum() - np.exp(-tau).sum()
            variance += (np.exp(-tau) * (1 - np.exp(-tau))).sum()
    assert abs(off) < 3 * math.sqrt(variance)


@pytest.mark.extended
def test_turned_scaled_and_mirrored_copies_are_where_they_stand(tmp_path):
    """Densities stay per m³; a grid that is turned by 90° is that of turned numbers."""
    draw = np.random.default_rng(6)
    density = draw.uniform(0, 1, (4, 3, 2))
    mesh = tree(tmp_path / "T.vox", density, low=(0, 0, 0), size=0.5)
    sky = ball("Sky", 40.0, fineness=2)
    sensor = Sensor(Beams(np.radians(np.linspace(-8, 8, 40))), Spin(900, 360))
    around = density.transpose(1, 0, 2)[::-1]
    turned = tree(tmp_path / "U.vox", around, low=(3.5, -0.7, 0), size=0.5)
    quarter = SceneInstance(mesh, Pose((5, -0.7, 0), yaw_deg=90))
    one, other = (cast([m, sky], sensor, (0, 0, 0.5)) for m in (turned, quarter))
    assert np.array_equal(one["object"], other["object"])
    assert one["range"] == pytest.approx(other["range"], abs=1e-4)
    larger = tree(tmp_path / "V.vox", density[:, ::-1], low=(4, -2.7, -1.2), size=1.0)
    matrix = np.diag([2.0, -2, 2, 1])
    matrix[:3, 3] = 4, 0.3, -1.2
    flat = Transform(matrix[:3, :3], matrix[:3, 3])
    scaled = [SceneInstance(mesh, matrix), mesh.affine_transform("T", flat.linear, flat.offset)]
    first, *others = (cast([m, sky], sensor, (0, 0, 0.5)) for m in (larger, *scaled))
    assert (first["object"] == 0).sum() > 500
    for found in others:
        assert np.array_equal(found["object"], first["object"])
        assert found["range"] == pytest.approx(first["range"], abs=1e-4)


@pytest.mark.slow
def test_crowns_and_grids_that_overlap_add_up(tmp_path):
    """Leaves belong to each in proportion; two grids, and a crown of one density."""
    one = tree(tmp_path / "One.vox", np.full((4, 8, 8), 0.2), low=(5, -4, -4))
    two = tree(tmp_path / "Two.vox", np.full((8, 16, 16), 0.6), low=(7, -4, -4), size=0.5)
    ivy = box("Ivy", (7, -4, -4), (9, 4, 4))
    wall = box("Wall", (20, -9, -9), (21, 9, 9))
    materials = [Material("Ivy", leaf_area_density=0.4), GROUND]
    found = cast([one, two, ivy, wall], rays(), AT, materials=materials)
    before = 0.1 * 2
    among = 0.6 * 2
    behind = 0.3 * 2
    stop = math.exp(-before) * (1 - math.exp(-among))
    shares = (found["object"][:, None] == np.arange(4)).mean(axis=0)
    assert shares[0] == pytest.approx(1 - math.exp(-before) + stop / 6, rel=0.03)
    last = math.exp(-before - among) * (1 - math.exp(-behind))
    assert shares[1] == pytest.approx(stop / 2 + last, rel=0.03)
    assert shares[2] == pytest.approx(stop / 3, rel=0.03)
    assert shares[3] == pytest.approx(math.exp(-before - among - behind), rel=0.03)


# -- the same bits -------------------------------------------------------------------------------


STANDS = {"poses": [Pose((0, 0, 1), 10, 5, -3), (4, 0, 1)]}
MOVES = {"trajectory": Cart()}


@pytest.mark.slow
@pytest.mark.slow(keep=("path1",))
@pytest.mark.parametrize("path", (STANDS, MOVES))
def test_batches_blocks_and_backends_leave_no_trace(tmp_path, path, monkeypatch):
    draw = np.random.default_rng(1)
    grids = [
        tree(tmp_path / f"T{n}.vox", draw.uniform(0, 0.7, (6, 7, 5)), low=low, size=0.6)
        for n, low in enumerate([(2, -1, -1), (3, 0, -2), (-4, -2, -1)])
    ]
    copies = [SceneInstance(grids[0], Pose((0.5, 1, 0), yaw_deg=30, roll_deg=8), "T9")]
    meshes = [*grids, *copies, ball("Bush", 1.5, (5, -2, 0.5), 2)]
    meshes += [
        box("Window", (-3, -2, 0), (-2.9, 2, 2)),
        box("Ground", (-30, -30, -3), (30, 30, -2)),
    ]
    materials = [
        Material("Window", transparent="pass", refractive_index=1.5, attenuation_per_m=0.3),
        Material("Bush", 0.5, leaf_area_density=2.0, leaf_angle="erectophile"),
        Material("T*", 0.5, leaf_angle=1.7),
        Material("*", 0.4),
    ]
    sensor = Sensor(Beams(np.radians([-20, -5, 0, 12])), Spin(360, step_deg=30), 0.5, 20)
    survey = Survey(sensor, steps=12, keep_every=2, **{**ALL_ON, "materials": materials}, **path)
    rig = Rig(Scene.from_meshes(meshes), survey, "numpy")
    whole = cast_between(rig, survey, [0, 24])
    assert len(whole[0]["x"]) > 4000
    monkeypatch.setattr("lidarsim.pulses.pulses.CHUNK_RAYS", 1000)
    monkeypatch.setattr("lidarsim.casting.voxels.BLOCK_RAYS", 33)
    assert cast_between(rig, survey, [0, 1, 5, 12, 17, 24]) == whole
    if "tiles" in CPU:
        other = Rig(Scene.from_meshes(meshes), survey, "tiles")
        assert cast_between(other, survey, [0, 24]) == whole


# -- what does not suit them ---------------------------------------------------------------------


@pytest.mark.parametrize(
    "fields",
    [{"leaf_area_density": 1.0}, {"transparent": "pass"}, {"roughness": 0.5}, {"retro": True}],
)
def test_materials_that_do_not_suit_voxels_are_refused(tmp_path, fields):
    mesh = tree(tmp_path / "T.vox", [[[1.0]]])
    with pytest.raises(LidarError, match="'T' contains voxels, whose file defines the leaf area"):
        cast([mesh], rays(1), materials=[Material("*", **fields)])


def test_what_voxels_cannot_do_is_refused(tmp_path):
    mesh = tree(tmp_path / "T.vox", [[[1.0]]])
    with pytest.raises(LidarError, match="'T' contains voxels, which cannot move"):
        Actor(mesh)
    with pytest.raises(LidarError, match="'X' contains voxels and cannot be joined"):
        join_meshes("X", [mesh, mesh])
    assert join_meshes("X", [mesh]).voxels is not None
    with pytest.raises(LidarError, match="'T' consists of voxels, which cannot be written"):
        write_scene(tmp_path / "out.glb", Scene.from_meshes([mesh]))
    for density, matrix in [
        (np.zeros((1, 1, 1)), np.eye(3, 4)),
        (np.full((1, 1, 1), np.nan, np.float32), np.eye(3, 4)),
        (np.ones((1, 1, 1), np.float32), np.zeros((3, 4))),
        *[(np.zeros(np.roll((10_001, 1, 1), axis), np.float32), np.eye(3, 4)) for axis in range(3)],
    ]:
        with pytest.raises(LidarError, match=r"voxels of 'T' must be float32"):
            SceneMesh("T", mesh.vertices, mesh.faces, voxels=Voxels(density, matrix))
    most = Voxels(np.zeros((1, 10_000, 1), np.float32), np.eye(3, 4))
    assert SceneMesh("T", mesh.vertices, mesh.faces, voxels=most).voxels is most


def test_a_scenario_names_them_as_files_and_copies(tmp_path):
    written(tmp_path / "oak.vox", np.full((2, 2, 3), 0.8), low=(-1, -1, 1))
    path = tmp_path / "scenario.yaml"
    path.write_text(
        """
scene:
  files: [{file: oak.vox, translation: [5, 0, 0]}]
  copies: [{name: Oak, file: oak.vox, at: [{position: [9, 1, 0], yaw_deg: 30}]}]
  ground: {}
materials:
  - {objects: ["oak", "Oak*"], spectrum: "leaf, green", leaf_angle: planophile}
  - {objects: "*", reflectance: 0.3}
planning: {enabled: false}
"""
    )
    scenario = Scenario.load(path)
    built = prepare(scenario)
    scene = built.scene
    assert dict(zip(scene.names, scene.has_voxels.tolist(), strict=True)) == {
        "oak": True, "Oak": True, "Ground": False
    }  # fmt: skip
    assert scene.object_bounds[0] == pytest.approx(np.array([[4, -1, 1], [6, 1, 4]]), abs=0.021)
    (line,) = built.findings.sources.values()
    assert "2 x 2 x 3 voxels" in line
    job = prepare(scenario).job
    plain = Scene.from_meshes([box("Ground", (0, 0, 0), (1, 1, 1))])
    assert cast_bytes(job.scene, job.survey) > cast_bytes(plain, job.survey)
