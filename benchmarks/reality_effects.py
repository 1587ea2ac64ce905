"""Which effects of the simulator bring twins of public recordings nearer to the recordings.

`python -m benchmarks.reality_effects FOLDER [NAME …] [--json FILE]` builds the twins of
`benchmarks.reality` without every second sweep, fits the sensor to the others, and simulates the
rays of held-out sweeps: with all effects, and without each in turn.

| figure | of |
|---|---|
| half, 90 % | sizes of the differences of ranges, of points that stand |
| rough | median size of the second difference of ranges along a ring, of the same rays |
| mixed | share of points between a near and a far surface beside them on the ring |
| lost, F1 | share of pulses without a return; F1 of "no return" |
| rank | rank correlation of intensities |

`rough`, `mixed` and `lost` are simulated and recorded, and should be equal.

Noise has no place in the difference of two ranges, which it only makes larger: it shows in how
rough a surface looks.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from lidarpool.reconstruction.alignment import AlignedSweeps
from lidarpool.reconstruction.building import NO_RETURN, color_by_reflectance, fit_sensor
from lidarpool.reconstruction.lost_pulses import SensorCoverage
from lidarpool.reconstruction.motion import Motion
from lidarpool.reconstruction.recorded_sweeps import RecordedSweeps
from lidarpool.reconstruction.reflectances import Reflectances
from lidarpool.reconstruction.surface_map import SurfaceMap
from lidarpool.reconstruction.surfels import surfel_mesh
from lidarsim import Material, Noise, Returns, Scanner, Scene
from lidarsim.motion.trajectory import CENTER
from lidarsim.numerics.arrays import Bools, Floats, Ints
from lidarsim.scene.scene_mesh import SceneMesh
from lidarsim.sensor.beams import Spin
from lidarsim.sensor.models import SensorModel, read_model
from lidarsim.sensor.ray_sensors import ListedSensor

from .reality import SOURCES, HalfMap, part_of

_COMPARED_SWEEPS = 12
_SUBRAYS = 19
_SWEEP_RAYS = 1 << 17  # cast at a time
_RANGE_MARGIN_M = 0.5  # beyond the largest recorded range
_ALL = "all effects"
_MAX_STEPS = 2.5  # of a ring, between the rays on both sides of a ray
_MIN_EDGE_M = 1.0  # between a near and a far surface
_OFF_EDGE_M = 0.25  # from both, of a point that is between
MODELS = {"hdl32": "velodyne/hdl32e"}  # others are of the HDL-64E
_DEFAULT_MODEL = "velodyne/hdl64e-s2"


@dataclass(frozen=True, eq=False)
class Rays:
    """Rays of held-out sweeps, ring by ring in the order of their azimuths, as n rays.

    Attributes
    ----------
    origins, directions
        float64 (n, 3): in the surface_map, meters, and of length 1.
    recorded_m
        float64 (n,): NaN of a lost pulse.
    standing
        bool (n,): whether the recorded point stands.
    neighbors
        bool (n - 2,): whether three successive rays are neighbors on a ring.
    """

    origins: Floats
    directions: Floats
    recorded_m: Floats
    standing: Bools
    neighbors: Bools

    @classmethod
    def of_sweeps(
        cls, sweeps: AlignedSweeps, standing: dict[int, Bools], numbers: list[int]
    ) -> Rays:
        """Return the rays of sweeps, lost pulses included."""
        parts = []
        for number in numbers:
            for sweep, stands in zip(
                sweeps.read_with_lost(number), (standing[number], None), strict=True
            ):
                count = len(sweep.points)
                vectors = sweep.world - sweep.origins
                length_m = np.linalg.norm(vectors, axis=1)
                azimuth = np.arctan2(sweep.points[:, 1], sweep.points[:, 0])
                columns = [
                    sweep.origins,
                    vectors / np.maximum(length_m, 1e-9)[:, None],
                    np.full(count, np.nan) if stands is None else length_m,
                    np.zeros(count, bool) if stands is None else stands,
                    sweep.ring + sweeps.recorded.ring_count * number,
                    azimuth,
                ]
                parts.append(columns)
        joined = [np.concatenate(columns) for columns in zip(*parts, strict=True)]
        ring, azimuth = joined[4:]
        order = np.lexsort((azimuth, ring))
        return cls(
            *(values[order] for values in joined[:4]), _neighbors(ring[order], azimuth[order])
        )

    def sensor(self) -> ListedSensor:
        """Return a sensor that fires these rays, `_SWEEP_RAYS` in a frame, the last again."""
        rows = np.arange(-(-len(self.recorded_m) // _SWEEP_RAYS) * _SWEEP_RAYS)
        rows = rows.clip(max=len(self.recorded_m) - 1)
        return ListedSensor(
            head=Spin(_SWEEP_RAYS, 360),
            rays=self.directions[rows],
            shot_ns=np.zeros(len(rows)),
            starts=self.origins[rows],
        )


def _neighbors(ring: Ints, azimuth: Floats) -> Bools:
    """Mark successive three of rays, sorted by ring and azimuth, that are neighbors."""
    gap = np.diff(azimuth)
    step = np.median(gap[(gap > 0) & (np.diff(ring) == 0)])
    return (ring[2:] == ring[:-2]) & (azimuth[2:] - azimuth[:-2] < _MAX_STEPS * step)


@dataclass(frozen=True, eq=False)
class Effects:
    """Effects of a sensor in a surface_map."""

    noise: Noise
    returns: Returns
    textured: bool  # whether surfaces have reflectances

    @classmethod
    def of_model(cls, model: SensorModel, textured: bool) -> Effects:
        """Return all effects of a sensor that was fitted."""
        noise = Noise() if model.performance is None else model.datasheet().noise
        returns = Returns(
            "strongest",
            subrays=_SUBRAYS,
            divergence_mrad=model.optics.divergence_mrad,
            pulse_ns=model.optics.pulse_ns,
        )
        return cls(noise, returns, textured)

    def without(self) -> dict[str, Effects]:
        """Return the effects without each in turn."""
        exact = replace(self.noise, range_m=0, range_per_m=0, range_at_threshold_m=0)
        seen = replace(
            self.noise,
            dropout=0,
            detection_range_m=None,
            range_at_threshold_m=0,
            false_alarm_hz=0,
        )
        narrow = replace(self.returns, subrays=1)
        effects = {
            _ALL: self,
            "without beam width": replace(self, returns=narrow),
            "without range noise": replace(self, noise=exact),
            "without reflectances": replace(self, textured=False),
            "without detection limits": replace(self, noise=seen),
            "bare rays": Effects(Noise(), narrow, False),
        }
        if not self.textured:
            effects.pop("without reflectances")
        return effects

    def ranges(self, scene: Scene, rays: Rays, max_range_m: float) -> Floats:
        """Return the simulated ranges (n,) of rays; NaN without a return."""
        scanner = Scanner(
            scene,
            rays.sensor(),
            materials=[
                *[Material(NO_RETURN, reflectance=0)] * (NO_RETURN in scene.names),
                Material("*", reflectance="texture" if self.textured else None),
            ],
            returns=self.returns,
            noise=self.noise,
        )
        frames = -(-len(rays.recorded_m) // _SWEEP_RAYS)
        ranges_m = [scanner.ranges(CENTER, number=number).ravel() for number in range(frames)]
        found_m = np.concatenate(ranges_m)[: len(rays.recorded_m)].astype(np.float64)
        return np.where(found_m <= max_range_m, found_m, np.nan)


def figures(rays: Rays, simulated_m: Floats) -> dict[str, float]:
    """Return the figures of simulated ranges (n,) of rays."""
    size_m = np.abs(simulated_m - rays.recorded_m)[rays.standing]
    size_m = size_m[np.isfinite(size_m)]
    lost = np.isnan(rays.recorded_m)
    lost_again = np.isnan(simulated_m)
    rough = []
    mixed = []
    bends = [np.abs(np.diff(ranges_m, 2)) for ranges_m in (simulated_m, rays.recorded_m)]
    same = rays.neighbors & np.isfinite(bends[0] + bends[1])
    same &= rays.standing[1:-1] & rays.standing[:-2] & rays.standing[2:]
    for ranges_m, bend_m in zip((simulated_m, rays.recorded_m), bends, strict=True):
        rough.append(float(np.median(bend_m[same])))
        sides = np.sort(np.stack([ranges_m[:-2], ranges_m[2:]]), axis=0)
        between = (ranges_m[1:-1] > sides[0] + _OFF_EDGE_M) & (
            ranges_m[1:-1] < sides[1] - _OFF_EDGE_M
        )
        edges = rays.neighbors & (sides[1] - sides[0] > _MIN_EDGE_M)
        mixed.append(float((between & edges).sum() / np.isfinite(ranges_m).sum()))
    return {
        "median_size_m": float(np.median(size_m)),
        "p90_size_m": float(np.quantile(size_m, 0.9)),
        "rough_m": rough[0],
        "rough_recorded_m": rough[1],
        "mixed": mixed[0],
        "mixed_recorded": mixed[1],
        "lost": float(lost_again.mean()),
        "lost_recorded": float(lost.mean()),
        "f1": float(2 * (lost & lost_again).sum() / (lost.sum() + lost_again.sum())),
    }


def meshes(
    surface_map: SurfaceMap, reflectances: Reflectances | None
) -> tuple[SceneMesh, list[SceneMesh]]:
    """Return a mesh of the reflecting surfels, with colors, and a mesh of the others, if any."""
    dark = surface_map.surfels.dark
    lit = surface_map.surfels.select(~dark).mesh
    if reflectances is not None:
        lit = color_by_reflectance(lit, replace(reflectances, surfels=reflectances.surfels[~dark]))
    corners = surface_map.surfels.mesh.vertices.reshape(-1, 4, 3)[dark]
    return lit, [surfel_mesh(NO_RETURN, corners)] if len(corners) else []


def measure(name: str, root: Path) -> list[dict[str, Any]]:
    """Return and print the figures of a recording's parts, with and without effects."""
    source = SOURCES[name]
    base = read_model(MODELS.get(name, _DEFAULT_MODEL))
    whole = source.open(root / source.repository)
    coverage = SensorCoverage.from_sweeps(RecordedSweeps.from_recording(whole))
    rows = []
    for part, chosen in source.parts.items():
        recording = part_of(whole, chosen)
        half = HalfMap.of_recording(recording, _COMPARED_SWEEPS, coverage)
        found = _rows(half, base)
        if half.sweeps.alignment.motion is not Motion.COMPENSATED:
            # A recording that knows its firings is read as compensated.
            stated = replace(recording, fired=recording.read)
            rebuilt = HalfMap.of_recording(stated, _COMPARED_SWEEPS, coverage)
            row = _rows(rebuilt, base, only=_ALL)[0]
            found.append(row | {"effect": "without motion within the sweep"})
        for row in found:
            row["recording"] = f"{name}, {part}"
            print(_line(row), flush=True)
        rows += found
    return rows


