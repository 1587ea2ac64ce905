"""Results of items that are kept until the result of a command is complete.

An interrupted command continues with the items that are missing, and its result has the same bytes.
"""

from __future__ import annotations

import io
import json
import os
import secrets
import shutil
import zipfile
import zlib
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields, is_dataclass
from itertools import chain
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
ONCE = "000000"  # key of a step that runs once
_STAGED = f"{WRITING}00000000"


@dataclass(frozen=True)
class Inputs:
    """What the result of a command depends on.

    The keys are the names of the inputs in messages, such as "recording" or "options".

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
    """Return a hash of the names, sizes and modification times of a file or of all in a folder.

    Symbolic links are followed.
    """
    files = sorted(_files_below(path)) if path.is_dir() else [path]
    states = [
        (str(file.relative_to(path)), status.st_size, status.st_mtime_ns)
        for file in files
        if file.is_file() and (status := file.stat())
    ]
    return fingerprint(str(path.absolute()), states)


def _files_below(folder: Path) -> Iterator[Path]:
    visited = set[str]()  # links may lead to a folder that contains them
    for current, folders, names in os.walk(folder, followlinks=True):
        resolved = os.path.realpath(current)
        if resolved in visited:
            folders.clear()
            continue
        visited.add(resolved)
        folders.sort()
        yield from (Path(current, name) for name in names)


class Step(NamedTuple):
    """A processing step that a command applies to each item.

    Attributes
    ----------
    name
        Name of the step, which is the name of a folder.
    kinds
        Types of the records that the step returns for an item: NamedTuples or dataclasses whose
        fields are arrays, numbers, strings or None.
    """

    name: str
    kinds: tuple[type, ...]


class FileStep(NamedTuple):
    """A processing step that returns the contents of files by their relative paths.

    `Work.each` yields the paths of the stored files instead of their contents.
    """

    name: str


class Work:
    """Folder with the results of the items that are finished.

    Use `open`. An item is finished when its mark is written, which lists the sizes and checksums of
    its files. The results of damaged items are computed again.

    Attributes
    ----------
    target
        Folder of the result.
    overwrites
        Whether the user has asked to replace an existing result.
    """

    def __init__(self, target: Path, inputs: Inputs, noun: str) -> None:
        self.target = target
        self._noun = noun
        self._inputs = inputs
        self._identity = inputs.identity()
        self._folder = target / FOLDER
        self._target_storage = Storage.at(target, durable=False)
        self._storage = self._target_storage.below(FOLDER)
        self._manifest = b""
        self.overwrites = False

    @classmethod
    @contextmanager
    def open(
        cls,
        target: Path,
        inputs: Inputs,
        *,
        noun: str,
        resume: bool = False,
        restart: bool = False,
        overwrite: bool = False,
    ) -> Iterator[Work]:
        """Start or resume the computation of a result.

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
        overwrite
            Whether `overwrites` is true, also when the work is continued.

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
            work._prepare(resume=resume, overwrite=overwrite)
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

    def _prepare(self, *, resume: bool, overwrite: bool) -> None:
        manifest = self._folder / _MANIFEST
        if not manifest.exists():
            self._remove()  # without a manifest, it is what a killed process has not removed
            self._folder.mkdir(parents=True)
            # The ID identifies the folder to workers, which may have another one at this path.
            self.overwrites = overwrite
            content = {
                "id": secrets.token_hex(8),
                "inputs": self._identity,
                "overwrites": overwrite,
            }
            self._manifest = json.dumps(content, indent=1).encode() + b"\n"
            self._storage.write(_MANIFEST, self._manifest)
            return
        advice = "Continue it with `--resume`, or remove it with `--restart`."
        if not resume:
            raise LidarError(f"{self.target} contains an unfinished {self._noun}. {advice}")
        try:
            self._manifest = manifest.read_bytes()
            content = json.loads(self._manifest)
            earlier = dict(content["inputs"])
            self.overwrites = overwrite or bool(content["overwrites"])
        except (ValueError, TypeError, KeyError) as error:
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
        self,
        step: Step | FileStep,
        run: MapFunction,
        function: Callable[[Any], Any],
        items: Sequence[Any],
        keys: Sequence[str] | None = None,
        chunk: int = 1,
    ) -> Generator[Any, None, None]:
        """Yield the results of a step for each item, in order.

        Items without a stored result are processed by `run`, which has the signature of `map`. The
        function returns a record or None for each type of the step, or the contents of files.
        Processes that can access the folder store the results themselves.

        Parameters
        ----------
        step
            The step.
        run
            Function that processes items, such as `map`.
        function
            Function that returns the results of an item.
        items
            All items of the step.
        keys
            Relative paths under which the results are stored. By default, items are numbered.
        chunk
            Maximum number of consecutive items that a process receives together.
        """
        if keys is None:
            keys = [f"{index:06}" for index in range(len(items))]
        missing = [not self._mark(step, key).exists() for key in keys]
        numbers = [index for index, is_missing in enumerate(missing) if is_missing]
        compute = _Compute(step, function, self._storage, self._manifest, str(self.target))
        chunks = (
            _Items([(keys[index], items[index]) for index in numbers[first : first + chunk]])
            for first in range(0, len(numbers), chunk)
        )
        with _closing(run(compute, chunks)) as results:
            computed = chain.from_iterable(results)
            for index, key in enumerate(keys):
                loaded = None if missing[index] else self.find(step, key)
                if loaded is None:
                    if not missing[index]:  # damaged
                        computed_again = run(compute, [_Items([(key, items[index])])])
                        contents = next(chain.from_iterable(computed_again))
                    else:
                        contents = next(computed)
                    if contents is not None:
                        _store(self._storage, step, key, contents, str(self.target))
                    loaded = self._load(step, key, is_new=True)
                yield loaded

    def once(self, step: Step | FileStep, call: Callable[[], Any], key: str = ONCE) -> Any:
        """Return the results of a step that runs once, and is called unless they are stored."""
        if (loaded := self.find(step, key)) is None:
            contents = _pack_result(step, call())
            _store(self._storage, step, key, contents, str(self.target))
            loaded = self._load(step, key, is_new=True)
        return loaded

    def find(self, step: Step | FileStep, key: str) -> Any:
        """Return the stored results of an item, or None if they are missing or damaged."""
        try:
            return self._load(step, key)
        except _DAMAGED:
            return None

    def folder(self, step: Step | FileStep) -> Path:
        """Return the folder that contains the stored results of a step."""
        return self._folder / step.name

    def count(self, step: Step | FileStep, keys: Iterable[str]) -> int:
        """Return how many of the given items have stored results."""
        return sum(self._mark(step, key).exists() for key in keys)

    def forget(self, step: Step | FileStep, key: str) -> None:
        """Remove the stored results of an item, or of all items whose keys begin with a folder."""
        folder = self._folder / step.name / key
        for mark in folder.rglob(_MARK):
            mark.unlink()
        self._storage.discard(f"{step.name}/{key}")

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
    def publishing(
        self, last: str, remove: Iterable[str] = (), *, merge: bool = False
    ) -> Iterator[Path]:
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
                    staged,
                    self.target,
                    last=last,
                    remove=remove,
                    merge=merge,
                    on_written=self._remove,
                )
        except LidarError as error:
            raise LidarError(str(error).replace(str(staged), str(self.target))) from error
        finally:
            shutil.rmtree(staged, ignore_errors=True)

    @contextmanager
    def publishing_whole(self, target: Path, outdated: Iterable[str] = ()) -> Iterator[Path]:
        """Yield the path of a file or folder to write, which then replaces `target`.

        The path ends with the name of the target, which must be in the same file system. Nothing
        else may be written to its folder. The finished items are kept. Files next to the target
        that are `outdated` are removed before it changes.

        Raises
        ------
        LidarError
            If the inputs have changed since the work began, or if a file cannot be written.
        """
        staged = self._folder / _STAGED
        try:
            with explain_os_errors(f"Cannot write to {target}", "free some disk space"):
                self._storage.discard(_STAGED)
                staged.mkdir()
                yield staged / target.name
                self._check_unchanged()
                move_into_place(
                    staged, target.absolute().parent, last=target.name, outdated=outdated
                )
        except LidarError as error:
            text = str(error).replace(str(staged / target.name), str(target))
            raise LidarError(text) from error
        finally:
            shutil.rmtree(staged, ignore_errors=True)

    def remove(self) -> None:
        """Remove the stored results, which are not needed any more."""
        self._remove()

    def _check_unchanged(self) -> None:
        for noun, path in self._inputs.files.items():
            if fingerprint_files(path) != self._identity[noun]:
                raise LidarError(
                    f"{path} has changed since the {self._noun} began. Start again with "
                    "`--restart`."
                )

    def _item(self, step: Step | FileStep, key: str) -> Path:
        return self._folder / step.name / key

    def _mark(self, step: Step | FileStep, key: str) -> Path:
        return self._item(step, key) / _MARK

    def _has_items(self) -> bool:
        return any(self._folder.rglob(_MARK))

    def _load(self, step: Step | FileStep, key: str, *, is_new: bool = False) -> Any:
        checksums = self._checksums(step, key)
        if isinstance(step, FileStep):
            folder = self._item(step, key)
            if not is_new:
                for name, expected in checksums.items():
                    if self._storage.checksum(f"{step.name}/{key}/{name}") != [*expected]:
                        raise ValueError(f"{name} is damaged")
            return {name: folder / name for name in checksums}
        return tuple(
            self._load_record(step, key, number, checksums) for number in range(len(step.kinds))
        )

    def _checksums(self, step: Step | FileStep, key: str) -> dict[str, list[int]]:
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


