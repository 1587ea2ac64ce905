"""The distributions of this repository: what they hold, alone and together."""

import ast
import importlib.metadata
import os
import re
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import pytest
from packaging.requirements import Requirement

import lidarpool
import lidarsim
import poolpart
import raybeam
from lidarpool import __version__

ROOT = Path(__file__).parents[2]


@dataclass(frozen=True)
class Distribution:
    """A distribution: `pip install ROOT/folder`."""

    folder: str  # with pyproject.toml
    packages: tuple[str, ...]  # folders of its import packages, from `folder`
    only: frozenset[str] = frozenset()  # all distributions that come with it, if they are few
    without: frozenset[str] = frozenset()  # distributions that do not come with it
    prints: str = ""  # by the example of its README, if it has one
    more: str = ""  # code behind that example

    @property
    def imports(self) -> list[str]:
        """Names of its import packages."""
        return [(ROOT / self.folder / package).resolve().name for package in self.packages]


# {name: distribution}; the first requires the others.
DISTRIBUTIONS = {
    "lidarpool": Distribution(
        ".",
        ("workflows/lidarlive", "workflows/lidarpool"),
        without=frozenset({"pytest"}),
    ),
    "raybeam": Distribution(
        "kernels",
        ("raybeam",),
        only=frozenset({"numpy"}),
        prints="[ 5. inf]\nnumpy\n",
        more="print(caster.backend)\n",
    ),
    "poolpart": Distribution(
        "scheduler",
        ("poolpart",),
        without=frozenset({"lidarpool", "raybeam", "numpy"}),
        prints="1 2\n1024\n45\n",
    ),
    "lidarsim": Distribution(
        "workflows/lidarsim",
        (".",),
        without=frozenset(
            {"lidarpool", "poolpart", "dask", "distributed", "bokeh", "matplotlib", "fsspec"}
            | {"open3d", "open3d-cpu"}
        ),
        prints="2494 3\n",
    ),
    "lidarfiles": Distribution(
        "workflows/lidarfiles",
        (".",),
        without=frozenset(
            {"lidarpool", "lidarreal", "poolpart", "dask", "distributed", "matplotlib", "scipy"}
            | {"open3d", "open3d-cpu", "click"}
        ),
        prints="3 intensity\n",
    ),
    "lidarreal": Distribution(
        "workflows",
        ("lidarscenes", "lidarview", "lidarscenario", "lidarreal"),
        without=frozenset({"lidarpool", "poolpart", "dask", "distributed", "rich"}),
        prints="(2296, 4) (2083, 4)\n",
    ),
}
# Those that each requires of the others.
REQUIRED = {
    "lidarpool": {"raybeam", "poolpart", "lidarsim", "lidarfiles", "lidarreal"},
    "lidarsim": {"raybeam"},
    "lidarfiles": {"raybeam", "lidarsim"},
    "lidarreal": {"raybeam", "lidarsim", "lidarfiles"},
}
# Files of a distribution beside its package.
ABOUT = {"pyproject.toml", "README.md", "LICENSE"}
WHOLE, *PARTS = DISTRIBUTIONS


def folder_of(name: str) -> Path:
    return ROOT / DISTRIBUTIONS[name].folder


def declared(name: str) -> dict:
    return tomllib.loads((folder_of(name) / "pyproject.toml").read_text(encoding="utf-8"))


@pytest.mark.parametrize("name", PARTS)
def test_a_part_wants_what_the_whole_wants(name):
    whole = declared(WHOLE)["project"]
    part = declared(name)["project"]
    extras = whole["optional-dependencies"]
    in_whole = {Requirement(text).name: text for text in whole["dependencies"]}
    for text in part["dependencies"]:
        assert in_whole.get(Requirement(text).name, text) == text
    for extra, wanted in part.get("optional-dependencies", {}).items():
        assert extra not in extras or set(wanted) <= set(extras[extra])
    assert part["requires-python"] == whole["requires-python"]
    assert (folder_of(name) / "LICENSE").read_bytes() == (ROOT / "LICENSE").read_bytes()


