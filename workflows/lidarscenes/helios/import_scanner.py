"""Convert HELIOS++ scanners to scenarios if there is no survey.

Channels become separate sensors unless they differ only in their beams.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree.ElementTree import Element, ParseError

import numpy as np
import yaml

from lidarsim.errors import LidarError
from lidarsim.io.input_files import read_input
from lidarsim.io.xmlfile import xml_root
from lidarsim.motion.trajectory import Pose
from lidarsim.survey.survey import MAX_SENSORS
from lidarsim.words import did_you_mean, list_names

from ..writers.lidar_scenario import SCENARIO_FILE
from .files import Assets, read_number, round_values
from .scanner_xml import Device, HeliosScanner, make_device, read_channels, unsupported_features
from .survey_xml import AHEAD, returns_section

_MAX_NAMES = 12  # maximum number of scanners in a message


class _Reference(NamedTuple):
    """A reference to a scanner, such as FILE.xml#ID.

    The ID can be omitted if the file has a single scanner.
    """

    file: Path
    scanner: str  # ID of the scanner, or empty

    @classmethod
    def from_path(cls, survey: Path) -> _Reference:
        """Divide a path such as FILE.xml#ID into the file and the scanner ID."""
        name, mark, scanner = survey.name.rpartition("#")
        if mark and not survey.exists():
            return cls(survey.with_name(name), scanner)
        return cls(survey, "")


def is_scanner(survey: Path) -> bool:
    """Return True if a path refers to a HELIOS++ file that contains scanners but no survey."""
    with suppress(OSError, LidarError, ValueError, ParseError):
        root = xml_root(read_input(_Reference.from_path(survey).file))
        has_scanner = root.find("scanner") is not None
        return root.tag == "document" and has_scanner and root.find("survey") is None
    return False


def import_scanner(survey: Path, folder: Path, assets: Sequence[Path]) -> list[str]:
    """Write a HELIOS++ scanner as a scenario.

    The folder gets `scenario.yaml`, with the scene of `lidarpool demo`, and the data files of the
    sensors. The axes are converted, so that y in HELIOS++ becomes x.

    Parameters
    ----------
    survey
        File with <scannerSettings> that state the rates. If the file has several scanners, write
        FILE.xml#ID.
    folder
        Existing output folder.
    assets
        Folders that are searched first for referenced files.

    Returns
    -------
    Unsupported features, one line each.

    Raises
    ------
    LidarError
        If the file cannot be read, the reference is ambiguous, or the scanner is not supported.
    """
    reference = _Reference.from_path(survey)
    files = Assets(reference.file, list(assets))
    element = _element(files, reference)
    scanners = read_channels(element)
    first = next(iter(scanners.values()))
    lines = [line for scanner in scanners.values() for line in unsupported_features(scanner)]
    settings = _settings(files, reference.file, element)
    if settings is None:
        lines.append("scanners without <scannerSettings> (the highest rates are used)")
        settings = _highest_rates(first)
    settings.pop("opticsWarmupPhase_s", None)  # without a survey, there is no leg that it precedes
    devices = {name: make_device(scanner, settings) for name, scanner in scanners.items()}
    sensors = _merged(devices)
    if len(sensors) > MAX_SENSORS:
        raise LidarError(
            f"its {len(sensors)} channels become separate sensors, but a scenario can have at "
            f"most {MAX_SENSORS}."
        )
    if len(sensors) > 1:
        lines.append(f"{len(sensors)} channels in one sensor (they become separate sensors)")
    _write(folder, survey.name, first, sensors, list(dict.fromkeys(lines)))
    return list(dict.fromkeys(lines))


def _element(files: Assets, reference: _Reference) -> Element:
    """Return the <scanner> element to which a reference refers.

    Raises LidarError if the reference is ambiguous or invalid.
    """
    elements = files.root(reference.file).findall("scanner")
    by_id = {element.get("id", ""): element for element in elements}
    if reference.scanner:
        if reference.scanner not in by_id:
            hint = did_you_mean(reference.scanner, by_id)
            raise LidarError(f"the file has no <scanner> {reference.scanner!r}.{hint}")
        return by_id[reference.scanner]
    if len(elements) > 1:
        names = [*by_id]
        raise LidarError(
            f"it has {len(elements)} scanners. Select one, for example "
            f"{reference.file.name}#{names[0]}. Its scanners are {list_names(names, _MAX_NAMES)}."
        )
    return elements[0]


def _settings(files: Assets, home: Path, scanner: Element) -> dict[str, str] | None:
    """Return the settings that have the scanner's ID or, if unambiguous, the only settings.

    Returns None if the file has no such settings.
    """
    elements = files.root(home).findall("scannerSettings")
    fitting = [e for e in elements if e.get("id") == scanner.get("id")]
    if not fitting and len(files.root(home).findall("scanner")) == 1 and len(elements) == 1:
        fitting = elements
    return files.read_settings(fitting[0], home) if fitting else None


