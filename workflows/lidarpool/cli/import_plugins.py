"""Convert surveys from other programs to scenarios, using plug-ins for additional formats."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from pathlib import Path

from lidarscenes.files.lenient_xml import parse_lenient_xml
from lidarsim.environment.plugins import Plugin, find_plugin
from lidarsim.errors import LidarError
from lidarsim.io.input_files import read_input
from lidarsim.io.storage import staging
from lidarsim.words import printable

# Entry point group of importers. The name of an entry point is the root tag of an XML file, without
# its namespace, or the extension of any other file.
GROUP = "lidarpool.importers"
SCENARIO_FILE = "scenario.yaml"
_HELIOS = "document"  # root tag of a HELIOS++ survey
_MUJOCO = "mujoco"  # root tag of a MuJoCo model

# The arguments of an importer are the survey, the folder for SCENARIO_FILE and all other files, and
# the folders in which references are resolved. It returns one line for each unsupported feature.
Importer = Callable[[Path, Path, Sequence[Path]], Iterable[str]]


def find_importer(survey: Path) -> Plugin | None:
    """Return the plug-in that imports a survey, or None if there is none.

    Returns None for formats that lidarpool imports itself, and for unknown formats.

    Raises
    ------
    LidarError
        If two plug-ins support the same format.
    """
    name = _format_key(survey)
    return None if name in (_HELIOS, _MUJOCO) else find_plugin(GROUP, name)


def is_mujoco_model(survey: Path) -> bool:
    """Return True if the file is a MuJoCo model."""
    return _format_key(survey) == _MUJOCO


def _format_key(survey: Path) -> str:
    """Return the root tag of an XML file without its namespace, or else the file extension."""
    with suppress(OSError, LidarError, ValueError):
        return parse_lenient_xml(read_input(survey)).tag.rpartition(":")[2]
    return survey.suffix.lower()


def import_with_plugin(
    plugin: Plugin,
    survey: Path,
    folder: Path,
    assets: Sequence[Path],
    check: Callable[[Path], object],
) -> list[str]:
    """Convert a survey to a scenario, using a plug-in.

    The other arguments and the result are those of `import_atomically`.

    Raises
    ------
    LidarError
        If the plug-in fails, or if the import fails for another reason.
    """
    load: Importer = plugin.load(Callable)  # type: ignore[arg-type]

    def write(survey: Path, partial: Path, assets: Sequence[Path]) -> list[str]:
        try:
            unsupported = [*map(str, load(survey, partial, assets))]
        except LidarError:
            raise
        except Exception as error:  # a plug-in may raise anything
            reason = printable(str(error)) or type(error).__name__
            raise LidarError(f"{plugin} failed: {reason}.") from error
        if not (partial / SCENARIO_FILE).is_file():
            raise LidarError(f"{plugin} did not write {SCENARIO_FILE}.")
        return unsupported

    return import_atomically(write, survey, folder, assets, check)


def import_atomically(
    write: Importer,
    survey: Path,
    folder: Path,
    assets: Sequence[Path],
    check: Callable[[Path], object],
) -> list[str]:
    """Convert a survey to a scenario in a new folder.

    If the conversion fails, no files are left behind.

    Parameters
    ----------
    write
        Function that writes the scenario and its files.
    survey
        File of the survey.
    folder
        Output folder, which does not exist yet.
    assets
        Folders in which references in the survey are resolved.
    check
        Function that reads the scenario file, and raises LidarError if it cannot be simulated.

    Returns
    -------
    One line for each feature of the survey that is not supported.

    Raises
    ------
    LidarError
        If the survey cannot be converted, or the scenario is invalid.
    """
    folder.parent.mkdir(parents=True, exist_ok=True)
    try:
        with staging(folder.parent, folder, folder.name) as partial:
            unsupported = [*write(survey, partial, assets)]
            check(partial / SCENARIO_FILE)
            partial.rename(folder)
    except LidarError as error:
        raise LidarError(f"{survey} cannot be converted to a scenario: {error}") from error
    return unsupported
