"""The command `lidarpool augment`: its options, its output, and its messages."""

from __future__ import annotations

import json
from typing import get_args

import pytest
from click.testing import CliRunner
from tests.recorded_drives import recorded_points, write_pcd_drive

from lidarfiles import open_recording
from lidarfiles.clouds.recording_ref import RecordingRef
from lidarpool.cli.commands import cli
from lidarreal.augmentation.insertions import load_insertion
from lidarreal.augmentation.rewriting.opening import open_rewriter
from lidarreal.augmentation.running import Augmentation, AugmentedRecording
from lidarreal.augmentation.sweep_tasks import PointCounts
from lidarsim import LidarError
from lidarsim.media.weather import Weather
from lidarsim.schema.vocabulary import INSERTIONS, RETURN_MODES
from lidarsim.sensor.optics import Mode

SWEEPS = 3


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    folder = tmp_path_factory.mktemp("recorded") / "drive"
    return write_pcd_drive(folder, recorded_points(SWEEPS))


@pytest.fixture
def run():
    """Return a function that runs the command, and returns its result."""

    def invoke(*arguments, fails=False):
        result = CliRunner().invoke(cli, ["augment", *map(str, arguments)])
        if not fails and result.exception is not None:
            raise result.exception
        return result

    return invoke


@pytest.fixture
def captured(monkeypatch, drive, tmp_path, run):
    """Return a function that runs the command, and returns the augmentation without running it."""

    def arguments_of(*arguments):
        calls = []

        def record(self, out, **options):
            calls.append((self, options))
            return AugmentedRecording((out,), None, SWEEPS, PointCounts(), 1.0, ())

        monkeypatch.setattr(Augmentation, "run", record)
        run(drive, "--out", tmp_path / "out", *arguments)
        ((augmentation, options),) = calls
        return augmentation, options

    return arguments_of


def effects_of(captured, *arguments):
    augmentation, _ = captured(*arguments)
    return augmentation.variants.effects(0)


def test_a_drive_is_augmented(run, drive, tmp_path):
    out = tmp_path / "wet"
    result = run(drive, "--out", out, "--rain", 50, "--fog", 0.2, "--workers", 1)
    *notes, summary, place, following = result.stdout.splitlines()
    assert all(note.startswith("note: ") for note in notes)
    assert summary.startswith(f"{SWEEPS} sweeps augmented: ")
    assert "from air" in summary
    assert place == f"result in {out}"
    assert following == f"next: lidarpool view {out}"
    assert "reading the recording" in result.stderr
    assert len(open_recording(out)) == SWEEPS


def test_results_are_printed_as_json(run, drive, tmp_path):
    out = tmp_path / "wet"
    result = run(drive, "-o", out, "--rain", 50, "--workers", 1, "--json", "--quiet")
    figures = json.loads(result.stdout)
    assert figures["outputs"] == [str(out)]
    assert figures["sweeps"] == SWEEPS
    assert figures["kept"] <= figures["returns"]
    assert not result.stderr


def test_campaigns_name_their_first_variant(run, drive, tmp_path):
    (tmp_path / "effects.yaml").write_text("weather: {rain_mm_h: 5}")
    campaign = tmp_path / "campaign.yaml"
    campaign.write_text("base: effects.yaml\nvary: {weather.rain_mm_h: {each: [1, 20]}}\n")
    out = tmp_path / "out"
    result = run(drive, campaign, "--out", out, "--workers", 1)
    assert "augmented in each of 2 variants" in result.stdout
    assert f"variants in {out}\nnext: lidarpool view {out / '0000'}" in result.stdout


def test_weather_options(captured):
    effects = effects_of(captured, "--rain", 5, "--snow", 1, "--fog", 0.5, "--dust", 30)
    expected = Weather(rain_mm_h=5, snow_mm_h=1, visibility_km=0.5, dust_mg_m3=30)
    assert effects.weather == expected


def test_fault_and_noise_options(captured):
    effects = effects_of(
        captured,
        *("--dirt", 0.3, "--dead-channels", "3,7", "--dropped-packets", 0.1),
        *("--dropout", 0.05, "--range-noise", 0.02, "--mode", "dual", "--seed", 9),
    )
    dirt, dead, dropped = effects.faults
    assert (dirt.kind, dirt.transmission) == ("dirt", 0.3)
    assert dead.channels == (3, 7)
    assert (dropped.kind, dropped.share) == ("dropped_packets", 0.1)
    assert effects.noise == {"dropout": 0.05, "range_m": 0.02}
    assert effects.mode == "dual"
    assert effects.seed == 9


def test_options_override_a_file(captured, tmp_path):
    path = tmp_path / "effects.yaml"
    path.write_text("weather: {rain_mm_h: 5, dust_mg_m3: 3}\nnoise: {seed: 4}\n")
    effects = effects_of(captured, path, "--rain", 20)
    assert effects.weather == Weather(rain_mm_h=20, dust_mg_m3=3)
    assert effects.seed == 4
    assert effects_of(captured, path, "--seed", 0).seed == 0


