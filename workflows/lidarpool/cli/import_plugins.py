"""Surveys of other programs as scenarios, by plug-ins."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from pathlib import Path

from lidarscenes.files.lenient_xml import parse_lenient_xml
from lidarsim.environment.plugins import Plugin, find_plugin
from lidarsim.errors import LidarError
from lidarsim.io.input_files import read_input
from lidarsim.words import printable

# Names are tags of the outermost elements of XML files, without namespaces, or endings of other
# files.
GROUP = "lidarpool.importers"
SCENARIO_FILE = "scenario.yaml"
_HELIOS = "document"  # root of a survey of HELIOS++
_MUJOCO = "mujoco"  # root of a model of MuJoCo

# Arguments: a survey, the folder for SCENARIO_FILE and further files, and folders where references
# start. Returns the features that are not supported, a line each.
Importer = Callable[[Path, Path, Sequence[Path]], Iterable[str]]


def importer_of(survey: Path) -> Plugin | None:
    """Return the plug-in that imports a survey.

    Returns None for surveys that lidarpool imports itself, and for unknown files.

    Raises
    ------
    LidarError
        If two plug-ins import the survey.
    """
    name = _kind_of(survey)
    return None if name in (_HELIOS, _MUJOCO) else find_plugin(GROUP, name)


def is_mujoco_model(survey: Path) -> bool:
    """Return True if a file is a model of MuJoCo."""
    return _kind_of(survey) == _MUJOCO


def _kind_of(survey: Path) -> str:
    """Return the tag of the outermost element of XML without a namespace, else the ending."""
    with suppress(OSError, LidarError, ValueError):
        return parse_lenient_xml(read_input(survey)).tag.rpartition(":")[2]
    return survey.suffix.lower()


def import_by(
    plugin: Plugin,
    survey: Path,
    folder: Path,
    assets: Sequence[Path],
    check: Callable[[Path], object],
) -> list[str]:
    """Write a survey as a scenario by a plug-in.

    Raises the errors of `import_whole`.

    Raises
    ------
    LidarError
        Also if the plug-in fails.
    """
    load: Importer = plugin.load(Callable)  # type: ignore[arg-type]

    def write(survey: Path, partial: Path, assets: Sequence[Path]) -> list[str]:
        try:
            left_out = [*map(str, load(survey, partial, assets))]
        except LidarError:
            raise
        except Exception as error:  # a plug-in may raise anything
            reason = printable(str(error)) or type(error).__name__
            raise LidarError(f"{plugin} failed: {reason}.") from error
        if not (partial / SCENARIO_FILE).is_file():
            raise LidarError(f"{plugin} did not write {SCENARIO_FILE}.")
        return left_out

    return import_whole(write, survey, folder, assets, check)


def import_whole(
    write: Importer,
    survey: Path,
    folder: Path,
    assets: Sequence[Path],
    check: Callable[[Path], object],
) -> list[str]:
    """Write a survey as a scenario into a new folder, completely or not at all.

    `write` writes the files; `check` reads the scenario and raises LidarError for a scenario that
    cannot be simulated.

    Returns
    -------
    The features that are not supported.

    Raises
    ------
    LidarError
        If the folder exists, the survey cannot be written, or the scenario is refused.
    """
    if folder.exists():
        raise LidarError(f"{folder} already exists. Pass another folder with `--out`.")
    folder.parent.mkdir(parents=True, exist_ok=True)
    partial = Path(tempfile.mkdtemp(prefix=f".{folder.name}.", dir=folder.parent))
    try:
        left_out = [*write(survey, partial, assets)]
        check(partial / SCENARIO_FILE)
        partial.chmod(0o755)  # temporary folders are their owner's alone
        partial.rename(folder)
    except LidarError as error:
        message = str(error).replace(str(partial), str(folder))
        raise LidarError(f"{survey} cannot be converted to a scenario: {message}") from error
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return left_out
