"""`lidarpool occupancy`: files of Occ3D and SemanticKITTI, campaigns, and errors."""

from __future__ import annotations

import json

import numpy as np
import pytest
from click.testing import CliRunner

from lidarpool.cli.commands import cli
from lidarscenario.occupancy.class_names import occ3d_class
from lidarscenario.occupancy.writing import OccupancySettings, write_occupancy
from lidarsim import LidarError
from lidarsim.simulator.occupancy import VoxelGrid

SCENARIO = """
scene:
  copies:
    - {name: House, box: [3, 4, 2], at: [[8.6, 1.1, 0.3]]}
    - {name: Cloud, box: [1, 1, 1], at: [[5.1, -4.1, 1]]}
    - {name: Thing, box: [1, 1, 1], at: [[3.1, -4.1, 0]]}
sensors:
  roof: {rays_per_revolution: 72, layers: 9, vertical_fov_deg: 30, step_deg: 90, mount: [0, 0, 0.5]}
  side: {rays_per_revolution: 36, layers: 5, vertical_fov_deg: 30, step_deg: 90, mount: [0, 0, 0.5]}
trajectory: {points: [{time_s: 0, position: [0, 0, 0]}, {time_s: 0.3, position: [3, 0, 0]}]}
materials:
  - {objects: House, class: 50}
  - {objects: Cloud, class: 7}
  - {objects: "*"}
classes: {50: building, 7: cloud}
"""


@pytest.fixture(scope="module")
def scenario(tmp_path_factory):
    path = tmp_path_factory.mktemp("occupancy") / "street.yaml"
    path.write_text(SCENARIO)
    return path


@pytest.fixture(scope="module")
def kitti(scenario):
    out = scenario.parent / "kitti"
    options = ["--layout", "semantickitti", "--workers", "1", "--following", "1"]
    outcome = invoke(scenario, out, *options, "--json")
    assert json.loads(outcome.stdout)["shape"] == [256, 256, 32]
    return out / "sequences/00/voxels"


def invoke(scenario, out, *options):
    command = ["occupancy", str(scenario), "--out", str(out), "--backend", "numpy", *options]
    return CliRunner().invoke(cli, command, catch_exceptions=True)