def _highest_rates(scanner: HeliosScanner) -> dict[str, str]:
    """Return settings with the highest rates that the scanner supports."""
    pulses = scanner.values.get("pulseFreqs_Hz", "").split(",")
    settings = {"pulseFreq_hz": max(pulses, key=lambda hz: read_number({"hz": hz}, "hz", 0))}
    if scanner.number("scanFreqMax_Hz") > 0:
        settings["scanFreq_hz"] = scanner.values["scanFreqMax_Hz"]
    if scanner.number("scanAngleMax_deg") > 0:
        settings["scanAngle_deg"] = scanner.values["scanAngleMax_deg"]
    if scanner.number("headRotatePerSecMax_deg") > 0:
        settings["headRotatePerSec_deg"] = scanner.values["headRotatePerSecMax_deg"]
        settings["headRotateStop_deg"] = "360"
    return settings


def _merged(devices: dict[str, Device]) -> dict[str, Device]:
    """Merge channels that differ only in their beams into a single sensor.

    Otherwise, each channel remains a separate sensor.
    """
    first, *others = devices.values()
    tables = [mounted.data.get("beams", {}) for mounted in devices.values()]
    shared = {name: value for name, value in first.data.items() if name != "beams"}
    is_shared = all(
        {name: value for name, value in other.data.items() if name != "beams"} == shared
        and np.array_equal(other.rotation, first.rotation)
        and other.range_m == first.range_m
        for other in others
    )
    starts = np.array([mounted.position for mounted in devices.values()])
    # A beam origin off the axis would rotate with the head here, but not in HELIOS++.
    on_axis = not np.ptp(starts[:, :2], axis=0).any()
    single = all(_count(table) == 1 for table in tables)
    if not (others and is_shared and single and on_axis):
        return devices
    beams: dict[str, Any] = {
        "elevation_deg": [_only(table.get("elevation_deg", 0.0)) for table in tables],
        "azimuth_deg": [_only(table.get("azimuth_deg", 0.0)) for table in tables],
    }
    heights = round_values(starts[:, 2] - starts[0, 2])
    if np.any(heights):
        beams["origin_m"] = [[0.0, 0.0, height] for height in np.atleast_1d(heights).tolist()]
    merged = replace(first, data=shared | {"beams": beams})
    return {"": merged}


def _count(table: dict[str, Any]) -> int:
    """Return the number of beams in a table."""
    angles = table.get("elevation_deg", [0.0])
    return int(angles["count"]) if isinstance(angles, dict) else len(angles)


def _only(angles: Any) -> float:
    """Return the only angle in a column of a beam table."""
    if isinstance(angles, dict):
        return float(angles["first"])
    return float(angles[0]) if isinstance(angles, list) else float(angles)


def _write(
    folder: Path,
    program_file: str,
    first: HeliosScanner,
    sensors: dict[str, Device],
    lines: list[str],
) -> None:
    """Write the scenario and the data files for its sensors."""
    entries = {}
    for name, mounted in sensors.items():
        stem = re.sub(r"[^\w.-]+", "_", f"{mounted.data['name']} {name}").strip("._").lower()
        file = f"{stem or 'sensor'}.yaml"
        data = yaml.safe_dump(
            mounted.data, sort_keys=False, default_flow_style=None, width=100, allow_unicode=True
        )
        (folder / file).write_text(data, encoding="utf-8", newline="\n")
        entries[name or "lidar"] = _entry(file, mounted)
    only = next(iter(entries.values()))
    if len(entries) == 1 and "mount" not in only:
        content: dict[str, Any] = {"scene": "seed", "sensor": only}
    else:
        content = {"scene": "seed", "sensors": entries}
    if accuracy_m := round_values(first.number("accuracy_m")):
        content["noise"] = {"range_m": accuracy_m}
    waveforms = first.child("FWFSettings")
    if waveforms is not None or first.number("maxNOR"):
        settings = {} if waveforms is None else dict(waveforms.attrib)
        content["returns"] = returns_section(
            settings, first.number("maxNOR"), first.number("pulseLength_ns", 4)
        )
    head = [
        f"Created from {program_file} (HELIOS++) by lidarpool import.",
        *(f"Not supported: {line}." for line in lines),
    ]
    text = "".join(f"# {line}\n" for line in head) + yaml.safe_dump(content, sort_keys=False)
    (folder / SCENARIO_FILE).write_text(text, encoding="utf-8", newline="\n")


def _entry(file: str, mounted: Device) -> dict[str, Any]:
    """Return a sensor's entry in the scenario."""
    min_range_m, max_range_m = mounted.range_m
    pose = Pose.from_rotation(AHEAD @ mounted.position, AHEAD @ mounted.rotation)
    mount: dict[str, Any] = {
        name: angle
        for name in ("yaw_deg", "pitch_deg", "roll_deg")
        if (angle := round_values(getattr(pose, name)))
    }
    if any(position := round_values(pose.position)):  # type: ignore[arg-type]
        mount = {"position": position, **mount}
    entry: dict[str, Any] = {"model": file}
    if min_range_m:
        entry["min_range_m"] = round_values(min_range_m)
    if np.isfinite(max_range_m):
        entry["max_range_m"] = round_values(max_range_m)
    return {**entry, "mount": mount} if mount else entry
