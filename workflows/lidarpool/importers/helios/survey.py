"""A survey of HELIOS++ as a scenario: one sensor for each leg that scans, on one trajectory."""

from __future__ import annotations

import os
import re
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np
import yaml

from ...base.errors import LidarpoolError
from ...scenario.scenario import Scenario
from ...sensor import Pose
from ...sensor.disc import SUBRAYS
from ...sensor.survey import SENSORS_MOST
from .files import Assets, Float, about, clean, number, rotation, vector
from .scanner import Device, Scanner, channels, device, unread
from .scene import Surroundings
from .way import Legs, Stretch, Way, flown, read_way, stood

SCENARIO_FILE = "scenario.yaml"
# Carriers look along x, the platforms of HELIOS++ along y.
_AHEAD = about(np.array([0.0, 0, 1]), -90)


@dataclass
class Imported:
    """A written scenario, and the unsupported features of its survey."""

    path: Path
    scenario: Scenario
    left_out: list[str]


def import_survey(
    survey: str | Path, out: str | Path, assets: Sequence[str | Path] = ()
) -> Imported:
    """Write a HELIOS++ survey as a scenario, into a new folder.

    Beside `scenario.yaml` go data files of its sensors, and the trajectory if it is a file.

    Parameters
    ----------
    survey
        Its XML file.
    out
        The folder.
    assets
        Folders where its references start, before the survey's own and those above it.

    Raises
    ------
    LidarpoolError
        If a file is missing or broken, or an essential feature is not supported; nothing is
        written then.
    """
    survey, out = Path(survey), Path(out)
    if out.exists():
        raise LidarpoolError(f"{out} exists: name another folder, --out DIR.")
    try:
        made = _Import(survey, [Path(folder) for folder in assets])
    except LidarpoolError as error:
        told = str(error)
        raise LidarpoolError(told if told.startswith(str(survey)) else f"{survey}: {told}") from (
            error
        )
    out.parent.mkdir(parents=True, exist_ok=True)
    partial = Path(tempfile.mkdtemp(prefix=f".{out.name}.", dir=out.parent))
    try:
        for name, text in made.files(out).items():
            (partial / name).write_text(text, encoding="utf-8", newline="\n")
        scenario = Scenario.load(partial / SCENARIO_FILE)
        scenario.survey(scenario.build_scene())  # with whatever is wrong about it
        partial.chmod(0o755)  # temporary folders are their owner's alone
        partial.rename(out)
    except LidarpoolError as error:
        told = str(error).replace(str(partial), str(out))
        raise LidarpoolError(f"{survey} makes no scenario: {told}") from error
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return Imported(out / SCENARIO_FILE, Scenario.load(out / SCENARIO_FILE), made.left_out)


