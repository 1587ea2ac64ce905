"""Augmentations in worker processes: same bytes, resuming, and refused inputs."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from distributed import Client
from tests.recorded_drives import recorded_points, write_pcd_drive

import poolpart.deploy
from lidarfiles import open_recording
from lidarfiles.clouds.recording_ref import RecordingRef
from lidarfiles.work.work import FOLDER, Work
from lidarreal.augmentation.effects import Effects, Insertion
from lidarreal.augmentation.running import WORK_SUFFIX, Augmentation
from lidarreal.augmentation.sweep_tasks import unchanged_sweep
from lidarreal.augmentation.variants import CampaignVariants, Variants
from lidarsim import LidarError, box, load_sensor
from lidarsim.io.storage import Storage

SWEEPS = 8
RAIN = {"weather": {"rain_mm_h": 50, "visibility_km": 0.2}}
CAMPAIGN = """\
base: effects.yaml
count: 3
seed: 5
vary:
  weather.visibility_km: {log_uniform: [0.1, 1]}
  weather.rain_mm_h: {each: [0, 10, 50]}
splits: {train: 0.5, val: 0.5}
"""
# Augments until it is killed, in another process.
SLOW = """\
import sys, time
from pathlib import Path
from lidarreal.augmentation import running
from lidarreal.augmentation.effects import Effects
from lidarreal.augmentation.running import Augmentation
from lidarfiles.clouds.recording_ref import RecordingRef
from lidarreal.augmentation.variants import Variants

def pause(done, total):
    print(done, flush=True)
    time.sleep(0.2)

