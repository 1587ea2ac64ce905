"""Results of items that are kept until the result of a command is complete.

An interrupted command continues with the items that are missing, and its result has the same bytes.
"""

from __future__ import annotations

import io
import json
import shutil
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from lidarsim.errors import LidarError, explain_os_errors
from lidarsim.io.storage import WRITING, Storage
from lidarsim.words import join_names

from ..identity.fingerprint import fingerprint
from ..identity.versions import software
from .mapping import MapFunction
from .publishing import move_into_place

FOLDER = ".lidarpool-work"
_MANIFEST = "manifest.json"
_MARK = "item.json"  # written after the other files of an item
_STAGED = f"{WRITING}00000000"


@dataclass(frozen=True)
class Inputs:
    """What the result of a command depends on.

    The keys are nouns for messages, such as "recording" or "options".

    Attributes
    ----------
    files
        Files and folders. A file is identified by its name, size and modification time.
    values
        Values, which are identified by their fingerprints.
    """

    files: Mapping[str, Path]
    values: Mapping[str, object]

    def identity(self) -> dict[str, str]:
        """Return a hash of each input, and the version of lidarpool."""
        return {
            **{noun: fingerprint_files(path) for noun, path in self.files.items()},
            **{noun: fingerprint(value) for noun, value in self.values.items()},
            "version of lidarpool": software()["lidarpool"],
        }


def fingerprint_files(path: Path) -> str:
    """Return a hash of the names, sizes and modification times of a file or of all in a folder."""
    files = sorted(path.rglob("*")) if path.is_dir() else [path]
    states = [
        (str(file.relative_to(path)), status.st_size, status.st_mtime_ns)
        for file in files
        if file.is_file() and (status := file.stat())
    ]
    return fingerprint(str(path.absolute()), states)


class Step(NamedTuple):
    """A processing step that a command applies to each item.

    Attributes
    ----------
    name
        Name of the step, which is the name of a folder.
    kinds
        Types of the records that the step returns for an item: NamedTuples or dataclasses whose
        fields are arrays or None.
    """

    name: str
    kinds: tuple[type, ...]


