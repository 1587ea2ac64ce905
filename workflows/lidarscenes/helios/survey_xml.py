"""Convert HELIOS++ surveys to scenarios.

Each active leg becomes a sensor, and all sensors share a trajectory.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np
import yaml

from lidarsim.errors import LidarError, prefix_errors
from lidarsim.io.storage import staging
from lidarsim.media.materials import MOR_SHARE
from lidarsim.motion.trajectory import Pose
from lidarsim.numerics.arrays import Floats
from lidarsim.scene.scene import Scene
from lidarsim.scene.transform import rotation_about
from lidarsim.sensor.disc import SUBRAYS
from lidarsim.survey.survey import MAX_SENSORS

from ..writers.scene_file import write_scene
from .files import Assets, read_number, read_rotation, read_vector, round_values
from .legs import (
    HeliosTrajectory,
    Leg,
    LegSegment,
    moving_trajectory,
    read_legs,
    read_trajectory,
    stationary_trajectory,
)
from .scanner_xml import Device, make_device, read_channels, unsupported_features
from .scene_xml import HeliosScene, SurfelMaker

SCENARIO_FILE = "scenario.yaml"
# Vehicles in lidarsim look along x, platforms in HELIOS++ along y.
AHEAD = rotation_about((0, 0, 1), -90)


@dataclass
class ImportedSurvey:
    """The path of a converted scenario, and the survey features that it does not support."""

    path: Path
    unsupported: list[str]


def import_survey(
    survey: str | Path,
    folder: str | Path,
    assets: Sequence[str | Path] = (),
    *,
    check: Callable[[Path], object],
    surfels: SurfelMaker,
) -> ImportedSurvey:
    """Convert a HELIOS++ survey to a scenario in a new folder.

    The folder contains `scenario.yaml`, the data files of its sensors, meshes made from points and,
    if the survey refers to a file of poses, the trajectory.

    Parameters
    ----------
    survey
        XML file of the survey.
    folder
        New folder.
    assets
        Folders that are searched for referenced files before the folder of the survey and its
        parent folders.
    check
        Reads the written `scenario.yaml`, and raises a LidarError if it cannot be simulated.
    surfels
        Makes a mesh from the points of a file that an `xyzloader` reads.

    Raises
    ------
    LidarError
        If a file is missing or invalid, an essential feature is not supported, or `check` refuses
        the scenario. In this case, nothing is written.
    """
    survey = Path(survey)
    folder = Path(folder)
    if folder.exists():
        raise LidarError(f"{folder} already exists. Pass another folder with --out.")
    try:
        survey_import = _Import(survey, [Path(path) for path in assets], folder, surfels)
    except LidarError as error:
        message = str(error)
        if not message.startswith(str(survey)):
            message = f"{survey}: {message}"
        raise LidarError(message) from error
    folder.parent.mkdir(parents=True, exist_ok=True)
    try:
        with staging(folder.parent, folder, folder.name) as partial:
            for name, text in survey_import.files(folder).items():
                (partial / name).write_text(text, encoding="utf-8", newline="\n")
            for part in survey_import.scene.parts:
                if part.surfels is not None:
                    write_scene(partial / part.file.name, Scene.from_meshes([part.surfels]))
            check(partial / SCENARIO_FILE)
            partial.rename(folder)
    except LidarError as error:
        raise LidarError(f"{survey} cannot be converted to a scenario: {error}") from error
    return ImportedSurvey(folder / SCENARIO_FILE, survey_import.unsupported)


class _Import:
    """A survey, read from its XML files and converted."""

    def __init__(
        self, survey: Path, asset_folders: Sequence[Path], folder: Path, surfels: SurfelMaker
    ) -> None:
        self._home = survey
        self._assets = Assets(survey, asset_folders)
        element = self._assets.root(survey).find("survey")
        if element is None:
            raise LidarError("it has no <survey>.")
        self._element = element
        self._name = element.get("name") or survey.stem
        self._scanners = read_channels(self._asset("scanner"))
        self._first = next(iter(self._scanners.values()))
        self.scene = HeliosScene(self._asset("scene"), self._assets, folder, surfels)
        self._notes: list[str] = []
        self._files: dict[str, dict[str, Any]] = {}  # {name of a data file: its content}
        self._sensors: dict[str, dict[str, Any]] = {}
        self._trajectory = self._read_legs()
        if not self._sensors:
            raise LidarError("no leg has an active scanner.")
        if len(self._sensors) > MAX_SENSORS:
            raise LidarError(
                f"its active legs and channels require {len(self._sensors)} sensors, but a "
                f"scenario can have at most {MAX_SENSORS}."
            )
        self._materials = self.scene.materials(self._first.number("wavelength_nm", 1064))
        if element.get("legRandomOffset", "false") in ("true", "1"):
            self._notes.append("legRandomOffset (legs are at their specified positions)")
        if read_number(element, "numRuns", 1) > 1:
            self._notes.append("numRuns (a single run is simulated)")
        if read_number(self._full_waveform(), "maxFullwaveRange_ns", 0) > 0:
            self._notes.append("maxFullwaveRange_ns (waveforms are as long as their echoes)")
        unsupported = (
            line for scanner in self._scanners.values() for line in unsupported_features(scanner)
        )
        self.unsupported = list(
            dict.fromkeys([*self._notes, *unsupported, *self.scene.unsupported_features()])
        )

    def _asset(self, kind: str) -> Element:
        """Return the element to which the survey refers by an attribute, such as "scanner"."""
        if not (reference := self._element.get(kind)):
            raise LidarError(f"its <survey> has no {kind}.")
        return self._assets.find_element(reference, kind, self._home).element

    def _read_legs(self) -> HeliosTrajectory:
        """Read legs and platform, fill `_sensors`, and return the trajectory."""
        legs = read_legs(self._element, self._assets, self._home, self.scene.height)
        trajectory = None
        if self._element.get("platform") == "interpolated":
            mount = self._interpolated_mount()
            trajectory = read_trajectory(self._element, legs, self._assets)
            moves = False
        else:
            platform = self._asset("platform")
            mount = platform.find("scannerMount")
            moves = self._moves(platform)
        # The last leg of a moving platform is only the end of its trajectory.
        devices = self._devices(legs[:-1] if moves else legs)
        if trajectory is None and moves:
            trajectory = moving_trajectory(legs)
        elif trajectory is None:
            trajectory = stationary_trajectory(legs, _head_times(devices))
        self._mount_devices(mount, devices, trajectory)
        return trajectory

    def _interpolated_mount(self) -> Element | None:
        """Return the <scannerMount> of an interpolated platform, or else of its base platform."""
        mount = self._element.find("scannerMount")
        base = self._element.get("basePlatform")
        if mount is None and base:
            platform = self._assets.find_element(base, "platform", self._home).element
            return platform.find("scannerMount")
        return mount

    def _moves(self, platform: Element) -> bool:
        """Return whether the platform moves from leg to leg, and note what is not supported."""
        kind = platform.get("type", "").lower()
        if kind in ("groundvehicle", "multicopter"):
            self._notes.append(
                f"driving dynamics of a {kind} (it moves straight from leg to leg at constant "
                "speed)"
            )
        noise_tags = [
            e.tag for parent in (platform, self._element) for e in parent if "Noise" in e.tag
        ]
        if noise_tags:
            self._notes.append(f"platform noise ({', '.join(noise_tags)})")
        return kind in ("linearpath", "groundvehicle", "multicopter")

    def _devices(self, legs: Sequence[Leg]) -> dict[int, dict[str, Device]]:
        """Return the devices for each active leg, by leg number and channel."""
        devices = {}
        for leg in legs:
            with prefix_errors(f"leg {leg.number}"):
                if leg.is_active:
                    devices[leg.number] = {
                        channel: make_device(scanner, leg.scanner)
                        for channel, scanner in self._scanners.items()
                    }
        return devices

    def _mount_devices(
        self,
        mount: Element | None,
        devices: dict[int, dict[str, Device]],
        trajectory: HeliosTrajectory,
    ) -> None:
        """Move the trajectory to the scanners' position, and fill `_sensors`."""
        mount_rotation = read_rotation(mount)
        mount_position = read_vector(mount)
        positions = {
            tuple(round_values(mount_position + mounted.position))  # type: ignore[arg-type]
            for by_channel in devices.values()
            for mounted in by_channel.values()
        }
        if len(positions) > 1:
            self._notes.append(
                "different positions of channels (all channels have the same position)"
            )
        trajectory.rows[:, 1:4] += min(positions, default=(0, 0, 0))
        for segment in trajectory.segments:
            if not segment.active:
                continue
            for channel, mounted in devices[segment.leg].items():
                name = f"leg{segment.leg}" + (f"-{channel}" if channel else "")
                self._sensors[name] = self._sensor(mounted, segment, mount_rotation)

    def _sensor(self, mounted: Device, segment: LegSegment, mount: Floats) -> dict[str, Any]:
        """Return the `sensors` entry for a device during one segment.

        `mount` is the rotation (3, 3) of its mount.
        """
        delay_s = mounted.delay_s
        if delay_s and delay_s + mounted.line_s > segment.seconds:
            delay_s = 0.0
            self._notes.append(
                f"opticsWarmupPhase_s of leg {segment.leg} (the leg is shorter than two scan lines)"
            )
        step_deg, steps = mounted.steps(segment.seconds - delay_s)
        min_range_m, max_range_m = mounted.range_m
        pose = Pose.from_rotation((0, 0, 0), AHEAD @ mount @ mounted.rotation)
        angles = {
            name: round_values(getattr(pose, name)) for name in ("yaw_deg", "pitch_deg", "roll_deg")
        }
        return {
            "model": self._file_of(mounted.data),
            "step_deg": step_deg,
            **({"min_range_m": round_values(min_range_m)} if min_range_m else {}),
            **({"max_range_m": round_values(max_range_m)} if np.isfinite(max_range_m) else {}),
            "mount": {name: angle for name, angle in angles.items() if angle},
            "start_s": round_values(segment.start_s + delay_s),
            "steps": steps,
        }

    def _file_of(self, data: dict[str, Any]) -> str:
        """Return the name of the data file for a sensor. Identical sensors share a file."""
        stem = re.sub(r"[^\w.-]+", "_", str(data["name"])).strip("._").lower() or "sensor"
        name = f"{stem}.yaml"
        number = 1
        while self._files.setdefault(name, data) != data:
            number += 1
            name = f"{stem}-{number}.yaml"
        return name

    def files(self, folder: Path) -> dict[str, str]:
        """Return the content of all text files for the folder, by name."""
        trajectory, files = self._trajectory.section_and_files()
        light, range_m = self._light()
        names = [
            os.path.relpath(part.file.resolve(), folder.resolve()) for part in self.scene.parts
        ]
        entries = zip(self.scene.parts, names, strict=True)
        classes = ["class"] if any("class" in entry for entry in self._materials) else []
        data = {
            "scene": {"files": [part.entry(Path(name).as_posix()) for part, name in entries]},
            "trajectory": trajectory,
            "sensors": {name: sensor | range_m for name, sensor in self._sensors.items()},
            **({"materials": self._materials} if self._materials else {}),
            **light,
            "cloud": {
                "precision_m": 0.001,
                "columns": ["time", "range", "intensity", "return_number", "returns", *classes],
            },
        }
        head = [
            f"Created from the HELIOS++ survey {self._name!r} by lidarpool import.",
            *(f"Not supported: {line}." for line in self.unsupported),
        ]
        text = "".join(f"# {line}\n" for line in head) + _dumped(data)
        sensors = {name: _dumped(sensor) for name, sensor in self._files.items()}
        return {**files, **sensors, SCENARIO_FILE: text}

    def _full_waveform(self) -> dict[str, str]:
        """Return the FWFSettings of the scanner, as overridden by the survey."""
        elements = (self._first.child("FWFSettings"), self._element.find("FWFSettings"))
        settings: dict[str, str] = {}
        for element in elements:
            if element is not None:
                settings.update(element.attrib)
        return settings

    def _light(self) -> tuple[dict[str, Any], dict[str, float]]:
        """Return the sections about light, and the range limits that the survey sets."""
        scanner = self._first
        detector = self._element.find("detectorSettings")
        detector_settings = {} if detector is None else detector.attrib
        waveform_settings = self._full_waveform()
        sections = {
            "returns": returns_section(
                waveform_settings, scanner.number("maxNOR"), scanner.number("pulseLength_ns", 4)
            ),
            "noise": {
                "range_m": round_values(
                    read_number(detector_settings, "accuracy_m", scanner.number("accuracy_m"))
                )
            },
            # HELIOS++ defines visibility at a contrast of 2 %.
            "weather": {
                "visibility_km": round_values(
                    MOR_SHARE * scanner.number("atmosphericVisibility_km", 23)
                )
            },
        }
        ranges = {"min_range_m": "rangeMin_m", "max_range_m": "rangeMax_m"}
        return sections, {
            field: read_number(detector_settings, name, 0)
            for field, name in ranges.items()
            if name in detector_settings
        }