effects = Effects.load(options={"weather": {"rain_mm_h": 50, "visibility_km": 0.2}})
augmentation = Augmentation(RecordingRef(Path(sys.argv[1])), Variants(effects))
augmentation.run(Path(sys.argv[2]), workers=1, progress=pause)
"""


@pytest.fixture(scope="module")
def points():
    return recorded_points(SWEEPS)


@pytest.fixture
def drive(points, tmp_path):
    return write_pcd_drive(tmp_path / "drive", points)


@pytest.fixture
def augmentation(drive):
    return Augmentation(RecordingRef(drive), Variants(Effects.load(options=RAIN)))


def content(folder):
    """Return the contents of all files in a folder."""
    paths = sorted(path for path in folder.rglob("*") if path.is_file())
    return {str(path.relative_to(folder)): path.read_bytes() for path in paths}


def work_folder(out):
    """Return the folder with the encoded sweeps of an output."""
    return out.with_name(f"{out.name}{WORK_SUFFIX}")


def stop_after(count):
    """Return a progress function that raises KeyboardInterrupt after some sweeps."""

    def progress(done, total):
        if done >= count:
            raise KeyboardInterrupt

    return progress


@pytest.mark.extended
def test_bytes_do_not_depend_on_the_number_of_processes(augmentation, tmp_path):
    alone = augmentation.run(tmp_path / "alone", workers=1)
    together = augmentation.run(tmp_path / "together", workers=3)
    assert content(tmp_path / "alone") == content(tmp_path / "together")
    assert alone.counts == together.counts
    assert alone.sweeps == SWEEPS
    assert alone.counts.added["air"] > 1000
    assert not [*tmp_path.glob("*.augment")]


def test_points_are_counted(augmentation, drive, tmp_path):
    augmented = augmentation.run(tmp_path / "wet", workers=1)
    recorded = open_recording(drive)
    wet = open_recording(tmp_path / "wet")
    assert augmented.counts.returns == sum(len(sweep) for sweep in recorded)
    assert augmented.counts.points == sum(len(sweep) for sweep in wet)
    assert augmented.counts.kept < augmented.counts.returns
    assert "8 sweeps augmented" in repr(augmented)
    assert json.dumps(augmented.figures, allow_nan=False)


def test_progress_is_reported(augmentation, tmp_path):
    steps = []
    augmentation.run(tmp_path / "wet", workers=1, progress=lambda *step: steps.append(step))
    assert steps[0] == (0, SWEEPS)
    assert steps[-1] == (SWEEPS, SWEEPS)
    assert steps == sorted(steps)


def test_an_interrupted_run_continues_with_the_same_bytes(augmentation, tmp_path):
    augmentation.run(tmp_path / "expected", workers=1)
    out = tmp_path / "wet"
    with pytest.raises(KeyboardInterrupt) as stopped:
        augmentation.run(out, workers=1, progress=stop_after(5))
    assert "Continue with `--resume`" in stopped.value.__notes__[0]
    assert not out.exists()
    steps = []
    resumed = augmentation.run(
        out, workers=1, resume=True, progress=lambda *step: steps.append(step)
    )
    assert steps[0] == (5, SWEEPS)
    assert content(out) == content(tmp_path / "expected")
    assert resumed.sweeps == SWEEPS
    assert not work_folder(out).exists()


@pytest.mark.extended
@pytest.mark.parametrize("sweeps", [1, 4])
def test_a_killed_process_is_resumed(augmentation, drive, tmp_path, sweeps):
    augmentation.run(tmp_path / "expected", workers=1)
    out = tmp_path / "wet"
    arguments = [sys.executable, "-c", SLOW, str(drive), str(out)]
    with subprocess.Popen(arguments, stdout=subprocess.PIPE, text=True) as process:
        for line in process.stdout:
            if int(line) >= sweeps:
                os.kill(process.pid, signal.SIGKILL)
                break
    assert process.returncode == -signal.SIGKILL
    with pytest.raises(LidarError, match=r"unfinished augmentation\. Continue it with `--resume`"):
        augmentation.run(out, workers=1)
    steps = []
    augmentation.run(out, workers=1, resume=True, progress=lambda *step: steps.append(step))
    assert sweeps <= steps[0][0] < SWEEPS
    assert content(out) == content(tmp_path / "expected")


@pytest.mark.extended
def test_a_partly_written_output_is_written_again(augmentation, tmp_path, monkeypatch):
    augmentation.run(tmp_path / "expected", workers=1)
    out = tmp_path / "wet"

    def stop(*arguments):
        raise KeyboardInterrupt

    monkeypatch.setattr(Work, "forget", stop)
    with pytest.raises(KeyboardInterrupt):  # after the output was moved into place
        augmentation.run(out, workers=1)
    monkeypatch.undo()
    assert out.exists()
    augmentation.run(out, workers=1, resume=True)
    assert content(out) == content(tmp_path / "expected")


def test_nothing_is_left_if_nothing_was_augmented(augmentation, drive, tmp_path):
    with pytest.raises(KeyboardInterrupt) as stopped:
        augmentation.run(tmp_path / "wet", workers=1, progress=stop_after(0))
    assert not getattr(stopped.value, "__notes__", [])
    assert [*tmp_path.iterdir()] == [drive]


@pytest.mark.extended
def test_workers_without_the_work_folder_return_files(augmentation, tmp_path, monkeypatch):
    augmentation.run(tmp_path / "expected", workers=1)
    monkeypatch.setattr(Storage, "has_content", lambda *arguments: False)
    augmentation.run(tmp_path / "wet", workers=1)
    assert content(tmp_path / "wet") == content(tmp_path / "expected")


@pytest.mark.extended
def test_a_cluster_augments_sweeps(augmentation, tmp_path):
    augmentation.run(tmp_path / "expected", workers=1)
    with (
        poolpart.deploy.local_cluster({"OTHER": (2, 1)}, dashboard_port=None) as cluster,
        Client(cluster, set_as_default=False) as client,
    ):
        augmentation.run(tmp_path / "wet", client=client)
    assert content(tmp_path / "wet") == content(tmp_path / "expected")


@pytest.mark.extended(every=3)
@pytest.mark.parametrize(
    ("change", "noun"),
    [
        (lambda a: replace(a, variants=Variants(Effects.load(options={"weather": {}}))), "effects"),
        (
            lambda a: replace(a, variants=Variants(replace(Effects.load(options=RAIN), seed=1))),
            "effects",
        ),
        (lambda a: replace(a, model=load_sensor("velodyne/vlp16")), "model"),
        (lambda a: replace(a, resampled=load_sensor("velodyne/vlp16")), "sensor"),
        (lambda a: replace(a, numbers=range(3)), "options"),
        (lambda a: replace(a, file=replace(a.file, intensity="ring")), "options"),
        (None, "recording"),
    ],
)
def test_changed_inputs_are_refused(augmentation, drive, tmp_path, change, noun):
    out = tmp_path / "wet"
    with pytest.raises(KeyboardInterrupt):
        augmentation.run(out, workers=1, progress=stop_after(2))
    if change is None:
        os.utime(drive / "000003.pcd", (1, 1))
    else:
        augmentation = change(augmentation)
    with pytest.raises(LidarError, match=rf"different inputs \({noun}\)"):
        augmentation.run(out, workers=1, resume=True)
    assert len([*work_folder(out).rglob("encode/*/*/*/item.json")]) == 2


def test_other_software_is_refused(augmentation, tmp_path, monkeypatch):
    out = tmp_path / "wet"
    with pytest.raises(KeyboardInterrupt):
        augmentation.run(out, workers=1, progress=stop_after(2))
    other = {"lidarpool": "0.0 (sources 1)"}
    monkeypatch.setattr("lidarfiles.work.work.software", lambda: other)
    with pytest.raises(LidarError, match=r"different inputs \(version of lidarpool\)"):
        augmentation.run(out, workers=1, resume=True)


@pytest.mark.extended
def test_damaged_manifests_are_reported(augmentation, tmp_path):
    out = tmp_path / "wet"
    with pytest.raises(KeyboardInterrupt):
        augmentation.run(out, workers=1, progress=stop_after(2))
    (work_folder(out) / FOLDER / "manifest.json").write_text("{")
    with pytest.raises(LidarError, match=r"is damaged\. Remove .* with `--restart`"):
        augmentation.run(out, workers=1, resume=True)
    augmentation.run(out, workers=1, restart=True)
    assert out.exists()


def test_a_recording_that_changes_is_noticed(augmentation, drive, tmp_path):
    def change(done, total):
        if done == total:
            os.utime(drive / "000003.pcd", (1, 1))

    with pytest.raises(LidarError, match="drive has changed since the augmentation"):
        augmentation.run(tmp_path / "wet", workers=1, progress=change)
    assert not (tmp_path / "wet").exists()


@pytest.mark.extended
def test_outputs_are_only_replaced_on_request(augmentation, tmp_path):
    out = tmp_path / "wet"
    augmentation.run(out, workers=1)
    before = content(out)
    with pytest.raises(LidarError, match=r"already exists\. .* pass `--overwrite`"):
        augmentation.run(out, workers=1)
    other = replace(augmentation, variants=Variants(replace(Effects.load(options=RAIN), seed=1)))
    with pytest.raises(KeyboardInterrupt):
        other.run(out, workers=1, overwrite=True, progress=stop_after(5))
    assert content(out) == before
    other.run(out, workers=1, resume=True)
    assert content(out) != before


@pytest.mark.parametrize("name", ["drive", "drive/wet", "."])
def test_recordings_are_not_overwritten(augmentation, drive, name):
    before = content(drive)
    with pytest.raises(LidarError):
        augmentation.run(drive.parent / name, workers=1, overwrite=True)
    assert content(drive) == before


def test_folders_with_other_files_are_kept(augmentation, tmp_path):
    folder = work_folder(tmp_path / "wet")
    folder.mkdir()
    (folder / "notes.txt").write_text("mine")
    augmentation.run(tmp_path / "wet", workers=1, overwrite=True)
    assert content(folder) == {"notes.txt": b"mine"}


def test_other_sweeps_are_unchanged(augmentation, drive, tmp_path):
    some = replace(augmentation, numbers=range(2, 4))
    augmented = some.run(tmp_path / "wet", workers=1)
    assert augmented.sweeps == 2
    recorded = open_recording(drive)
    assert augmented.counts.returns == len(recorded[2]) + len(recorded[3])
    before = content(drive)
    after = content(tmp_path / "wet")
    changed = [name for name, data in before.items() if after[name] != data]
    assert changed == ["000002.pcd", "000003.pcd"]
    everything = content(tmp_path / "wet")
    augmentation.run(tmp_path / "all", workers=1)
    assert everything["000002.pcd"] == content(tmp_path / "all")["000002.pcd"]


def test_sweeps_that_do_not_exist_are_refused(augmentation, tmp_path):
    with pytest.raises(LidarError, match=r"has 8 sweeps, so `--sweeps` must start before 8"):
        replace(augmentation, numbers=range(8, 20)).run(tmp_path / "wet", workers=1)


def test_unchanged_sweeps_have_the_cause_of_surfaces(drive):
    sweep = open_recording(drive)[0]
    unchanged = unchanged_sweep(sweep)
    assert np.array_equal(unchanged.sweep.points, sweep.points)
    assert not unchanged.sweep.columns["cause"].any()
    assert unchanged.is_recorded.all()


def test_a_single_file_keeps_its_name(points, tmp_path):
    (path,) = write_pcd_drive(tmp_path / "drive", points[:1]).iterdir()
    variants = Variants(Effects.load(options=RAIN))
    into = Augmentation(RecordingRef(path), variants).run(tmp_path / "wet", workers=1)
    assert into.outputs == (tmp_path / "wet" / path.name,)
    other = Augmentation(RecordingRef(path), variants).run(tmp_path / "wet.pcd", workers=1)
    assert other.outputs == (tmp_path / "wet.pcd",)
    assert into.outputs[0].read_bytes() == other.outputs[0].read_bytes()


@pytest.mark.extended
def test_recordings_are_resampled_and_augmented(augmentation, drive, tmp_path):
    vlp16 = load_sensor("velodyne/vlp16")
    clear = replace(augmentation, variants=Variants(Effects()), resampled=vlp16)
    resampled = clear.run(tmp_path / "clear", workers=1)
    assert resampled.counts.added == {}
    assert resampled.counts.kept > 0.9 * resampled.counts.returns
    wet = replace(augmentation, resampled=vlp16).run(tmp_path / "wet", workers=1)
    assert wet.counts.added["air"] > 1000
    for number, sweep in enumerate(open_recording(tmp_path / "clear")):
        recorded = {tuple(row) for row in open_recording(drive)[number].points.tolist()}
        assert {tuple(row) for row in sweep.points.tolist()} <= recorded
    with pytest.raises(LidarError, match="`--sweeps` and `--sensor` cannot be combined"):
        replace(clear, numbers=range(2))


def test_objects_are_inserted(augmentation, tmp_path):
    crate = Insertion(box("crate", (1, 1, 1)), 6, -3)
    effects = Variants(Effects(insertions=(crate,)))
    inserted = replace(augmentation, variants=effects).run(tmp_path / "crate", workers=1)
    assert inserted.counts.added["surface"] > 50
    assert inserted.counts.kept < inserted.counts.returns


def write_kitti(folder, sweeps, sequences=("00", "01")):
    """Write each sweep to both sequences of a KITTI data set."""
    for name in sequences:
        (folder / "sequences" / name / "velodyne").mkdir(parents=True)
        for number, rows in enumerate(sweeps):
            names = ("x", "y", "z", "intensity")
            values = np.column_stack([rows[column] for column in names]).astype("<f4")
            values[:, 3] /= 255
            path = folder / "sequences" / name / "velodyne" / f"{number:06}.bin"
            path.write_bytes(values.tobytes())
    return folder


@pytest.fixture
def kitti(points, tmp_path):
    return write_kitti(tmp_path / "kitti", points[:2])


@pytest.mark.extended
def test_all_sequences_of_a_data_set_are_augmented(kitti, tmp_path):
    everything = Augmentation(RecordingRef(kitti), Variants(Effects.load(options=RAIN)))
    augmented = everything.run(tmp_path / "all", workers=1)
    assert augmented.sweeps == 4
    assert any(note.startswith("00: ") for note in augmented.notes)
    assert any(note.startswith("01: ") for note in augmented.notes)
    files = content(tmp_path / "all")
    before = content(kitti)
    names = [
        f"sequences/{name}/velodyne/{number:06}.bin" for name in ("00", "01") for number in (0, 1)
    ]
    assert all(files[name] != before[name] for name in names)
    assert files[names[0]] != files[names[2]]  # sequences have different random numbers
    everything.run(tmp_path / "together", workers=3)
    assert content(tmp_path / "together") == files
    with pytest.raises(KeyboardInterrupt):
        everything.run(tmp_path / "resumed", workers=1, progress=stop_after(3))
    everything.run(tmp_path / "resumed", workers=1, resume=True)
    assert content(tmp_path / "resumed") == files
    one = replace(everything, file=replace(everything.file, sensor="01"))
    augmented = one.run(tmp_path / "one", workers=1)
    assert augmented.sweeps == 2
    after = content(tmp_path / "one")
    assert [after[name] == before[name] for name in names] == [True, True, False, False]
    assert [after[name] == files[name] for name in names[2:]] == [True, True]


def test_messages_name_one_of_several_sensors(kitti, tmp_path):
    for path in kitti.glob("sequences/01/velodyne/*.bin"):
        path.write_bytes(b"")
    several = Augmentation(RecordingRef(kitti), Variants(Effects.load(options=RAIN)))
    with pytest.raises(LidarError) as refused:
        several.run(tmp_path / "wet", workers=1)
    assert "01" in str(refused.value)
    assert not (tmp_path / "wet").exists()


def test_insertions_into_several_sequences(kitti, tmp_path):
    crate = Variants(Effects(insertions=(Insertion(box("crate", (1, 1, 1)), 6, -3),)))
    augmented = Augmentation(RecordingRef(kitti), crate).run(tmp_path / "crate", workers=1)
    assert augmented.counts.added["surface"] > 50


def test_one_of_several_sensors_is_converted(kitti, tmp_path):
    augmentation = Augmentation(
        RecordingRef(kitti), Variants(Effects.load(options=RAIN)), output_format="pcd"
    )
    with pytest.raises(LidarError, match="Choose it with `--topic`"):
        augmentation.run(tmp_path / "wet", workers=1)
    assert not (tmp_path / "wet").exists()
    one = replace(augmentation, file=replace(augmentation.file, sensor="01"))
    augmented = one.run(tmp_path / "wet", workers=1)
    counts = [len(sweep.returns()) for sweep in open_recording(tmp_path / "wet")]
    assert sum(counts) == augmented.counts.points


@pytest.mark.extended
def test_recordings_are_converted(drive, tmp_path):
    wet = Variants(Effects.load(options=RAIN))
    augmentation = Augmentation(RecordingRef(drive), wet, output_format="mcap")
    augmented = augmentation.run(tmp_path / "into", workers=1)
    assert augmented.outputs == (tmp_path / "into" / "drive.mcap",)
    assert len(open_recording(augmented.outputs[0])) == SWEEPS
    other = tmp_path / "other" / "drive.mcap"  # bags contain their name
    augmentation.run(other, workers=3)
    assert other.read_bytes() == augmented.outputs[0].read_bytes()
    same = replace(augmentation, output_format="pcd")
    same.run(tmp_path / "pcd", workers=1)
    replace(augmentation, output_format=None).run(tmp_path / "own", workers=1)
    assert content(tmp_path / "pcd") == content(tmp_path / "own")
    with pytest.raises(LidarError, match="'pdf'"):
        replace(augmentation, output_format="pdf").run(tmp_path / "none", workers=1)


@pytest.fixture
def campaign(tmp_path):
    (tmp_path / "effects.yaml").write_text("weather: {visibility_km: 1}\n")
    path = tmp_path / "campaign.yaml"
    path.write_text(CAMPAIGN)
    return path


@pytest.mark.extended
def test_campaigns_write_variants(augmentation, campaign, tmp_path):
    variants = replace(augmentation, variants=CampaignVariants(campaign))
    augmented = variants.run(tmp_path / "one", workers=1)
    assert [path.name for path in augmented.outputs] == ["0000", "0001", "0002"]
    header, *rows = augmented.table.read_text().splitlines()
    assert header == ("variant,split,weather.visibility_km,weather.rain_mm_h,returns,kept,added")
    cells = [row.split(",") for row in rows]
    assert [row[0] for row in cells] == ["0000", "0001", "0002"]
    assert {row[1] for row in cells} == {"train", "val"}
    assert [row[3] for row in cells] == ["0", "10", "50"]
    assert len({row[2] for row in cells}) == 3
    files = content(tmp_path / "one")
    assert files["0000/000000.pcd"] != files["0001/000000.pcd"]
    variants.run(tmp_path / "three", workers=3)
    assert content(tmp_path / "three") == files


@pytest.mark.extended
def test_a_variant_does_not_depend_on_the_others(augmentation, campaign, tmp_path):
    variants = replace(augmentation, variants=CampaignVariants(campaign))
    variants.run(tmp_path / "all", workers=1)
    alone = Variants(CampaignVariants(campaign).effects(1))
    replace(augmentation, variants=alone).run(tmp_path / "alone", workers=1)
    assert content(tmp_path / "all" / "0001") == content(tmp_path / "alone")


@pytest.mark.extended
def test_interrupted_campaigns_continue(augmentation, campaign, tmp_path, monkeypatch):
    monkeypatch.setattr("lidarreal.augmentation.running.MAX_VARIANTS", 2)
    variants = replace(augmentation, variants=CampaignVariants(campaign))
    variants.run(tmp_path / "expected", workers=1)
    out = tmp_path / "out"
    for sweeps in (5, 20):
        with pytest.raises(KeyboardInterrupt):
            variants.run(out, workers=1, resume=sweeps > 5, progress=stop_after(sweeps))
    assert (out / "0001").exists()
    assert not (out / "0002").exists()
    variants.run(out, workers=1, resume=True)
    assert content(out) == content(tmp_path / "expected")
    with pytest.raises(LidarError, match="already exists"):
        variants.run(out, workers=1)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (f"{CAMPAIGN}keep: kitti\n", "`keep` cannot be applied to a recording"),
        (f"{CAMPAIGN}license: MIT\n", "`license` cannot be applied to a recording"),
        (f"{CAMPAIGN}title: rain\n", "`title` cannot be applied to a recording"),
        (CAMPAIGN.replace("weather.rain", "weather.ran"), "rain_mm_h"),
        (CAMPAIGN.replace("effects.yaml", "nowhere.yaml"), "nowhere.yaml does not exist"),
        (
            CAMPAIGN.replace("weather.rain_mm_h: {each: [0, 10, 50]}", "steps: {each: [1, 2]}"),
            "`steps` cannot be applied to a recording",
        ),
        (
            CAMPAIGN.replace(
                "weather.rain_mm_h: {each: [0, 10, 50]}", "noise.angle_deg: {each: [1]}"
            ),
            "`noise.angle_deg` cannot be simulated on a recording",
        ),
    ],
)
def test_invalid_campaigns_are_refused(campaign, text, words):
    campaign.write_text(text)
    with pytest.raises(LidarError) as refused:
        CampaignVariants(campaign)
    assert words in str(refused.value)


@pytest.mark.extended
def test_two_runs_do_not_share_an_output(augmentation, drive, tmp_path):
    out = tmp_path / "wet"
    arguments = [sys.executable, "-c", SLOW, str(drive), str(out)]
    with subprocess.Popen(arguments, stdout=subprocess.PIPE, text=True) as process:
        try:
            process.stdout.readline()
            with pytest.raises(LidarError, match=r"is using \S+/wet\. Wait"):
                augmentation.run(out, workers=1, resume=True)
        finally:
            process.kill()


def test_missing_recordings_are_reported(tmp_path):
    variants = Variants(Effects.load(options=RAIN))
    with pytest.raises(LidarError, match=r"nowhere does not exist"):
        Augmentation(RecordingRef(tmp_path / "nowhere"), variants).run(tmp_path / "out")
    assert not [*tmp_path.iterdir()]
