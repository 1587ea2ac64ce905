"""Commands that are killed at any change on disk, and continued or repeated.

The computing is replaced by a few values, so that each row of `USERS` takes little time.
"""

from __future__ import annotations

import errno
import os
import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import NamedTuple

import numpy as np
import pytest
from tests.kills import count_changes, is_killed
from tests.recorded_drives import recorded_points, write_pcd_drive

from lidarfiles import save_cloud
from lidarfiles.clouds.recording_ref import RecordingRef
from lidarfiles.work import publishing, work
from lidarfiles.work.work import FOLDER, Step
from lidarpool.cli import flight_command, stations_command
from lidarpool.report import flight_map, result_pictures
from lidarpool.report.result_pictures import publish_pictures
from lidarreal import twin
from lidarreal.augmentation.effects import Effects
from lidarreal.augmentation.running import Augmentation
from lidarreal.augmentation.sweep_tasks import PartProcess
from lidarreal.augmentation.variants import CampaignVariants, Variants
from lidarreal.comparing.comparison_files import write_comparison
from lidarreal.comparing.fit import charts, fitting
from lidarreal.reconstruction import building
from lidarreal.reconstruction.recorded_sweeps import RecordedSweeps
from lidarscenario.mounting import pictures
from lidarscenario.mounting.evaluation import MountEvaluator, MountResult
from lidarscenario.mounting.study_files import rank_mounts
from lidarscenario.occupancy import writing
from lidarscenario.plan import flight, flight_density, stations
from lidarsim import Cloud
from lidarsim.errors import LidarError, explain_os_errors
from lidarsim.io.storage import TEMPORARY, WRITING, replace_file
from lidarsim.simulator.occupancy import VoxelGrid

# Names of files and folders that are not part of a result.
UNFINISHED = (FOLDER, TEMPORARY, WRITING)
ORDER = ("earlier", "incomplete", "new")  # what is left after a kill, the later the more
POSITIONS = 12  # number of kills of each command in a short test


class Values(NamedTuple):
    values: np.ndarray


VALUES = Step("values", (Values,))
TOTAL = Step("total", (Values,))


class User:
    """Command that stores finished items, or only moves its result into place.

    A result depends on a number, its version.

    Attributes
    ----------
    last
        File or folder without which a result is visibly incomplete, relative to the folder that
        contains all outputs.
    states
        What a kill may leave.
    resumes
        Whether finished items are stored.
    source
        Input file of a command that stores finished items.
    noun
        Name of this input in messages.
    """

    last = ""
    states = ORDER
    resumes = False
    source = ""
    noun = "recording"

    def prepare(self, folder: Path, patches: pytest.MonkeyPatch) -> None:
        """Write the inputs to a folder, and replace the computing."""

    def run(self, inputs: Path, outputs: Path, version: int, *, resume: bool = False) -> None:
        """Write a result, or continue with one, and replace an earlier one."""
        raise NotImplementedError


@cache
def drive_points():
    return recorded_points(4)


@dataclass(frozen=True)
class _FakeTwin:
    total: int

    def write(self, folder):
        (folder / "actors").mkdir()
        for number in range(self.total % 4):
            (folder / "actors" / f"{number}.ply").write_text(f"{number} of {self.total}")
        (folder / "page.html").write_text(f"page of {self.total}")
        (folder / "scenario.yaml").write_text(f"twin of {self.total}")


class TwinUser(User):
    last = "out/scenario.yaml"
    resumes = True
    source = "drive/000001.pcd"

    def prepare(self, folder, patches):
        drive = write_pcd_drive(folder / "drive", drive_points())
        recorded = RecordedSweeps.open(drive)

        def compute(building, track):
            factor = round(10 * building.voxel_m)
            items = [factor * number for number in range(3)]
            each = building.work.each(VALUES, map, lambda item: (Values(np.array([item])),), items)
            total = sum(int(part.values[0]) for (part,) in each)
            (kept,) = building.work.once(TOTAL, lambda: (Values(np.array([total])),))
            return _FakeTwin(int(kept.values[0]))

        patches.setattr(building._Building, "twin", compute)
        patches.setattr(RecordedSweeps, "open", lambda *arguments: recorded)

    def run(self, inputs, outputs, version, *, resume=False):
        drive, out = inputs / "drive", outputs / "out"
        twin(drive, out=out, voxel_m=0.1 * version, resume=resume, overwrite=True)


_AUGMENTED: dict[tuple, tuple] = {}  # what has been computed for all tests


