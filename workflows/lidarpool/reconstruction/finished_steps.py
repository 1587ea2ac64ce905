"""Store the results of reconstruction steps in a folder until the reconstruction is complete.

A step runs for each submap of the drive, or once. Its results are loaded when they are needed, so
only one submap has to fit in memory, and an interrupted command can be resumed.
"""

from __future__ import annotations

import json
import pickle
import shutil
import struct
import zipfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from lidarsim._version import __version__
from lidarsim.errors import LidarError, explain_os_errors

from ..identity.fingerprint import fingerprint

if TYPE_CHECKING:
    from ..work.mapping import MapFunction

STEPS_FOLDER = ".lidarpool-twin"
_OF_FILE = "of.json"  # identifies the inputs of the steps
# Errors that NumPy and zipfile raise for damaged files.
_DAMAGED = (
    EOFError,
    NotImplementedError,
    OSError,
    RuntimeError,
    TypeError,
    ValueError,
    pickle.UnpicklingError,
    struct.error,
    zipfile.BadZipFile,
)


class TwinStep(NamedTuple):
    """Name of a reconstruction step, and types of its results."""

    name: str
    kinds: tuple[type, ...]  # NamedTuples or dataclasses whose fields are arrays or None


@dataclass(frozen=True)
class FinishedSteps:
    """Folder with the results of finished reconstruction steps."""

    folder: Path

    @classmethod
    def create_or_resume(cls, folder: Path, made_of: object, *, resume: bool) -> FinishedSteps:
        """Create the folder, or open an existing one with results of the same inputs.

        Parameters
        ----------
        folder
            Folder for the results.
        made_of
            Inputs that determine the results.
        resume
            Whether to resume from an existing folder.

        Raises
        ------
        LidarError
            If the folder contains steps with other inputs, if it exists and `resume` is False, or
            if it cannot be written to.
        """
        own = {"lidarpool": __version__, "made_of": fingerprint(made_of)}
        file = folder / _OF_FILE
        if file.exists():
            if not resume:
                raise LidarError(
                    f"{folder.parent} contains an unfinished reconstruction. Continue it with "
                    "`--resume`, or start again with `--overwrite`."
                )
            if _read_json(file) != own:
                raise LidarError(
                    f"{folder.parent} contains an unfinished reconstruction of another "
                    "recording, or one with other options or from another version of "
                    "lidarpool, or its files are damaged. Start again with `--overwrite`."
                )
            return cls(folder)
        with explain_os_errors(f"Cannot write to {folder.parent}", "choose another folder"):
            folder.mkdir(parents=True, exist_ok=True)
            _replace(file, lambda path: path.write_text(json.dumps(own), encoding="utf-8"))
        return cls(folder)

    def remove(self) -> None:
        """Remove the folder and the results that it contains."""
        shutil.rmtree(self.folder, ignore_errors=True)

    def each(
        self, step: TwinStep, run: MapFunction, function: Callable[[Any], Any], items: Sequence[Any]
    ) -> Iterator[tuple[Any, ...]]:
        """Yield the results of a reconstruction step for each item.

        Items without a stored result are processed by `run`, which has the signature of `map`. The
        function returns a record or None for each type of the step. If a stored result is damaged,
        its item is processed again.
        """
        done = [self._file(step, index).exists() for index in range(len(items))]
        results = iter(
            run(function, (items[index] for index, known in enumerate(done) if not known))
        )
        for index, is_known in enumerate(done):
            loaded = self._load_intact(step, index) if is_known else None
            if loaded is None:
                result = next(iter(run(function, [items[index]])) if is_known else results)
                self._save(step, index, result)
                loaded = self.load(step, index)
            yield loaded

    def run_once(self, step: TwinStep, call: Callable[[], tuple[Any, ...]]) -> tuple[Any, ...]:
        """Load the results of a step that runs once.

        `call` computes them if the step has not run yet, or if the stored results are damaged.
        """
        if (loaded := self._load_intact(step, 0)) is None:
            self._save(step, 0, call())
            loaded = self.load(step, 0)
        return loaded

    def load(self, step: TwinStep, index: int) -> tuple[Any, ...]:
        """Load the results that a step has computed for an item.

        Raises
        ------
        LidarError
            If the results are damaged or missing.
        """
        return tuple(self._load_records(step, index, range(len(step.kinds))))

    def load_record(self, step: TwinStep, index: int, number: int) -> Any:
        """Load one of the records that a step has computed for an item, as `load` does."""
        return self._load_records(step, index, [number])[0]

    def _load_records(self, step: TwinStep, index: int, numbers: Iterable[int]) -> list[Any]:
        file = self._file(step, index)
        try:
            with file.open("rb") as opened, np.load(opened) as arrays:
                return [_record(step.kinds[number], f"{number}.", arrays) for number in numbers]
        except _DAMAGED as error:
            raise LidarError(
                f"The step file {file} is missing or damaged. Delete it, and continue with "
                "`--resume`."
            ) from error

    def _load_intact(self, step: TwinStep, index: int) -> tuple[Any, ...] | None:
        """Load the results for an item, or return None if they are missing or damaged."""
        try:
            return self.load(step, index)
        except LidarError:
            return None

    def _file(self, step: TwinStep, index: int) -> Path:
        return self.folder / f"{step.name}-{index:05d}.npz"

    def _save(self, step: TwinStep, index: int, records: Sequence[Any]) -> None:
        arrays = {
            f"{number}.{name}": getattr(record, name)
            for number, record in enumerate(records)
            if record is not None
            for name in _names(type(record))
            if getattr(record, name) is not None
        }

        def write(path: Path) -> None:
            with path.open("wb") as file:
                np.savez(file, **arrays)

        with explain_os_errors(f"Cannot write to {self.folder}", "free some disk space"):
            _replace(self._file(step, index), write)


def _read_json(file: Path) -> Any:
    """Return the content of a JSON file, or None if it is damaged."""
    try:
        return json.loads(file.read_text(encoding="utf-8"))
    except ValueError:  # not UTF-8, or not JSON
        return None


def _record(kind: type, prefix: str, arrays: Any) -> Any:
    """Create a record from arrays whose names begin with a prefix.

    Returns None if there are no such arrays.
    """
    found = {name: arrays.get(prefix + name) for name in _names(kind)}
    return None if all(value is None for value in found.values()) else kind(**found)


def _names(kind: type) -> list[str]:
    if is_dataclass(kind):
        return [field.name for field in fields(kind)]
    names: tuple[str, ...] = kind._fields  # type: ignore[attr-defined]
    return [*names]


def _replace(file: Path, write: Callable[[Path], Any]) -> None:
    part = file.with_name(f"{file.name}.part")
    write(part)
    Path(part).replace(file)
