"""Disks that are full: a clear error, nothing lost, and the run goes on once there is room."""

import gc
import re
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml
from distributed import Client

from lidarpool import LidarError, save_cloud, simulate
from lidarpool.report.result_files import FILES
from lidarpool.run import forecast
from lidarscenario.prepare import prepare
from lidarscenario.scenario import Scenario

SCENARIO = """
scene: seed
planning: {start: [25, 25], target: [-30, -20], trials: 2, iterations: 20}
pool: {backend: tiles}
"""


@pytest.fixture(scope="module")
def run(cluster: str) -> Callable[..., Any]:
    """Run the scenario from Python."""
    built = prepare(Scenario.from_data(yaml.safe_load(SCENARIO)))

    def run(**options: Any) -> Any:
        with Client(cluster, set_as_default=False) as client:
            return simulate(
                built.scene, built.survey, built.job.planning, client=client,
                backend="tiles", **options,
            )  # fmt: skip

    return run


@pytest.fixture(scope="module")
def expected(run: Callable[..., Any], tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """The cloud of an undisturbed run."""
    path = tmp_path_factory.mktemp("undisturbed") / "cloud.ply"
    save_cloud(run().points, path)
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


@pytest.mark.extended
def test_the_disk_of_the_run_is_full(disk, run, expected):
    folder = disk(100) / "run"
    for kilobytes in (160, 4000):  # some more room, and it is full again
        with pytest.raises(
            LidarError, match=r"(cannot be stored in|cannot be written) .*\. Free "
        ) as caught:
            run(folder=folder, resume=True)
        assert "\n" not in str(caught.value)
        assert re.search(
            r"\d+ of 108 scans are stored in .*\. Continue with `--resume`", *caught.value.__notes__
        )
        disk(kilobytes)
    result = run(folder=folder, resume=True)
    assert result.resumed > 0
    save_cloud(result.points, folder.parent / "cloud.ply")
    assert (folder.parent / "cloud.ply").read_bytes() == expected


def test_a_disk_without_room_for_anything(disk, run):
    folder = disk(4)
    (folder / "filler").write_bytes(bytes(4096))
    with pytest.raises(LidarError, match=r"run\.db cannot be written .*\. Free disk") as caught:
        run(folder=folder / "run")
    assert not hasattr(caught.value, "__notes__")
    assert [path.name for path in folder.iterdir()] == ["filler"]


@pytest.mark.extended
def test_the_disk_of_the_result_is_full(
    disk, run, expected, cluster, lidarpool, tmp_path, monkeypatch
):
    """The run is complete, and there is no room for its files beside an earlier result."""
    monkeypatch.setattr(forecast, "REPORT_BYTES", 0)  # else it would be refused at once
    out = disk(4000) / "out"
    out.mkdir()
    for name in FILES:
        (out / name).write_text(f"an earlier {name}")
    run(folder=out / "run")
    used = sum(path.stat().st_blocks * 512 for path in out.rglob("*"))
    disk(used // 1024 + 30)
    (tmp_path / "s.yaml").write_text(SCENARIO)
    command = ["run", tmp_path / "s.yaml", "--out", out, "--scheduler", cluster, "-q", "--resume"]
    failed = lidarpool(*command)
    assert failed.code == 2
    assert re.search(
        r"(?i)free (some|up) space|free some|make room|no space", failed.err.splitlines()[-1]
    )
    assert f"108 of 108 scans are stored in {out}/run. Continue with `--resume` (" in failed.err
    assert {path.name for path in out.iterdir()} == {"run", *FILES}
    assert all((out / name).read_text() == f"an earlier {name}" for name in FILES)
    disk(40_000)
    done = lidarpool(*command)
    assert (done.code, done.err) == (0, "")
    assert (out / "cloud.ply").read_bytes() == expected
    assert {path.name for path in out.iterdir()} == {f for f in FILES if not f.endswith(".png")}