@dataclass(frozen=True)
class _Items:
    """Items that a process receives together, with their keys."""

    pairs: Sequence[tuple[str, Any]]

    @property
    def label(self) -> str | None:
        """Items in a message, if they have labels."""
        labels = [getattr(item, "label", None) for _, item in (self.pairs[0], self.pairs[-1])]
        first, last = labels
        return first if first == last else f"{first} to {last}"


@dataclass(frozen=True)
class _Compute:
    """Function that computes and stores the results of items in any process.

    It returns the contents of files that this process cannot store, and otherwise None.
    """

    step: Step | FileStep
    function: Callable[[Any], Any]
    storage: Storage
    manifest: bytes
    target: str

    def __call__(self, items: _Items) -> list[dict[str, bytes] | None]:
        return [self._compute(key, item) for key, item in items.pairs]

    def _compute(self, key: str, item: Any) -> dict[str, bytes] | None:
        contents = _pack_result(self.step, self.function(item))
        if not self.storage.has_content(_MANIFEST, self.manifest):
            return contents
        _store(self.storage, self.step, key, contents, self.target)
        return None


def _store(
    storage: Storage, step: Step | FileStep, key: str, contents: Mapping[str, bytes], target: str
) -> None:
    """Write the files of an item, and then its mark."""
    folder = f"{step.name}/{key}"
    checksums = {name: [len(data), zlib.crc32(data)] for name, data in contents.items()}
    with explain_os_errors(f"Cannot write to {target}", "free some disk space"):
        storage.remove([f"{folder}/{_MARK}"])
        storage.prepare(folder)
        for name, data in contents.items():
            if "/" in name:
                storage.prepare(f"{folder}/{name.rpartition('/')[0]}")
            storage.write(f"{folder}/{name}", data)
        storage.write(f"{folder}/{_MARK}", json.dumps(checksums).encode())