def _rows(half: HalfMap, base: SensorModel, only: str = "") -> list[dict[str, Any]]:
    """Return the figures of held-out sweeps, with all effects and without each."""
    surface_map, reflectances = half.surface_map, half.reflectances
    sizes = {number: len(half.standing[number]) for number in half.mapped}
    lit, dark = meshes(surface_map, reflectances)
    bare = Scene.from_meshes([lit])
    response = None if reflectances is None else reflectances.response
    model, notes = fit_sensor(half.sweeps, sizes, bare, response, base)
    rays = Rays.of_sweeps(half.sweeps, half.standing, half.compared)
    print(f"{len(rays.recorded_m):,} rays, {model.performance}, {notes}", flush=True)
    scene = Scene.from_meshes([lit, *dark])
    max_range_m = half.sweeps.coverage.max_range_m + _RANGE_MARGIN_M
    rows = []
    for effect, effects in Effects.of_model(model, reflectances is not None).without().items():
        if only not in ("", effect):
            continue
        row: dict[str, Any] = {"effect": effect}
        row |= figures(rays, effects.ranges(scene, rays, max_range_m))
        row["rank"] = None if reflectances is None else _rank(half, reflectances, effects.textured)
        rows.append(row)
    return rows


def _rank(half: HalfMap, reflectances: Reflectances, textured: bool) -> float | None:
    """Return the rank correlation of recorded and simulated intensities.

    Without a texture, all surfels are as bright.
    """
    if not textured:
        reflectances = replace(reflectances, surfels=np.full_like(reflectances.surfels, 0.5))
    standing = half.rays(half.compared, reflectances).figures()["stationary"]
    rank: float | None = standing["rank_correlation"]
    return rank


