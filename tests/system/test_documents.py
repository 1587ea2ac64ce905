"""Code in README and docs: Python runs, commands are parsed, scenarios are validated.

What cannot run says so in a comment before it, `<!-- not run: the reason -->`; of that, what
can be looked at without running it is. Files, links and tests that documents name exist.
"""

import argparse
import ast
import doctest
import importlib.util
import inspect
import json
import re
import runpy
import shlex
import shutil
import subprocess
import sys
import tomllib
import warnings
from collections.abc import Iterator
from contextlib import nullcontext, suppress
from dataclasses import dataclass
from functools import cache, partial
from itertools import dropwhile
from pathlib import Path
from typing import Any

import click
import dask
import distributed
import numpy as np
import pytest
import yaml
from distributed.cli import dask_scheduler, dask_worker
from tests import kubernetes
from tests.clusters import import_jobqueue

import lidarpool
import lidarpool.run.cluster.cluster
import lidarsim
import lidarsim.packets
import poolpart
import raybeam
from lidarfiles.clouds.built_in_formats import EXPORTS, LAYOUTS
from lidarfiles.clouds.format_table import point_suffixes
from lidarfiles.datasets.dataset import DATA_SETS
from lidarpool import Cloud, LidarError, save_cloud
from lidarpool.cli.commands import cli
from lidarscenario.campaign.campaign_sections import CampaignSection
from lidarscenario.mount_sections import VehicleFile
from lidarscenario.plausibility import plausibility_warnings
from lidarscenario.prepare import prepare
from lidarscenario.scenario import Scenario
from lidarscenario.schema import campaign_schema, scenario_schema, vehicle_schema
from lidarscenario.sensors_file import SensorsFile
from lidarsim.columns.table import TABLE
from lidarsim.scene.files.mesh_formats import endings, option_names
from lidarsim.schema.model_names import model_names
from lidarsim.sensor.models import SensorModel, read_model

ROOT = Path(__file__).parents[2]
DOCUMENTS = [ROOT / "README.md", *sorted(ROOT.glob("docs/**/*.md"))]
_BLOCK = re.compile(
    r"^(?:<!-- not run: (?P<reason>[^\n]*) -->\n)?"
    r'^```(?P<language>\w*)(?: title="(?P<title>[^"]*)")?\n(?P<code>.*?)^```$',
    re.MULTILINE | re.DOTALL,
)
_SHELL = ("sh", "console", "")
DASK = {"scheduler": dask_scheduler.main, "worker": dask_worker.main}


@dataclass(frozen=True)
class Block:
    """Code in a document; `reason` says why it does not run, where it does not."""

    where: str
    language: str
    title: str | None
    code: str
    reason: str | None = None


def blocks_of(path: Path) -> list[Block]:
    text = path.read_text(encoding="utf-8")
    return [
        Block(
            f"{path.relative_to(ROOT)}:{text[: match.start('code')].count(chr(10)) + 1}",
            match["language"],
            match["title"],
            match["code"],
            match["reason"],
        )
        for match in _BLOCK.finditer(text)
    ]


def programs() -> Iterator[Block]:
    """Python of all documents; that of a page which says so is one program."""
    for path in (*DOCUMENTS, ROOT / "scheduler/README.md"):
        python = [block for block in blocks_of(path) if block.language == "python"]
        if "<!-- one program -->" in path.read_text(encoding="utf-8"):
            code = "\n".join(block.code for block in python)
            python = [Block(str(path.relative_to(ROOT)), "python", None, code)]
        yield from python


ALL = [block for path in DOCUMENTS for block in blocks_of(path)]
PROGRAMS = list(programs())
[FIRST] = (block for block in PROGRAMS if block.where.startswith("docs/overview.md"))


def of(*languages: str) -> Any:
    chosen = [block for block in ALL if block.language in languages]
    return pytest.mark.parametrize("block", chosen, ids=lambda block: block.where)