@dataclass
class _Import:
    survey: Path
    folders: list[Path]
    left_out: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.assets = Assets(self.survey, self.folders)
        root = self.assets.root(self.survey)
        element = root.find("survey")
        if element is None:
            raise LidarpoolError("it has no <survey>.")
        self.element, self.name = element, element.get("name") or self.survey.stem
        reference = self._reference("scanner")
        self.scanners = channels(self.assets.asset(reference, "scanner", self.survey).element)
        scene = self.assets.asset(self._reference("scene"), "scene", self.survey)
        self.scene = Surroundings(scene.element, self.assets)
        self.data: dict[str, dict[str, Any]] = {}  # {file: of a sensor}
        self.way, self.sensors = self._carried(*self._legs())
        if not self.sensors:
            raise LidarpoolError("no leg scans anything.")
        if len(self.sensors) > SENSORS_MOST:
            raise LidarpoolError(
                f"{len(self.sensors)} legs and channels scan; a scenario has {SENSORS_MOST} "
                "sensors at most."
            )
        first = next(iter(self.scanners.values()))
        self.materials = self.scene.materials(first.number("wavelength_nm", 1064))
        self.left_out = list(
            dict.fromkeys([*self.left_out, *self._unread(), *self.scene.left_out()])
        )

    def _reference(self, kind: str) -> str:
        if not (found := self.element.get(kind)):
            raise LidarpoolError(f"its <survey> names no {kind}.")
        return found

    def _legs(self) -> tuple[Legs, Element | None]:
        """Read the legs, and the mount of their platform."""
        legs = Legs.of(self.element, self.assets, self.survey, self.scene.height)
        reference = self._reference("platform")
        if reference == "interpolated":
            base = self.element.get("basePlatform")
            platform = base and self.assets.asset(base, "platform", self.survey).element
            mount = platform.find("scannerMount") if isinstance(platform, Element) else None
            own = self.element.find("scannerMount")
            legs.moves = True
            legs.way = read_way(self.element, legs, self.assets)
            return legs, mount if own is None else own
        platform = self.assets.asset(reference, "platform", self.survey).element
        kind = platform.get("type", "").lower()
        if kind in ("groundvehicle", "multicopter"):
            self.left_out.append(
                f"how a {kind} drives: it keeps its speed and goes straight from leg to leg"
            )
        legs.moves = kind in ("linearpath", "groundvehicle", "multicopter")
        noisy = [e.tag for parent in (platform, self.element) for e in parent if "Noise" in e.tag]
        if noisy:
            self.left_out.append(f"noise of the platform: {', '.join(noisy)}")
        return legs, platform.find("scannerMount")

    def _carried(self, legs: Legs, mount: Element | None) -> tuple[Way, dict[str, dict[str, Any]]]:
        """Trajectory of the carrier, and its sensors by name."""
        turn, place = rotation(mount), vector(mount)
        devices = {
            (leg.number, channel): self._device(leg.number, scanner, leg.settings)
            for leg in legs.active
            for channel, scanner in self.scanners.items()
        }
        heads = {
            number: max((d.head_s or 0.0 for (leg, _), d in devices.items() if leg == number))
            for number in {leg.number for leg in legs.active}
        }
        way = legs.way or (flown(legs) if legs.moves else stood(legs, heads))
        sensors: dict[str, dict[str, Any]] = {}
        places = {tuple(clean(place + one.place)) for one in devices.values()}  # type: ignore[arg-type]
        if len(places) > 1:
            self.left_out.append("places of channels beside each other: all leave from the first's")
        way.move(np.array(min(places, default=(0, 0, 0))))
        for stretch in way.stretches:
            for channel in self.scanners if stretch.active else ():
                one = devices[stretch.leg, channel]
                name = f"leg{stretch.leg}" + (f"-{channel}" if channel else "")
                sensors[name] = self._sensor(one, stretch, turn)
        return way, sensors

    def _device(self, leg: int, scanner: Scanner, settings: dict[str, str]) -> Device:
        try:
            return device(scanner, settings)
        except LidarpoolError as error:
            raise LidarpoolError(f"leg {leg}: {error}") from error

    def _sensor(self, one: Device, stretch: Stretch, mount: Float) -> dict[str, Any]:
        """Entry of `sensors`."""
        step_deg, steps = one.steps(stretch.seconds)
        near, far = one.range_m
        pose = Pose.of((0, 0, 0), _AHEAD @ mount @ one.turn)
        angles = {name: clean(getattr(pose, name)) for name in ("yaw_deg", "pitch_deg", "roll_deg")}
        return {
            "model": self._file_of(one.data),
            "step_deg": step_deg,
            **({"min_range_m": clean(near)} if near else {}),
            **({"max_range_m": clean(far)} if np.isfinite(far) else {}),
            "mount": {name: angle for name, angle in angles.items() if angle},
            "start_s": clean(stretch.start_s),
            "steps": steps,
        }

    def _file_of(self, data: dict[str, Any]) -> str:
        """Name of the file of a sensor; those that are alike share one."""
        stem = re.sub(r"[^\w.-]+", "_", str(data["name"])).strip("._").lower() or "sensor"
        name, number = f"{stem}.yaml", 1
        while self.data.setdefault(name, data) != data:
            number += 1
            name = f"{stem}-{number}.yaml"
        return name

    def _unread(self) -> Iterator[str]:
        for scanner in self.scanners.values():
            yield from unread(scanner)
        if self.element.get("legRandomOffset", "false") in ("true", "1"):
            yield "legRandomOffset: legs are where they say"
        if number(self.element, "numRuns", 1) > 1:
            yield "numRuns: it is one run"

    # -- what is written ---------------------------------------------------------------------

    def files(self, out: Path) -> dict[str, str]:
        """Return what goes into the folder `out`: {name: text}."""
        trajectory, files = self.way.written()
        light = Light.of(self.element, next(iter(self.scanners.values())))
        data = {
            "scene": {
                "files": [
                    part.entry(Path(os.path.relpath(part.file.resolve(), out.resolve())).as_posix())
                    for part in self.scene.parts
                ]
            },
            "trajectory": trajectory,
            "sensors": {name: {**sensor, **light.range_m} for name, sensor in self.sensors.items()},
            **({"materials": self.materials} if self.materials else {}),
            **light.sections,
            "cloud": {
                "keep_every": 1,
                "precision_m": 0.001,
                "columns": ["time", "range", "intensity", "return_number", "returns"],
            },
            "planning": {"enabled": False},
        }
        head = [
            f"From the HELIOS++ survey {self.name!r} by lidarpool import.",
            *(f"Not supported: {line}." for line in self.left_out),
        ]
        text = "".join(f"# {line}\n" for line in head) + _dumped(data)
        sensors = {name: _dumped(sensor) for name, sensor in self.data.items()}
        return {**files, **sensors, SCENARIO_FILE: text}


@dataclass(frozen=True)
class Light:
    """Sections on light, and ranges that the survey sets for its scanner."""

    sections: dict[str, Any]
    range_m: dict[str, float]

    @classmethod
    def of(cls, survey: Element, scanner: Scanner) -> Light:
        """Take them from a survey, else from its scanner."""
        detector = survey.find("detectorSettings")
        own = {} if detector is None else detector.attrib
        quality = 3.0
        for settings in (scanner.child("FWFSettings"), survey.find("FWFSettings")):
            if settings is not None:
                quality = number(settings, "beamSampleQuality", quality)
        rings = int(np.clip(quality - 1, 0, len(SUBRAYS) - 1))
        sections = {
            "returns": {
                "mode": "first" if scanner.number("maxNOR") == 1 else "all",
                "subrays": SUBRAYS[rings],
            },
            "noise": {"range_m": clean(number(own, "accuracy_m", scanner.number("accuracy_m")))},
            "weather": {"visibility_km": clean(scanner.number("atmosphericVisibility_km", 23))},
        }
        ranges = {"min_range_m": "rangeMin_m", "max_range_m": "rangeMax_m"}
        return cls(sections, {ours: number(own, n, 0) for ours, n in ranges.items() if n in own})


def _dumped(data: dict[str, Any]) -> str:
    return yaml.safe_dump(data, sort_keys=False, default_flow_style=None, width=100)
