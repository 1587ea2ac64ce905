"""Clouds in other formats, by scenarios and by the command."""

import errno
import json
import os

import laspy
import numpy as np
import pytest
from rosbags.highlevel import AnyReader

from lidarfiles.clouds import multi_file_format
from lidarfiles.clouds.folder import result_folder
from lidarfiles.clouds.writing import ExportSpec
from lidarpool import Cloud, Scene, Survey, read_cloud, save_cloud
from lidarsim.io.storage import Storage
from lidarsim.sweeps.sweeps import Sweeps

SCENARIO = """
trajectory: {points: [{time_s: 0, position: [0, 0, 1]}, {time_s: 0.3, position: [3, 0, 1]}]}
sensors:
  front: {model: velodyne/vlp16, mount: {position: [1, 0, 0]}}
  rear: {model: velodyne/vlp16}
cloud: {columns: [intensity], keep_every: 7}
output: {write: [ply, laz, {format: mcap, layout: ouster}, kitti]}
scene: seed
"""


def test_a_run_writes_what_its_scenario_asks_for_and_a_result_is_exported(
    cluster, lidarpool, tmp_path
):
    (tmp_path / "s.yaml").write_text(SCENARIO)
    out = tmp_path / "out"
    run = ("run", tmp_path / "s.yaml", "--out", out, "--scheduler", cluster, "--cloud-only")
    done = lidarpool(*run, "-q")
    assert done.code == 0, done.err
    made = {"cloud.ply", "sweeps.npz", "cloud.laz", "cloud.mcap", "kitti", "report.json"}
    assert {path.name for path in out.iterdir()} == made
    report = json.loads((out / "report.json").read_text())
    assert {*report["files"]} == made
    left = [note for note in report["notes"] if note.startswith(("MCAP", "KITTI"))]
    assert left == [  # of the columns that were asked for, none that another format needs
        "MCAP cannot store object",
        "MCAP stores signal and reflectivity instead of intensity",
        "MCAP can store class only if classes have names. Set `classes: {1: ground, …}`; see "
        "docs/how-to/labels.md",
        "KITTI cannot store channel",
        "KITTI stores reflectivity instead of intensity",
    ]
    assert all(note in done.out for note in left)
    assert report["stages"]["export"]["items"] == 6  # sweeps, written by workers
    assert report["tasks"]["LIDAR"]["export"] == 1 and report["placement_violations"] == 0
    cloud = read_cloud(out / "cloud.ply")
    assert {"intensity", "time", "range", "class", "reflectivity"} <= set(cloud.columns)
    assert "survey's sweeps" in cloud.sweeps.__doc__
    assert [*cloud.sweeps().sensors] == ["front", "rear"]
    laz = laspy.read(out / "cloud.laz")
    np.testing.assert_allclose(laz.xyz, cloud.positions, atol=1e-5)
    np.testing.assert_allclose(laz.gps_time, cloud.time / 1e9)
    np.testing.assert_array_equal(laz.return_number, cloud.return_number)
    assert len(list((out / "kitti/sequences/01/velodyne").iterdir())) == 3  # turns of 0.1 s

    before = laspy.read(out / "cloud.laz")
    full_scale = report["intensity_full_scale"]["laz"]
    stored = np.minimum(before["energy"] / full_scale, 1) * 65_535
    np.testing.assert_allclose(before.intensity, stored, atol=0.51)
    assert np.quantile(before.intensity, 0.99) > 32_767, "the scale is no larger than needed"
    refused = lidarpool("export", out, "-f", "mcap", "--layout", "images", "--out", tmp_path / "no")
    assert (
        refused.code == 2
        and "layout images requires the column ray, which" in refused.err
        and "with `output: {write: [{format: mcap, layout: images}]}`, or add" in refused.err
    )
    assert not (tmp_path / "no").exists()
    mixed = ("export", out, "-f", "pcd", "-f", "kitti", "--compensated", "--out", tmp_path / "mix")
    mixed = lidarpool(*mixed)
    assert mixed.code == 0 and "note: PCD cannot store time" in mixed.err
    columns = "channel, time, range, return_number, returns"
    assert f"note: KITTI cannot store {columns}\n" in mixed.err
    assert b"start of the sweep" in (tmp_path / "mix/pcd/000000.pcd").read_bytes()[:100]
    scaled = ("export", out, "-f", "pcd", "-f", "las", "--intensity-full-scale", "100")
    assert lidarpool(*scaled, "--out", tmp_path / "scaled").code == 0
    faint = laspy.read(tmp_path / "scaled/cloud.las").intensity
    np.testing.assert_allclose(faint, before["energy"] / 100 * 65_535, atol=0.51)
    refused = lidarpool("export", out, "-f", "kitti", "--compensated", "--out", tmp_path / "no")
    assert refused.code == 2 and "kitti does not support `compensated`" in refused.err
    (out / ".lidarpool-writing-01234567").mkdir()  # of an export that was killed
    refused = lidarpool("export", out, "-f", "pcd", "-f", "laz")
    assert refused.code == 2 and "cloud.laz already exists" in refused.err
    assert not (out / "pcd").exists()
    done = lidarpool("export", out, "-f", "pcd", "-f", "laz", "--overwrite")
    assert (done.code, done.out) == (0, f"{out}/pcd\n{out}/cloud.laz\n")
    assert f"note: LAZ stores the intensity {full_scale:g} as 65,535" in done.err
    again = laspy.read(out / "cloud.laz")
    for name in before.point_format.dimension_names:
        np.testing.assert_array_equal(again[name], before[name])
    assert not (out / ".lidarpool-writing-01234567").exists()
    with result_folder(out):
        refused = lidarpool("export", out, "-f", "las")
    assert refused.code == 2 and "Another run or export is using the folder" in refused.err
    elsewhere = lidarpool("export", out, "-f", "nuscenes", "--out", tmp_path / "other")
    assert elsewhere.code == 0 and "nuScenes cannot store" in elsewhere.err
    assert len(list((tmp_path / "other/nuscenes/samples/rear").iterdir())) == 3

    # What the earlier run left would pass for this one's; an export is in no report, and stays.
    (tmp_path / "s.yaml").write_text(SCENARIO.replace("laz, ", ""))
    assert lidarpool(*run, "-q", "--overwrite").code == 0
    assert {path.name for path in out.iterdir()} == (made | {"pcd"}) - {"cloud.laz"}