class AugmentUser(User):
    """Augmentation of a folder, which is replaced as a whole."""

    last = "out"
    resumes = True
    source = "drive/000001.pcd"

    def prepare(self, folder, patches):
        write_pcd_drive(folder / "drive", drive_points()[:2])
        compute = PartProcess.files

        def load(part, number, variant):
            key = part.file.path.name, part.plan.variants[variant].seed, number
            if key not in _AUGMENTED:
                _AUGMENTED[key] = compute(part, number, variant)
            return _AUGMENTED[key]

        patches.setattr(PartProcess, "files", load)
        patches.setattr(PartProcess, "prepare", lambda part, variant: None)

    def augmentation(self, inputs, version):
        effects = replace(Effects.load(options={"weather": {"rain_mm_h": 50}}), seed=version)
        return Augmentation(RecordingRef(inputs / "drive"), Variants(effects))

    def run(self, inputs, outputs, version, *, resume=False):
        augmentation = self.augmentation(inputs, version)
        augmentation.run(outputs / "out", workers=1, resume=resume, overwrite=True)


class AugmentFileUser(AugmentUser):
    """Augmentation of a file."""

    last = "out/000001.pcd"
    states = ("earlier", "new")

    def augmentation(self, inputs, version):
        augmentation = super().augmentation(inputs, version)
        return replace(augmentation, file=RecordingRef(inputs / "drive" / "000001.pcd"))


class AugmentCampaignUser(AugmentUser):
    """Augmentation with several variants, of which the second version has fewer."""

    last = "out/variants.csv"

    def prepare(self, folder, patches):
        super().prepare(folder, patches)
        (folder / "effects.yaml").write_text("weather: {visibility_km: 1}\n")
        for version in (1, 2):
            text = f"base: effects.yaml\ncount: {4 - version}\nseed: {version}\n"
            (folder / f"{version}.yaml").write_text(text)

    def augmentation(self, inputs, version):
        variants = CampaignVariants(inputs / f"{version}.yaml")
        return replace(super().augmentation(inputs, version), variants=variants)


class Picture(NamedTuple):
    text: str

    def svg(self):
        return self.text

    html = svg


VEHICLE = """
body: {{box: [4, 2, 1], at: [0, 0, 0.3]}}
sensors: {{top: {{model: velodyne/vlp16, mounts: [[0, 0, 1.{version}], [1, 0, 1.{version}]]}}}}
targets: [cone]
region: {{distances_m: [6], bearings: 2, headings_deg: [0]}}
map: {{cell_m: 2, margin_m: 2}}
"""


class MountUser(User):
    last = "out/best.yaml"
    resumes = True
    source = "2.yaml"
    noun = "vehicle"

    def prepare(self, folder, patches):
        for version in (1, 2):
            (folder / f"{version}.yaml").write_text(VEHICLE.format(version=5 + version))

        def evaluate(evaluator, mounted):
            x, _, z = mounted.mount.position
            points = np.full(len(evaluator.placements), round(20 * (x + z)))
            heights = np.full((evaluator.grid.rows, evaluator.grid.columns), np.float32(z))
            return MountResult(points, heights, heights, 100, 3, 0, np.zeros((90, 180), np.float32))

        patches.setattr(MountEvaluator, "__call__", evaluate)
        draw = cache(pictures.draw_all)
        first = []

        def draw_all(result):
            first.append(result)
            return {name: Picture(result.study.vehicle.source) for name in draw(first[0])}

        patches.setattr(pictures, "draw_all", draw_all)

    def run(self, inputs, outputs, version, *, resume=False):
        file = inputs / f"{version}.yaml"
        rank_mounts(file, outputs / "out", workers=1, resume=resume, overwrite=True)


STREET = """
scene: {{copies: [{{name: House, box: [1, 4, 2], at: [[{version}, 1, 0]]}}]}}
sensor: {{rays_per_revolution: 36, layers: 5, vertical_fov_deg: 30, step_deg: 90}}
trajectory: {{points: [{{time_s: 0, position: [0, 0, 0]}}, {{time_s: 0.6, position: [1, 0, 0]}}]}}
"""


class OccupancyUser(User):
    """Grids that are added to a folder with those of another sensor."""

    last = "out/occupancy.json"
    resumes = True
    source = "2.yaml"
    noun = "scenario"
    other = "out/sequences/01/voxels/000000.bin"

    def prepare(self, folder, patches):
        for version in (1, 2):
            (folder / f"{version}.yaml").write_text(STREET.format(version=version))
        patches.setattr(writing, "_compute_files", cache(writing._compute_files))

    def run(self, inputs, outputs, version, *, resume=False):
        if not (outputs / self.other).exists():
            (outputs / self.other).parent.mkdir(parents=True)
            (outputs / self.other).write_text("of another sensor")
        grid = VoxelGrid((0, -2, -2), (4, 2, 2), 1)
        settings = writing.OccupancySettings("semantickitti", grid, backend="numpy")
        writing.write_occupancy(
            inputs / f"{version}.yaml",
            outputs / "out",
            settings,
            workers=1,
            resume=resume,
            overwrite=True,
        )


