"""What users get wrong: each with its message, exit code 2, and the earlier result untouched."""

from __future__ import annotations

import gzip
import os
import re
import socket
import struct
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import trimesh
from distributed import Scheduler, SpecCluster, Worker

import lidarpool.run.checks as lidarpool_checks
import lidarpool.run.connection
from lidarpool.cli.log_file import LOG
from raybeam import available_backends

BOX = trimesh.creation.box((2, 4, 6))
NAN_OBJ = b"v 0 0 0\nv 1 0 nan\nv 0 1 0\nf 1 2 3\n"
CLOUD_PLY = b"""ply
format ascii 1.0
element vertex 1
property float x
property float y
property float z
end_header
0 0 0
"""


def exported(kind: str) -> bytes:
    data = BOX.export(file_type=kind)
    return data.encode() if isinstance(data, str) else data


# -- mesh files: name, content (None: no such file), what the message says ---------------------

MESHES: dict[str, tuple[str, bytes | None, str]] = {
    "missing glb": ("hall.glb", None, "hall.glb does not exist"),
    "missing stl": ("hall.stl", None, "hall.stl does not exist"),
    "empty stl": ("hall.stl", b"", "hall.stl is empty"),
    "empty glb": ("hall.glb", b"", "hall.glb is empty"),
    "junk glb": ("hall.glb", b"junk" * 50, "not a binary glTF"),
    "junk gltf": ("hall.gltf", b"{,", "no valid JSON"),
    "junk stl": ("hall.stl", bytes(range(256)) * 3, "hall.stl"),
    "junk obj": ("hall.obj", b"hello\n" * 20, "no triangles"),
    "junk ply": ("hall.ply", b"ply?\n" * 9, "no PLY header"),
    "junk off": ("hall.off", b"ON\n", "no OFF header"),
    "junk dae": ("hall.dae", b"<COLLADA>", "hall.dae"),
    "junk 3mf": ("hall.3mf", b"PK\x03\x04 and so on", "hall.3mf is broken"),
    "cut stl": ("hall.stl", exported("stl")[:-60], "hall.stl"),
    "cut text stl": ("hall.stl", exported("stl_ascii")[:-60], "cut short"),
    "cut glb": ("hall.glb", exported("glb")[:-20], "cut short"),
    "cut ply": ("hall.ply", exported("ply")[:-20], "hall.ply"),
    "cut off": ("hall.off", exported("off")[:-8], "cut short"),
    "point cloud": ("hall.ply", CLOUD_PLY, "point cloud, it has no faces"),
    "points only": ("hall.obj", b"v 0 0 0\nv 1 0 0\n", "no triangles"),
    "NaN": ("hall.obj", NAN_OBJ, "hall.obj"),
    "face of a missing vertex": ("hall.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n", "hall.obj"),
    "unsupported": ("hall.step", b"ISO-10303-21;\n", "hall.step"),
    "relative obj": (
        "hall.obj",
        b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf -1 -2 -4\n",
        "a vertex that is not there",
    ),
    "packed": ("hall.stl", gzip.compress(exported("stl")), "is packed with gzip: unpack it first"),
    "another kind": ("hall.obj", exported("glb"), "is a .glb file by its content"),
    "web page": ("hall.glb", b"<!DOCTYPE html><html></html>", "is a page of the web"),
    "far away": ("hall.obj", b"v 0 0 1e30\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "reaches 1e+30 m"),
    "compressed": (
        "hall.gltf",
        b'{"asset": {"version": "2.0"}, "extensionsRequired": ["KHR_draco_mesh_compression"]}',
        "KHR_draco_mesh_compression",
    ),
}

# -- scenario files: content, what the message says --------------------------------------------

SCENARIOS: dict[str, tuple[str | bytes, str]] = {
    "empty": ("", "is empty"),
    "comments only": ("# nothing\n", "is empty"),
    "not YAML": ("scene: [seed\n", "line 2"),
    "tabs": ("scene:\n\tpreset: seed\n", "line 2: there is a tab: indent"),
    "a tab after a name": ("sensor:\t{layers: 2}\n", "line 1: there is a tab"),
    "indented otherwise": ("sensor:\n   layers: 2\n  steps: 3\n", "line 3: this line is indented"),
    "a path with backslashes": ('scene: {files: ["C:\\mesh\\a.stl"]}\n', "write paths with /"),
    "a file with fields on two lines": ("scene:\n  - a.stl\n    unit: mm\n", "{file: part.stl"),
    "three dots": ("steps: 3\n...\nsteps: 4\n", "a scenario is one document"),
    "a section in itself": ("scene: &a {files: *a}\n", "scene.files[0].file is missing"),
    "a list in itself": ("poses: &a [*a]\n", "poses[0].position[0] is [[[[...]]]]"),
    "a list": ("- seed\n", "holds a list"),
    "a word": ("seed\n", "holds only 'seed'"),
    "two documents": ("steps: 3\n---\nsteps: 4\n", "line 2"),
    "not UTF-8": ("# übung\n".encode("latin-1"), "not UTF-8"),
    "binary": (bytes(range(256)), "not UTF-8"),
    "UTF-16": ("steps: 3\n".encode("utf-16"), "not UTF-8"),
    "key twice": ("steps: 3\nsteps: 4\n", "'steps' is given twice"),
    "tag": ("steps: !!python/name:os.system\n", "no meaning here"),
    "impossible date": ("steps: 2026-99-99\n", "not valid YAML"),
    "misspelt section": ("sensr: {}\n", "Did you mean 'sensor'?"),
    "misspelt field": ("sensor: {layer: 3}\n", "Did you mean 'layers'?"),
    "unknown field": ("sensor: {colour: red}\n", "sensor.colour is not a field. There are: rays"),
    "number as key": ("3: 4\n", "[3] is not a field"),
    "text for a number": ("sensor: {layers: many}\n", "must be a whole number, 1 to 65535"),
    "quoted number": ("sensor: {layers: '40'}\n", "sensor.layers is '40'"),
    "fraction of a layer": ("sensor: {layers: 1.5}\n", "must be a whole number"),
    "no layers": ("sensor: {layers: 0}\n", "sensor.layers is 0; it must be 1 to 65535"),
    "too many layers": ("sensor: {layers: 70000}\n", "1 to 65535"),
    "true layers": ("sensor: {layers: true}\n", "sensor.layers is true"),
    "field of view": ("sensor: {vertical_fov_deg: 181}\n", "above 0, at most 180"),
    "NaN": ("sensor: {step_deg: .nan}\n", "sensor.step_deg is nan"),
    "infinite": ("sensor: {vertical_fov_deg: .inf}\n", "sensor.vertical_fov_deg is inf"),
    "ranges the wrong way": ("sensor: {min_range_m: 5, max_range_m: 4}\n", "above min_range_m"),
    "step below an azimuth": ("sensor: {step_deg: 0.1}\n", "less than one firing"),
    "too many rays": (
        "sensor: {rays_per_revolution: 10000000, layers: 65535}\n",
        "at most 100,000,000 rays",
    ),
    "section as list": ("sensor: [1]\n", "sensor is [1]; it must be a section"),
    "section as number": ("cloud: 5\n", "cloud is 5; it must be a section"),
    "no poses": ("poses: []\n", "poses is []; it must be a list of at least 1"),
    "one pose without its list": ("poses: [0, 0, 1]\n", "must be in a list: [[x, y, z]]"),
    "one pose as a section": ("poses: {position: [0, 0, 1]}\n", "must be in a list"),
    "flat pose": (
        "poses: [[0, 0]]\n",
        "poses[0].position is [0, 0]; it must be a list of 3 numbers",
    ),
    "pose of words": ("poses: [[a, b, c]]\n", "poses[0].position[0] is 'a'"),
    "pose beyond floats": ("poses: [[1.0e+999, 0, 0]]\n", "poses[0].position[0] is inf"),
    "pose off the Earth": ("poses: [[1.0e+30, 0, 0]]\n", "poses[0].position[0] is 1e+30"),
    "huge whole number": ("poses: [[1" + 400 * "0" + ", 0, 0]]\n", "poses[0].position[0]"),
    "no steps": ("steps: 0\n", "steps is 0"),
    "too many steps": ("steps: 1000000000000\n", "steps is 1000000000000"),
    "too many scans": ("steps: 1000000\nposes: [" + 20 * "[0, 0, 1], " + "]\n", "at most 10,000"),
    "every 0th point": ("cloud: {keep_every: 0}\n", "cloud.keep_every is 0"),
    "no precision": ("cloud: {precision_m: 0}\n", "cloud.precision_m is 0"),
    "nothing to scan": ("scene: {preset: none}\n", "nothing to scan"),
    "unknown preset": ("scene: {preset: sed}\n", "scene.preset is 'sed'; it must be one of"),
    "mesh is missing": ("scene: {files: [nowhere.glb]}\n", "nowhere.glb does not exist"),
    "mesh is misspelt": ("scene: {files: [b.stl]}\n", "Did you mean 'a.stl'?"),
    "mesh beyond the Earth": ("scene: [{file: a.stl, scale: 1.0e+9}]\n", "reaches 3e+09 m"),
    "mesh is a folder": ("scene: {files: [.]}\n", "is not a file"),
    "mesh without name": ("scene: {files: [{unit: m}]}\n", "scene.files[0].file is missing"),
    "unknown unit": ("scene: {files: [{file: a.stl, unit: ells}]}\n", "files[0].unit is 'ells'"),
    "flattened mesh": ("scene: {files: [{file: a.stl, scale: 0}]}\n", "flattens the mesh"),
    "no backend of that name": ("pool: {backend: cpu}\n", "pool.backend is 'cpu'"),
    "no collectors": ("pool: {collectors: 0}\n", "pool.collectors is 0"),
    "no workers": ("pool: {gpu: 0}\n", "pool.gpu is 0"),
    "start in an obstacle": ("planning: {start: [5, 5]}\n", "within its circle"),
    "obstacle is no object": ("planning: {obstacles: [Ladder]}\n", "no object is called so"),
    "misspelt obstacle": ("planning: {obstacles: [Vasse]}\n", "Did you mean 'Vase'?"),
    "half a disc": ("planning: {obstacles: [{centre: [1, 1]}]}\n", "both centre and radius_m"),
    "no trials": ("planning: {trials: 0}\n", "planning.trials is 0"),
    "planning without ends": (
        "scene: [a.stl]\nplanning: {enabled: true}\n",
        "give planning.start and planning.target",
    ),
    "planning with one end": (
        "scene: [a.stl]\nplanning: {start: [9, 9]}\n",
        "give both planning.start and planning.target, or neither",
    ),
    "planning from and to one place": (
        "planning: {target: [25, 25]}\n",
        "start and target of the path are both (25.0, 25.0)",
    ),
    "too fine for the scene": (
        "scene: {ground: {margin_m: 1000000}}\ncloud: {precision_m: 0.000001}\n",
        "too fine",
    ),
    "file name with a zero": ('scene: {files: ["a\\0.stl"]}\n', "a"),
    "deep": (2000 * "[" + 2000 * "]", "nested too deeply"),
}

# -- options: arguments, what the message says -------------------------------------------------

OPTIONS: dict[str, tuple[list[str], str]] = {
    "no scenario": (["run"], "Missing argument 'SCENARIO'"),
    "two scenarios": (["run", "a.yaml", "b.yaml"], "unexpected extra argument"),
    "unknown command": (["frobnicate"], "There is no command 'frobnicate'"),
    "misspelt command": (["rum"], "Did you mean 'run'?"),
    "unknown option": (["demo", "--fast"], "--fast"),
    "option without value": (["run", "good.yaml", "--out"], "--out"),
    "unknown backend": (["run", "good.yaml", "--backend", "gpu"], "There is no backend 'gpu'"),
    "misspelt backend": (["run", "good.yaml", "--backend", "embre"], "Did you mean 'embree'?"),
    "missing scenario": (["run", "nowhere.yaml"], "nowhere.yaml does not exist"),
    "scenario is a folder": (["run", "."], "is a folder"),
    "malformed address": (["run", "good.yaml", "--scheduler", "tcp://::1:x"], "tcp://host:8786"),
    "address of nothing": (["run", "good.yaml", "--scheduler", ""], "tcp://host:8786"),
    "unknown protocol": (["run", "good.yaml", "--scheduler", "http://x:1"], "tcp://host:8786"),
    "unknown host": (["run", "good.yaml", "--scheduler", "tcp://no.invalid:1"], "No Dask sched"),
    "no scheduler": (["run", "good.yaml", "--scheduler", "tcp://127.0.0.1:1"], "No Dask scheduler"),
    "info: no scheduler": (["info", "--scheduler", "tcp://127.0.0.1:1"], "No Dask scheduler"),
}


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A working folder with a good scenario and an earlier result."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "good.yaml").write_text("sensor: {layers: 2}\nsteps: 2\n")
    (tmp_path / "a.stl").write_bytes(exported("stl"))
    (tmp_path / "lidarpool-out").mkdir()
    for name in ("cloud.ply", "path.png", "report.json", "notes of mine.txt"):
        (tmp_path / "lidarpool-out" / name).write_text(f"an earlier {name}")
    return tmp_path


@pytest.fixture
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Give up soon; for addresses where nobody answers. On a busy machine a scheduler may not."""
    monkeypatch.setattr(lidarpool.run.connection, "CONNECT_TIMEOUT_S", 1)


def content(folder: Path) -> dict[str, bytes | None]:
    """All that is in a folder, but for what libraries had to say on a busy machine."""
    files = {path.relative_to(folder): path for path in folder.rglob("*") if path.name != LOG}
    return {str(k): None if p.is_dir() else p.read_bytes() for k, p in files.items()}


@pytest.fixture
def refused(place: Path, lidarpool: Callable[..., Any]) -> Callable[..., None]:
    """Run the command and check that it ends as it should on bad input."""

    def check(arguments: list[str], says: str) -> None:
        before = content(place)
        outcome = lidarpool(*arguments)
        assert says in outcome.err
        check_refusal(outcome.code, outcome.out, outcome.err)
        assert content(place) == before

    return check


def check_refusal(code: int, out: str, err: str) -> None:
    assert code == 2
    assert out == ""
    assert err.startswith("lidarpool: ")
    told = [line for line in err.splitlines() if not re.match(r"\d\d:\d\d:\d\d  ", line)]
    assert 1 <= len(told) <= 3
    assert "Traceback" not in err
    assert max(map(len, told)) < 500


@pytest.mark.parametrize("case", MESHES)
def test_a_bad_mesh_file(case, place, refused):
    name, data, says = MESHES[case]
    if data is not None:
        (place / name).write_bytes(data)
    refused(["run", name], says)


def test_a_folder_with_the_ending_of_a_mesh(place, refused):
    (place / "hall.glb").mkdir()
    refused(["run", "hall.glb"], "is not a file")


@pytest.mark.parametrize("case", SCENARIOS)
def test_a_bad_scenario(case, place, refused):
    text, says = SCENARIOS[case]
    (place / "s.yaml").write_bytes(text if isinstance(text, bytes) else text.encode())
    refused(["run", "s.yaml"], says)


@pytest.mark.parametrize("case", OPTIONS)
def test_bad_arguments(case, refused, impatient):
    refused(*OPTIONS[case])


def test_a_scenario_that_is_far_too_large(place, refused):
    (place / "s.yaml").write_bytes(b"# " + 5 * 2**20 * b"x")
    refused(["run", "s.yaml"], "larger than 4 MiB")


def test_cuda_without_a_gpu(refused):
    if not available_backends()["cuda"]:
        pytest.skip("there is a GPU")
    refused(["run", "good.yaml", "--backend", "cuda"], "Backend 'cuda' cannot be used here")


TOO_LONG = "x" * 300


@pytest.mark.parametrize(
    "arguments",
    [
        ["run", TOO_LONG],
        ["run", f"{TOO_LONG}.stl"],
        ["run", "a.stl", "--out", TOO_LONG],
        ["check", "good.yaml", "--out", TOO_LONG],
        ["init", TOO_LONG],
        ["init", "new", "--mesh", f"{TOO_LONG}.stl"],
        ["plot", TOO_LONG],
        ["view", f"{TOO_LONG}.ply", "--no-browser"],
        ["scene", "city", f"{TOO_LONG}.glb"],
    ],
    ids=lambda arguments: " ".join(arguments)[:40],
)
def test_a_name_that_no_file_can_have(arguments, place, lidarpool):
    before = content(place)
    outcome = lidarpool(*arguments)
    assert (outcome.code, outcome.err.count("Traceback")) == (2, 0)
    assert "File name too long" in outcome.err
    assert content(place) == before


# -- where the result goes ----------------------------------------------------------------------


def test_out_is_a_file(place, refused):
    refused(["run", "good.yaml", "--out", "a.stl"], "a.stl is a file")


def test_out_lies_under_a_file(refused):
    refused(["run", "good.yaml", "--out", "a.stl/out"], "Cannot write to the folder")


def test_out_cannot_be_made(refused):
    refused(["run", "good.yaml", "--out", "/proc/out"], "Cannot write to the folder /proc/out")


def test_out_has_a_folder_where_a_file_is_to_go(place, refused):
    (place / "lidarpool-out" / "scene.png").mkdir()
    refused(["run", "good.yaml"], "scene.png is a folder")


@pytest.mark.skipif(os.name != "posix" or os.geteuid() == 0, reason="root may write anywhere")
def test_out_is_write_protected(place, refused):
    (place / "lidarpool-out").chmod(0o500)
    refused(["run", "good.yaml"], "Cannot write to the folder")


@pytest.mark.skipif(sys.platform == "win32", reason="no locks on folders")
def test_out_is_in_use_by_another_run(place, refused):
    import fcntl

    handle = os.open(place / "lidarpool-out", os.O_RDONLY)
    fcntl.flock(handle, fcntl.LOCK_EX)
    refused(["run", "good.yaml"], "Another run is using the folder")
    os.close(handle)


def test_no_folder_is_left_behind_by_a_run_that_was_refused(place, refused, impatient):
    refused(
        ["run", "good.yaml", "--out", "new/deep", "--scheduler", "tcp://127.0.0.1:1"], "No Dask"
    )


@pytest.fixture
def small_disk(place: Path) -> Iterator[Callable[[str], Path]]:
    """Mount disks of a given size."""
    mounted: list[Path] = []

    def mount(size: str) -> Path:
        disk = place / f"disk{len(mounted)}"
        disk.mkdir()
        command = ["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(disk)]
        if subprocess.run(command, capture_output=True, check=False).returncode:
            pytest.skip("small disks can be mounted by root only")
        mounted.append(disk)
        return disk

    yield mount
    for disk in mounted:
        subprocess.run(["umount", str(disk)], check=True)


def test_a_disk_that_is_nearly_full(small_disk, refused):
    disk = small_disk("1m")
    refused(["run", "good.yaml", "--out", str(disk / "out")], "make room")


def test_a_disk_that_may_only_be_read(small_disk, refused):
    refused(["run", "good.yaml", "--out", str(small_disk("1m,ro"))], "Read-only file system")


# -- clusters -----------------------------------------------------------------------------------


def test_a_listener_that_is_no_scheduler(refused, impatient):
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        refused(["run", "good.yaml", "--scheduler", f"tcp://127.0.0.1:{port}"], "No Dask scheduler")


def test_a_listener_that_talks_of_something_else(refused, impatient):
    with socket.create_server(("127.0.0.1", 0)) as server:

        def answer() -> None:
            while True:
                try:
                    connection, _ = server.accept()
                except OSError:
                    return
                connection.sendall(struct.pack("<Q", 2**40) + b"HTTP/1.1 400 Bad Request\r\n\r\n")
                connection.close()

        threading.Thread(target=answer, daemon=True).start()
        port = server.getsockname()[1]
        refused(["run", "good.yaml", "--scheduler", f"tcp://127.0.0.1:{port}"], "No Dask scheduler")


@pytest.fixture
def cluster() -> Iterator[Callable[..., str]]:
    """Start a cluster whose workers are threads and declare some resources; its address."""
    started: list[SpecCluster] = []

    def start(*resources: dict[str, int]) -> str:
        quiet = {"host": "127.0.0.1", "dashboard": False}
        workers = {
            i: {"cls": Worker, "options": {"resources": r, "nthreads": 1, **quiet}}
            for i, r in enumerate(resources)
        }
        scheduler = {"cls": Scheduler, "options": {"port": 0, "dashboard_address": ":0", **quiet}}
        started.append(SpecCluster(workers=workers, scheduler=scheduler, silence_logs=50))
        return started[-1].scheduler_address

    yield start
    for each in started:
        each.close()


CLUSTERS: dict[str, tuple[list[dict[str, int]], str]] = {
    "no workers": ([], "has no workers: start some"),
    "workers of no partition": ([{}], "Partition 'GPU' has 0 of the 1 slot"),
    "no GPU": ([{"LIDAR": 4}, {"OTHER": 1}], "Partition 'GPU' has 0 of the 1 slot"),
    "no LIDAR": ([{"GPU": 1}, {"OTHER": 1}], "Partition 'LIDAR' has 0 of the 4 slots"),
    "little LIDAR": (
        [{"GPU": 1}, {"LIDAR": 3}, {"OTHER": 1}],
        "Partition 'LIDAR' has 3 of the 4 slots",
    ),
    "no OTHER": ([{"GPU": 1}, {"LIDAR": 4}], "--no-plan"),
    "two resources": ([{"GPU": 1, "LIDAR": 4}, {"OTHER": 1}], "declares GPU and LIDAR"),
}


@pytest.mark.parametrize("case", CLUSTERS)
def test_a_cluster_that_lacks_something(case, cluster, refused):
    resources, says = CLUSTERS[case]
    command = ["run", "good.yaml", "--scheduler", cluster(*resources)]
    refused(command if case == "two resources" else [*command, "--wait", "0s"], says)


def test_workers_that_are_waited_for_are_named_meanwhile(cluster, place, lidarpool, monkeypatch):
    monkeypatch.setattr(lidarpool_checks, "TELL_EVERY_S", 0.1)
    address = cluster({"GPU": 1}, {"OTHER": 1})
    outcome = lidarpool("run", "good.yaml", "--scheduler", address, "--wait", "0.5s")
    assert outcome.code == 2
    assert re.match(
        r"note: waiting for workers, for another \d s: Partition 'LIDAR' has 0 of the 4 slots",
        outcome.err,
    )
    assert outcome.err.splitlines()[-1].startswith("lidarpool: Partition 'LIDAR' has 0 of the 4")


def test_a_backend_that_the_workers_lack(cluster, refused):
    if not available_backends()["cuda"]:
        pytest.skip("there is a GPU")
    address = cluster({"GPU": 1}, {"LIDAR": 4}, {"OTHER": 1})
    refused(
        ["run", "good.yaml", "--backend", "cuda", "--scheduler", address],
        "Backend 'cuda' cannot be used on the GPU worker at",
    )


def test_info_of_a_cluster_without_workers(cluster, lidarpool):
    outcome = lidarpool("info", "--scheduler", cluster())
    assert (outcome.code, "Traceback" in outcome.err) == (2, False)
    assert "has no workers" in outcome.err


def test_info_lists_the_workers(cluster, lidarpool):
    outcome = lidarpool("info", "--scheduler", cluster({"GPU": 1}, {"LIDAR": 4}))
    lines = outcome.out[outcome.out.index("cluster:") :].splitlines()
    assert lines[0] == "cluster: 2 workers on 1 host"
    assert [line.split()[0] for line in lines[1:]] == ["GPU=1", "LIDAR=4"]


WITHOUT_LIDARPOOL = """
import sys

class Absent:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in ("lidarpool", "poolpart", "raybeam"):
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

sys.meta_path.insert(0, Absent())
"""
ANOTHER_VERSION = "import lidarpool._version as v; v.__version__ = '99.0'"


@pytest.mark.parametrize(
    ("preload", "says"),
    [
        (WITHOUT_LIDARPOOL, "does not have lidarpool: install lidarpool"),
        (ANOTHER_VERSION, "has lidarpool 99.0, here it is"),
    ],
)
def test_workers_whose_lidarpool_is_not_ours(preload, says, outside, place, refused):
    cluster = outside()
    cluster.add("GPU", preload=preload)
    cluster.wait()
    refused(["run", "good.yaml", "--scheduler", cluster.address], says)


# -- in a process of its own --------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["run", "nowhere.yaml"], "nowhere.yaml does not exist: check the name and the folder."),
        (["rum"], "There is no command 'rum'. Did you mean 'run'? See lidarpool --help."),
    ],
)
def test_the_installed_command_says_the_same(arguments, says, place):
    before = content(place)
    command = [sys.executable, "-c", "from lidarpool.cli.commands import main; main()", *arguments]
    env = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    ended = subprocess.run(command, capture_output=True, text=True, env=env, check=False)
    assert ended.stderr == f"lidarpool: {says}\n"
    check_refusal(ended.returncode, ended.stdout, ended.stderr)
    assert content(place) == before
