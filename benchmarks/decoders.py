"""Compare exported files with what third-party decoders and devkits read from them.

    python -m benchmarks.decoders [--python PYTHON ...] [--only PROGRAM ...]

The benchmark writes the packets of static Velodyne and Ouster sensors in a city. It also writes a
drive of two lidars past actors in six formats. Each program reads its files in its own process. The
results are compared with the survey's cloud and the exact trajectories of the actors. Because some
programs require packages that conflict with lidarpool, each program runs in the first Python
environment that has it: the current one, then those given by `--python`.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from lidarpool import Scene, save_cloud
from lidarscenes.procedural.city import city

from .decoders_compare import (
    Arrays,
    Row,
    compare_bag,
    compare_e57,
    compare_kitti,
    compare_las,
    compare_nuscenes,
    compare_ouster,
    compare_velodyne,
)
from .decoders_surveys import Drive, drive_of, packets_of
from .harness import argument_parser, print_row, write_results

TRIANGLES = 100_000  # of the city
SWEEPS = 20  # of the drive
REVOLUTIONS = 5  # of packets
TOY_TRIANGLES = 5_000
TOY_SWEEPS = 9
TOY_REVOLUTIONS = 1


class PacketProgram(NamedTuple):
    """Third-party decoder of packets."""

    maker: str
    models: tuple[str, ...]
    compare: Callable[[Drive, str, Arrays], Iterator[Row]]


class FileProgram(NamedTuple):
    """Third-party reader of the drive's files."""

    files: dict[str, str]  # {name: format}
    compare: Callable[[Drive, Arrays], Iterator[Row]]
    inputs: tuple[str, ...] = ()  # what it opens, unless the files
    companion: str = ""  # package that it needs as well


PROGRAMS: dict[str, PacketProgram | FileProgram] = {
    "velodyne-decoder": PacketProgram(
        "velodyne", ("vlp16", "vlp16-hires", "vlp32c", "hdl32e", "vls128"), compare_velodyne
    ),
    "ouster-sdk": PacketProgram("ouster", ("os0-32", "os1-64", "os2-128"), compare_ouster),
    "nuscenes-devkit": FileProgram({"nuscenes": "nuscenes"}, compare_nuscenes),
    "pykitti": FileProgram(
        {"kitti": "kitti"},
        compare_kitti,
        ("kitti/sequences/00", "kitti/sequences/01"),
        "opencv-python-headless",
    ),
    "pye57": FileProgram({"e57.e57": "e57"}, compare_e57),
    "laspy": FileProgram({"las.las": "las", "laz.laz": "laz"}, compare_las, companion="lazrs"),
    "mcap": FileProgram({"bag.mcap": "mcap"}, compare_bag, companion="mcap-ros2-support"),
}


def packages_of(program: str) -> list[str]:
    """Return the PyPI names of the packages that a program needs."""
    description = PROGRAMS[program]
    companion = description.companion if isinstance(description, FileProgram) else ""
    return [program, *filter(None, [companion])]


def python_of(program: str, pythons: list[str]) -> str | None:
    """Return the first Python interpreter that has a program's packages, or None."""
    look = f"from importlib.metadata import version; [*map(version, {packages_of(program)!r})]"
    for python in pythons:
        ended = subprocess.run([python, "-c", look], capture_output=True, check=False)
        if ended.returncode == 0:
            return python
    return None


def read_files(program: str, python: str, files: list[Path], folder: Path) -> Arrays:
    """Let a program read files, and return the arrays it has read, including its `version`.

    Raise RuntimeError if the program fails.
    """
    script = Path(__file__).with_name("decoders_peers.py")
    out = folder / f"{program}.npz"
    # -P: the folder of the script, whose modules are called as packages, is not searched.
    command = [python, "-P", str(script), program, str(out), *map(str, files)]
    ended = subprocess.run(command, capture_output=True, text=True, check=False)
    if ended.returncode:
        raise RuntimeError(f"{program} failed:\n{ended.stderr}")
    with np.load(out) as arrays:
        return dict(arrays)


def packet_rows(
    program: str, python: str, folder: Path, scene: Scene, revolutions: int
) -> tuple[str, list[Row]]:
    """Compare packets with what a program decodes from them.

    Return the program's version and the table rows.
    """
    description = PROGRAMS[program]
    assert isinstance(description, PacketProgram)
    drives = {}
    files = []
    for model in description.models:
        drive = packets_of(f"{description.maker}/{model}", scene, revolutions)
        save_cloud(drive.cloud, folder / model, format="pcap")
        for file in (folder / model).glob("lidar.*"):
            file.rename(file.with_stem(model))  # arrays have the names of the files
        files.append(folder / model / f"{model}.pcap")
        drives[model] = drive
    arrays = read_files(program, python, files, folder)
    rows: list[Row] = []
    for model, drive in drives.items():
        prefix = f"{model}/"
        of_model = {
            name.removeprefix(prefix): array
            for name, array in arrays.items()
            if name.startswith(prefix)
        }
        rows += description.compare(drive, model, of_model)
    return str(arrays["version"]), rows


def drive_rows(program: str, python: str, folder: Path, drive: Drive) -> tuple[str, list[Row]]:
    """Compare the drive's files with what a program reads from them.

    Return the program's version and the table rows.
    """
    description = PROGRAMS[program]
    assert isinstance(description, FileProgram)
    for name, file_format in description.files.items():
        save_cloud(drive.cloud, folder / name, format=file_format)
    files = [folder / name for name in description.inputs or description.files]
    arrays = read_files(program, python, files, folder)
    return str(arrays["version"]), list(description.compare(drive, arrays))


def main(arguments: list[str] | None = None) -> int:
    """Print the table, and return 1 if a program is missing."""
    parser = argument_parser(__doc__, quick=True)
    parser.add_argument(
        "--python",
        action="append",
        default=[],
        help="Python interpreter to search for programs (repeatable)",
    )
    parser.add_argument("--only", nargs="+", choices=PROGRAMS, default=[*PROGRAMS])
    options = parser.parse_args(arguments)
    scene = city(TOY_TRIANGLES if options.quick else TRIANGLES)
    drive = drive_of(scene, TOY_SWEEPS if options.quick else SWEEPS)
    revolutions = TOY_REVOLUTIONS if options.quick else REVOLUTIONS
    missing = []
    results = {}
    print_row("program", "file", "compared", "count", "maximum difference")
    print("|---|---|---|--:|---|")
    for program in options.only:
        python = python_of(program, [sys.executable, *options.python])
        if python is None:
            missing.append(program)
            continue
        with tempfile.TemporaryDirectory() as name:
            if isinstance(PROGRAMS[program], PacketProgram):
                version, rows = packet_rows(program, python, Path(name), scene, revolutions)
            else:
                version, rows = drive_rows(program, python, Path(name), drive)
        results[f"{program} {version}"] = [row._asdict() for row in rows]
        for row in rows:
            words = "; ".join(f"{name} {value}" for name, value in row.differences.items())
            print_row(f"{program} {version}", row.file, row.things, f"{row.count:,}", words)
    for program in missing:
        packages = " ".join(packages_of(program))
        print(
            f"{program} was skipped. Install it with `pip install {packages}`, "
            "or pass --python with the Python interpreter of an environment that has it.",
            file=sys.stderr,
        )
    write_results(options.json, results)
    return 1 if missing else 0


if __name__ == "__main__":
    sys.exit(main())
