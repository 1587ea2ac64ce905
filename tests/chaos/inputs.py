"""Input files to damage: recordings, OSI traces, HELIOS++ surveys and compiled loops."""

from __future__ import annotations

import gzip
import importlib.util
import sys
from pathlib import Path
from types import ModuleType

from click.testing import CliRunner
from distributed import Client
from tests.chaos.target import Target
from tests.shapes import block

from lidarfiles.recordings.opening import open_sensors
from lidarlive.playback.pcap_recording import PcapRecording
from lidarpool import (
    Actor,
    LidarError,
    Result,
    Scene,
    Survey,
    Track,
    load_sensor,
    save_cloud,
    simulate,
)
from lidarpool.cli.scenario_commands import import_
from lidarscenario.prepare import prepare
from lidarscenario.scenario import Scenario
from raybeam.compiled import compiled

RECORDINGS = {"mcap": "cloud.mcap", "pcap": "packets"}  # {format: file, or folder of files}
TRACES = {"osi": "trace_gt.osi", "osi_mcap": "trace.mcap"}  # {format: file}
PACKED_TRACE = "packed_gt.osi.gz"
TRAFFIC = """
scene: seed
sensor: {rays_per_revolution: 90, layers: 4, step_deg: 4}
poses: [[0, 0, 1]]
steps: 25
"""
SQUARE = "v -1 -1 0\nv 1 -1 0\nv 1 1 0\nv -1 1 0\nf 1 2 3\nf 1 3 4\n"
HELIOS = {
    "parts/ground.obj": f"mtllib ground.mtl\nusemtl soil\n{SQUARE}",
    "parts/ground.mtl": "newmtl soil\nhelios_isGround true\nhelios_reflectance 0.3\n",
    "parts/points.xyz": "".join(f"{x} {y} {x / 9}\n" for x in range(9) for y in range(9)),
    "devices.xml": """<document>
<scanner id="s" name="S" optics="oscillating" scanAngleMax_deg="60" scanFreqMin_Hz="1"
 scanFreqMax_Hz="200" pulseFreqs_Hz="1000"/>
<platform id="plane" type="linearpath"><scannerMount z="0.5"/></platform></document>""",
    "fly.xml": """<document>
<survey name="fly" scene="fly.xml#field" platform="devices.xml#plane" scanner="devices.xml#s">
<leg><platformSettings x="0" y="0" z="50" movePerSec_m="10"/>
<scannerSettings pulseFreq_hz="1000" scanAngle_deg="30" scanFreq_hz="30"/></leg>
<leg><platformSettings x="3" y="4" z="50"/></leg></survey>
<scene id="field"><part>
<filter type="objloader"><param type="string" key="filepath" value="parts/ground.obj"/></filter>
<filter type="scale"><param type="double" key="scale" value="100"/></filter></part>
<part><filter type="xyzloader"><param type="string" key="filepath" value="parts/points.xyz"/>
<param type="double" key="voxelSize" value="1"/></filter></part></scene></document>""",
}
LOOP = "def twice(x):\n    return 2.0 * x\n"


def write_inputs(folder: Path, client: Client) -> list[Target]:
    """Write all inputs and return the folders to damage."""
    result = drive(client)
    recordings = folder / "recordings" / "whole"
    recordings.mkdir(parents=True)
    for name, path in RECORDINGS.items():
        save_cloud(result.cloud, recordings / path, format=name)
    traces = folder / "traces" / "whole"
    traces.mkdir(parents=True)
    for name, file in TRACES.items():
        save_cloud(result.cloud, traces / file, format=name)
        (traces / f"{name}.yaml").write_text(f"{TRAFFIC}traffic: {{file: {file}}}\n")
    packed = gzip.compress((traces / TRACES["osi"]).read_bytes())
    (traces / PACKED_TRACE).write_bytes(packed)
    (traces / "osi_packed.yaml").write_text(f"{TRAFFIC}traffic: {{file: {PACKED_TRACE}}}\n")
    return [
        Target(recordings, {"recordings": read_recordings}, lambda file: file.suffix == ".mcap"),
        Target(recordings, {"recordings": read_recordings}, lambda file: file.suffix == ".pcap"),
        Target(traces, {"traces": read_traces}, lambda file: file.suffix != ".yaml"),
        helios_target(folder),
        loops_target(folder),
    ]


def helios_target(folder: Path) -> Target:
    """Write a HELIOS++ survey to a folder."""
    helios = folder / "helios" / "whole"
    for name, text in HELIOS.items():
        path = helios / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return Target(helios, {"HELIOS++": import_helios})


def loops_target(folder: Path) -> Target:
    """Compile a loop that numba caches in a folder."""
    loops = folder / "loops" / "whole"
    loops.mkdir(parents=True)
    (loops / "twice.py").write_text(LOOP)
    run_loop(loops)
    return Target(loops, {"loops": run_loop}, lambda file: file.suffix in (".nbc", ".nbi"))


def drive(client: Client) -> Result:
    """Simulate a revolution of a VLP-16 while a car passes."""
    scene = Scene.from_meshes([block("room", (10, 8, 6))])
    car = Actor(block("car", (1, 1, 1)), Track([0, 9], [[2, 0, 0], [3, 0, 0]]))
    columns = ["ray", "range", "reflectivity", "time", "intensity"]
    survey = Survey(load_sensor("vlp16"), [(0, 0, 0)], 36, columns=columns, keep_every=1)
    return simulate(scene.with_actors((car,)), survey, client=client, backend="numpy")


def read_recordings(place: Path) -> str:
    """Read sweeps of all recordings, and all datagrams of packet files."""
    for path in sorted(place.rglob("*.*cap")):
        if path.suffix == ".pcap":
            list(PcapRecording(path).batches(100_000_000))
        for recording in open_sensors(path).values():
            for number in range(min(2, len(recording))):
                recording[number].returns()
            _ = recording.stamps_ns
    return ""  # they have no checksums of all


def read_traces(place: Path) -> str:
    """Prepare all scenarios, which contain the traffic of the traces."""
    for path in sorted(place.glob("*.yaml")):
        prepare(Scenario.load(path))
    return ""


def import_helios(place: Path) -> str:
    """Import a HELIOS++ survey like the command."""
    outcome = CliRunner().invoke(import_, [str(place / "fly.xml"), "-o", str(place / "out")])
    if isinstance(outcome.exception, Exception):
        raise outcome.exception
    if outcome.exit_code:
        raise LidarError(outcome.output.strip())
    return ""


def run_loop(place: Path) -> str:
    """Run a loop, which numba loads from its cache or compiles again."""
    loop = compiled("f8(f8)")(module_of(place / "twice.py").twice)
    return str(loop(21.0))


def module_of(path: Path) -> ModuleType:
    """Import a file again, without a cached module."""
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[path.stem] = module  # compiled code imports its module
    spec.loader.exec_module(module)
    return module