def test_no_code_is_overlooked():
    fences = sum(path.read_text("utf-8").count("\n```") for path in DOCUMENTS)
    assert fences == 2 * len(ALL)  # none has another form
    assert {block.language for block in ALL} <= {
        "python",
        "yaml",
        "toml",
        "text",
        "matlab",
        *_SHELL,
    }


@pytest.fixture
def in_threads(monkeypatch, cluster_client):
    """Give programs clusters of threads: the tests' own, or one that they describe.

    Their workers would be paused if this process, whose memory they measure, were above a limit.
    """
    monkeypatch.setitem(dask.config.config["distributed"]["worker"]["memory"], "pause", False)
    theirs = partial(distributed.LocalCluster, processes=False, protocol="tcp")
    monkeypatch.setattr(distributed, "LocalCluster", theirs)
    ours = nullcontext(cluster_client)
    monkeypatch.setattr(lidarpool.run.cluster.cluster, "local_client", lambda *_, **__: ours)


@pytest.mark.extended(every=8)
@pytest.mark.parametrize("block", PROGRAMS, ids=lambda block: block.where)
def test_python_runs(tmp_path, block, in_threads, capsys, monkeypatch):
    compile(block.code, block.where, "exec")
    if block.reason:
        return
    if "dask_jobqueue" in block.code:
        import_jobqueue()
    if "dask_kubernetes" in block.code:
        kubernetes.install(monkeypatch)  # a stand-in
    if "Foxglove" in block.code:
        pytest.importorskip("foxglove", reason="needs foxglove-sdk: the extra live")
    if "import mujoco" in block.code:
        pytest.importorskip("mujoco", reason="MuJoCo is not installed: pip install mujoco")
    if "import newton" in block.code:
        pytest.importorskip("newton", reason="Newton is not installed: pip install newton")
    folder = tmp_path / "lidarpool-out"
    folder.mkdir()
    one = np.ones(1, np.int32)
    columns = {"scan": one, "channel": one, "object": one}
    save_cloud(Cloud(np.ones((1, 3), np.float32), columns), folder / "cloud.ply")
    script = tmp_path / "example.py"
    fewer = block.code.replace("trials=100", "trials=4")  # all are in `make slow`
    script.write_text(fewer, encoding="utf-8")
    runpy.run_path(str(script), run_name="__main__")
    printed = capsys.readouterr().out.splitlines()
    # What a comment beside a print promises is what is printed.
    for promised in re.findall(r"print\(.*\)  # (.*)", block.code):
        assert promised in printed
    if block is FIRST:
        assert re.fullmatch(r"\d+ points, a path of 71\.\d\d m", *printed)