class Work:
    """Folder with the results of the items that are finished.

    Use `open`. An item is finished when its mark is written, which lists the sizes and checksums of
    its files. The results of damaged items are computed again.
    """

    def __init__(self, target: Path, inputs: Inputs, noun: str) -> None:
        self.target = target
        self._noun = noun
        self._inputs = inputs
        self._identity = inputs.identity()
        self._folder = target / FOLDER
        self._target_storage = Storage.at(target, durable=False)
        self._storage = self._target_storage.below(FOLDER)

    @classmethod
    @contextmanager
    def open(
        cls, target: Path, inputs: Inputs, *, noun: str, resume: bool = False, restart: bool = False
    ) -> Iterator[Work]:
        """Create or continue the work on a result.

        If the body raises an exception, finished items are kept, and a note about `--resume` is
        added to the exception.

        Parameters
        ----------
        target
            Folder of the result, which the caller has locked.
        inputs
            What the result depends on.
        noun
            What is done, for messages, such as "reconstruction".
        resume
            Whether to continue unfinished work.
        restart
            Whether to remove unfinished work.

        Raises
        ------
        LidarError
            If there is unfinished work, and neither `resume` nor `restart` is set; if it has
            different inputs; or if the folder cannot be written to.
        """
        work = cls(target, inputs, noun)
        if restart:
            work._remove()
        with explain_os_errors(f"Cannot write to {target}", "specify another folder with `--out`"):
            work._prepare(resume=resume)
        try:
            yield work
        except BaseException as error:
            if work._has_items():
                error.add_note(
                    f"The finished steps are stored in {target}. Continue with `--resume`."
                )
            else:
                work._remove()
            raise

    @staticmethod
    def is_unfinished(target: Path) -> bool:
        """Return whether the folder of a result contains unfinished work."""
        return (target / FOLDER / _MANIFEST).exists()

    def _prepare(self, *, resume: bool) -> None:
        manifest = self._folder / _MANIFEST
        if not manifest.exists():
            self._remove()  # without a manifest, it is what a killed process has not removed
            self._folder.mkdir(parents=True)
            self._storage.write(_MANIFEST, json.dumps(self._identity, indent=1).encode() + b"\n")
            return
        advice = "Continue it with `--resume`, or remove it with `--restart`."
        if not resume:
            raise LidarError(f"{self.target} contains an unfinished {self._noun}. {advice}")
        try:
            earlier = dict(json.loads(manifest.read_bytes()))
        except (ValueError, TypeError) as error:
            raise LidarError(
                f"{manifest} is damaged. Remove the unfinished {self._noun} with `--restart`."
            ) from error
        names = dict.fromkeys([*self._identity, *earlier])
        if changed := [name for name in names if earlier.get(name) != self._identity.get(name)]:
            raise LidarError(
                f"{self.target} contains an unfinished {self._noun} with different inputs "
                f"({join_names(changed)}). Repeat the original command with `--resume`, or remove "
                "the unfinished work with `--restart`."
            )

    def each(
        self, step: Step, run: MapFunction, function: Callable[[Any], Any], items: Sequence[Any]
    ) -> Iterator[tuple[Any, ...]]:
        """Yield the results of a step for each item, in order.

        Items without a stored result are processed by `run`, which has the signature of `map`. The
        function returns a record or None for each type of the step.
        """
        keys = [f"{index:06}" for index in range(len(items))]
        missing = [not self._mark(step, key).exists() for key in keys]
        results = iter(
            run(function, (items[index] for index, is_missing in enumerate(missing) if is_missing))
        )
        for index, key in enumerate(keys):
            loaded = None if missing[index] else self._load_intact(step, key)
            if loaded is None:
                found = next(results if missing[index] else iter(run(function, [items[index]])))
                self._save(step, key, found)
                loaded = self._load(step, key)
            yield loaded

    def once(self, step: Step, call: Callable[[], Sequence[Any]]) -> tuple[Any, ...]:
        """Return the results of a step that runs once, and is called unless they are stored."""
        key = "000000"
        if (loaded := self._load_intact(step, key)) is None:
            self._save(step, key, call())
            loaded = self._load(step, key)
        return loaded

    def load(self, step: Step, index: int, number: int) -> Any:
        """Load one of the records that a step has returned for an item.

        Raises
        ------
        LidarError
            If the record is damaged.
        """
        key = f"{index:06}"
        try:
            return self._load_record(step, key, number, self._checksums(step, key))
        except _DAMAGED as error:
            raise LidarError(
                f"{self._item(step, key)} is damaged. Continue with `--resume`, which repeats the "
                "step."
            ) from error

    @contextmanager
    def publishing(self, last: str, remove: Sequence[str] = ()) -> Iterator[Path]:
        """Yield a folder for the files of the result, and then move them to the target.

        The work is removed when all files are in place. See `move_into_place`.

        Raises
        ------
        LidarError
            If the inputs have changed since the work began, or if a file cannot be written.
        """
        staged = self._folder / _STAGED
        shutil.rmtree(staged, ignore_errors=True)
        try:
            with explain_os_errors(f"Cannot write to {self.target}", "free some disk space"):
                staged.mkdir()
                yield staged
                self._check_unchanged()
                move_into_place(
                    staged, self.target, last=last, remove=remove, on_written=self._remove
                )
        except LidarError as error:
            raise LidarError(str(error).replace(str(staged), str(self.target))) from error
        finally:
            shutil.rmtree(staged, ignore_errors=True)

    def _check_unchanged(self) -> None:
        for noun, path in self._inputs.files.items():
            if fingerprint_files(path) != self._identity[noun]:
                raise LidarError(
                    f"{path} has changed since the {self._noun} began. Start again with "
                    "`--restart`."
                )

    def _item(self, step: Step, key: str) -> Path:
        return self._folder / step.name / key

    def _mark(self, step: Step, key: str) -> Path:
        return self._item(step, key) / _MARK

    def _has_items(self) -> bool:
        return any(self._folder.glob(f"*/*/{_MARK}"))

    def _save(self, step: Step, key: str, records: Sequence[Any]) -> None:
        contents = {
            f"{number}.npz": _pack(record)
            for number, record in enumerate(records)
            if record is not None
        }
        checksums = {name: [len(data), zlib.crc32(data)] for name, data in contents.items()}
        folder = f"{step.name}/{key}"
        with explain_os_errors(f"Cannot write to {self.target}", "free some disk space"):
            self._mark(step, key).unlink(missing_ok=True)
            self._storage.prepare(folder)
            for name, data in contents.items():
                self._storage.write(f"{folder}/{name}", data)
            self._storage.write(f"{folder}/{_MARK}", json.dumps(checksums).encode())

    def _load(self, step: Step, key: str) -> tuple[Any, ...]:
        checksums = self._checksums(step, key)
        return tuple(
            self._load_record(step, key, number, checksums) for number in range(len(step.kinds))
        )

    def _load_intact(self, step: Step, key: str) -> tuple[Any, ...] | None:
        """Load the results of an item, or return None if they are missing or damaged."""
        try:
            return self._load(step, key)
        except _DAMAGED:
            return None

    def _checksums(self, step: Step, key: str) -> dict[str, list[int]]:
        return dict(json.loads(self._mark(step, key).read_bytes()))

    def _load_record(
        self, step: Step, key: str, number: int, checksums: Mapping[str, Sequence[int]]
    ) -> Any:
        name = f"{number}.npz"
        if name not in checksums:
            return None
        data = (self._item(step, key) / name).read_bytes()
        if [len(data), zlib.crc32(data)] != [*checksums[name]]:
            raise ValueError(f"{name} is damaged")
        return _unpack(step.kinds[number], data)

    def _remove(self) -> None:
        self._target_storage.discard(f"{FOLDER}/{_MANIFEST}")
        self._target_storage.discard(FOLDER)


# Errors of missing or damaged files.
_DAMAGED = (OSError, ValueError, TypeError, EOFError, zipfile.BadZipFile)


def _pack(record: Any) -> bytes:
    arrays = {name: getattr(record, name) for name in _field_names(type(record))}
    file = io.BytesIO()
    np.savez(file, **{name: array for name, array in arrays.items() if array is not None})
    return file.getvalue()


def _unpack(kind: type, data: bytes) -> Any:
    with np.load(io.BytesIO(data)) as arrays:
        return kind(**{name: arrays.get(name) for name in _field_names(kind)})


def _field_names(kind: type) -> list[str]:
    if is_dataclass(kind):
        return [field.name for field in fields(kind)]
    names: tuple[str, ...] = kind._fields  # type: ignore[attr-defined]
    return [*names]