def test_options_of_each_insertion_follow_it(captured):
    effects = effects_of(
        captured,
        *("--insert", "car", "--at", "12,3"),
        *("--insert", "pedestrian", "--heading", 90, "--at=-5,1,-1.5", "--class", "person"),
        *("--insert", "car", "--at", "1,2", "--heading", -45, "--name", "taxi"),
    )
    assert [insertion.name for insertion in effects.insertions] == ["", "", "taxi"]
    car, person, other = effects.insertions
    assert (car.mesh.name, car.x_m, car.y_m, car.z_m) == ("car", 12, 3, None)
    assert (car.heading_deg, car.class_name) == (0, "car")
    assert (person.x_m, person.y_m, person.z_m) == (-5, 1, -1.5)
    assert (person.heading_deg, person.class_name) == (90, "person")
    assert (other.mesh.name, other.x_m, other.heading_deg) == ("car", 1, -45)


def test_recording_and_run_options(captured):
    augmentation, options = captured(
        *("--rain", 1, "--topic", "/points", "--intensity", "signal", "--model", "ouster/os1-64"),
        *("--sensor", "velodyne/vlp16", "--reflectance", 0.2),
        *("--workers", 3, "--resume", "--format", "pcd"),
    )
    assert (augmentation.file.sensor, augmentation.file.intensity) == ("/points", "signal")
    assert augmentation.model.name == "Ouster OS1-64"
    assert augmentation.model.noise is not None
    assert augmentation.resampled.name == "Velodyne VLP-16"
    assert augmentation.numbers is None
    assert augmentation.reflectance == 0.2
    assert augmentation.output_format == "pcd"
    assert options["workers"] == 3
    assert options["resume"]
    assert not options["overwrite"]
    assert options["client"] is None


@pytest.mark.parametrize(
    ("text", "numbers"), [("7", range(7, 8)), (":3", range(3)), ("3:9", range(3, 9))]
)
def test_ranges_of_sweeps(captured, text, numbers):
    assert captured("--rain", 1, "--sweeps", text)[0].numbers == numbers


def test_ranges_may_have_no_end(captured):
    assert captured("--rain", 1, "--sweeps", "2:")[0].numbers.start == 2


def test_resampling_requires_no_effects(captured):
    augmentation, _ = captured("--sensor", "velodyne/vlp16")
    assert augmentation.variants.effects(0).is_empty
    assert not augmentation.partial
    assert captured("--sensor", "velodyne/vlp16", "--partial")[0].partial


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([], "No effects are specified. Pass an effects file, or an option such as `--rain 25`"),
        (["--at", "1,2"], "`--at` must follow the `--insert` of the object"),
        (["--insert", "car"], "`--insert car` requires a position. Add `--at X,Y` after it."),
        (
            ["--insert", "car", "--at", "1,2", "--at", "3,4"],
            "`--at` occurs twice for `--insert car`",
        ),
        (["--name", "Anna"], "`--name` must follow the `--insert` of the object"),
        (["--class", "car"], "`--class` must follow the `--insert` of the object"),
        (["--insert", "car", "--at", "1"], "'1' is not a position. Expected X,Y or X,Y,Z"),
        (["--insert", "cart", "--at", "1,2"], "There is no object 'cart' to insert. Did you mean"),
        (["--insert", "no.glb", "--at", "1,2"], "no.glb does not exist"),
        (["--dead-channels", "a"], "'a' is not a list of channels"),
        (["--sweeps", "5:2", "--rain", 1], "'5:2' is not a range of sweeps"),
        (["--sweeps", "x", "--rain", 1], "'x' is not a range of sweeps"),
        (["--sweeps", "30:40", "--rain", 1], "has 3 sweeps, so `--sweeps` must start before 3"),
        (
            ["--sweeps", "0:2", "--sensor", "velodyne/vlp16"],
            "`--sweeps` and `--sensor` cannot be combined",
        ),
        (["--rain", 1, "--partial"], "`--partial` requires `--sensor`."),
        (["--rain", 1, "--resume", "--restart"], "`--resume` and `--restart` cannot be"),
        (["--rain", -1], "-1.0 is not in the range"),
        (["--rain", 1, "--model", "velodyne/none"], "velodyne/none"),
        (["--rain", 1, "--sensor", "velodyne/none"], "velodyne/none"),
        (["--rain", 1, "--intensity", "signal"], "it has no column 'signal'"),
        (["nowhere.yaml"], "nowhere.yaml does not exist"),
        (
            ["--rain", 1, "--workers", 2, "--scheduler", "tcp://127.0.0.1:9"],
            "`--workers` and `--scheduler` cannot be combined",
        ),
    ],
)
def test_invalid_options_are_refused(run, drive, tmp_path, arguments, words):
    out = tmp_path / "out"
    result = run(drive, *arguments, "--out", out, "--quiet", fails=True)
    message = str(result.exception) if isinstance(result.exception, LidarError) else result.output
    assert words in " ".join(message.split())
    assert not [*tmp_path.iterdir()]