@pytest.mark.parametrize("part", [raybeam, poolpart, lidarpool])
def test_all_parts_have_one_version(part):
    assert part.__version__ == lidarsim.__version__
    assert "__version__" in part.__all__


@pytest.mark.parametrize("name", DISTRIBUTIONS)
def test_other_distributions_are_required_at_the_same_version(name):
    required = [Requirement(text) for text in declared(name)["project"]["dependencies"]]
    others = {one.name: str(one.specifier) for one in required if one.name in DISTRIBUTIONS}
    assert set(others.values()) <= {f"=={__version__}"}
    assert {*others} == REQUIRED.get(name, set())


# Packages that always come with another.
WITH_OTHERS = {
    "markupsafe": "jinja2",
    "pydantic-core": "pydantic",
    "tornado": "distributed",
}
# {import name of a package that is not required: where it is imported, once it was found}. Look for
# all paths to a new place: a command that imports a package without a check ends in a traceback
# where only the requirements are installed.
OPTIONAL = {
    "DracoPy": ("lidarsim/scene/files/gltf_draco.py",),
    "IPython": ("lidarsim/environment/notebook.py",),
    "betterosi": ("lidarfiles/clouds/osi.py", "lidarscenario/traffic/osi_trace.py"),
    "cuda": ("raybeam/cuda_backend.py",),
    "cupy": ("raybeam/cuda_backend.py",),
    "dask": ("lidarfiles/work/cluster_map.py",),
    "distributed": ("lidarfiles/work/cluster_map.py",),
    "poolpart": ("lidarfiles/work/cluster_map.py",),
    "cyclonedds": ("lidarlive/playback/dds.py", "lidarlive/playback/serialized_topics.py"),
    "foxglove": ("lidarlive/viewers/foxglove_server.py",),
    "fsspec": ("lidarsim/io/storage.py",),
    "google": ("lidarlive/serving/",),
    "grpc": ("lidarlive/serving/",),
    "ifcopenshell": ("lidarscenes/files/ifc_child.py",),
    "kr8s": ("poolpart/deploy/kubernetes.py",),
    "laspy": ("lidarfiles/clouds/las",),
    "lazrs": ("lidarfiles/clouds/las",),
    "llvmlite": ("raybeam/",),  # comes with numba
    "lpips": ("lidarreal/comparing/lidar4d.py",),
    "lz4": ("lidarreal/augmentation/rewriting/mcap_copy.py",),  # comes with rosbags
    "mujoco": ("lidarscenes/mujoco/model_child.py",),
    "numba": ("raybeam/",),
    "ouster": ("lidarsim/packets/ouster.py",),
    "pandas": ("poolpart/task_table.py",),
    "prometheus_client": ("poolpart/extras/metrics.py",),
    "pxr": ("lidarscenes/files/usd_child.py", "lidarscenes/sensors/omnilidar_child.py"),
    "py4dgeo": ("lidarreal/comparing/surveys/m3c2.py",),
    "pyarrow": (
        "lidarfiles/clouds/parquet", "lidarfiles/datasets/job_table.py",
        "lidarsim/sensor_files/ray_parquet.py",
    ),
    "pye57": ("lidarfiles/clouds/e57",),
    "rasterio": (
        "lidarfiles/clouds/navigation_files.py", "lidarfiles/clouds/well_known_text.py",
        "lidarscenario/plan/flight_area.py", "lidarscenes/files/rasters.py",
        "lidarsim/scene/files/coordinate_systems.py", "lidarsim/scene/files/stated_system.py",
    ),
    "rerun": ("lidarfiles/clouds/rrd.py", "lidarlive/viewers/rerun_server.py"),
    "rosbags": (
        "lidarreal/augmentation/rewriting/bag_rewriter.py", "lidarfiles/clouds/ros/",
        "lidarlive/following/pose_input.py", "lidarlive/playback/dds.py",
        "lidarsim/columns/bags.py", "lidarsim/columns/closing_bag.py",
    ),
    "shapely": ("lidarscenario/plan/flight_",),
    "small_gicp": ("lidarreal/reconstruction/odometry.py",),
    "torch": ("lidarreal/comparing/lidar4d.py", "lidarfiles/datasets/torch_sweeps.py"),
    "velodyne_decoder": ("lidarsim/packets/velodyne.py",),
}  # fmt: skip


