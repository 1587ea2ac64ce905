"""Augment recorded sweeps in Python: sweep by sweep, or as a transform of a data set."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import fields, replace
from pathlib import Path
from typing import Any, NamedTuple, overload

import numpy as np

from lidarfiles.clouds.boxes import SweepBoxes
from lidarfiles.clouds.recording import PointCloud, Recording, SweepsInMemory
from lidarfiles.recordings.opening import open_recording, with_sweeps
from lidarsim.columns.column_names import standard_names
from lidarsim.columns.sweep import Sweep
from lidarsim.environment.extras import reading
from lidarsim.errors import ArgumentError, LidarError
from lidarsim.media.weather import Weather
from lidarsim.motion.trajectory import Track
from lidarsim.numerics.arrays import AnyArray
from lidarsim.numerics.even_samples import even_indices
from lidarsim.scene.actors import Actor
from lidarsim.schema.checks import check_number
from lidarsim.sensor import Sensor
from lidarsim.sensor.models import load_sensor, read_model
from lidarsim.words import did_you_mean, join_names

from .augmented_sweep import AugmentedSweep
from .augmenter import Augmenter
from .effects import Effects
from .intensity_scale import UnknownIntensitiesError

EffectsLike = Effects | str | Path | Mapping[str, Any]
ModelLike = Sensor | str | Path

_REFERENCE_SWEEPS = 5  # sweeps of a reference recording that are kept
_NUMBERS = 1 << 31  # sweep numbers, which select the random numbers of a transform


def augment(
    recording: str | Path | Recording | PointCloud,
    effects: EffectsLike | None = None,
    *,
    model: ModelLike | None = None,
    seed: int | None = None,
    sweeps: Iterable[int] | None = None,
    reflectance: float | None = None,
    **weather: Any,
) -> Iterator[Sweep]:
    """Simulate weather, faults, noise and inserted objects on the sweeps of a recording.

    Parameters
    ----------
    recording
        Recording in any format that `open_recording` supports. If it has several sensors, open one
        of them with ``open_recording(path, sensor)``.
    effects
        Effects, an effects file, or a mapping with the sections of an effects file.
    model
        Model of the recording's sensor, which defines its intensity scale, optics and sensitivity.
        By default, they are estimated from the recording.
    seed
        Seed of all random numbers. By default, it is the seed of the effects.
    sweeps
        Numbers of the sweeps, by default all.
    reflectance
        Reflectance of all recorded surfaces if the recording has no intensities.
    **weather
        Fields of the section `weather` that override those of the effects, such as
        ``rain_mm_h=25`` or ``visibility_km=0.5``.

    Yields
    ------
    Sweep
        The augmented sweep in the frame of the recorded sweep, with the columns of the recording.
        The column `cause` is 0 for surfaces; other values are returns that were added. `boxes`
        includes the inserted objects.

    Raises
    ------
    LidarError
        If the recording cannot be read, or if an effect cannot be applied to it.

    Examples
    --------
    >>> for sweep in augment("drive.mcap", rain_mm_h=25):  # doctest: +SKIP
    ...     print(len(sweep))
    """
    if not isinstance(recording, str | Path | Recording | PointCloud):
        raise ArgumentError(
            f"The recording must be a path or a Recording, but its type is "
            f"{type(recording).__name__}. To augment sweeps and arrays, use the transform "
            "`Augment`."
        )
    chosen = _effects(effects, weather, seed)
    if isinstance(recording, str | Path):
        recording = open_recording(recording, keep_noise=True)
    recorded = with_sweeps(recording)
    with _python_advice("Open the recording with `open_recording(path, intensity=COLUMN)`"):
        augmenter = Augmenter(recorded, chosen, _model(model), reflectance)
    numbers = range(len(recorded)) if sweeps is None else sweeps
    return _augmented_sweeps(recorded, augmenter, numbers)


def _augmented_sweeps(
    recording: Recording, augmenter: Augmenter, numbers: Iterable[int]
) -> Iterator[Sweep]:
    for number in numbers:
        sweep = recording[number]
        yield _with_boxes(sweep, augmenter.augment(sweep, sweep.number))


class Augment:
    """Transform that simulates weather, faults, noise and inserted objects on single sweeps.

    The result depends only on the points and the seed, so a data set has the same augmentations in
    any order and with any number of workers. The transform can be pickled.

    Without a `reference`, the scan pattern, the intensity scale and the sensitivity of the sensor
    are estimated from each sweep. With a reference, they are estimated once, which is faster and
    more accurate, but requires that all sweeps come from the same sensor.

    Parameters
    ----------
    effects
        Effects, an effects file, or a mapping with the sections of an effects file. Effects must
        not change over time. Positions of actors and insertions refer to the sensor.
    model
        Model of the sensor, which defines its intensity scale, optics and sensitivity. By default,
        they are estimated.
    reference
        Recording of the sensor, as a path, a `Recording` or a list of sweeps.
    columns
        Names of the columns of arrays after x, y and z, such as ``("intensity", "ring")``.
    reflectance
        Reflectance of all recorded surfaces if there are no intensities.
    **weather
        Fields of the section `weather` that override those of the effects, such as
        ``rain_mm_h=25``.

    Raises
    ------
    LidarError
        If an effect cannot be applied to recordings, or changes over time.

    Examples
    --------
    >>> from lidarpool import Pose, Scanner, Scene, load_sensor
    >>> sensor = load_sensor("velodyne/vlp16")
    >>> scanner = Scanner(Scene.seed(), sensor, columns=["reflectivity"], coordinates="sensor")
    >>> cloud = scanner.sweep(Pose((0, 0, 1.5)))
    >>> points = np.column_stack([cloud.positions, cloud["reflectivity"]])
    >>> fog = Augment(visibility_km=0.1, model="velodyne/vlp16")
    >>> points.shape, fog(points, seed=1).shape
    ((2296, 4), (2083, 4))
    """

    def __init__(
        self,
        effects: EffectsLike | None = None,
        *,
        model: ModelLike | None = None,
        reference: str | Path | Recording | Sequence[Sweep] | None = None,
        columns: Sequence[str] = ("intensity",),
        reflectance: float | None = None,
        **weather: Any,
    ) -> None:
        self.effects = _effects(effects, weather, None)
        _check_constant(self.effects)
        self.model = _model(model)
        self.columns = tuple(columns)
        self.reflectance = reflectance
        self._standard_names = standard_names(self.columns)
        if len({*self.columns}) < len(self.columns):
            raise LidarError(
                f"The columns must have different names, but are {join_names(self.columns)}."
            )
        self._reference = None if reference is None else _reference_sweeps(reference)
        # {columns of a sweep: state of the reference with these columns}
        self._states: dict[frozenset[str], _SensorState] = {}

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_states": {}}

    def __repr__(self) -> str:
        reference = "" if self._reference is None else ", with a reference"
        sensor = "" if self.model is None else f", {self.model.model}"
        return f"<Augment{sensor}, columns {', '.join(self.columns) or 'none'}{reference}>"

    @overload
    def __call__(self, points: Sweep, seed: int = 0) -> Sweep: ...

    @overload
    def __call__(self, points: AnyArray, seed: int = 0) -> AnyArray: ...

    def __call__(self, points: Any, seed: int = 0) -> Any:
        """Augment a sweep.

        Parameters
        ----------
        points
            Sweep, or array or PyTorch tensor of shape (n, 3 + k) with x, y and z in meters in the
            sensor frame and the k columns that were passed to the constructor.
        seed
            Seed of the random numbers. Use a different seed for each sweep and epoch.

        Returns
        -------
        Sweep or array
            The augmented points. An array has the type and the columns of the input. If no point
            is a return, the points are unchanged.

        Raises
        ------
        LidarError
            If the shape of the array does not match the columns, or if the sweep cannot be
            augmented.
        """
        check_number("seed", seed, whole=True, ge=0)
        if isinstance(points, Sweep):
            return self._augment_sweep(points, seed)
        if type(points).__module__.partition(".")[0] == "torch":
            return points.new_tensor(self._augment_array(points.detach().cpu().numpy(), seed))
        return self._augment_array(np.asarray(points), seed)

    def _augment_sweep(self, sweep: Sweep, seed: int) -> Sweep:
        if not sweep.has_return.any():  # its pulses are unknown
            return sweep.replace(columns={**sweep.columns, "cause": np.zeros(len(sweep), np.uint8)})
        augmented = self._augment(_without_pose(sweep), seed)
        result = _with_boxes(sweep, augmented)
        return result.replace(
            pose=sweep._pose,
            number=sweep.number,
            job=sweep.job,
            job_number=sweep.job_number,
            split=sweep.split,
            values=sweep.values,
        )

    def _augment_array(self, points: AnyArray, seed: int) -> AnyArray:
        width = 3 + len(self.columns)
        if points.ndim != 2 or points.shape[1] != width:
            raise LidarError(
                f"The points must have the shape (n, {width}) for x, y, z and "
                f"{join_names(self.columns) or 'no further columns'}, but have the shape "
                f"{points.shape}. Pass the names of the columns as `columns`."
            )
        # In double precision, values from files are not exact multiples of their steps.
        columns = {name: points[:, 3 + k].astype(np.float32) for k, name in enumerate(self.columns)}
        sweep = Sweep(points[:, :3].astype(np.float64), columns)
        if not sweep.has_return.any():  # its pulses are unknown
            return points.copy()
        augmented = self._augment(sweep, seed).sweep
        values = [augmented.columns[name] for name in self._standard_names]
        return np.column_stack([augmented.points, *values]).astype(points.dtype)

    def _augment(self, sweep: Sweep, seed: int) -> AugmentedSweep:
        """Augment a sweep, using the seed as its number."""
        if self._reference is None:
            return self._sensor_state([sweep]).augment(sweep, seed)
        names = frozenset(standard_names(sweep.columns))
        if names not in self._states:
            # Rings and times are determined from the columns that the sweep also has.
            self._states[names] = self._sensor_state(
                [_with_columns(reference, names) for reference in self._reference]
            )
        return self._states[names].augment(sweep, seed)

    def _sensor_state(self, sweeps: Sequence[Sweep]) -> _SensorState:
        recording = SweepsInMemory("the sweep", sweeps)
        with _python_advice("Pass the names of the columns as `columns`, including an intensity"):
            augmenter = Augmenter(recording, self.effects, self.model, self.reflectance)
        return _SensorState(recording, augmenter)


class _SensorState(NamedTuple):
    """What the sweeps of a sensor have in common."""

    recording: Recording
    augmenter: Augmenter

    def augment(self, sweep: Sweep, seed: int) -> AugmentedSweep:
        with reading(self.recording.info.name):
            standard = self.recording.standardize(0, sweep)
        return self.augmenter.augment(standard, seed % _NUMBERS)


@contextmanager
def _python_advice(advice: str) -> Iterator[None]:
    """Replace options of the command line in the error for unknown intensities."""
    try:
        yield
    except UnknownIntensitiesError as error:
        raise LidarError(
            f"{error.problem} {advice}, or pass `reflectance=0.3` to assume the same reflectance "
            "for all returns."
        ) from error


def _effects(effects: EffectsLike | None, weather: Mapping[str, Any], seed: int | None) -> Effects:
    """Return effects in which some fields of the weather and the seed are replaced."""
    names = [entry.name for entry in fields(Weather)]
    for name in weather:
        if name not in names:
            raise LidarError(
                f"{name!r} is not a field of the weather.{did_you_mean(name, names)} The fields "
                f"are {join_names(names)}."
            )
    if isinstance(effects, Effects):
        effects = replace(effects, weather=replace(effects.weather, **weather))
    else:
        options = {"weather": dict(weather)} if weather else {}
        if isinstance(effects, Mapping):
            merged = {**effects.get("weather", {}), **weather}
            options = {**effects, **({"weather": merged} if merged else {})}
            effects = None
        effects = Effects.load(effects, options)
    return effects if seed is None else replace(effects, seed=seed)


def _model(model: ModelLike | None) -> Sensor | None:
    """Load a sensor model with the values of its data sheet, if it has any."""
    if model is None or isinstance(model, Sensor):
        return model
    has_sheet = read_model(model).performance is not None
    return load_sensor(model, performance="datasheet" if has_sheet else "ideal")


def _check_constant(effects: Effects) -> None:
    """Raise LidarError if effects change over time, because single sweeps have no time."""
    for number, fault in enumerate(effects.faults):
        if fault.from_s or fault.to_s is not None:
            raise LidarError(
                f"faults[{number}]: A transform augments single sweeps, which have no time. Remove "
                "`from_s` and `to_s`."
            )
    for actor in effects.actors:
        if _moves(actor):
            raise LidarError(
                f"Actor {actor.name!r} moves, but a transform augments single sweeps, which have "
                "no time. Use `augment` on the recording, or set `at` instead of `trajectory`."
            )


def _moves(actor: Actor) -> bool:
    """Return whether the pose of an actor changes. An actor with `at` has a constant track."""
    track = actor.trajectory
    if not track.moves or not isinstance(track, Track):
        return track.moves
    turns = track.quaternions is not None and np.ptp(track.quaternions, axis=0).any()
    return bool(turns or np.ptp(track.positions, axis=0).any())


def _reference_sweeps(
    reference: str | Path | Recording | PointCloud | Sequence[Sweep],
) -> list[Sweep]:
    """Return a few sweeps of a reference without their poses."""
    if isinstance(reference, str | Path):
        reference = open_recording(reference, keep_noise=True)
    if not len(reference):
        raise LidarError("The reference contains no sweeps. Pass at least one sweep.")
    numbers = even_indices(len(reference), _REFERENCE_SWEEPS).tolist()
    return [_without_pose(reference[number]) for number in numbers]


def _without_pose(sweep: Sweep) -> Sweep:
    return Sweep(sweep.points, dict(sweep.columns), compensated=sweep.compensated)


def _with_columns(sweep: Sweep, names: Collection[str]) -> Sweep:
    columns = {name: values for name, values in sweep.columns.items() if name in names}
    return Sweep(sweep.points, columns, compensated=sweep.compensated)


def _with_boxes(recorded: Sweep, augmented: AugmentedSweep) -> Sweep:
    """Return an augmented sweep with the boxes of recorded and of inserted objects."""
    boxes = augmented.boxes
    if not len(boxes):
        return augmented.sweep.replace(boxes=recorded._boxes)
    recorded_boxes = recorded.boxes
    assert recorded_boxes is None or isinstance(recorded_boxes, SweepBoxes)
    return augmented.sweep.replace(boxes=_join_boxes(recorded_boxes, boxes))


def _join_boxes(first: SweepBoxes | None, second: SweepBoxes) -> SweepBoxes:
    if first is None or not len(first):
        return second
    return SweepBoxes(
        names=first.names + second.names,
        types=first.types + second.types,
        objects=np.concatenate([first.objects, second.objects]),
        centers=np.concatenate([first.centers, second.centers]),
        quaternions=np.concatenate([first.quaternions, second.quaternions]),
        sizes=np.concatenate([first.sizes, second.sizes]),
        points=np.concatenate([first.points, second.points]),
    )
