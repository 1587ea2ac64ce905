"""Files of compiled loops in numba's cache, with checksums."""

from __future__ import annotations

import hashlib
import io
import itertools
import logging
import pickle
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

from numba.core.caching import IndexDataCacheFile
from numba.core.serialize import dumps

_log = logging.getLogger(__name__)
_UNFINISHED = "*.nb[ic].tmp.*"  # files that numba renames once they are whole
_ABANDONED_S = 3600.0  # age of an unfinished file that no process still writes


class LoopFiles(IndexDataCacheFile):
    """Index file of a loop (.nbi), and files of its compiled code (.nbc), one a signature.

    The files of numba itself have no checksums. Unpickling a damaged one ends in any error, and a
    process that is killed between index and code leaves an index that names the code of an earlier
    version of the loop. Here the index begins with its own checksum and holds the checksums of the
    code, which is written first. A file that does not fit its checksum counts as missing, so that
    the loop is compiled again.

    Parameters
    ----------
    folder
        Folder of the files.
    name
        Start of the names of the files, by numba.
    stamp
        Value that changes with the sources of the loop.
    """

    def __init__(self, folder: str, name: str, stamp: object) -> None:
        # Special names: numba and earlier versions of this package cannot read the index.
        super().__init__(folder, f"{name}.checked", stamp)

    def load(self, key: Any) -> Any:
        """Return the compiled code of a signature, or None without whole files."""
        name, checksum = self._load_index().get(key, ("", b""))
        if not name:
            return None
        code = self._content(name)
        if code is None or _checksum(code) != checksum:
            self._warn_damaged(name)
            return None
        return pickle.loads(code)  # noqa: S301 - fits its checksum

    def save(self, key: Any, data: Any) -> None:
        """Write the compiled code of a signature, then the index.

        Raises OSError if that is impossible.
        """
        entries = self._load_index()  # {signature: name of the file of its code, its checksum}
        if key in entries:
            name = entries[key][0]
        else:
            used_names = {entry[0] for entry in entries.values()}
            names = map(self._data_name, itertools.count(1))
            name = next(name for name in names if name not in used_names)
        code = dumps(data)
        self._write(self._data_path(name), code)
        entries[key] = name, _checksum(code)
        self._save_index(entries)

    def _load_index(self) -> dict[Any, tuple[str, bytes]]:
        """Return the entries of the index, or none if it is missing, damaged or outdated."""
        content = self._content(self._index_name)
        if content is None:
            return {}
        checksum = content[: hashlib.sha256().digest_size]
        pickled = content[len(checksum) :]
        if _checksum(pickled) != checksum:
            self._warn_damaged(self._index_name)
            return {}
        file = io.BytesIO(pickled)
        if pickle.load(file) != self._version:  # noqa: S301 - fits its checksum
            return {}  # another version of numba may not unpickle the rest
        try:
            stamp, entries = pickle.load(file)  # noqa: S301 - fits its checksum
        except (AttributeError, ImportError):
            return {}  # after an update, signatures may contain types that no longer exist
        return entries if stamp == self._source_stamp else {}

    def _save_index(self, entries: dict[Any, tuple[str, bytes]]) -> None:
        """Write the index."""
        pickled = pickle.dumps(self._version) + dumps((self._source_stamp, entries))
        self._write(self._index_path, _checksum(pickled) + pickled)

    def _content(self, name: str) -> bytes | None:
        """Return the content of a file of the folder, or None if it cannot be read."""
        try:
            return Path(self._data_path(name)).read_bytes()
        except OSError:
            return None

    def _write(self, path: str, content: bytes) -> None:
        """Write a file under a temporary name, and rename it."""
        with self._open_for_write(path) as file:
            file.write(content)

    def _warn_damaged(self, name: str) -> None:
        """Say that a file is not used."""
        _warn_once(
            "Compiled loops in %s are damaged and will be compiled again. The first one is %s.",
            self._cache_path,
            name,
        )


def warn_not_cached(folder: str, error: OSError) -> None:
    """Say that compiled code cannot be written, so that each process compiles."""
    _warn_once(
        "Compiled loops cannot be stored in %s, so each process compiles them: %s.",
        folder,
        error.strerror or str(error),
    )


def remove_unfinished(folder: str, is_locked: bool) -> None:
    """Remove files that killed processes were writing.

    `is_locked` says that no other process writes in the folder; otherwise only old files are
    removed.
    """
    abandoned_s = time.time() - _ABANDONED_S
    for path in Path(folder).glob(_UNFINISHED):
        with suppress(OSError):
            if is_locked or path.stat().st_mtime <= abandoned_s:
                path.unlink()


def _checksum(content: bytes) -> bytes:
    """Return the checksum of the content of a file, 32 bytes."""
    return hashlib.sha256(content).digest()


_warned = set[tuple[str, str]]()  # messages of this process, and the folders that they name


def _warn_once(message: str, folder: str, example: str) -> None:
    """Log a warning on a folder with an example, once for all loops of the folder."""
    if (message, folder) not in _warned:
        _warned.add((message, folder))
        _log.warning(message, folder, example)
