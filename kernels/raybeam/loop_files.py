"""Cache files of compiled loops, protected by checksums."""

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
_UNFINISHED = "*.nb[ic].tmp.*"  # temporary files, which numba renames when they are complete
_ABANDONED_S = 3600.0  # older temporary files are considered abandoned


class LoopFiles(IndexDataCacheFile):
    """Cache files of a loop: an index (.nbi), and a code file (.nbc) for each signature.

    numba's own cache files have no checksums. Unpickling a damaged file can raise any exception,
    and if a process is killed after it has written the index but before it has written the code,
    the index refers to code from an earlier version of the loop. Here, the code is written first,
    and the index starts with its own checksum and contains the checksums of the code. If a checksum
    does not match, the file is ignored and the loop is compiled again.

    Parameters
    ----------
    folder
        Folder of the files.
    name
        Common prefix of the file names, which numba determines.
    stamp
        Value that changes with the sources of the loop.
    """

    def __init__(self, folder: str, name: str, stamp: object) -> None:
        # The suffix differs from numba's, because numba cannot read this index.
        super().__init__(folder, f"{name}.checked", stamp)

    def load(self, key: Any) -> Any:
        """Load the compiled code for a signature, or return None if it is missing or damaged."""
        name, checksum = self._load_index().get(key, ("", b""))
        if not name:
            return None
        code = self._content(name)
        if code is None or _checksum(code) != checksum:
            self._warn_damaged(name)
            return None
        return pickle.loads(code)  # noqa: S301 - the checksum matches

    def save(self, key: Any, data: Any) -> None:
        """Write the compiled code for a signature first, and then the index.

        Raises OSError if a file cannot be written.
        """
        entries = self._load_index()  # {signature: (file name of the code, checksum)}
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
        """Load the entries of the index, or return {} if it is missing, damaged, or outdated."""
        content = self._content(self._index_name)
        if content is None:
            return {}
        checksum = content[: hashlib.sha256().digest_size]
        pickled = content[len(checksum) :]
        if _checksum(pickled) != checksum:
            self._warn_damaged(self._index_name)
            return {}
        file = io.BytesIO(pickled)
        if pickle.load(file) != self._version:  # noqa: S301 - the checksum matches
            return {}  # A different version of numba may be unable to unpickle the rest.
        try:
            stamp, entries = pickle.load(file)  # noqa: S301 - the checksum matches
        except (AttributeError, ImportError):
            return {}  # After an update, signatures may contain types that no longer exist.
        return entries if stamp == self._source_stamp else {}

    def _save_index(self, entries: dict[Any, tuple[str, bytes]]) -> None:
        pickled = pickle.dumps(self._version) + dumps((self._source_stamp, entries))
        self._write(self._index_path, _checksum(pickled) + pickled)

    def _content(self, name: str) -> bytes | None:
        try:
            return Path(self._data_path(name)).read_bytes()
        except OSError:
            return None

    def _write(self, path: str, content: bytes) -> None:
        """Write a file under a temporary name first, and then rename it."""
        with self._open_for_write(path) as file:
            file.write(content)

    def _warn_damaged(self, name: str) -> None:
        """Warn that a file is damaged."""
        _warn_once(
            "Compiled loops in %s are damaged and will be compiled again. The first one is %s.",
            self._cache_path,
            name,
        )


def warn_not_cached(folder: str, error: OSError) -> None:
    """Warn that compiled code cannot be stored, so that every process has to compile the loops."""
    _warn_once(
        "Compiled loops cannot be stored in %s, so each process compiles them: %s.",
        folder,
        error.strerror or str(error),
    )


def remove_unfinished(folder: str, is_locked: bool) -> None:
    """Remove temporary files of processes that were killed while writing.

    If `is_locked` is true, no other process writes to the folder, and all temporary files are
    removed. Otherwise, only old ones are removed.
    """
    abandoned_s = time.time() - _ABANDONED_S
    for path in Path(folder).glob(_UNFINISHED):
        with suppress(OSError):
            if is_locked or path.stat().st_mtime <= abandoned_s:
                path.unlink()


def _checksum(content: bytes) -> bytes:
    return hashlib.sha256(content).digest()


_warned = set[tuple[str, str]]()  # messages that this process has logged, with their folders


def _warn_once(message: str, folder: str, example: str) -> None:
    """Log a warning about a folder only once, even if it concerns several loops."""
    if (message, folder) not in _warned:
        _warned.add((message, folder))
        _log.warning(message, folder, example)
