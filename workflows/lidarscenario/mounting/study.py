"""Study of the mounting positions in a vehicle file."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from lidarfiles.identity.fingerprint import fingerprint
from lidarfiles.work.mapping import MapFunction, parallel_map
from lidarfiles.work.work import Inputs, Step, Work
from lidarscenes.procedural.cars import MODELS, car
from lidarscenes.procedural.road_users import ROAD_USERS
from lidarsim.errors import LidarError, prefix_errors
from lidarsim.media.weather import Weather
from lidarsim.motion.trajectory import CENTER, Pose
from lidarsim.numerics.arrays import Bools
from lidarsim.numerics.vectors import rotate
from lidarsim.scene.scene_mesh import SceneMesh, stack_meshes
from lidarsim.schema.declared import declared_values
from lidarsim.schema.vocabulary import BODIES
from lidarsim.sensor import Noise, Returns
from raybeam import RayCaster

from ..mount_sections import MAX_CELLS, BodyPart, VehicleFile
from ..sections import ShapeSection
from ..static_scene import FileFindings, ShapeLoader
from .blind_loops import CellGrid
from .evaluation import VEHICLE, MountEvaluator, MountResult
from .placements import Placements, Target, grid_placements
from .ranking import CandidateResult, MountCandidate, RankingRules, pareto_front, rank_candidates
from .ranking_notes import ranking_notes
from .search import CandidateSearch
from .traffic_placements import traffic_placements

if TYPE_CHECKING:
    from lidarfiles.work.mapping import Client

_WORKER_BYTES = 1 << 30
_MOUNTS = Step("mounts", (MountResult,))
_KEY_LETTERS = 24
_CARS = dict(zip(BODIES, MODELS, strict=True))


@dataclass(frozen=True, eq=False)
class MountRanking:
    """Ranked candidates of a vehicle file.

    Attributes
    ----------
    study
        The study.
    ranked
        All candidates, best first.
    on_front
        Whether each candidate is on the trade-off curve. Shape (candidates,).
    mounts
        Number of evaluated mounts of all sensors.
    notes
        Notes for the user.
    """

    study: MountStudy
    ranked: Sequence[CandidateResult]
    on_front: Bools
    mounts: int
    notes: tuple[str, ...]

    @property
    def best(self) -> CandidateResult:
        """The candidate with the highest score."""
        return self.ranked[0]


@dataclass(frozen=True, eq=False)
class MountStudy:
    """Vehicle, targets and map of a vehicle file, ready to be evaluated.

    Attributes
    ----------
    vehicle
        The vehicle file.
    evaluator
        Evaluator of sensors at a mount.
    rules
        Parameters of the score.
    notes
        Notes about the files.
    """

    vehicle: VehicleFile
    evaluator: MountEvaluator
    rules: RankingRules
    notes: tuple[str, ...] = field(default=())

    @classmethod
    def from_file(cls, vehicle: VehicleFile) -> MountStudy:
        """Read the meshes of a vehicle file, and place the targets.

        Raises
        ------
        LidarError
            If a mesh or scenario cannot be read, or if no target is outside the vehicle.
        """
        findings = FileFindings()
        loader = ShapeLoader(vehicle.files, findings)
        body = _body(vehicle.body, loader)
        if float(body.bounds[0, 2]) < -0.5:
            findings.notes.append(
                f"the body extends to z = {body.bounds[0, 2]:.2f} m, but the ground is z = 0 in "
                "the frame of the vehicle"
            )
        everywhere = _placements(vehicle, loader)
        placements = everywhere.without_collisions(body.bounds[:, :2])
        if not len(placements):
            raise LidarError(
                f"{vehicle.source}: No target is outside the vehicle. Use larger distances in "
                "`region.distances_m`."
            )
        grid = _grid(vehicle, body)
        weather = declared_values(vehicle.weather, Weather)
        evaluator = MountEvaluator(
            body,
            placements,
            grid,
            max(vehicle.map.heights_m),
            vehicle.map.reflectance,
            Returns(**declared_values(vehicle.returns, Returns)),
            {"noise": Noise(**declared_values(vehicle.noise, Noise)), **weather},
        )
        rules = RankingRules(
            tuple(sorted(vehicle.map.heights_m)),
            vehicle.ranked_height_m,
            vehicle.rank.blind_weight,
            _outside(body, grid),
            grid.cell_m**2,
        )
        return cls(vehicle, evaluator, rules, (*findings.notes, *findings.remarks))

    @property
    def placements(self) -> Placements:
        """Targets that are evaluated."""
        return self.evaluator.placements

    def inputs(self, file: Path) -> Inputs:
        """Return what the files of the study depend on, including the vehicle file."""
        vehicle = self.vehicle
        models = [
            vehicle.files.path(section.model)
            for section in vehicle.sensors.values()
            if section.model is not None and section.has_custom_model
        ]
        return Inputs(
            {"vehicle": file, **{str(model): model for model in models}},
            {
                "body and targets": (self.evaluator, self.notes),
                "sensors": [vehicle.mounted_sensor(name, CENTER) for name in vehicle.sensors],
            },
        )

    def run(
        self,
        *,
        client: Client | None = None,
        workers: int | None = None,
        work: Work | None = None,
        progress: Callable[[int], None] = lambda done: None,
    ) -> MountRanking:
        """Evaluate all candidates, and rank them.

        The result does not depend on the number of workers.

        Parameters
        ----------
        client
            Client of a cluster whose OTHER workers evaluate the mounts. By default, processes on
            this machine do.
        workers
            Number of processes on this machine. By default, it depends on the number of cores and
            the memory.
        work
            Unfinished work that keeps the evaluated mounts, and provides those of an earlier run.
        progress
            Function that is called with the number of evaluated mounts.

        Raises
        ------
        LidarError
            If a sensor cannot be simulated, or if the cluster is lost.
        """
        vehicle = self.vehicle
        done = 0
        with parallel_map(client, self._batch, _WORKER_BYTES, workers) as run:

            def evaluate(mounts: Sequence[tuple[str, Pose]]) -> Iterator[MountResult]:
                nonlocal done
                for result in self._evaluate(run, mounts, work):
                    done += 1
                    progress(done)
                    yield result

            search = CandidateSearch(vehicle, self.placements, self.rules, evaluate)
            found = rank_candidates(search.run())
        if vehicle.is_search:
            found = [_named(result, f"mount {n}") for n, result in enumerate(found, 1)]
        front = pareto_front(found, self.rules.ranked_height_m)
        notes = ranking_notes(found, vehicle, self.placements, self.evaluator.body)
        return MountRanking(self, found, front, done, (*self.notes, *notes))

    def _evaluate(
        self, run: MapFunction, mounts: Sequence[tuple[str, Pose]], work: Work | None
    ) -> Iterable[MountResult]:
        mounted = [self.vehicle.mounted_sensor(name, pose) for name, pose in mounts]
        if work is None:
            return run(self.evaluator, mounted)
        evaluator = self.evaluator
        keys = [fingerprint(mount)[:_KEY_LETTERS] for mount in mounts]
        results = work.each(_MOUNTS, run, lambda item: (evaluator(item),), mounted, keys)
        return (result for (result,) in results)

    @property
    def _batch(self) -> int:
        """Maximum number of mounts that are evaluated together."""
        if not self.vehicle.is_search:
            return sum(len(sensor.mounts) for sensor in self.vehicle.sensors.values())
        return self.vehicle.search.samples


def _named(result: CandidateResult, name: str) -> CandidateResult:
    return replace(result, candidate=MountCandidate(name, result.candidate.mounts))


def _rounded(mesh: SceneMesh, name: str) -> SceneMesh:
    """Return a renamed mesh without colors, whose vertices have single precision as in files."""
    vertices = mesh.vertices.astype(np.float32).astype(np.float64)
    return SceneMesh(name, vertices, mesh.faces)


def _body(parts: Sequence[BodyPart], loader: ShapeLoader) -> SceneMesh:
    """Return all parts of a vehicle body as one mesh in the vehicle frame."""
    pieces = []
    for part in parts:
        if part.model is not None:
            mesh = car(_CARS[part.model])
        else:
            section = ShapeSection(name=VEHICLE, file=part.file, box=part.box)
            with prefix_errors(f"{loader.scenario.source}: body"):
                mesh = loader.load_mesh(section)
        vertices = rotate(mesh.vertices, part.at.rotation) + part.at.position
        pieces.append((vertices, mesh.faces))
    return _rounded(SceneMesh(VEHICLE, *stack_meshes(pieces)), VEHICLE)


def _placements(vehicle: VehicleFile, loader: ShapeLoader) -> Placements:
    """Return the targets of a vehicle file, which may overlap the vehicle."""
    if vehicle.traffic is not None:
        found = traffic_placements(vehicle, vehicle.traffic)
        meshes = tuple(_rounded(mesh, mesh.name) for mesh in found.meshes)
        return replace(found, meshes=meshes)
    targets = []
    meshes_by_class = []
    for name, section in vehicle.targets.items():
        if section.file is None and section.box is None:
            mesh = ROAD_USERS[name]()
        else:
            shape = ShapeSection(name=name, file=section.file, box=section.box)
            with prefix_errors(f"{vehicle.source}: targets: {name}"):
                mesh = loader.load_mesh(shape)
        targets.append(Target(name, section.points, section.reflectance, section.weight))
        meshes_by_class.append(_rounded(mesh, name))
    region = vehicle.region
    return grid_placements(
        targets, meshes_by_class, region.distances_m, region.bearings, region.headings_deg
    )


def _grid(vehicle: VehicleFile, body: SceneMesh) -> CellGrid:
    """Return the cells of the map, whose borders are multiples of the cell size.

    Raise LidarError if there are too many cells.
    """
    cell = vehicle.map.cell_m
    margin = vehicle.map.margin_m
    lower = np.floor((body.bounds[0, :2] - margin) / cell).astype(int)
    upper = np.ceil((body.bounds[1, :2] + margin) / cell).astype(int)
    columns, rows = (upper - lower).tolist()
    if columns * rows > MAX_CELLS:
        raise LidarError(
            f"{vehicle.source}: The map has {columns * rows:,} cells, but the limit is "
            f"{MAX_CELLS:,}. Increase `map.cell_m`, or reduce `map.margin_m`."
        )
    x, y = (lower * cell).round(9).tolist()
    return CellGrid(x, y, cell, columns, rows)


def _outside(body: SceneMesh, grid: CellGrid) -> Bools:
    """Return whether the center of each cell is not below the vehicle. Shape (rows, columns)."""
    x = grid.x + (np.arange(grid.columns) + 0.5) * grid.cell_m
    y = grid.y + (np.arange(grid.rows) + 0.5) * grid.cell_m
    centers = np.stack([*np.meshgrid(x, y), np.full((grid.rows, grid.columns), -100.0)], axis=-1)
    up = np.tile([0.0, 0.0, 1.0], (centers[..., 0].size, 1))
    hits = RayCaster(body.vertices, body.faces).cast(centers.reshape(-1, 3), up)
    return ~hits.hit.reshape(grid.rows, grid.columns)


def figures_of(result: MountRanking) -> dict[str, Any]:
    """Return a ranking as a dictionary for JSON."""
    study = result.study
    vehicle = study.vehicle
    placements = study.placements
    return {
        "vehicle": vehicle.source,
        "sensors": {
            name: vehicle.mounted_sensor(name, CENTER).sensor.model for name in vehicle.sensors
        },
        "targets": {
            target.name: {
                "points": target.points,
                "reflectance": target.reflectance,
                "weight": target.weight,
                "placements": int((placements.target == number).sum()),
            }
            for number, target in enumerate(placements.targets)
        },
        "map_m2": _tidy(result.best.map_m2),
        "ranked_height_m": study.rules.ranked_height_m,
        "blind_weight": study.rules.blind_weight,
        "seed": vehicle.search.seed if vehicle.is_search else None,
        "evaluated_mounts": result.mounts,
        "candidates": [
            _candidate_figures(one, bool(front))
            for one, front in zip(result.ranked, result.on_front, strict=True)
        ],
        "notes": list(result.notes),
    }


def _candidate_figures(result: CandidateResult, on_front: bool) -> dict[str, Any]:
    return {
        "name": result.candidate.name,
        "score": _tidy(result.score),
        "on_tradeoff_curve": on_front,
        "detection_rate": _tidy(result.detection_rate),
        "detection": {name: _tidy(value) for name, value in result.detection.items()},
        "mean_points": {name: _tidy(value) for name, value in result.mean_points.items()},
        "redundancy": {name: _tidy(value) for name, value in result.redundancy.items()},
        "blind_m2": {f"{h:g}": _tidy(area) for h, area in result.blind_m2.items()},
        "hidden_by_vehicle_m2": {f"{h:g}": _tidy(area) for h, area in result.hidden_m2.items()},
        "seen_twice_m2": {f"{h:g}": _tidy(area) for h, area in result.twice_m2.items()},
        "sensors": {
            name: {
                **pose_entry(result.candidate.mounts[name]),
                "blocked_by_vehicle": _tidy(sensor.blocked / sensor.beams),
            }
            for name, sensor in result.sensors.items()
        },
    }


def pose_entry(pose: Pose) -> dict[str, Any]:
    """Return a pose as a mapping for YAML or JSON, without angles that are zero."""
    angles = {name: getattr(pose, name) for name in ("yaw_deg", "pitch_deg", "roll_deg")}
    return {"position": [*pose.position], **{name: v for name, v in angles.items() if v}}


def _tidy(value: float) -> float | None:
    """Return a value with six digits after the decimal point, or None for NaN."""
    return None if np.isnan(value) else round(float(value), 6)