def _head_times(devices: dict[int, dict[str, Device]]) -> dict[int, float]:
    """Return the time in seconds for which heads rotate during each leg, or 0 without a head.

    Raises LidarError if a head has passed its stop before the leg starts.
    """
    times = {}
    for leg, by_channel in devices.items():
        heads = [mounted.head_s for mounted in by_channel.values() if mounted.head_s is not None]
        if heads and max(heads) <= 0:
            raise LidarError(
                f"leg {leg}: the head reaches headRotateStop_deg during opticsWarmupPhase_s, so "
                "the leg has no pulses. Reduce opticsWarmupPhase_s."
            )
        times[leg] = max(heads, default=0.0)
    return times


def returns_section(
    settings: dict[str, str], max_returns: float, pulse_ns: float
) -> dict[str, Any]:
    """Return the `returns` section, given the FWFSettings, maxNOR, and the pulse length."""
    quality = read_number(settings, "beamSampleQuality", 3.0)
    return {
        "mode": "first" if max_returns == 1 else "all",
        "subrays": SUBRAYS[int(np.clip(quality - 1, 0, len(SUBRAYS) - 1))],
        **waveform(settings, pulse_ns),
    }


def waveform(settings: dict[str, str], pulse_ns: float) -> dict[str, Any]:
    """Return the waveform fields for `returns`. There are none without waveform settings.

    In HELIOS++, a time is the range divided by the speed of light. This is half of the time that
    light takes to a surface and back.
    """
    if "binSize_ns" not in settings and "winSize_ns" not in settings:
        return {}
    sample_ns = 2 * read_number(settings, "binSize_ns", 0.25)
    return {"waveform": "peaks", "sample_ns": round_values(min(sample_ns, pulse_ns / 2))}


def _dumped(data: dict[str, Any]) -> str:
    """Format data as YAML."""
    return yaml.safe_dump(data, sort_keys=False, default_flow_style=None, width=100)