HALL = """
scene:
  copies: [{{name: Wall, box: [0.2, 4, 2], at: [[{version}, 0, 0]]}}]
  ground: {{margin_m: 8}}
sensor: velodyne/vlp16
"""


@dataclass(frozen=True)
class FakePicture:
    plan: object
    density: object = None

    def save(self, path):
        shown = getattr(self.plan, "stations", None)
        path.write_text(f"{self.plan.length_m if shown is None else shown}")


def run_command(command, *arguments):
    """Run a command without the messages that the program prints for errors."""
    with command.make_context(command.name, [*arguments]) as context:
        command.invoke(context)


class StationsUser(User):
    last = "out/stations.yaml"
    resumes = True
    source = "2.yaml"
    noun = "scene"

    def prepare(self, folder, patches):
        for version in (1, 2):
            (folder / f"{version}.yaml").write_text(HALL.format(version=version))
        places = np.mgrid[-6:6:2, -6:6:2, 2:3].reshape(3, -1).T.astype(np.float64)
        patches.setattr(stations, "candidates", lambda *arguments: places)
        patches.setattr(stations, "sensor_elevations", lambda sensor: (-0.5, 0.5))
        patches.setattr(stations, "_POINTS", 100)
        patches.setattr(result_pictures, "draw_stations", FakePicture)

    def run(self, inputs, outputs, version, *, resume=False):
        options = ("--out", str(outputs / "out"), "--spacing", "2", "--workers", "1")
        start = ("--resume",) if resume else ()
        run_command(
            stations_command.stations, f"{inputs}/{version}.yaml", *options, *start, "--overwrite"
        )


class FlightUser(User):
    """Plan of which the second version has no coordinate system, and therefore fewer files."""

    last = "out/flight.yaml"

    def prepare(self, folder, patches):
        plans = {}
        compute = flight.plan_flight

        def plan_flight(shape, *arguments, **settings):
            if shape.wkt not in plans:
                plans[shape.wkt] = compute(shape, *arguments, **settings)
            return plans[shape.wkt]

        patches.setattr(flight, "plan_flight", plan_flight)
        patches.setattr(flight_density, "SAMPLED_RAYS", 1000)
        patches.setattr(flight_map, "draw_flight", FakePicture)

    def run(self, inputs, outputs, version, *, resume=False):
        options = ("--sensor", "riegl-vq780i", "--agl", "700", "--out", str(outputs / "out"))
        system = ("--epsg", "25832") if version == 1 else ()
        area = f"0,0,{version}00,200"
        run_command(flight_command.flight, area, *options, *system, "--overwrite")


class CompareUser(User):
    last = "out/compare.json"

    def run(self, inputs, outputs, version, *, resume=False):
        picture = SimpleNamespace(png=lambda: f"picture {version}".encode())
        names = ["map", "above"][: 3 - version]  # the earlier result has more files
        table = "table" if version == 1 else None
        pages = dict.fromkeys(names, picture)
        write_comparison(outputs / "out", {"version": version}, f"page {version}", pages, table)


class FitUser(User):
    last = "sensor.yaml"

    def prepare(self, folder, patches):
        patches.setattr(charts, "draw_charts", lambda figures: SimpleNamespace(svg=str))
        patches.setattr(fitting, "render_template", lambda *_, report, **__: f"page of {report}")
        patches.setattr(fitting.Fit, "__repr__", lambda self: f"fit {self.figures}")

    def run(self, inputs, outputs, version, *, resume=False):
        model = SimpleNamespace(model_dump=lambda **_: {"name": str(version)})
        fitting.Fit(version, model).save(outputs / "sensor.yaml")


class PlotUser(User):
    last = "map.png"

    def prepare(self, folder, patches):
        def draw(shown, result, folder, *_):
            (folder / "report.html").write_text(f"page {shown}")
            paths = [folder / "path.png", folder / "map.png"]
            for path in paths:
                path.write_text(f"picture {shown}")
            return paths

        patches.setattr(result_pictures, "draw_pictures", draw)
        (folder / "report.html").write_text("page")

    def run(self, inputs, outputs, version, *, resume=False):
        publish_pictures(version, outputs, outputs, inputs / "report.html")