@pytest.mark.slow
def test_instruments_have_files_and_topics_of_the_same_numbers(cluster, lidarpool, tmp_path):
    out = tmp_path / "out"
    scenario = tmp_path / "s.yaml"
    text = SCENARIO.replace("[ply, laz, {format: mcap, layout: ouster}, kitti]", "[mcap]")
    navigation = "navigation: {imu: {gyroscope_bias: 1.0e-3}, gnss: {horizontal_m: 0.1}}\n"
    scenario.write_text(text + navigation)
    run = ("run", scenario, "--out", out, "--scheduler", cluster, "--cloud-only", "-q")
    done = lidarpool(*run)
    assert done.code == 0, done.err
    measured = {"imu.csv", "gnss.csv"}
    assert measured < {*json.loads((out / "report.json").read_text())["files"]}
    assert len((out / "imu.csv").read_text().splitlines()) == 60  # after the header
    assert lidarpool("export", out, "-f", "mcap", "--out", tmp_path / "again").code == 0
    first, again = (_messages(folder / "cloud.mcap") for folder in (out, tmp_path / "again"))
    assert first == again
    assert first["/imu/data_raw"] == 59 and first["/gnss/position"] == 3
    # Without them, their files go with the result that had them.
    (tmp_path / "again" / "imu.csv").write_text("of a user")
    scenario.write_text(text)
    assert f"{out} contains the result of a different survey" in lidarpool(*run).err
    assert (
        f"note: {out} contains the result of a different survey ("
        in lidarpool("check", *run[1:4]).out
    )
    assert lidarpool(*run, "--overwrite").code == 0
    assert not measured & {path.name for path in out.iterdir()}
    other = tmp_path / "again"
    assert lidarpool(*run[:3], other, *run[4:], "--overwrite").code == 0
    assert (other / "imu.csv").read_text() == "of a user"
    scenario.write_text(text + navigation)
    refused = lidarpool(*run[:3], other, *run[4:])
    assert refused.code == 2
    assert f"{other} contains the result of a different survey" in refused.err


def _messages(path):
    with AnyReader([path]) as bag:
        return {topic: found.msgcount for topic, found in bag.topics.items()}


def test_what_is_no_result_or_has_been_cut_is_one_line(lidarpool, tmp_path):
    told = lidarpool("export", tmp_path, "-f", "laz")
    assert (
        told.code == 2
        and "does not contain cloud.ply. Pass the output folder of a finished run" in told.err
    )
    for command in (("export", "-f", "laz"), ("plot",), ("merge", "--out", tmp_path / "all")):
        told = lidarpool(*command, tmp_path / "nowhere")
        assert told.code == 2 and "nowhere does not exist" in told.err
    for name in ("cloud.ply", "report.json"):
        (tmp_path / name).touch()
    (tmp_path / "sweeps.npz").write_bytes(b"PK")
    told = lidarpool("export", tmp_path, "-f", "laz")
    assert told.code == 2 and "sweeps.npz is damaged" in told.err
    told = lidarpool("export", tmp_path)
    assert told.code == 2 and "Choose from: las, laz, parquet," in told.err.split("\n")[0]