def unpacked(path):
    """Voxels of a file, read bit by bit: index x * 256 * 32 + y * 32 + z, first bit highest."""
    data = path.read_bytes()
    assert len(data) == 256 * 256 * 32 // 8
    x, y, z = np.meshgrid(*map(np.arange, (256, 256, 32)), indexing="ij")
    index = x * 256 * 32 + y * 32 + z
    return (np.frombuffer(data, np.uint8)[index // 8] >> (7 - index % 8) & 1).astype(bool)


def voxel_of(point):
    """Voxel of a point in the sensor frame."""
    return tuple(np.floor((np.array(point) - (0, -25.6, -2)) / 0.2).astype(int))


@pytest.mark.extended
def test_semantickitti_stores_labels_and_bits_in_its_order(kitti):
    label = np.fromfile(kitti / "000000.label", "<u2").reshape(256, 256, 32)
    instance = np.fromfile(kitti / "000000.instance", "<u2").reshape(256, 256, 32)
    # The house is at x 7.1 to 10.1, y -0.9 to 3.1, and z -0.2 to 1.8 in the sensor frame. Its base
    # and its roof lie between two layers of voxels, so both layers are occupied.
    inside = np.zeros_like(label, np.bool_)
    first, last = voxel_of((7.1, -0.9, -0.3)), voxel_of((10.1, 3.1, 1.9))
    inside[tuple(slice(a, b + 1) for a, b in zip(first, last, strict=True))] = True
    np.testing.assert_array_equal(label == 50, inside)
    assert set(np.unique(label)) == {0, 7, 50, 99}  # 99: the thing has no class
    assert (instance[label == 50] == 1).all() and set(np.unique(instance)) == {0, 1, 2, 3}
    hit, occluded, invalid = (
        unpacked(kitti / f"000000.{ending}") for ending in ("bin", "occluded", "invalid")
    )
    assert hit.sum() > 5 and (label[hit] > 0).all() and not occluded[hit].any()
    assert not occluded[voxel_of((6.5, 0.05, 0.05))]  # a ray goes straight forward
    assert occluded[voxel_of((8.5, 0.05, 0.05))]
    assert (occluded | ~invalid).all() and (occluded & ~invalid).sum() > 100
    assert sorted(path.name for path in kitti.parent.parent.parent.iterdir()) == [
        "occupancy.json", "sequences",
    ]  # fmt: skip
    assert len([*kitti.iterdir()]) == 5 * 3


def test_occ3d_stores_semantics_and_masks_in_the_platform_frame(scenario):
    outcome = invoke(scenario, scenario.parent / "occ", "--layout", "occ3d", "--workers", "1")
    assert outcome.exit_code == 0, outcome.output
    assert "Occ3D has no equivalent of these classes" in outcome.output
    assert "3 grids of 200 x 200 x 16 voxels" in outcome.output
    folders = [*(scenario.parent / "occ/gts/scene-0001").iterdir()]
    assert len(folders) == 3 and all(len(folder.name) == 32 for folder in folders)
    by_reach = {}
    for folder in folders:
        with np.load(folder / "labels.npz") as file:
            grids = {name: file[name] for name in file.files}
        assert {name: (grid.dtype.name, grid.shape) for name, grid in grids.items()} == {
            "semantics": ("uint8", (200, 200, 16)), "mask_lidar": ("uint8", (200, 200, 16)),
            "mask_camera": ("uint8", (200, 200, 16)), "instances": ("uint16", (200, 200, 16)),
        }  # fmt: skip
        assert set(np.unique(grids["semantics"])) == {0, 15, 17}
        np.testing.assert_array_equal(grids["mask_lidar"], grids["mask_camera"])
        assert (grids["instances"] == 0)[grids["semantics"] == 17].all()
        by_reach[int(np.argwhere(grids["semantics"] == 15)[:, 0].min())] = grids
    # The house begins at x = 7.1 m, and the platform moves by 1 m between sweeps.
    assert sorted(by_reach) == [int((40 + 7.1 - moved) / 0.4) for moved in (2, 1, 0)]
    columns = by_reach[max(by_reach)]["semantics"] == 15
    assert columns.any(axis=(0, 1)).nonzero()[0].tolist() == list(range(3, 9))  # z 0.3 to 2.3


def test_grids_of_given_extent_of_another_sensor(scenario):
    options = ["--layout", "semantickitti", "--workers", "1", "--sensor", "side"]
    extent = ["--extent=-2,-2,-1,12,2,3", "--voxel-size", "0.5", "--frame", "platform"]
    outcome = invoke(scenario, scenario.parent / "side", *options, *extent)
    assert "3 grids of 28 x 8 x 8 voxels" in outcome.output
    folder = scenario.parent / "side/sequences/01/voxels"
    label = np.fromfile(folder / "000000.label", "<u2").reshape(28, 8, 8)
    assert np.argwhere(label == 50).min(axis=0).tolist() == [18, 2, 2]
    assert (folder / "000000.occluded").stat().st_size == 28 * 8 * 8 // 8
    info = json.loads((scenario.parent / "side/occupancy.json").read_text())
    assert info["frame"] == "platform" and info["voxel_m"] == 0.5


def test_jobs_of_campaigns(scenario):
    campaign = scenario.with_name("campaign.yaml")
    campaign.write_text(
        "base: street.yaml\ncount: 2\nkeep: nuscenes\n"
        "vary: {sensors.roof.mount.position.2: {each: [0.5, 0.6]}}\n"
    )
    options = ["--layout", "occ3d", "--workers", "1"]
    grid = ["--extent=-2,-2,-1,2,2,3", "--voxel-size", "1"]
    outcome = invoke(campaign, scenario.parent / "jobs", *options, *grid)
    assert outcome.exit_code == 0, outcome.output
    scenes = sorted(path.name for path in (scenario.parent / "jobs/gts").iterdir())
    assert len(scenes) == 2 and "6 grids" in outcome.output
    one = invoke(campaign, scenario.parent / "one", *options, *grid, "--job", "1")
    assert [path.name for path in (scenario.parent / "one/gts").iterdir()] == scenes[1:]
    assert "3 grids" in one.output
    missing = invoke(campaign, scenario.parent / "none", *options, "--job", "2")
    assert "Job 2 does not exist" in str(missing.exception)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--layout", "occ3d", "--sensor", "side"], "Occ3D requires the first sensor"),
        (["--layout", "occ3d", "--sensor", "none"], "The sensors of the scenario are roof"),
        (["--layout", "occ3d", "--following", "2"], "only exist in the layout semantickitti"),
        (["--layout", "occ3d", "--voxel-size", "0.3"], "must be a multiple of the voxel size"),
        (["--layout", "occ3d", "--extent", "1,2,3"], "is not an extent"),
        (["--layout", "occ3d", "--extent", "1,1,1,0,0,0"], "the lower corner must come first"),
        (["--layout", "occ3d", "--job", "1"], "can only be used with campaigns"),
        (["--layout", "occ3d", "--workers", "1", "--scheduler", "tcp://h:1"], "cannot be combined"),
    ],
)  # fmt: skip
def test_options_that_do_not_fit(scenario, options, words):
    outcome = invoke(scenario, scenario.parent / "refused", *options)
    assert outcome.exit_code and words in f"{outcome.exception} {outcome.output}"
    assert not (scenario.parent / "refused").exists()