@pytest.mark.parametrize("options", [[], ["--format", "mcap"], ["--format", "las"]])
def test_clouds_are_refused_because_they_have_no_sweeps(run, tmp_path, options):
    cloud = tmp_path / "c.csv"
    cloud.write_text("x,y,z,intensity\n1,2,3,4\n5,6,7,8\n")
    result = run(cloud, "--out", tmp_path / "x.csv", "--rain", 5, *options, fails=True)
    expected = f"{cloud} contains no sweeps. Use a recording that consists of sweeps."
    assert str(result.exception) == expected
    assert [*tmp_path.iterdir()] == [cloud]


def test_folders_of_results_name_their_recordings(run, drive, tmp_path):
    folder = tmp_path / "result"
    folder.mkdir()
    header = "ply\nformat ascii 1.0\nelement vertex 2\n"
    header += "".join(f"property float {axis}\n" for axis in "xyz")
    (folder / "cloud.ply").write_text(f"{header}end_header\n1 2 3\n4 5 6\n")
    (folder / "notes.txt").write_text("")
    (folder / "pcd").symlink_to(drive)
    remedy = f"Pass {folder / 'pcd'} instead."
    result = run(folder, "--out", tmp_path / "out", "--rain", 5, fails=True)
    assert str(result.exception) == f"{folder} contains no sweeps. {remedy}"
    with pytest.raises(LidarError) as error:
        open_rewriter(RecordingRef(folder), open_recording(drive))
    assert str(error.value) == f"{folder} cannot be rewritten in PLY. {remedy}"


@pytest.mark.parametrize(
    ("name", "options", "words"),
    [
        (
            "x.las",
            [],
            "x.las ends in .las, but the copy is a folder. Use `--format las`, or an output "
            "folder.",
        ),
        (
            "x.MCAP",
            ["--format", "las"],
            "x.MCAP ends in .mcap, but the copy is a .las file. Use `--format mcap`, or an output "
            "folder.",
        ),
        ("x.pcd", [], "x.pcd ends in .pcd, but the copy is a folder. Use an output folder."),
    ],
)
def test_endings_of_other_formats_are_refused(run, drive, tmp_path, name, options, words):
    result = run(drive, "--out", tmp_path / name, "--rain", 5, *options, fails=True)
    assert str(result.exception) == f"{tmp_path}/{words}"
    assert not [*tmp_path.iterdir()]


def test_endings_of_files_are_refused_for_campaigns(run, drive, tmp_path):
    (tmp_path / "effects.yaml").write_text("weather: {rain_mm_h: 5}")
    campaign = tmp_path / "campaign.yaml"
    campaign.write_text("base: effects.yaml\nvary: {weather.rain_mm_h: {each: [1, 20]}}\n")
    out = tmp_path / "x.mcap"
    result = run(drive, campaign, "--out", out, fails=True)
    assert str(result.exception) == (
        f"{out} ends in .mcap, but a campaign writes a folder with a copy for each variant. "
        "Specify a path without this ending with `--out`."
    )
    assert not out.exists()


def test_folders_that_cannot_be_created_are_named_like_the_output(run, drive):
    result = run(drive, "--out", "/proc/x", "--rain", 5, fails=True)
    assert str(result.exception) == (
        "Cannot write to /proc/x: No such file or directory. Specify another path with `--out`."
    )


def test_urls_are_refused(run, drive):
    result = run(drive, "--rain", 1, "--out", "s3://bucket/wet", fails=True)
    assert "s3://bucket/wet is a URL" in str(result.exception)


@pytest.mark.parametrize("option", [["--rain", 3], ["--seed", 3], ["--dirt", 0.5]])
def test_options_are_refused_with_campaigns(run, drive, tmp_path, option):
    (tmp_path / "effects.yaml").write_text("weather: {rain_mm_h: 5}")
    campaign = tmp_path / "campaign.yaml"
    campaign.write_text("base: effects.yaml\ncount: 2\nvary: {}\n")
    result = run(drive, campaign, *option, "--out", tmp_path / "out", fails=True)
    assert "cannot be combined with a campaign" in result.output


def test_files_without_effects_are_refused(run, drive, tmp_path):
    path = tmp_path / "effects.yaml"
    path.write_text("classes: {3: car}\n")
    result = run(drive, path, "--out", tmp_path / "out", fails=True)
    assert "effects.yaml has no effects" in str(result.exception)


def test_names_of_the_options():
    assert get_args(Mode) == RETURN_MODES
    assert [load_insertion(name).name for name in INSERTIONS] == [*INSERTIONS]
