"""Copies of data sets in which some files are replaced.

Large files are hard links, so a copy of a data set takes little time and space. Text files, such as
tables and calibrations, are always copied, because users edit them.
"""

from __future__ import annotations

import os
import shutil
import stat
from collections.abc import Collection, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from lidarsim.errors import LidarError, MissingFileError
from lidarsim.words import list_names, plural

# A folder that contains this file was written by this program, which may therefore replace it.
MARK_FILE = ".lidarpool-augmented"
_TEXT_SUFFIXES = {
    "", ".cfg", ".csv", ".ini", ".json", ".label_map", ".md", ".toml", ".txt", ".xml", ".yaml",
    ".yml",
}  # fmt: skip


def place_file(source: Path, target: Path) -> bool:
    """Link a file to a new path, or copy it if it is a text file or cannot be linked.

    Symbolic links are followed. An existing file is replaced. Returns whether the file was linked.
    """
    target.parent.mkdir(parents=True, exist_ok=True)
    target.unlink(missing_ok=True)  # it may be a link to a file of the recording
    if source.suffix.lower() not in _TEXT_SUFFIXES:
        with suppress(OSError):  # the folders are on different disks, or links are not supported
            os.link(source.resolve(), target)
            return True
    shutil.copyfile(source, target)
    return False


def copy_data_set(source: Path, target: Path, replaced: Collection[str]) -> list[str]:
    """Link or copy all files of a folder to a new folder, except those that are written anew.

    Broken links and special files are skipped.

    Parameters
    ----------
    source, target
        Folder to copy, and the new folder.
    replaced
        Paths of files that are not copied, relative to the source.

    Returns
    -------
    Sentences for the user about linked and skipped files.

    Raises
    ------
    OSError
        If a file cannot be read or written.
    """
    copy = _FolderCopy(source, target, replaced)
    copy.write()
    return copy.notes()


@dataclass
class _FolderCopy:
    """A copy of a folder (see `copy_data_set`)."""

    source: Path
    target: Path
    replaced: Collection[str]
    linked: int = field(default=0, init=False)
    copied: int = field(default=0, init=False)
    _skipped: list[str] = field(default_factory=list, init=False)

    def write(self) -> None:
        self.target.mkdir(parents=True, exist_ok=True)
        for name in self._files():
            if name in self.replaced:
                continue
            if place_file(self.source / name, self.target / name):
                self.linked += 1
            else:
                self.copied += 1

    def notes(self) -> list[str]:
        notes = []
        if self.linked:
            notes.append(
                f"Hard links to the original data in {self.source} were created for "
                f"{plural(self.linked, 'unchanged file')}. They share their storage with the "
                "original files, so copy a file before you modify it."
            )
        if self._skipped:
            notes.append(
                f"{list_names(self._skipped)} in {self.source} could not be copied, because they "
                "are broken links or not regular files."
            )
        return notes

    def _files(self) -> Iterator[str]:
        """Yield the paths of all regular files, relative to the source.

        Symbolic links to folders are followed, unless they lead to a folder that contains them.
        """
        pending: list[tuple[str, tuple[Path, ...]]] = [("", (self.source.resolve(),))]
        while pending:
            name, ancestors = pending.pop()
            for entry in sorted(os.scandir(self.source / name), key=lambda entry: entry.name):
                path = f"{name}{entry.name}"
                if path == MARK_FILE:
                    continue
                if not entry.is_dir():
                    if entry.is_file():
                        yield path
                    else:
                        self._skipped.append(path)
                    continue
                resolved = Path(entry.path).resolve()
                if resolved in ancestors:
                    self._skipped.append(path)
                else:
                    pending.append((f"{path}/", (*ancestors, resolved)))


def check_target(target: Path, source: Path, *, overwrite: bool) -> None:
    """Raise LidarError unless an augmented copy of a recording can be written to a path."""
    if not target.absolute().parent.is_dir():
        raise MissingFileError(f"The folder {target.parent} does not exist. Create it first.")
    resolved = target.resolve()
    original = source.resolve()
    if resolved == original:
        raise LidarError(f"{target} is the recording itself. Specify another path.")
    if resolved.is_relative_to(original) and source.is_dir():
        raise LidarError(
            f"{target} is inside the recording {source}, which must not be modified. Specify a "
            "path outside of it."
        )
    if original.is_relative_to(resolved):
        raise LidarError(
            f"{target} contains the recording {source}. Specify a path that does not contain it."
        )
    if not target.exists() and not target.is_symlink():
        return
    if not overwrite:
        raise LidarError(f"{target} already exists. Use another path, or pass `--overwrite`.")
    mode = target.stat().st_mode if target.exists() else 0
    is_empty = stat.S_ISDIR(mode) and not any(target.iterdir())
    if stat.S_ISDIR(mode) and not is_empty and not (target / MARK_FILE).exists():
        raise LidarError(
            f"The folder {target} was not written by `lidarpool augment`, so it is not replaced. "
            "Remove it, or use another path."
        )
