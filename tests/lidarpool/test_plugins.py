"""Plug-ins of other distributions: what is found, and what is said of those that cannot be used."""

import subprocess
import sys

import numpy as np
import pytest
from tests.meshes import write
from tests.plugin_files import write_distribution

from lidarfiles import save_cloud
from lidarfiles.clouds.format_table import format_row
from lidarfiles.clouds.writing import ExportSpec
from lidarfiles.identity.versions import plugin_versions, software
from lidarfiles.recordings.opening import open_recording
from lidarpool.cli.commands import cli
from lidarpool.identity.software import describe_difference
from lidarscenario.campaign.campaign_jobs import file_hashes
from lidarscenario.points.point_files import read_points
from lidarscenario.prepare import prepare
from lidarscenario.scenario import Scenario
from lidarscenario.schema import scenario_schema
from lidarsim import Cloud, LidarError, Scene, load_sensor
from lidarsim.environment.plugins import find_plugin, plugins_of
from lidarsim.scene.files.meshfile import load_meshes

# A mesh of one triangle, whatever is in the file.
TRIANGLE = """
import numpy as np
from lidarsim.plugins import Content, MeshFormat, SceneMesh

def read(data, path, wanted):
    mesh = SceneMesh("Triangle", np.eye(3), np.array([[0, 1, 2]]))
    return Content([mesh], unit_m=1.0, up_axis="z")

FORMAT = MeshFormat((".{ending}",), read)
"""


@pytest.fixture
def distribution(tmp_path, monkeypatch):
    """Return what installs a distribution; its modules have a name of their own in each test."""

    def distribution(name, entry_points, modules):
        folder = tmp_path / "installed" / name
        monkeypatch.syspath_prepend(write_distribution(folder, name, entry_points, modules))

    return distribution


def mesh(distribution, name, ending, text, value=None):
    module = name.replace("-", "_")
    value = value or f"{module}:FORMAT"
    distribution(name, {"lidarsim.meshes": {f".{ending}": value}}, {f"{module}.py": text})


# -- names ---------------------------------------------------------------------------------------


def test_a_plugin_reads_files_of_its_ending(tmp_path, distribution):
    mesh(distribution, "plain-mesh", "plain", TRIANGLE.format(ending="plain"))
    (triangle,) = load_meshes(write(tmp_path / "a.PLAIN", "anything"))
    assert triangle.name == "Triangle"


SIZED = """
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from lidarsim.plugins import Content, MeshFormat, SceneMesh, about

@dataclass(frozen=True)
class SizedOptions:
    size_m: Annotated[float, about("length of the edges, meters", gt=0, le=100)] = 1.0

def read(data, path, wanted):
    mesh = SceneMesh("Triangle", wanted.own.size_m * np.eye(3), np.array([[0, 1, 2]]))
    return Content([mesh], unit_m=1.0, up_axis="z")

FORMAT = MeshFormat((".sized",), read, options=SizedOptions)
"""


def test_a_plugin_has_options_of_its_own(tmp_path, distribution):
    mesh(distribution, "sized-mesh", "sized", SIZED)
    path = write(tmp_path / "a.sized", "anything")
    assert load_meshes(path)[0].vertices.max() == 1
    assert Scene.load(path, size_m=3.0).vertices.max() == 3
    assert "above 0" in refused(Scene.load, path, size_m=0.0)
    told = refused(Scene.load, write(tmp_path / "a.obj", "v 0 0 0\n"), size_m=3.0)
    assert "a.obj does not support size_m (an option of .sized). Remove size_m." in told


def test_a_scenario_takes_options_of_a_plugin(tmp_path, distribution):
    mesh(distribution, "scenario-mesh", "sized", SIZED)
    write(tmp_path / "a.sized", "anything")

    def scene(entry):
        data = {"scene": [entry], "poses": [[0, 0, 1]]}
        return prepare(Scenario.from_data(data, folder=tmp_path)).scene

    assert scene({"file": "a.sized", "size_m": 3.0}).vertices.max() == 3
    told = refused(scene, {"file": "a.sized", "size_m": 0})
    assert told == "scenario: scene.files[0].size_m must be above 0 and at most 100, but is 0."
    told = refused(scene, {"file": "a.obj", "size_m": 3})
    assert "a.obj does not support size_m (an option of .sized). Remove size_m." in told
    assert scenario_schema()["$defs"]["MeshFile"]["properties"]["size_m"]["maximum"] == 100


