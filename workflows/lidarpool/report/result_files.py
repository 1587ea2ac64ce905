"""Files of a survey's result, and the check before an earlier result is replaced.

`lidarpool check` uses this module without importing what writes the files.
"""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, NamedTuple

from lidarfiles.clouds.built_in_formats import FORMATS
from lidarfiles.clouds.folder import LAST_FILE
from lidarfiles.clouds.format_table import format_row, plugin_formats
from lidarfiles.clouds.writing import ExportSpec, check_foreign_files
from lidarfiles.identity.field_words import describe_changes
from lidarfiles.picture_file import PICTURE_FILE
from lidarsim.errors import LidarError, explain_os_errors
from lidarsim.io.storage import Storage
from lidarsim.schema.vocabulary import PICTURES
from lidarsim.survey.survey import Survey
from lidarsim.sweeps.instruments import INSTRUMENT_FILES, Instruments
from lidarsim.sweeps.sweeps import SWEEPS_FILE

if TYPE_CHECKING:
    from ..run.job_source import SingleJob
    from ..run.run_result import RunResult

CLOUD = FORMATS["ply"].file
PAGE = "report.html"
REPORT = LAST_FILE
_PICTURES = tuple(f"{name}.png" for name in PICTURES)
FILES = (CLOUD, *_PICTURES, PICTURE_FILE, SWEEPS_FILE, PAGE, REPORT)
_SURVEY_ENTRIES = ("scene", "survey")  # entries of the identity that must match for the same survey
_FORMAT_OF_FILE = {row.file: name for name, row in FORMATS.items() if row.file != CLOUD}


def check_existing(
    target: Path | Storage,
    survey: Survey,
    formats: Sequence[ExportSpec],
    inputs: SingleJob | RunResult,
    *,
    overwrite: bool = False,
) -> None:
    """Raise LidarError if the target contains anything that must not be replaced.

    Raises
    ------
    LidarError
        If a folder that would be replaced contains foreign files. Unless `overwrite` is True,
        also if the target contains a damaged result, the result of a different survey, or a
        file that would be replaced but does not belong to a result.
    """
    storage = Storage.at(target)
    advice = (
        "Specify another folder with `--out`, or replace the result with `--overwrite` "
        "(`overwrite=True` in Python)."
    )
    with explain_os_errors(f"{target} cannot be read"):
        try:
            entries = set(storage.entries())
        except NotADirectoryError:
            return
    earlier, listed, earlier_fields = read_earlier(storage)
    if REPORT in entries and not overwrite:
        expected = inputs.identity  # slow for large scenes
        if earlier != {name: expected[name] for name in _SURVEY_ENTRIES}:
            changed = describe_changes(earlier_fields, inputs.fields) if earlier_fields else ""
            raise LidarError(
                f"{target} contains the result of a different "
                f"survey{f' ({changed})' * bool(changed)}. {advice}"
            )
    further = optional_files(survey, formats)
    foreign = [name for name in (*FILES, *further) if name in entries and name not in listed]
    if foreign and not overwrite:
        lists = (
            f"{target} contains {foreign[0]}, which would be replaced although it does not "
            "belong to a result."
        )
        raise LidarError(f"{lists} {advice}")
    check_foreign_files(storage, formats_of_files({*further, *listed}))


def optional_files(survey: Survey, formats: Sequence[ExportSpec]) -> list[str]:
    """Return the names of files and folders that only some results have."""
    instruments = Instruments.from_survey(survey)
    measured = [] if instruments is None else instruments.files
    return [*(output_format.row.file for output_format in formats), *measured]


def formats_of_files(names: Collection[str]) -> list[str]:
    """Return the formats whose file or folder is in `names`."""
    unknown = {*names} - {*FILES, *INSTRUMENT_FILES, *_FORMAT_OF_FILE}
    return [name for file, name in _FORMAT_OF_FILE.items() if file in names] + plugin_formats(
        unknown
    )


def known_optional_files(names: Collection[str]) -> list[str]:
    """Return those names that are files of a format or an instrument, sorted by format."""
    measured = [name for name in INSTRUMENT_FILES if name in names]
    return [format_row(name).file for name in formats_of_files(names)] + measured


def obsolete_files(files: Collection[str], earlier: Collection[str]) -> list[str]:
    """Return the files of an `earlier` result to remove before the new `files` are published.

    The page is always included, because it must not appear beside other files than its own. If a
    run was killed after the removal of report.json, the list of earlier files is lost, and the
    files of other formats remain. Remaining pictures would appear to belong to the new result.
    """
    known = (*known_optional_files(earlier), *FILES)
    return [PAGE, *(name for name in known if name not in files and name != PAGE)]


class EarlierResult(NamedTuple):
    """Properties of a result that exists before the run."""

    identity: Mapping[str, str] = MappingProxyType({})  # hashes of the scene and the survey
    files: frozenset[str] = frozenset()  # files that may be removed
    fields: Mapping[str, str] = MappingProxyType({})  # {scenario field: value as text}


def read_earlier(storage: Storage) -> EarlierResult:
    """Return the properties of an existing result, or empty ones if it is missing or damaged."""
    try:
        report = json.loads(storage.read(REPORT))
        identity = {name: report["identity"][name] for name in _SURVEY_ENTRIES}
        files = frozenset(report["files"])
        files |= {*_PICTURES} if PICTURE_FILE in files else set()  # may have been drawn later
        return EarlierResult(identity, files, dict(report.get("fields", {})))
    except (OSError, ValueError, TypeError, LookupError):
        return EarlierResult()