def test_an_interrupt_says_which_formats_are_written(lidarpool, tmp_path, monkeypatch):
    scene = Scene.seed()
    survey = Survey(poses=[(0, 0, 1)], columns=["intensity"])
    Sweeps.from_survey(survey, scene).save(tmp_path / "sweeps.npz")
    columns = {name: np.zeros(3) for name in ("scan", "channel", "object", "intensity")}
    save_cloud(Cloud(np.zeros((3, 3)), columns), tmp_path / "cloud.ply")
    (tmp_path / "report.json").write_text("{}")
    write = ExportSpec.write

    def interrupted(one, *given, **more):
        if one.format == "nuscenes":
            raise KeyboardInterrupt
        write(one, *given, **more)

    monkeypatch.setattr(ExportSpec, "write", interrupted)
    told = lidarpool("export", tmp_path, "-f", "las", "-f", "nuscenes")
    assert told.code == 130
    assert (
        f"All processes were stopped. These files have already been written: {tmp_path}/cloud.las."
        in told.err
    )


def many_files(lidarpool, tmp_path, address):
    """Run a survey that exports to KITTI, with a range for each sweep."""
    (tmp_path / "s.yaml").write_text(SCENARIO.replace("laz, {format: mcap, layout: ouster}, ", ""))
    run = ("run", tmp_path / "s.yaml", "--out", tmp_path / "out", "--cloud-only", "-q")
    return lambda *more: lidarpool(*run, "--scheduler", address, *more)


@pytest.mark.slow
def test_a_worker_that_cannot_write_is_one_line_and_nothing_is_lost(
    cluster, lidarpool, tmp_path, monkeypatch
):
    def full(storage, name, data):
        if name.endswith("4.bin"):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        write(storage, name, data)

    monkeypatch.setattr(multi_file_format, "RANGE_PIECES", 1)
    run = many_files(lidarpool, tmp_path, cluster)
    write = Storage.write
    out = tmp_path / "out"
    (tmp_path / "s.yaml").write_text((tmp_path / "s.yaml").read_text().replace("0.3", "0.5"))
    with monkeypatch.context() as patch:
        patch.setattr(Storage, "write", full)
        failed = run()
    assert failed.code == 2 and failed.err.count("\n") == 1
    assert f"Writing {out}/kitti failed: The worker" in failed.err
    assert "cannot write the output: No space left on device. " in failed.err
    assert "are stored in" in failed.err
    assert {path.name for path in out.iterdir()} == {"run"}
    assert run("--resume").code == 0
    assert len(list((out / "kitti").rglob("*.bin"))) == 10
    assert not list(out.rglob(".*"))


# Ends its worker at its first file of points, and never again.
DIES = """
import os, pathlib, signal
from lidarsim.io.storage import Storage
armed = pathlib.Path(os.environ["ARMED"])
def write_and_die(storage, name, data, write=Storage.write):  # a preload may run twice
    write(storage, name, data)
    if name.endswith(".bin") and armed.exists():
        armed.unlink()
        os.kill(os.getpid(), signal.SIGKILL)
Storage.write = write_and_die
"""


@pytest.mark.slow
def test_another_worker_writes_the_range_of_one_that_dies(
    cluster, outside, lidarpool, tmp_path, monkeypatch
):
    monkeypatch.setattr(multi_file_format, "RANGE_PIECES", 1)
    armed = tmp_path / "armed"
    armed.touch()
    own = outside()
    own.add(("GPU", 1))
    for _ in range(2):
        own.add(("LIDAR", 4), preload=DIES, ARMED=str(armed))
    own.wait()
    done = many_files(lidarpool, tmp_path, own.address)()
    assert (done.code, done.err, armed.exists()) == (0, "", False)
    report = json.loads((tmp_path / "out/report.json").read_text())
    assert report["stages"]["export"]["items"] == 6
    assert len(report["stages"]["export"]["workers"]) in (1, 2)
    written = tmp_path / "out/kitti"
    files = {path.relative_to(written): path.read_bytes() for path in written.rglob("*.*")}
    (tmp_path / "out").rename(tmp_path / "first")
    assert many_files(lidarpool, tmp_path, cluster)().code == 0
    again = {path.relative_to(written): path.read_bytes() for path in written.rglob("*.*")}
    assert files == again