def test_an_option_of_two_formats_has_the_limits_of_the_file(distribution):
    mesh(distribution, "sag-mesh", "sized", SIZED.replace("size_m", "sag_m"))
    schema = scenario_schema()["$defs"]["MeshFile"]["properties"]["sag_m"]
    assert [entry["maximum"] for entry in schema["anyOf"]] == [1, 100]
    Scenario.from_data({"scene": [{"file": "a.sized", "sag_m": 90}]})
    told = refused(Scenario.from_data, {"scene": [{"file": "a.xodr", "sag_m": 90}]})
    assert "sag_m must be at most 1, but is 90." in told


@pytest.mark.parametrize(
    ("name", "fields", "message"),
    [
        ("unchecked", "size_m: float = 1.0", "are not a dataclass"),
        ("no-default", "size_m: float", "have no default for size_m"),
        ("shared", "unit: str = 'm'", "redefine unit, an option of all formats"),
    ],
)
def test_options_of_a_plugin_that_cannot_be_used(tmp_path, distribution, name, fields, message):
    text = SIZED.replace("    size_m: Annotated", f"    {fields}\n    other_m: Annotated")
    text = text.replace(".sized", f".{name}")
    text = text.replace("@dataclass(frozen=True)\n", "") if name == "unchecked" else text
    mesh(distribution, f"flawed-{name}", name, text)
    path = write(tmp_path / f"a.{name}", "anything")
    assert f"has options that {message}" in refused(Scene.load, path)


def test_formats_of_the_table_are_read_without_a_look_at_plugins(tmp_path, distribution):
    mesh(distribution, "own-obj", "obj", TRIANGLE.format(ending="obj"))
    with pytest.raises(LidarError, match="contains no triangles"):
        load_meshes(write(tmp_path / "a.obj", "v 0 0 0\n"))


def test_a_plugin_reads_what_the_table_has_only_advice_for(tmp_path, distribution):
    assert "FreeCAD" in refused(load_meshes, write(tmp_path / "b.stp", "anything"))
    mesh(distribution, "step-mesh", "step", TRIANGLE.format(ending="step"))
    assert len(load_meshes(write(tmp_path / "b.step", "anything"))) == 1


def test_an_unknown_ending_lists_those_of_plugins(tmp_path, distribution):
    mesh(distribution, "listed-mesh", "listed", TRIANGLE.format(ending="listed"))
    assert ".ifczip .listed" in refused(load_meshes, write(tmp_path / "a.unlisted", "anything"))


def test_two_plugins_of_one_name_are_an_error(tmp_path, distribution):
    for name in ("twice-a", "twice-b"):
        mesh(distribution, name, "twice", TRIANGLE.format(ending="twice"))
    told = refused(load_meshes, write(tmp_path / "a.twice", "anything"))
    assert "twice-a 0.1 and twice-b 0.1 both provide '.twice' for lidarsim.meshes" in told


def test_names_without_a_plugin(distribution):
    distribution("only-one", {"lidarpool.commands": {"only": "only_one:command"}}, {})
    assert find_plugin("lidarpool.commands", "other") is None
    assert list(plugins_of("lidarpool.commands")) == ["only"]


# -- plug-ins that cannot be used ----------------------------------------------------------------


def refused(function, *arguments, **options):
    with pytest.raises(LidarError) as caught:
        function(*arguments, **options)
    told = str(caught.value)
    assert "\n" not in told
    return told


