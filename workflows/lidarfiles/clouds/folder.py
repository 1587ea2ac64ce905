"""Output folders for results and exports.

A folder has one writer at a time, and never contains partial files.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path

from lidarsim.errors import LidarError, MissingFileError, as_sentence, explain_os_errors
from lidarsim.io.storage import Storage, is_url, lock

from ..work.work import Work

LAST_FILE = "report.json"  # written last, so a result that contains this file is complete


def output_destination(text: str | Path) -> Path | Storage:
    """Return the destination for a result.

    It is remote storage if the text is a URL.
    """
    return Storage.at(text) if is_url(text) else Path(text)


def path_in(output: Path | Storage, name: str) -> str:
    """Return the path or URL of a file in an output, for messages."""
    return output.path(name) if isinstance(output, Storage) else str(output / name)


def check_not_existing(files: Iterable[Path], *, overwrite: bool) -> None:
    """Raise LidarError if one of the files exists and must not be overwritten."""
    existing = next((file for file in files if file.exists()), None)
    if existing is not None and not overwrite:
        raise LidarError(
            f"{existing} already exists. Use another output with `--out`, or pass `--overwrite`."
        )


def check_new_result(
    folder: Path, names: Iterable[str], *, resume: bool, restart: bool, overwrite: bool
) -> None:
    """Check the options of a command that keeps finished items in its output folder.

    Raises
    ------
    LidarError
        If options contradict each other, or if one of the files exists and must not be overwritten.
        Unfinished work that is resumed may replace files.
    """
    if resume and restart:
        raise LidarError("`resume` and `restart` cannot be combined.")
    replaces = overwrite or (resume and Work.is_unfinished(folder))
    check_not_existing((folder / name for name in names), overwrite=replaces)


@contextmanager
def result_folder(output: Path | Storage, shown: Path | None = None) -> Iterator[Path]:
    """Create and lock the folder for a result or export.

    Temporary files of a killed run or export are removed. Folders that were created on entry are
    removed on exit if they are still empty. If the output is storage, the context manager yields a
    temporary folder, and the caller must copy its files to the storage.

    Parameters
    ----------
    output
        Path of the folder, or storage.
    shown
        Path of the output in error messages, if the folder only contains temporary files for it.

    Raises
    ------
    LidarError
        If the path is a file, if the folder cannot be created or written to, or if another run or
        export is using it.
    """
    if isinstance(output, Storage):
        output.claim()
        with local_folder(output) as folder:
            yield folder
        return
    folder = output
    if folder.exists() and not folder.is_dir():
        raise LidarError(f"{folder} is a file. Specify a folder with `--out`.")
    missing_folders = [
        path for path in (folder, *folder.parents) if not path.exists()
    ]  # innermost first
    kind = "folder" if shown is None else "path"
    place = f"the folder {folder}" if shown is None else str(shown)
    with ExitStack() as stack:
        with explain_os_errors(f"Cannot write to {place}", f"specify another {kind} with `--out`"):
            try:
                folder.mkdir(parents=True, exist_ok=True)
                with tempfile.TemporaryFile(dir=folder):
                    stack.enter_context(lock(folder, wait=False))
                Storage.at(folder).remove_unfinished(deep=False)
            except BlockingIOError as error:
                raise LidarError(
                    f"Another run or export is using {place}. Wait until it has finished, or "
                    f"specify another {kind} with `--out`."
                ) from error
        try:
            yield folder
        finally:
            for path in missing_folders:
                if path.exists() and not any(path.iterdir()):
                    path.rmdir()


def check_exists(place: Path | Storage, advice: str) -> None:
    """Raise LidarError with advice for the user if a local file or folder does not exist."""
    local = place if isinstance(place, Path) else Path(place.url) if place.is_local else None
    if local is not None and not local.exists():
        raise MissingFileError(f"{place} does not exist. {as_sentence(advice)}")


@contextmanager
def local_result(output: Path | Storage, names: Sequence[str]) -> Iterator[Path]:
    """Yield the folder of a result.

    For a result in storage, this is a temporary local copy.

    Parameters
    ----------
    output
        Folder or storage that contains the result.
    names
        Files to copy from storage, in addition to the report. Missing files are skipped.

    Raises
    ------
    LidarError
        If the folder does not exist, or if the storage cannot be read or does not contain a
        complete result.
    """
    check_exists(output, "specify the output folder of a finished run")
    with local_folder(output) as folder:
        if not isinstance(output, Storage):
            yield folder
            return
        with explain_os_errors(f"{output.url} cannot be read"):
            sizes = output.sizes()
            if LAST_FILE not in sizes:
                raise LidarError(
                    f"{output.url} does not contain a complete result, because {LAST_FILE} is "
                    "missing. Specify the URL of a finished run. To complete an unfinished run, "
                    "use `lidarpool run --resume`."
                )
            for name in (*names, LAST_FILE):
                if name in sizes:
                    output.get(name, folder / name)
        yield folder


@contextmanager
def local_folder(output: Path | Storage) -> Iterator[Path]:
    """Yield a local folder for the output.

    For storage, this is a temporary folder that is named like the end of its URL.
    """
    if not isinstance(output, Storage):
        yield output
        return
    with tempfile.TemporaryDirectory(prefix="lidarpool-") as temporary:
        folder = Path(temporary, output.url.rpartition("/")[2])
        folder.mkdir()
        yield folder