class ExportUser(User):
    last = "cloud.ply"
    states = ("earlier", "new")

    def run(self, inputs, outputs, version, *, resume=False):
        save_cloud(Cloud(np.full((3, 3), float(version)), {}), outputs / "cloud.ply")


class FolderUser(User):
    last = "bag"

    def run(self, inputs, outputs, version, *, resume=False):
        with (
            explain_os_errors("The bag cannot be written"),
            publishing.publishing(outputs / "bag") as staged,
        ):
            (staged / "bag" / "topic").mkdir(parents=True)
            for number in range(3 - version):
                (staged / "bag" / "topic" / f"{number}").write_text(f"message of {version}")


class FileUser(User):
    last = "picture.png"
    states = ("earlier", "new")

    def run(self, inputs, outputs, version, *, resume=False):
        with explain_os_errors("The picture cannot be written"):
            replace_file(outputs / "picture.png", f"picture {version}".encode())


USERS: dict[str, Callable[[], User]] = {
    "twin": TwinUser,
    "augment": AugmentUser,
    "augment, file": AugmentFileUser,
    "augment, campaign": AugmentCampaignUser,
    "mount": MountUser,
    "occupancy": OccupancyUser,
    "stations": StationsUser,
    "flight": FlightUser,
    "compare": CompareUser,
    "fit": FitUser,
    "plot": PlotUser,
    "export": ExportUser,
    "folder": FolderUser,
    "picture": FileUser,
}


def files(folder: Path) -> dict[str, bytes]:
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file()
    }


class Kills:
    """A command that replaces a result of version 1 with version 2, and is killed."""

    def __init__(self, user: User, folder: Path) -> None:
        self.user = user
        self.inputs = folder / "inputs"
        self.outputs = folder / "outputs"
        self.before = folder / "before"
        self.inputs.mkdir()
        self.outputs.mkdir()

    def prepare(self, patches: pytest.MonkeyPatch) -> None:
        """Compute both versions, and leave the first beside a file of the user."""
        self.user.prepare(self.inputs, patches)
        self.given = files(self.inputs)
        self.run(2)
        (self.outputs / "mine.txt").write_text("of the user")
        self.new = files(self.outputs)
        shutil.rmtree(self.outputs)
        self.outputs.mkdir()
        self.run(1)
        (self.outputs / "mine.txt").write_text("of the user")
        self.earlier = files(self.outputs)
        shutil.copytree(self.outputs, self.before)
        self.changes = count_changes(self.outputs.parent, lambda: self.run(2))

    def run(self, version: int, *, resume: bool = False) -> None:
        self.user.run(self.inputs, self.outputs, version, resume=resume)

    def kill(self, position: int) -> str:
        """Kill the command, and return what is left, after which it is continued."""
        self._restore()
        killed = is_killed(position, self.outputs.parent, lambda: self.run(2))
        left = self._check()
        # A second kill while the command is continued.
        second = position % 7
        is_killed(second, self.outputs.parent, lambda: self.run(2, resume=killed))
        self._check()
        self.run(2, resume=True)
        assert files(self.outputs) == self.new
        assert not [path for path in self.outputs.rglob("*") if path.name.startswith(UNFINISHED)]
        return left

    def fill_disk(self) -> None:
        """Run the command while no file can be flushed to the disk, and then continue it."""

        def fsync(_):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

        self._restore()
        with pytest.MonkeyPatch.context() as patches:
            patches.setattr(os, "fsync", fsync)
            with pytest.raises(LidarError, match="No space left") as info:
                self.run(2)
        assert not any(name in str(info.value) for name in UNFINISHED)
        notes = getattr(info.value, "__notes__", [])
        assert any("`--resume`" in note for note in notes) == self.user.resumes
        assert self._check() == "earlier"
        self.run(2, resume=True)
        assert files(self.outputs) == self.new

    def _restore(self) -> None:
        shutil.rmtree(self.outputs)
        shutil.copytree(self.before, self.outputs)

    def _check(self) -> str:
        """Check that there is one whole result, or visibly none."""
        assert files(self.inputs) == self.given
        found = {
            name: content
            for name, content in files(self.outputs).items()
            if not any(part.startswith(UNFINISHED) for part in Path(name).parts)
        }
        assert found["mine.txt"] == b"of the user"
        if not (self.outputs / self.user.last).exists():
            return "incomplete"
        if found == self.new:
            return "new"
        assert found == self.earlier
        return "earlier"