@pytest.mark.parametrize(
    ("name", "text", "value", "message"),
    [
        ("lost-library", "import no_such_library", None, "No module named 'no_such_library'"),
        ("lost-name", "", None, "has no attribute 'FORMAT'"),
        ("lost-module", "", "no_such_module:FORMAT", "No module named 'no_such_module'"),
        ("wrong-kind", "FORMAT = {}", None, "is a dict, but lidarsim.meshes requires a MeshFormat"),
        (
            "lost-field",
            "from lidarsim.plugins import MeshFormat\nFORMAT = MeshFormat()",
            None,
            "missing 1 required positional argument: 'endings'",
        ),
        (
            "lost-reader",
            "from lidarsim.plugins import MeshFormat\nFORMAT = MeshFormat(('.lost-reader',))",
            None,
            "lacks read, which lidarsim.meshes requires",
        ),
        (
            "lost-function",
            "from lidarsim.plugins import MeshFormat\n"
            "FORMAT = MeshFormat(('.lost-function',), 'lost_function:read')",
            None,
            "has no attribute 'read'",
        ),
        ("other-ending", TRIANGLE.format(ending="other"), None, "is a MeshFormat for .other"),
        (
            "late-library",
            TRIANGLE.format(ending="late-library").replace("mesh =", "import no_such; mesh ="),
            None,
            "cannot be imported: No module named 'no_such'",
        ),
        (
            "no-content",
            TRIANGLE.format(ending="no-content").replace("return ", "return [], "),
            None,
            "return Content",
        ),
    ],
)
def test_a_line_names_the_distribution(tmp_path, distribution, name, text, value, message):
    mesh(distribution, name, name, text, value)
    told = refused(load_meshes, write(tmp_path / f"a.{name}", "anything"))
    assert message in told
    assert f"'.{name}' of the plug-in {name} 0.1" in told


def test_formats_of_clouds_that_cannot_be_used(distribution):
    distribution(
        "half-cloud",
        {"lidarpool.clouds": {name: f"half_cloud:{name}" for name in ("Half", "Row", "Taken")}},
        {
            "half_cloud.py": "from lidarpool.plugins import CloudFormat, FormatRow\n"
            "class Half(CloudFormat): row = FormatRow('half.txt')\n"
            "class Row: pass\n"
            "class Taken(CloudFormat): row = FormatRow('cloud.ply')\n"
        },
    )
    assert "lacks half_cloud.Half.write" in refused(format_row, "Half")
    assert "lacks a subclass of lidarpool.plugins.CloudFormat" in refused(format_row, "Row")
    assert "writes 'cloud.ply'" in refused(format_row, "Taken")
    told = refused(ExportSpec, "quarter")
    assert "Unknown cloud format 'quarter'" in told and "Half" in told


def test_sensors_that_cannot_be_used(distribution):
    distribution("no-folder", {"lidarsim.sensors": {"nobody": "no_folder"}}, {"no_folder.py": ""})
    told = refused(load_sensor, "nobody/x1")
    assert "'nobody' of the plug-in no-folder 0.1 lacks the folder nobody in no_folder" in told
    distribution(
        "one-model",
        {"lidarsim.sensors": {"maker": "one_model"}},
        {"one_model/maker/x1.yaml": "firing_us: 1"},
    )
    assert "Did you mean 'maker/x1'?" in refused(load_sensor, "maker/x2")
    assert "x1.yaml is not a valid sensor model" in refused(load_sensor, "maker/x1")


def test_commands_that_cannot_be_used(distribution, capsys):
    distribution(
        "half-command",
        {"lidarpool.commands": {"half": "half_command:half"}},
        {"half_command.py": ""},
    )
    assert "'half' of the plug-in half-command 0.1" in refused(cli.main, ["half"])
    with pytest.raises(SystemExit):
        cli.main(["--help"])
    assert "half  half-command 0.1" in capsys.readouterr().out


# -- what is written -----------------------------------------------------------------------------


def test_a_plugin_writes_a_cloud_to_a_file(tmp_path, distribution):
    distribution(
        "text-cloud",
        {"lidarpool.clouds": {"text": "text_cloud:Text"}},
        {
            "text_cloud.py": "from lidarpool.plugins import CloudFormat, FormatRow\n"
            "class Text(CloudFormat):\n"
            "    row = FormatRow('cloud.text', packages=('no_such',))\n"
            "    def write(self, path, spec): path.write_text(f'{len(self.cloud)} points')\n"
        },
    )
    cloud = Cloud([[0.0, 0.0, 1.0]], {})
    told = refused(save_cloud, cloud, tmp_path / "a.text", format="text")
    assert "requires no_such. Run pip install no_such" in told
    object.__setattr__(format_row("text"), "packages", ())
    save_cloud(cloud, tmp_path / "a.text", format="text")
    assert (tmp_path / "a.text").read_text() == "1 points"


