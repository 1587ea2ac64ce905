"""YAML files as plain data: no tags, no duplicate keys, numbers as in YAML 1.2."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import yaml

from ..base.errors import LidarpoolError


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


# In YAML 1.1, which PyYAML implements, 1e-3 is text; in YAML 1.2 it is a number.
_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(r"^[-+]?[0-9][0-9_]*(\.[0-9_]*)?[eE][-+]?[0-9]+$"),
    list("-+0123456789"),
)


def read_yaml(
    path: Path, form: str = "a scenario has sections (scene:, sensor:, poses:, …)"
) -> dict[str, Any]:
    """Read a YAML file that holds one mapping; `form` says in errors what that looks like.

    Raises
    ------
    LidarpoolError
        If the file is missing, unreadable, not UTF-8, not YAML, empty, or holds something other
        than a mapping.
    """
    try:
        # The loader builds plain data only.
        content = yaml.load(path.read_text("utf-8-sig"), Loader=_Loader)  # noqa: S506
    except FileNotFoundError as error:
        raise LidarpoolError(f"{path} does not exist: check the name and the folder.") from error
    except OSError as error:
        raise LidarpoolError(f"{path} cannot be read: {error.strerror or error}.") from error
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        where = f", line {mark.line + 1}" if mark else ""
        raise LidarpoolError(f"{path}{where}: {error.problem or 'not valid YAML'}.") from error
    except (yaml.YAMLError, ValueError, OverflowError, RecursionError) as error:
        # ValueError: not UTF-8, or a date or number that Python cannot hold, such as 2026-99-99.
        reason = " ".join(str(error).partition(";")[0].split())[:200]
        raise LidarpoolError(f"{path} is not valid YAML: {reason}.") from error
    if content is None:
        raise LidarpoolError(f"{path} is empty; {form}.")
    if not isinstance(content, dict):
        kind = "a list" if isinstance(content, list) else f"only {str(content)[:40]!r}"
        raise LidarpoolError(f"{path} holds {kind}; {form}.")
    return content