@pytest.fixture(params=USERS)
def kills(request, tmp_path, monkeypatch):
    made = Kills(USERS[request.param](), tmp_path)
    made.prepare(monkeypatch)
    monkeypatch.setattr(os, "fsync", lambda handle: None)  # takes most of the time
    return made


@pytest.mark.extended(keep=("twin", "augment", "mount", "stations", "compare", "export", "folder"))
def test_a_killed_command_leaves_one_result_or_visibly_none_and_is_continued(kills):
    step = max(kills.changes // POSITIONS, 1)
    left = [kills.kill(position) for position in range(0, kills.changes, step)]
    assert left == sorted(left, key=ORDER.index)
    assert left[0] == "earlier"


def test_a_full_disk_leaves_the_earlier_result_and_the_finished_items(kills):
    kills.fill_disk()


@pytest.mark.extended
def test_wherever_a_command_is_killed(kills):
    left = [kills.kill(position) for position in range(kills.changes + 1)]
    assert left == sorted(left, key=ORDER.index)
    assert {*left} == {*kills.user.states}


# -- unfinished work -------------------------------------------------------------------------------


@pytest.fixture(params=[name for name, user in USERS.items() if user.resumes])
def command(request, tmp_path, monkeypatch):
    """Return a command that stores finished items."""
    made = Kills(USERS[request.param](), tmp_path)
    made.prepare(monkeypatch)
    made._restore()
    return made


@pytest.fixture
def on_stored(monkeypatch):
    """Return a function that registers a call for when the first item is stored."""

    def register(call):
        pending = [call]
        store = work._store

        def store_and_call(*arguments):
            store(*arguments)
            if pending:
                pending.pop()()

        monkeypatch.setattr(work, "_store", store_and_call)

    return register


def interrupt():
    raise KeyboardInterrupt


def stored_files(folder):
    """Return all files of finished items."""
    return [path for path in folder.rglob("*") if path.is_file() and path.parent.name != FOLDER]


def test_an_interrupted_command_states_how_to_continue(command, on_stored):
    on_stored(interrupt)
    with pytest.raises(KeyboardInterrupt) as info:
        command.run(2)
    (note,) = info.value.__notes__
    assert "Continue with `--resume`." in note
    assert command._check() == "earlier"
    with pytest.raises(
        LidarError, match=r"an unfinished \w+\. Continue it with `--resume`, or rem"
    ):
        command.run(2)
    with pytest.raises(LidarError, match=r"an unfinished \w+ with different inputs \([\w ]+\)"):
        command.run(1, resume=True)
    command.run(2, resume=True)
    assert files(command.outputs) == command.new


def test_nothing_is_kept_without_finished_items(command, monkeypatch):
    monkeypatch.setattr(work, "_store", lambda *arguments: interrupt())
    with pytest.raises(KeyboardInterrupt) as info:
        command.run(2)
    assert not hasattr(info.value, "__notes__")
    assert files(command.outputs) == command.earlier


def test_changed_inputs_of_unfinished_work_are_named(command, on_stored):
    on_stored(interrupt)
    with pytest.raises(KeyboardInterrupt):
        command.run(2)
    os.utime(command.inputs / command.user.source, (1, 1))
    words = rf"different inputs \({command.user.noun}\)\. Repeat the original"
    with pytest.raises(LidarError, match=words):
        command.run(2, resume=True)
    assert command._check() == "earlier"


def test_inputs_that_change_meanwhile_are_refused(command, on_stored):
    source = command.inputs / command.user.source
    on_stored(lambda: os.utime(source, (1, 1)))
    with pytest.raises(LidarError, match=r" has changed since the \w+ began\. Start again with"):
        command.run(2)
    assert command._check() == "earlier"


def test_a_result_has_one_writer(command, on_stored):
    def run_again():
        with pytest.raises(LidarError, match="Another run or export is using"):
            command.run(2, resume=True)

    on_stored(run_again)
    command.run(2)
    assert files(command.outputs) == command.new


@pytest.mark.parametrize(
    "damage", [lambda data: data[: len(data) // 2], lambda data: data[:-1] + b"?", lambda data: b""]
)
def test_damaged_items_are_replaced(command, monkeypatch, damage):
    with monkeypatch.context() as patches:
        patches.setattr(os, "fsync", lambda handle: interrupt())  # when all items are stored
        with pytest.raises(KeyboardInterrupt):
            command.run(2)
    paths = [path for path in stored_files(command.outputs) if FOLDER in path.parts]
    assert len(paths) > 3
    for path in paths:
        path.write_bytes(damage(path.read_bytes()))
    command.run(2, resume=True)
    assert files(command.outputs) == command.new