@contextmanager
def _closing(results: Iterable[Any]) -> Iterator[Iterable[Any]]:
    """Close the results of a map, which cancels waiting tasks if they are not needed any more."""
    try:
        yield results
    finally:
        if (close := getattr(results, "close", None)) is not None:
            close()


def link_files(files: Mapping[str, Path], folder: Path) -> None:
    """Create files of a `FileStep` in a folder, as hard links if the file system supports them."""
    target = Storage.at(folder, durable=False)
    for name, path in files.items():
        target.prepare(Path(name).parent)
        target.copy_from(Storage.at(path.parent), path.name, name)


def _pack_result(step: Step | FileStep, result: Any) -> dict[str, bytes]:
    if isinstance(step, FileStep):
        return dict(result)
    return {
        f"{number}.npz": _pack(record) for number, record in enumerate(result) if record is not None
    }


def _pack(record: Any) -> bytes:
    arrays = {name: getattr(record, name) for name in _field_names(type(record))}
    file = io.BytesIO()
    np.savez(file, **{name: array for name, array in arrays.items() if array is not None})
    return file.getvalue()


def _unpack(kind: type, data: bytes) -> Any:
    with np.load(io.BytesIO(data)) as arrays:
        return kind(**{name: _unpack_value(arrays.get(name)) for name in _field_names(kind)})


def _unpack_value(array: Any) -> Any:
    """Return an array, or the number or string that an array without dimensions contains."""
    return array if array is None or array.ndim else array.item()


def _field_names(kind: type) -> list[str]:
    if is_dataclass(kind):
        return [field.name for field in fields(kind)]
    names: tuple[str, ...] = kind._fields  # type: ignore[attr-defined]
    return [*names]
