"""Disks that are full: a clear error, nothing lost, and the run goes on once there is room."""

from __future__ import annotations

import gc
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml
from distributed import Client

import lidarpool.output as lidarpool_output
from lidarpool import LidarpoolError, save_cloud, simulate
from lidarpool.log_file import LOG
from lidarpool.output import FILES
from lidarpool.scenario import Scenario

SCENARIO = "cloud: {keep_every: 1}\nplanning: {trials: 2, iterations: 20}\npool: {backend: numpy}\n"


@pytest.fixture(scope="module")
def run(cluster: str) -> Callable[..., Any]:
    """Run the scenario from Python."""
    scenario = Scenario.from_data(yaml.safe_load(SCENARIO))
    scene = scenario.build_scene()

    def run(**options: Any) -> Any:
        with Client(cluster, set_as_default=False) as client:
            return simulate(
                scene, scenario.survey(scene), scenario.plan(scene), client=client,
                backend="numpy", **options,
            )  # fmt: skip

    return run


@pytest.fixture(scope="module")
def expected(run: Callable[..., Any], tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """The cloud of an undisturbed run."""
    path = tmp_path_factory.mktemp("undisturbed") / "cloud.ply"
    save_cloud(path, run().points)
    assert path.stat().st_size > 50_000
    return path.read_bytes()


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Callable[[str], Path]]:
    """A disk of its own whose size can be set, again and again."""
    folder = tmp_path / "disk"
    folder.mkdir()

    def size(kilobytes: int) -> Path:
        options = f"size={kilobytes}k" + (",remount" if folder.is_mount() else "")
        command = ["mount", "-t", "tmpfs", "-o", options, "tmpfs", str(folder)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            pytest.skip(f"small disks can be mounted by root only: {done.stderr.strip()}")
        return folder

    yield size
    gc.collect()  # pumps and tracebacks are circles, which hold files
    if folder.is_mount():
        done = subprocess.run(["umount", str(folder)], capture_output=True, text=True, check=False)
        if done.returncode:
            subprocess.run(["umount", "-l", str(folder)], check=True)
            pytest.fail(f"files of it are still open: {done.stderr}")


def test_the_disk_of_the_journal_is_full(disk, run, expected):
    journal = disk(64) / "journal"
    for kilobytes in (80, 96):  # some more room, and it is full again
        with pytest.raises(
            LidarpoolError, match=r"journal cannot be written \(No space left on device\): make"
        ) as caught:
            run(journal=journal, resume=True)
        assert re.search(
            r"\d+ of 108 scans are kept in .*: continue with resume=True", *caught.value.__notes__
        )
        disk(kilobytes)
    disk(2000)
    result = run(journal=journal, resume=True)
    assert result.resumed > 0
    save_cloud(journal.parent / "cloud.ply", result.points)
    assert (journal.parent / "cloud.ply").read_bytes() == expected


def test_a_disk_without_room_for_anything(disk, run):
    folder = disk(4)
    (folder / "filler").write_bytes(bytes(4096))
    with pytest.raises(LidarpoolError, match=r"journal cannot be written") as caught:
        run(journal=folder / "journal")
    assert not hasattr(caught.value, "__notes__")
    assert [path.name for path in folder.iterdir()] == ["filler"]


@pytest.mark.parametrize("free", [30, 90, 150, 190])
def test_the_disk_of_the_result_is_full(
    free, disk, run, expected, cluster, lidarpool, tmp_path, monkeypatch, no_pictures
):
    """The journal is complete, and there is no room for the files, or for a part of them."""
    monkeypatch.setattr(lidarpool_output, "ROOM_BYTES", 0)  # else it would be refused at once
    out = disk(2000) / "out"
    out.mkdir()
    run(journal=out / "journal")
    used = sum(path.stat().st_blocks * 512 for path in out.rglob("*"))
    disk(used // 1024 + free)
    (tmp_path / "s.yaml").write_text(SCENARIO)
    command = ["run", tmp_path / "s.yaml", "--out", out, "--scheduler", cluster, "-q", "--resume"]
    failed = lidarpool(*command)
    assert failed.code == 2
    assert re.search(r"(?i)make room", failed.err) and len(failed.err.splitlines()) == 1
    assert f"108 of 108 scans are kept in {out}/journal: continue with --resume." in failed.err
    assert {path.name for path in out.iterdir()} - {LOG} == {"journal"}
    disk(40_000)
    done = lidarpool(*command)
    assert (done.code, done.err) == (0, "")
    assert (out / "cloud.ply").read_bytes() == expected
    assert {path.name for path in out.iterdir()} - {LOG} == set(FILES)


LIMIT = "import resource; resource.setrlimit(resource.RLIMIT_FSIZE, ({0}, {0}))\n"
NO_PICTURES = """
import lidarpool.pictures as pictures
pictures.take_shot = lambda *_, **__: None
def draw(path, *_, **__): path.write_bytes(b"x")
pictures.draw_scene = pictures.draw_intensity = draw
pictures.draw_cloud = pictures.draw_path = draw
"""


@pytest.mark.skipif(sys.platform == "win32", reason="has no limit on the size of files")
def test_files_may_not_grow(cluster, start_command, run, expected, tmp_path):
    """A limit on the size of files is as good as a full disk, and needs no root."""
    command = (SCENARIO, "--scheduler", cluster, "--resume", "-q")
    first = start_command(*command, prelude=NO_PICTURES + LIMIT.format(40_000))
    assert first.process.wait(300) == 2
    assert re.fullmatch(
        r"lidarpool: The journal out/journal cannot be written \(File too large\): make room on "
        r"its disk, or give another folder\. \d+ of 108 scans are kept in out/journal: continue "
        r"with --resume\.\n",
        first.said,
    )
    run(journal=tmp_path / "out" / "journal", resume=True)
    # All is there but the files, of which none larger than this can be written.
    second = start_command(*command, prelude=NO_PICTURES + LIMIT.format(60_000))
    assert second.process.wait(300) == 2
    assert "cloud.ply" in second.said and "108 of 108 scans are kept" in second.said
    last = start_command(*command, prelude=NO_PICTURES)
    assert last.process.wait(300) == 0, last.said
    assert (tmp_path / "out" / "cloud.ply").read_bytes() == expected