@pytest.mark.slow
def test_the_program_of_the_overview_runs_as_a_script(tmp_path):
    """It starts processes, each of which imports it."""
    script = tmp_path / "example.py"
    script.write_text(FIRST.code, encoding="utf-8")
    done = subprocess.run(
        [sys.executable, script], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert re.fullmatch(r"\d+ points, a path of 71\.\d\d m\n", done.stdout)
    assert (tmp_path / "cloud.ply").exists()


@of(*_SHELL)
def test_commands_are_there(block, tmp_path):
    # Dask asks whether files of certificates are there while it parses.
    for name in ("ca.pem", "me.pem", "me.key"):
        (tmp_path / name).touch()
    lines = commands(block)
    assert lines
    known = [look(words) for words in lines]
    assert block.reason or all(known), lines


def commands(block: Block) -> list[list[str]]:
    """Words of each command, without what the prompt or the environment is."""
    lines = block.code.replace("\\\n", " ").splitlines()
    if block.language == "console":
        lines = [line.removeprefix("$ ") for line in lines if line.startswith("$ ")]
    each = (one for line in lines for one in line.split(" && "))
    found = (shlex.split(one, comments=True) for one in each)
    bare = (dropwhile(re.compile(r"[A-Z]+=").match, words) for words in found)
    return [words for words in map(list, bare) if words]


def look(words: list[str]) -> bool:
    """Whether this is a command of ours or of Dask; its arguments must be right then."""
    match words:
        case ["lidarpool", *arguments]:
            parse(cli, "lidarpool", arguments)
        case ["dask", kind, *arguments] if kind in DASK:
            parse(DASK[kind], kind, arguments)
        case ["make", target, *_]:
            assert re.search(rf"^{target}:", (ROOT / "Makefile").read_text("utf-8"), re.M)
        case ["python" | "python3", "-m", module, *_]:
            if options_of_module(module) is not None:
                arguments = words[words.index(module) + 1 :]
                parser_of(module).parse_args(arguments)  # SystemExit if they are wrong
        case ["pip", "install", *arguments]:  # pip takes an extra that there is not
            project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
            extras = re.findall(r"\[(\w+)\]", " ".join(arguments))
            assert set(extras) <= set(project["optional-dependencies"])
        case ["pytest", *_] | [".", ".venv/bin/activate"]:
            pass
        case _:
            return False
    for word in words:
        assert not word.startswith("examples/") or (ROOT / word).exists(), word
    return True


# Pages on which each command and option must exist. Changelogs also name what there was.
PAGES = [
    *sorted(ROOT.glob("*.md")),
    *(ROOT / name for name in ("benchmarks/README.md", "kernels/README.md", "scheduler/README.md")),
    *DOCUMENTS[1:],
]
PAGES.remove(ROOT / "CHANGELOG.md")
_FENCED = re.compile(r"^```.*?^```", re.M | re.S)
_INLINE = re.compile(r"(?<!`)(`+)(?!`)(.+?)(?<!`)\1(?!`)", re.S)
# Options of other programs, {option: program}, that pages name without the program.
OF_OTHERS = {
    "--array": "sbatch",
    "--human-readable-time": "sumo",
    "--fcd-output": "sumo",
    "--fcd-output.geo": "sumo",
    "--osi_compress": "esmini",
    "--step-length": "sumo",
    "--remap": "ros2 run",
    "--writeWaveform": "helios",
    "--seed": "helios",
}
# Single words of code before a verb that are neither commands nor names of this project.
OTHER_WORDS = {"lint-imports", "json", "frame", "nvidia-smi", "surface"}


def commands_of(group: click.Command, name: tuple[str, ...] = ()) -> Iterator[Any]:
    """Yield the words and the command of a group and all commands in it."""
    yield name, group
    if isinstance(group, click.Group):
        for word in group.list_commands(click.Context(group)):
            yield from commands_of(group.commands[word], (*name, word))


COMMANDS = dict(commands_of(cli))


def options_of(command: click.Command) -> set[str]:
    """Spellings of the options of a command."""
    flags = {flag for entry in command.params for flag in (*entry.opts, *entry.secondary_opts)}
    return flags | {"--help", "-h"}


class Asked(BaseException):
    """Raised by a parser of arguments in place of parsing, so that its program ends."""


@cache
def parser_of(module: str) -> argparse.ArgumentParser:
    """The parser of arguments of a program that is run as a module."""

    def ask(parser: argparse.ArgumentParser, *_: object) -> None:
        raise Asked(parser)

    with pytest.MonkeyPatch.context() as patch, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a test has perhaps imported the module
        patch.setattr(argparse.ArgumentParser, "parse_args", ask)
        with pytest.raises(Asked) as asked:
            runpy.run_module(module, run_name="__main__")
    parser = asked.value.args[0]
    assert isinstance(parser, argparse.ArgumentParser)
    return parser


def options_of_module(module: str) -> set[str] | None:
    """Options of a program of this repository that is run as a module; None for others."""
    spec = importlib.util.find_spec(module)
    assert spec is not None, module
    if module.split(".")[0] not in ("benchmarks", "docs", "tests"):
        return None
    return {*parser_of(module)._option_string_actions, "-m"}


def options_named_with(words: list[str]) -> set[str] | None:
    """Options of the command that words begin with; None for a program that is not known here."""
    match words:
        case ["lidarpool", *arguments]:
            name: tuple[str, ...] = ()
            for word in arguments:
                if (*name, word) not in COMMANDS:
                    break
                name = (*name, word)
            rest = arguments[len(name) :]
            is_group = isinstance(COMMANDS[name], click.Group)
            assert not (is_group and rest and re.match(r"[a-z]", rest[0])), f"no command {rest[0]}"
            return options_of(COMMANDS[name])
        case ["dask", kind, *_] if kind in DASK:
            return options_of(DASK[kind])
        case ["python" | "python3" | "$PYTHON", "-m", module, *_] if "NAME" not in module:
            return options_of_module(module)
        case ["make", target, *_]:
            assert re.search(rf"^{target}:", (ROOT / "Makefile").read_text("utf-8"), re.M), target
        case [word, *_] if (word,) in COMMANDS:
            return options_named_with(["lidarpool", *words])
    return None


def check_options(words: list[str], known: set[str]) -> None:
    flags = [re.match(r"-{1,2}[A-Za-z][\w.-]*", word) for word in words]
    named = {flag[0] for flag in flags if flag is not None}
    assert named <= known, f"{' '.join(words)}: no option {', '.join(named - known)}"


def inline_code(text: str) -> list[list[str]]:
    """Words of each inline code of a page."""
    prose = _FENCED.sub("", text)
    codes = [match[2].replace("`", "").replace(r"\|", "|") for match in _INLINE.finditer(prose)]
    return [code.split() for code in codes]


@pytest.mark.parametrize("path", PAGES, ids=lambda path: str(path.relative_to(ROOT)))
def test_commands_and_options_of_a_page_exist(path):
    """In blocks and in prose; an option that is named alone is one of a command on the page.

    Or of the commands that nearly all pages are about.
    """
    languages = _SHELL if path in DOCUMENTS else ("sh", "console")
    blocks = [block for block in blocks_of(path) if block.language in languages]
    lines = [words for block in blocks for words in commands(block)]
    codes = inline_code(path.read_text("utf-8"))
    on_page = {*OF_OTHERS, *options_of(COMMANDS["run",]), *options_of(DASK["worker"])}
    for words in (*lines, *codes):
        known = options_named_with(words)
        if known is not None:
            if words[0] not in ("dask",) or words in codes:
                check_options(words, known)
            on_page |= known
    for words in codes:
        if words and words[0].startswith("--"):
            check_options(words, on_page)


@pytest.mark.parametrize("path", sorted(ROOT.glob("examples/**/*.*")), ids=lambda path: path.name)
def test_commands_in_remarks_of_examples_exist(path):
    if path.suffix not in (".yaml", ".py"):
        return
    for line in re.findall(r"^#?\s+\$?\s*(lidarpool .*)$", path.read_text("utf-8"), re.M):
        words = shlex.split(line, comments=True)
        known = options_named_with(words)
        assert known is not None
        check_options(words, known)


@pytest.mark.parametrize(
    "path",
    [*sorted(ROOT.glob("benchmarks/*.py")), *sorted(ROOT.glob("docs/pictures/**/*.py"))],
    ids=lambda path: path.stem,
)
def test_options_in_docstrings_of_benchmarks_exist(path):
    docstring = ast.get_docstring(ast.parse(path.read_text("utf-8"))) or ""
    for line in re.findall(r"^ +(python -m .*)$", docstring, re.M):
        words = re.sub(r"[\[\]|]", " ", line).split()
        known = options_named_with(words)
        assert known is not None
        check_options(words, known)


def words_of_schema(schema: Any) -> Iterator[str]:
    """Yield the names and texts in a JSON schema."""
    if isinstance(schema, dict):
        yield from schema
        schema = list(schema.values())
    for entry in schema if isinstance(schema, list) else ():
        yield from words_of_schema(entry)
    if isinstance(schema, str):
        yield schema


def known_words() -> set[str]:
    """Names of this project and of Dask that pages write as code: fields, columns, functions, …"""
    words = {*EXPORTS, *LAYOUTS, *DATA_SETS}
    schemas = (scenario_schema(), campaign_schema(), vehicle_schema())
    for schema in (*schemas, SensorModel.model_json_schema()):
        words |= {*words_of_schema(schema)}
    for column in TABLE.values():
        words |= {column.name, column.in_files}
    for command in COMMANDS.values():
        words |= {entry.name for entry in command.params if entry.name}
        words |= {
            str(choice)
            for entry in command.params
            if isinstance(entry.type, click.Choice)
            for choice in entry.type.choices
        }
    for module in (lidarpool, lidarsim, lidarsim.packets, poolpart, raybeam, distributed):
        words |= {module.__name__}
        for name in {*dir(module), *getattr(module, "__all__", ())}:
            thing = getattr(module, name)
            words |= {name, *(dir(thing) if isinstance(thing, type) else ())}
            words |= {*getattr(thing, "__annotations__", ())}
            with suppress(TypeError, ValueError):
                words |= {*inspect.signature(thing).parameters}
    return words


def test_words_that_read_as_commands_are_known():
    """As in «`check` lists»: the word is a command, or a name of the project."""
    pattern = re.compile(r"`([a-z][a-z-]+)`,? (?:also |then |now )?([a-z]+s)\b")
    known = known_words() | {name for (name, *_) in filter(None, COMMANDS)} | OTHER_WORDS
    unknown = {
        f"{path.relative_to(ROOT)}: {match[0]}"
        for path in PAGES
        for match in pattern.finditer(_FENCED.sub("", path.read_text("utf-8")))
        if match[1] not in known and match[2] not in ("is", "has", "does", "was", "its", "as")
    }
    assert unknown == set()


def parse(command: click.Command, name: str, arguments: list[str]) -> None:
    """Parse arguments as the command does, and do nothing; click.UsageError if they are wrong."""
    parent = None
    while isinstance(command, click.Group):
        parent = click.Context(command, parent, name)
        name, command, arguments = command.resolve_command(parent, arguments)
    with command.make_context(name, list(arguments), parent) as context:
        # dask worker hands what it does not know to preloads.
        assert not context.params.get("preload_argv")


@of("yaml")
def test_yaml_is_what_it_is_for(block):
    data = yaml.safe_load(block.code)
    assert data
    if block.reason:
        return
    if block.title == "distributed.yaml":
        for key in leaves(data):
            # KeyError where Dask has no such setting; variables of the environment have any name.
            dask.config.get(re.sub(r"(?<=\.pre-spawn-environ)\..*", "", key))
    elif "cluster" in data:
        assert (ROOT / block.title).read_text("utf-8").endswith(f"\n{block.code}")
    elif block.title == "sensors.yaml":
        assert SensorsFile.model_validate(data).sensors_on_frames()
    elif block.title == "vehicle.yaml":
        VehicleFile.from_data({"body": "van", "sensors": {"a": {"mounts": [0, 0, 3]}}} | data)
    elif data.keys() & {"base", "vary"}:
        CampaignSection.model_validate({"base": "base.yaml"} | data)
    elif "beams" in data:
        SensorModel.model_validate(data)
    else:
        scenario = Scenario.from_data(data, source=block.where)
        if all(path.exists() for path in scenario.files):
            with suppress(LidarError):  # a fragment, such as materials of another scene
                assert plausibility_warnings(prepare(scenario, plans=False)) == []


# What in code needs an extra of lidarpool, {extra: pattern}.
EXTRAS = {
    "las": r"\bla[sz]\b",
    "parquet": r"\bparquet\b",
    "e57": r"\be57\b",
    "osi": r"\bosi\b|\bbetterosi\b",
    "ros": r"\bmcap\b|\brosbag2\b",
    "s3": r"\bs3://",
    "clusters": r"--cluster\b|\bdask_jobqueue\b",
    "fit": r"\blidarpool fit\b|\.pcap\b",
    "usd": r"\.usd[acz]?\b",
    "ifc": r"\.ifc\b",
    "geo": r"\.tiff?\b|\bepsg\b",
}


@pytest.mark.parametrize(
    "path", [path for path in DOCUMENTS if path.name != "install.md"], ids=lambda path: path.name
)
def test_pages_name_the_extras_that_their_examples_need(path):
    code = "\n".join(block.code for block in blocks_of(path))
    text = path.read_text("utf-8")
    named = {*re.findall(r"\[`(\w+)`\]\([./]*install\.md#extras\)", text)}
    needed = {extra for extra, pattern in EXTRAS.items() if re.search(pattern, code)}
    assert needed - named == set()


def test_the_readme_has_the_commands_of_a_bare_machine_in_their_order():
    """As they are typed; the system packages are those that .ci/setup installs."""
    text = (ROOT / "README.md").read_text("utf-8")
    places = [
        text.index(command)
        for command in (
            "\napt-get update\n", "\napt-get install ", "\nmake demo ",
            "\nmake test ", "\nlidarpool scene ",
        )
    ]  # fmt: skip
    assert places == sorted(places)
    packages = re.search(r"apt-get install -y (.*)", text)[1].split()
    setup = (ROOT / ".ci/setup").read_text("utf-8")
    assert [name for name in packages if name not in setup] == ["git"]


@pytest.mark.parametrize("path", DOCUMENTS, ids=lambda path: path.name)
def test_one_page_says_how_extras_are_added(path):
    """The distribution is on no index: `pip install "lidarpool[las]"` fails."""
    text = path.read_text("utf-8")
    assert "lidarpool[" not in text
    told = re.search(r"pip install (-e )?\"?\.\[(?!bench)", text)
    assert told is None or path.name == "install.md"


def leaves(data: dict[str, Any], above: str = "") -> Iterator[str]:
    """Keys of settings, with dots."""
    for key, value in data.items():
        if isinstance(value, dict):
            yield from leaves(value, f"{above}{key}.")
        else:
            yield f"{above}{key}"


@pytest.mark.extended
def test_a_twin_is_made_and_scanned_as_shown(tmp_path, lidarpool):
    blocks = [block for block in blocks_of(ROOT / "docs/how-to/twin.md") if not block.reason]
    sections = []
    for block in blocks:
        if block.language == "yaml" and block.title:
            Path(block.title).write_text(block.code, encoding="utf-8")
        elif block.language == "yaml":
            sections.append(yaml.safe_load(block.code))
        else:
            for words in commands(block):
                outcome = lidarpool(*words[1:])
                assert outcome.code == 0, outcome.err
    scenario = yaml.safe_load((tmp_path / "twin/scenario.yaml").read_text())
    written, edited = sections
    assert written == {"actors": scenario["actors"]}
    shutil.copy(ROOT / "examples/car.obj", tmp_path / "twin")
    (tmp_path / "twin/edited.yaml").write_text(yaml.safe_dump(scenario | edited))
    outcome = lidarpool("run", "twin/edited.yaml", "--out", "edited")
    assert outcome.code == 0, outcome.err
    figures = json.loads((tmp_path / "twin/twin.json").read_text())
    assert figures["motion"] == "as fired, with point times"
    assert figures["held_out"]["stationary"]["median_abs_difference_m"] < 0.003
    assert (tmp_path / "again/cloud.ply").stat().st_size > 1000


@pytest.mark.slow
def test_the_tutorial_from_beginning_to_end(tmp_path, lidarpool):
    told = ""
    ran = 0
    for block in blocks_of(ROOT / "docs/tutorial.md"):
        if block.reason or block.language == "python":
            continue
        if block.language == "yaml":
            Path(block.title).write_text(block.code, encoding="utf-8")
        elif block.language == "text":
            shown = {plain(line): counts(line) for line in told.splitlines()}
            for line in block.code.splitlines():
                assert plain(line) in shown, told
                assert shown[plain(line)] == pytest.approx(counts(line), rel=0.01), line
        else:
            for words in commands(block):
                assert words[0] == "lidarpool"
                outcome = lidarpool(*words[1:])
                assert outcome.code == 0, outcome.err
                assert "warning: " not in outcome.out + outcome.err
                told = outcome.out + outcome.err
                ran = ran + 1
    assert ran == 6
    for name in ("cloud.ply", "report.html"):
        assert (tmp_path / "hall/result" / name).stat().st_size > 1000


@pytest.mark.extended
@pytest.mark.parametrize(
    ("page", "package"),
    [
        ("openusd", "pxr"),
        ("cityjson", "json"),
        ("roads", "json"),
        ("ifc", "ifcopenshell"),
        ("terrain", "rasterio"),
    ],
)
def test_a_scene_is_checked_as_shown(lidarpool, page, package):
    pytest.importorskip(package)
    blocks = blocks_of(ROOT / f"docs/how-to/mesh-formats/{page}.md")
    for block in blocks:
        if block.title:
            Path(block.title).write_text(block.code, encoding="utf-8")
        elif block.language == "python":
            exec(block.code, {})
    [shown] = [block for block in blocks if block.language == "console"]
    [words] = commands(shown)
    outcome = lidarpool(*words[1:])
    assert outcome.code == 0 and "warning: " not in outcome.out
    assert {*shown.code.splitlines()[1:]} <= {*outcome.out.splitlines(), *outcome.err.splitlines()}


def counts(line: str) -> list[int]:
    """Numbers of rays, hits and the like, which are the same on all machines, nearly."""
    nouns = "triangles|objects|scans|rays|hits|points"
    return [int(n.replace(",", "")) for n in re.findall(rf"(\d[\d,]*) (?:{nouns})\b", line)]


def plain(line: str) -> str:
    """A line without its numbers, units of memory and spaces, which differ between machines."""
    return " ".join(re.sub(r"[\d,.]+(?: [kMG]?B\b)?", "N", line).split())


def test_the_overview_shows_the_example_as_it_is():
    example = (ROOT / "examples/survey.py").read_text(encoding="utf-8").split('"""', 2)[2].strip()
    assert example in (ROOT / "docs/overview.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("path", [*sorted(ROOT.glob("*.md")), *DOCUMENTS[1:]])
def test_links_lead_somewhere(path):
    text = path.read_text(encoding="utf-8")
    for target in re.findall(r"\]\(([^)#\s]+)[^)]*\)", text):
        if not target.startswith("https://"):
            assert (path.parent / target).exists(), target


def test_tests_that_the_documents_name_exist():
    written = {
        (path.name, node.name)
        for path in (ROOT / "tests").rglob("test_*.py")
        for node in ast.parse(path.read_text(encoding="utf-8")).body
        if isinstance(node, ast.FunctionDef)
    }
    named = {
        (file, name)
        for path in DOCUMENTS
        for file, name in re.findall(r"`(test_\w+\.py)::(test_\w+)`", path.read_text("utf-8"))
    }
    assert len(named) > 30
    assert named - written == set()


def tables_of(page: str, head: str) -> list[list[str]]:
    """Names in the first column of each table of a page whose heading begins with `head`."""
    text = (ROOT / page).read_text("utf-8")
    found = re.findall(rf"^\| {head} \|.*\n\|[-:|]+\n((?:\|.*\n)+)", text, re.M)
    return [re.findall(r"`(\w+)`", "".join(re.findall(r"^\|([^|]*)", t, re.M))) for t in found]


def test_tables_of_formats_are_those_of_the_code():
    of_clouds, _, of_fields, with_boxes = tables_of("docs/how-to/formats.md", "format")
    assert sorted(of_clouds) == sorted(EXPORTS)
    assert {"ply", *EXPORTS, *LAYOUTS} <= {*of_fields}
    assert {*with_boxes} < {*EXPORTS}
    assert tables_of("docs/how-to/formats.md", "layout") == [[*LAYOUTS]]
    of_jobs, of_loader = tables_of("docs/how-to/datasets.md", "format")
    assert sorted(of_jobs) == sorted(of_loader) == sorted(DATA_SETS)


def test_numbers_of_formats_and_models_are_those_of_the_code():
    words = ("four", "five", "six", "seven", "eight", "nine")
    page = (ROOT / "docs/how-to/datasets.md").read_text("utf-8")
    [count] = re.findall(r"the (\w+) formats", page)
    assert words.index(count) + 4 == len(DATA_SETS)
    names = model_names()
    assert f"lists {len(names)} models" in (ROOT / "docs/overview.md").read_text("utf-8")
    assert f"**{len(names)} sensor models**" in (ROOT / "README.md").read_text("utf-8")
    stated = sum(read_model(name).performance is not None for name in names)
    assert f"[{stated} models]" in (ROOT / "docs/how-to/noise.md").read_text("utf-8")


@pytest.mark.parametrize(
    ("pages", "suffixes"),
    [
        (
            ("how-to/meshes", "how-to/mesh-formats/*"),
            endings(),
        ),
        (("how-to/mesh-formats/terrain",), endings(lambda row: "step_m" in option_names(row))),
        (("how-to/point-clouds",), point_suffixes()),
    ],
)
def test_files_that_can_be_read_are_on_their_pages(pages, suffixes):
    paths = [path for page in pages for path in sorted(ROOT.glob(f"docs/{page}.md"))]
    text = "".join(path.read_text("utf-8") for path in paths)
    assert [suffix for suffix in suffixes if not re.search(rf"\{suffix}\b", text)] == []


def test_files_that_the_architecture_names_exist():
    text = (ROOT / "ARCHITECTURE.md").read_text(encoding="utf-8")
    tree = {
        str(p.relative_to(ROOT))
        for d in ("kernels", "scheduler", "workflows", "tests")
        for p in (ROOT / d).rglob("*")
    }
    named = set(re.findall(r"`([\w/.]+\.(?:py|cu|yaml))(?::[^`]*)?`", text)) - {"scenario.yaml"}
    assert len(named) > 10
    assert [
        name for name in sorted(named) if not any(f"/{f}".endswith(f"/{name}") for f in tree)
    ] == []


def test_every_benchmark_is_listed_and_cited_on_its_pages():
    table = (ROOT / "benchmarks/README.md").read_text("utf-8")
    rows = dict(re.findall(r"^\| `(\w+)` \|.*\| (.*) \|$", table, re.MULTILINE))
    sources = {path.stem: path.read_text("utf-8") for path in ROOT.glob("benchmarks/*.py")}
    commands = {name for name, text in sources.items() if f"python -m benchmarks.{name}" in text}
    assert rows.keys() == commands
    for name, links in rows.items():
        for page in re.findall(r"\]\(\.\./([^)#]+)", links):
            assert f"python -m benchmarks.{name}" in (ROOT / page).read_text("utf-8"), (name, page)


def test_the_docstring_of_simulate_says_what_is_printed(in_threads, capsys):
    examples = doctest.DocTestParser().get_examples(lidarpool.simulate.__doc__ or "")
    names: dict[str, Any] = {}
    for example in examples:
        exec(example.source, names)
    assert capsys.readouterr().out == "".join(example.want for example in examples) != ""
