"""YAML files as plain data: no tags, no doubled keys, no surprises with numbers."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import yaml

from ..base.errors import LidarpoolError

SIZE_LIMIT = 4 * 2**20  # bytes; a million poses are better made in Python


# {part of what PyYAML says: what it means to whoever wrote the file}
_WORDS = {
    "could not determine a constructor": "tags such as !name have no meaning here, a scenario is "
    "plain data",
    "expected <block end>": "this line is indented otherwise than those it belongs to, or a "
    "bracket above is not closed",
    "found character '\\t'": "there is a tab: indent and separate with blanks",
    "mapping values are not allowed": "a second ':' on one line, or a line that is indented too "
    "far; a list of files reads: - {file: part.stl, unit: mm}",
    "found unknown escape character": "between double quotes \\ begins an escape: write paths with "
    "/, or between single quotes",
    "expected ',' or": "a bracket is not closed, or a comma is missing",
    "expected '<document start>'": "a scenario is one document, without --- or ... in it",
}


class _Loader(yaml.SafeLoader):
    """SafeLoader that refuses a key given twice, where PyYAML silently takes the last."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        """Build a mapping; ConstructorError, with the place, for a key given twice."""
        seen: set[str] = set()
        for key, _ in node.value:
            if isinstance(key, yaml.ScalarNode) and key.value in seen:
                raise yaml.constructor.ConstructorError(
                    None, None, f"{key.value!r} is given twice", key.start_mark
                )
            seen.add(str(key.value))
        return super().construct_mapping(node, deep)


# YAML 1.1, which PyYAML speaks, takes 1e-3 for text; YAML 1.2 and everybody else for a number.
_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(r"^[-+]?[0-9][0-9_]*(\.[0-9_]*)?[eE][-+]?[0-9]+$"),
    list("-+0123456789"),
)


def read_yaml(path: Path) -> dict[str, Any]:
    """Read a YAML file that holds one mapping.

    Raises
    ------
    LidarpoolError
        If the file is missing, unreadable, too large, not UTF-8, not YAML, empty, or holds
        something other than a mapping.
    """
    if path.is_dir():
        raise LidarpoolError(f"{path} is a folder: give a scenario file (.yaml).")
    try:
        with path.open("rb") as file:
            data = file.read(SIZE_LIMIT + 1)
    except FileNotFoundError as error:
        raise LidarpoolError(f"{path} does not exist: check the name and the folder.") from error
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise LidarpoolError(f"{path} cannot be read: {reason}.") from error
    if len(data) > SIZE_LIMIT:
        raise LidarpoolError(
            f"{path} is larger than {SIZE_LIMIT // 2**20} MiB: is it a scenario? Meshes belong "
            "in files of their own."
        )
    content = _parse(path, data)
    if content is None:
        raise LidarpoolError(f"{path} is empty: lidarpool init writes a scenario to begin with.")
    if not isinstance(content, dict):
        kind = "a list" if isinstance(content, list) else f"only {str(content)[:40]!r}"
        raise LidarpoolError(
            f"{path} holds {kind}; a scenario has sections (scene:, sensor:, poses:, …)."
        )
    return content


def _parse(path: Path, data: bytes) -> Any:
    """Content of a YAML text."""
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise LidarpoolError(
            f"{path} is not UTF-8 text (byte {error.start}): save it as UTF-8."
        ) from error
    try:
        return yaml.load(text, Loader=_Loader)  # a SafeLoader: builds plain data only
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        where = f", line {mark.line + 1}" if mark else ""
        problem = error.problem or "not valid YAML"
        problem = next((words for sign, words in _WORDS.items() if sign in problem), problem)
        raise LidarpoolError(f"{path}{where}: {problem}.") from error
    except RecursionError as error:
        raise LidarpoolError(f"{path} is nested too deeply to be a scenario.") from error
    except (yaml.YAMLError, ValueError, OverflowError) as error:
        # ValueError: a date or number that Python cannot hold, such as 2026-99-99.
        reason = " ".join(str(error).partition(";")[0].split())[:200]
        raise LidarpoolError(f"{path} is not valid YAML: {reason}.") from error
