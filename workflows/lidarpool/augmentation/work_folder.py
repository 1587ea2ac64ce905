"""Work folders, in which encoded sweeps are collected until an augmented recording is complete.

The work folder is next to the output, and named after it. Its manifest identifies everything that
the encoded sweeps depend on, so an interrupted command continues exactly or not at all.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from lidarsim.errors import LidarError, explain_os_errors
from lidarsim.io.storage import Storage
from lidarsim.words import join_names

SUFFIX = ".augment"
_MANIFEST = "manifest.json"
_RESUME = "Continue it with `--resume`, or start again with `--overwrite`."


@dataclass(frozen=True)
class WorkFolder:
    """Folder with the encoded sweeps of all variants.

    Attributes
    ----------
    folder
        Path of the folder.
    identity
        Hashes of the inputs that determine the encoded sweeps, keyed by a noun for messages.
    replaces
        Whether an existing output may be replaced.
    """

    folder: Path
    identity: Mapping[str, str]
    replaces: bool = False

    @classmethod
    def for_output(cls, out: Path) -> Path:
        """Return the path of the work folder for an output."""
        return out.with_name(f"{out.name}{SUFFIX}")

    @classmethod
    def is_unfinished(cls, out: Path) -> bool:
        """Return whether there is an unfinished augmentation for an output."""
        return (cls.for_output(out) / _MANIFEST).exists()

    @classmethod
    def create_or_resume(
        cls, out: Path, identity: Mapping[str, str], *, resume: bool, overwrite: bool
    ) -> WorkFolder:
        """Create the work folder, or open an existing one with the same inputs.

        Parameters
        ----------
        out
            Output of the command.
        identity
            Hashes of the inputs, keyed by a noun for messages.
        resume
            Whether to continue with the sweeps in an existing folder.
        overwrite
            Whether to remove an existing work folder, and to replace an existing output.

        Raises
        ------
        LidarError
            If the folder contains sweeps with other inputs, if it exists and `resume` is False, or
            if it cannot be written to.
        """
        folder = cls.for_output(out)
        manifest = folder / _MANIFEST
        if overwrite and manifest.exists():
            _clear(folder)  # the folder itself is locked
        if manifest.exists():
            return cls._resume(folder, identity, resume=resume)
        if folder.is_dir() and any(folder.iterdir()):
            raise LidarError(
                f"{folder} is required for temporary files, but contains other files. Use another "
                "path with `--out`."
            )
        work = cls(folder, identity, overwrite)
        with explain_os_errors(f"Cannot write to {folder}", "use another path with `--out`"):
            folder.mkdir(parents=True, exist_ok=True)
            work._storage.write(_MANIFEST, work.manifest)
        return work

    @classmethod
    def _resume(cls, folder: Path, identity: Mapping[str, str], *, resume: bool) -> WorkFolder:
        if not resume:
            raise LidarError(f"{folder} contains an unfinished augmentation. {_RESUME}")
        try:
            stored = json.loads((folder / _MANIFEST).read_bytes())
            earlier = dict(stored["inputs"])
            replaces = bool(stored["replaces"])
        except (OSError, ValueError, TypeError, KeyError) as error:
            raise LidarError(
                f"{folder / _MANIFEST} is damaged. Start again with `--overwrite`."
            ) from error
        names = dict.fromkeys([*identity, *earlier])
        if changed := [name for name in names if earlier.get(name) != identity.get(name)]:
            raise LidarError(
                f"{folder} contains an unfinished augmentation with different inputs "
                f"({join_names(changed)}). Repeat the original command with `--resume`, or start "
                "again with `--overwrite`."
            )
        return cls(folder, identity, replaces)

    @property
    def manifest(self) -> bytes:
        """Content of the manifest, which workers compare with the file that they can access."""
        content: dict[str, Any] = {"inputs": dict(self.identity), "replaces": self.replaces}
        return json.dumps(content, indent=1).encode() + b"\n"

    @cached_property
    def _storage(self) -> Storage:
        return Storage(str(self.folder), durable=False)

    def is_accessible(self) -> bool:
        """Return whether this process can access the folder, with the same content."""
        try:
            return (self.folder / _MANIFEST).read_bytes() == self.manifest
        except OSError:
            return False

    def encoded(self, variant: int, part: int) -> Path:
        """Return the folder for the encoded sweeps of a variant of one sensor."""
        return self.folder / encoded_name(variant, part)

    def counts(self, variant: int, part: int, number: int) -> dict[str, Any]:
        """Return the point counts of an encoded sweep."""
        file = self.encoded(variant, part) / counts_name(number)
        counts: dict[str, Any] = json.loads(file.read_bytes())
        return counts

    def write(self, files: Mapping[str, bytes]) -> None:
        """Write files atomically and in the given order. Names are relative to the folder."""
        with explain_os_errors(f"Cannot write to {self.folder}", "free some disk space"):
            for name, content in files.items():
                self._storage.prepare(Path(name).parent)
                self._storage.write(name, content)

    def summary(self, variant: int) -> dict[str, Any] | None:
        """Return the summary of a variant whose output is complete, or None."""
        file = self.folder / _finished_name(variant)
        return json.loads(file.read_bytes()) if file.exists() else None

    @property
    def has_sweeps(self) -> bool:
        """Whether the folder contains encoded sweeps."""
        return any(self.folder.glob("*/*/.counts/*.json"))

    def may_replace(self, variant: int) -> bool:
        """Return whether the output of a variant may be replaced if it exists.

        This is the case if the user has asked for it, or if this run was stopped while it wrote the
        output.
        """
        return self.replaces or (self.folder / _begun_name(variant)).exists()

    def begin_output(self, variant: int) -> bool:
        """Record that the output of a variant is being written.

        Return whether an existing output may be replaced.
        """
        may_replace = self.may_replace(variant)
        self.write({_begun_name(variant): b""})
        return may_replace

    def end_output(self, variant: int, summary: Mapping[str, Any]) -> None:
        """Record that the output of a variant is complete, and remove its encoded sweeps."""
        self.write({_finished_name(variant): json.dumps(summary).encode()})
        shutil.rmtree(self.folder / f"{variant:04}", ignore_errors=True)

    def remove(self) -> None:
        """Remove the folder."""
        shutil.rmtree(self.folder, ignore_errors=True)


def _clear(folder: Path) -> None:
    for path in folder.iterdir():
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink()


def _begun_name(variant: int) -> str:
    return f"{variant:04}.begun"


def _finished_name(variant: int) -> str:
    return f"{variant:04}.finished"


def encoded_name(variant: int, part: int) -> str:
    """Return the name of the folder with encoded sweeps, relative to the work folder."""
    return f"{variant:04}/{part:04}"


def counts_name(number: int) -> str:
    """Return the name of the file with the point counts of a sweep, next to its other files."""
    return f".counts/{number:08}.json"