def test_existing_grids_are_kept_unless_they_are_to_be_overwritten(scenario, kitti):
    out = kitti.parent.parent.parent
    options = ["--layout", "semantickitti", "--workers", "1", "--following", "1"]
    before = {path.name: path.read_bytes() for path in kitti.iterdir()}
    outcome = invoke(scenario, out, *options)
    assert "already exists. Use another output with `--out`" in str(outcome.exception)
    assert invoke(scenario, out, *options, "--overwrite").exit_code == 0
    outcome = invoke(scenario, out, "--layout", "occ3d", "--workers", "1")
    assert "describes another grid. Use another folder" in str(outcome.exception)
    assert not (out / "gts").exists()
    assert {path.name: path.read_bytes() for path in kitti.iterdir()} == before


@pytest.mark.parametrize(
    ("layout", "folder", "others"),
    [
        ("semantickitti", "sequences/00/voxels", ["000007.txt", "../../01/voxels/000007.bin"]),
        ("occ3d", "gts/scene-0001", ["notes/labels.npz", "../other/labels.npz"]),
    ],
)
def test_files_of_a_longer_earlier_run_are_removed(tmp_path, layout, folder, others):
    path, out = tmp_path / "street.yaml", tmp_path / "out"
    settings = OccupancySettings(layout, VoxelGrid((-2, -2, -2), (2, 2, 2), 1), backend="numpy")

    def write(duration, target, **options):
        path.write_text(SCENARIO.replace("time_s: 0.3", f"time_s: {duration}"))
        write_occupancy(path, target, settings, workers=1, **options)
        return {file.relative_to(target).as_posix() for file in target.rglob("*") if file.is_file()}

    longer = write(0.6, out)
    kept = [out / folder / name for name in others]
    for file in kept:
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text("of the user")
    shorter = write(0.3, tmp_path / "shorter")
    assert len(shorter) < len(longer)
    names = {file.resolve().relative_to(out.resolve()).as_posix() for file in kept}
    assert write(0.3, out, overwrite=True) == shorter | names
    assert {file.read_text() for file in kept} == {"of the user"}
    assert not [left for left in out.rglob("*") if left.is_dir() and not any(left.iterdir())]


def test_class_names_of_other_data_sets():
    assert [occ3d_class(name) for name in ("car", "Person", "road", "traffic-sign", "sky")] == [
        4, 7, 11, 15, None,
    ]  # fmt: skip


@pytest.mark.extended
@pytest.mark.parametrize("layout", ["occ3d", "semantickitti"])
def test_the_files_do_not_depend_on_the_number_of_workers(tmp_path, layout):
    path = tmp_path / "street.yaml"
    path.write_text(SCENARIO.replace("time_s: 0.3", "time_s: 0.9"))  # nine sweeps in three tasks
    contents = []
    for workers in (1, 2):
        out = tmp_path / f"by-{workers}"
        write_occupancy(path, out, OccupancySettings(layout), workers=workers)
        files = (file for file in sorted(out.rglob("*")) if file.is_file())
        contents.append({file.relative_to(out).as_posix(): file.read_bytes() for file in files})
    assert contents[0] == contents[1] and len(contents[0]) > 9
    with pytest.raises(LidarError, match="already exists"):
        write_occupancy(path, out, OccupancySettings(layout), workers=1)