def plain(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


IMPORT = re.compile(r"""^ *(?:from|import) (\w+)|import_module\("(\w+)""", re.MULTILINE)


def imports_in(code: str, known: set[str]) -> set[str]:
    """Names of other packages that a module imports anywhere, except for annotations."""
    known = known | sys.stdlib_module_names
    if {name for names in IMPORT.findall(code) for name in names if name} <= known:
        return set()  # parsing takes long
    tree = ast.parse(code)
    unseen: set[int] = set()
    names: set[str] = set()
    for node in ast.walk(tree):  # outer nodes come first
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            unseen |= {id(inner) for part in node.body for inner in ast.walk(part)}
        if id(node) in unseen:
            continue
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and not node.level:
            names.add(node.module or "")
        elif isinstance(node, ast.Call) and "import_module" in (
            getattr(node.func, "id", ""),
            getattr(node.func, "attr", ""),
        ):
            names |= {one.value for one in node.args[:1] if isinstance(one, ast.Constant)}
    return {name.partition(".")[0] for name in names} - known


def test_imports_are_required_or_checked():
    """Every imported package is required by its distribution, or its absence is reported."""
    unknown = []
    places = {name: {*prefixes} for name, prefixes in OPTIONAL.items()}
    providers = importlib.metadata.packages_distributions()
    for name, distribution in DISTRIBUTIONS.items():
        known = {*distribution.imports} | required_imports(name, providers)
        for package in distribution.packages:
            folder = (ROOT / distribution.folder / package).resolve()
            for file in folder.rglob("*.py"):
                module = file.relative_to(folder.parent).as_posix()
                for imported in imports_in(file.read_text(encoding="utf-8"), known):
                    prefixes = [one for one in OPTIONAL.get(imported, ()) if module.startswith(one)]
                    places.get(imported, set()).difference_update(prefixes)
                    if not prefixes:
                        unknown.append(f"{module} imports {imported}")
    assert unknown == []
    assert {name for name, unused in places.items() if unused} == set()


# Optional packages of no extra: users install them for other reasons, or they come with a package
# of an extra.
WITHOUT_EXTRA = {
    "IPython", "cupy", "cuda", "google", "kr8s", "llvmlite", "lpips", "lz4", "mujoco", "numba",
    "ouster", "pandas", "torch",
}  # fmt: skip
_PROVIDERS = {"rerun": ["rerun-sdk"]}  # of packages that tests do without


def test_optional_imports_are_in_an_extra_of_their_distribution():
    providers = importlib.metadata.packages_distributions()
    missing = set()
    for name, distribution in DISTRIBUTIONS.items():
        extras = declared(name)["project"].get("optional-dependencies", {})
        texts = [text for texts in extras.values() for text in texts]
        offered = {plain(Requirement(text).name) for text in texts}
        if "s3fs" in offered:
            offered.add("fsspec")
        if "poolpart" in offered:
            offered |= {"dask", "distributed"}
        for imported, prefixes in OPTIONAL.items():
            own = [one for one in prefixes if one.partition("/")[0] in distribution.imports]
            names = {
                plain(one) for one in providers.get(imported, _PROVIDERS.get(imported, [imported]))
            }
            if own and imported not in WITHOUT_EXTRA and not names & (offered | {"raybeam"}):
                missing |= {f"{name}: {imported}"}
    assert missing == set()


def required_imports(name: str, providers: Mapping[str, list[str]]) -> set[str]:
    """Import names of the packages that a distribution requires, without extras."""
    required = {Requirement(text).name for text in declared(name)["project"]["dependencies"]}
    found = {one for other in required & {*DISTRIBUTIONS} for one in DISTRIBUTIONS[other].imports}
    wanted = {plain(one) for one in required}
    for imported, names in providers.items():
        for provider in map(plain, names):
            if wanted & {provider, WITH_OTHERS.get(provider)}:
                found.add(imported)
    return found


def outside() -> dict[str, str]:
    """Environment variables with which nothing is imported from the checkout."""
    return {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}


def python(*arguments: object, **options) -> str:
    done = subprocess.run(
        [sys.executable, *map(str, arguments)],
        env=outside(),
        stdout=subprocess.PIPE,
        text=True,
        **options,
    )
    assert not done.returncode, done.stdout
    return done.stdout


@pytest.fixture(scope="module")
def built(tmp_path_factory) -> Path:
    """Source distributions of this checkout, and the wheels built from them."""
    for tool in ("pip", "hatchling", "twine"):
        pytest.importorskip(tool, reason=f"needs {tool}: pip install '.[dev]'")
    place = tmp_path_factory.mktemp("built")
    for name in DISTRIBUTIONS:
        python("-m", "hatchling", "build", "-t", "sdist", "-d", place, cwd=folder_of(name))
    python(
        *("-m", "pip", "wheel", "--quiet", "--no-build-isolation", "--no-deps", "--no-index"),
        *("-w", place, *place.glob("*.tar.gz")),
    )
    return place


@pytest.mark.extended
@pytest.mark.parametrize("name", DISTRIBUTIONS)
def test_they_hold_the_files_that_git_has_and_no_others(built, name):
    tracked = subprocess.run(
        ["git", "ls-files", *DISTRIBUTIONS[name].packages],
        cwd=folder_of(name),
        stdout=subprocess.PIPE,
        text=True,
        check=True,
    ).stdout.split()
    if DISTRIBUTIONS[name].packages == (".",):  # the package is the folder of the distribution
        tracked = [file for file in tracked if file not in ABOUT]
    assert len(tracked) > 20
    stem = f"{name}-{__version__}"
    with tarfile.open(built / f"{stem}.tar.gz") as archive:
        found = {member.removeprefix(f"{stem}/") for member in archive.getnames()}
    assert found == {"PKG-INFO", ".gitignore"} | ABOUT.union(tracked)
    with zipfile.ZipFile(built / f"{stem}-py3-none-any.whl") as archive:
        found = set(archive.namelist())
    about = {file for file in found if file.startswith(f"{stem}.dist-info/")}
    outer = {f"{Path(package).parent}/" for package in DISTRIBUTIONS[name].packages} - {"./"}
    wanted = {re.sub(f"^({'|'.join(outer)})", "", file) if outer else file for file in tracked}
    if DISTRIBUTIONS[name].packages == (".",):
        wanted = {f"{name}/{file}" for file in wanted}
    assert found - about == wanted
    assert f"{stem}.dist-info/licenses/LICENSE" in about


@pytest.mark.extended
def test_a_package_index_would_take_them(built):
    files = sorted(built.iterdir())
    assert len(files) == 2 * len(DISTRIBUTIONS)
    python("-m", "twine", "--no-color", "check", "--strict", *files)


class Environment:
    """A virtual environment of wheels, and of what they require, which links lead to."""

    def __init__(self, folder: Path, built: Path, *wheels: str) -> None:
        python("-m", "venv", "--without-pip", folder)
        self.bin = folder / "bin"
        self._built = built
        self.pip("install", *wheels)
        self._site = next(folder.glob("lib/python*/site-packages"))
        self._link([Requirement(wheel) for wheel in wheels])

    def pip(self, command: str, *options: str) -> None:
        here = ["--no-index", "--no-deps", "--find-links", self._built]
        more = here if command == "install" else []
        python("-m", "pip", "--python", self.bin / "python", command, "--quiet", *more, *options)

    def _link(self, wanted: list[Requirement]) -> None:
        done: set[tuple[str, str]] = set()
        while wanted:
            requirement = wanted.pop()
            if requirement.name in DISTRIBUTIONS and requirement.name not in self.names():
                self.pip("install", requirement.name)
            [distribution, *_] = importlib.metadata.distributions(
                name=requirement.name, path=[str(self._site), *sys.path]
            )
            entries = {file.parts[0] for file in distribution.files or ()} - {"..", "__pycache__"}
            for entry in entries:
                if not (self._site / entry).exists():
                    (self._site / entry).symlink_to(distribution.locate_file(entry))
            for extra in {"", *requirement.extras}:
                if (requirement.name, extra) in done:
                    continue
                done.add((requirement.name, extra))
                for text in distribution.requires or ():
                    further = Requirement(text)
                    if not further.marker or further.marker.evaluate({"extra": extra}):
                        wanted.append(further)

    def names(self) -> set[str]:
        found = importlib.metadata.distributions(path=[str(self._site)])
        return {one.metadata["Name"] for one in found}

    def run(self, *command: str, cwd: Path) -> str:
        done = subprocess.run(
            [self.bin / command[0], *command[1:]],
            cwd=cwd, env=outside(), stdout=subprocess.PIPE, text=True,
        )  # fmt: skip
        return done.stdout if done.returncode == 0 else f"exit {done.returncode}: {done.stdout}"

    def run_readme(self, name: str, folder: Path) -> str:
        """Run the example of a distribution's README."""
        readme = (folder_of(name) / "README.md").read_text(encoding="utf-8")
        [code] = re.findall(r"```python\n(.*?)```", readme, re.DOTALL)
        code += DISTRIBUTIONS[name].more
        (folder / "example.py").write_text(code, encoding="utf-8")
        return self.run("python", "-I", "example.py", cwd=folder)


RINGS = """
scene: seed
sensor: velodyne/vlp16
poses: [[0, 0, 1], [1, 0, 1]]
output: {write: [kitti]}
"""


@pytest.mark.slow
@pytest.mark.extended(keep=("poolpart",))
@pytest.mark.parametrize("name", DISTRIBUTIONS)
def test_each_alone_needs_no_more_than_it_declares(built, tmp_path, name):
    alone = Environment(tmp_path / "venv", built, name)
    distribution = DISTRIBUTIONS[name]
    assert not distribution.without & alone.names()
    assert not distribution.only or alone.names() == distribution.only | {name}
    if name == WHOLE:
        assert "results in out: cloud.ply" in surveys(alone, tmp_path)
        assert (tmp_path / "out" / "report.html").stat().st_size > 10_000
        (tmp_path / "kitti.yaml").write_text(RINGS)
        alone.run("lidarpool", "run", "kitti.yaml", "--out", "kitti", cwd=tmp_path)
        recording = str(tmp_path / "kitti" / "kitti")
        for command in (
            ("augment", recording, "--out", "wet", "--model", "velodyne/vlp16", "--rain", "9"),
            ("compare", recording, recording, "--out", "same"),
        ):
            assert not alone.run("lidarpool", *command, cwd=tmp_path).startswith("exit")
    else:
        assert alone.run_readme(name, tmp_path) == distribution.prints


@pytest.mark.slow
def test_raybeam_with_tiles_needs_two_packages_more(built, tmp_path):
    alone = Environment(tmp_path / "venv", built, "raybeam[tiles]")
    assert alone.names() - {"numba", "llvmlite"} == {"raybeam", "numpy"}
    assert alone.run_readme("raybeam", tmp_path) == "[ 5. inf]\ntiles\n"


def surveys(environment: Environment, folder: Path, *options: str) -> str:
    """Run a survey; say how it ended."""
    car = str(ROOT / "examples" / "car.obj")
    return environment.run("lidarpool", "run", car, "--out", "out", *options, cwd=folder)


@pytest.mark.extended
def test_no_file_is_in_two_distributions(built):
    holders: dict[str, list[str]] = {}
    for wheel in sorted(built.glob("*.whl")):
        with zipfile.ZipFile(wheel) as archive:
            for file in archive.namelist():
                holders.setdefault(file, []).append(wheel.name)
    assert len(holders) > 700
    assert {file: names for file, names in holders.items() if len(names) > 1} == {}