def _line(row: dict[str, Any]) -> str:
    """Return the figures of a row as text."""
    rank = row.get("rank")
    return (
        f"{row['recording']}, {row['effect']}: half {1000 * row['median_size_m']:.1f} mm, 90 % "
        f"{1000 * row['p90_size_m']:.0f}, rough {1000 * row['rough_m']:.1f} of "
        f"{1000 * row['rough_recorded_m']:.1f} mm, mixed {1000 * row['mixed']:.2f} of "
        f"{1000 * row['mixed_recorded']:.2f} in 1,000, lost {100 * row['lost']:.1f} of "
        f"{100 * row['lost_recorded']:.1f} %, "
        f"F1 {row['f1']:.3f}, rank {'–' if rank is None else format(rank, '.3f')}"
    )


def main(arguments: list[str] | None = None) -> list[dict[str, Any]]:
    """Measure, print and return the rows of the recordings that are there."""
    parser = argparse.ArgumentParser(prog="benchmarks.reality_effects", description=__doc__)
    parser.add_argument("folder", type=Path, help="folder with the folders of the repositories")
    parser.add_argument("names", nargs="*", help=f"of {', '.join(SOURCES)}; all by default")
    parser.add_argument("--json", type=Path, help="file for the figures")
    options = parser.parse_args(arguments)
    rows = []
    for name in options.names or SOURCES:
        if (options.folder / SOURCES[name].repository).is_dir():
            rows += measure(name, options.folder)
    if options.json:
        options.json.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
    return rows


if __name__ == "__main__":
    main()