# -- what is read --------------------------------------------------------------------------------


def test_a_plugin_reads_a_cloud_as_sweeps_and_as_points(tmp_path, distribution):
    distribution(
        "line-cloud",
        {"lidarpool.clouds": {"lines": "line_cloud:Lines"}},
        {
            "line_cloud.py": "import numpy as np\n"
            "from lidarpool.plugins import CloudFormat, FormatRow, Sweep, SweepsInMemory\n"
            "class Lines(CloudFormat):\n"
            "    row = FormatRow('', suffixes=('.lines',))\n"
            "    for_scenes = True\n"
            "    @classmethod\n"
            "    def open(cls, ref):\n"
            "        return SweepsInMemory(ref.info(), [Sweep(np.loadtxt(ref.path))])\n"
        },
    )
    points = np.arange(60.0).reshape(20, 3)
    np.savetxt(tmp_path / "a.lines", points)
    recording = open_recording(tmp_path / "a.lines")
    np.testing.assert_array_equal(recording[0].points, points)
    scanned, epsg, _ = read_points(tmp_path / "a.lines", None, report=print)
    np.testing.assert_array_equal(scanned.points, points)
    assert epsg is None
    told = refused(save_cloud, Cloud(points, {}), tmp_path / "b.lines", format="lines")
    assert (
        told
        == "The format 'lines' can be read, but not written. Write another format, such as ply."
    )


# -- software ------------------------------------------------------------------------------------


def test_software_has_the_plugins_that_are_used(tmp_path, distribution):
    mesh(distribution, "used-mesh", "used", TRIANGLE.format(ending="used"))
    mesh(distribution, "idle-mesh", "idle", TRIANGLE.format(ending="idle"))
    plugin = find_plugin("lidarsim.meshes", ".used")
    described = software(plugins=[plugin])
    assert described.keys() == {"lidarpool", "plug-in used-mesh"}
    assert described["plug-in used-mesh"] == plugin_versions([plugin])[plugin]
    assert described["plug-in used-mesh"].startswith("0.1 (sources ")
    told = describe_difference(software(), described)
    assert told.startswith("no plug-in used-mesh, but the run requires plug-in used-mesh 0.1")


def test_jobs_of_campaigns_know_the_plugins_that_read_their_meshes(tmp_path, distribution):
    mesh(distribution, "job-mesh", "job", TRIANGLE.format(ending="job"))
    path = write(tmp_path / "a.job", "anything")
    names = [name for name, _ in file_hashes([path])]
    assert names == ["a.job", "job-mesh"]


@pytest.mark.slow
def test_the_hash_of_a_plugin_is_that_of_its_package(tmp_path):
    code = (
        "from lidarsim.environment.plugins import find_plugin\n"
        "from lidarfiles.identity.versions import plugin_versions\n"
        "print(*plugin_versions([find_plugin('lidarsim.meshes', '.hashed')]).values())"
    )
    texts = {"same": "", "other": "# a comment", "again": ""}
    versions = {}
    for name, comment in texts.items():
        folder = write_distribution(
            tmp_path / name,
            "hashed",
            {"lidarsim.meshes": {".hashed": "hashed.meshes:FORMAT"}},
            {"hashed/__init__.py": "", "hashed/meshes.py": "", "hashed/more.py": comment},
        )
        environment = subprocess.os.environ | {
            "PYTHONPATH": f"{folder}:{subprocess.os.environ['PYTHONPATH']}"
        }
        run = subprocess.run(
            [sys.executable, "-c", code],
            capture_output=True,
            text=True,
            check=True,
            env=environment,
        )
        versions[name] = run.stdout
    assert versions["same"] == versions["again"] != versions["other"]
