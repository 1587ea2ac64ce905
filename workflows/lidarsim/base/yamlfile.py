"""YAML files as plain data: no tags, no duplicate keys, numbers as in YAML 1.2."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import yaml

from .allowance import Allowance
from .errors import LidarError, prefixed
from .input_files import read_input_text

_NODE_BYTES = 500  # of a value, while the loader has it


class _Loader(yaml.SafeLoader):
    """SafeLoader that refuses keys given twice, and aliases that repeat too much.

    PyYAML silently takes the last of two keys. It keeps one object for all aliases of a value, but
    merging them, and every look at them, takes as long as if they were written out.
    """

    def __init__(self, text: str) -> None:
        super().__init__(text)
        self._allowance = Allowance(len(text), "write less, or without aliases (*name)")
        self._taken: dict[yaml.Node, int] = {}  # by values with an anchor, aliases written out

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        """Compose a node; an alias counts as often as it is used."""
        event: Any = self.peek_event()
        before = self._allowance.used_bytes
        self._allowance.take(_NODE_BYTES)
        node: Any = super().compose_node(parent, index)
        if isinstance(event, yaml.AliasEvent):
            if node not in self._taken:
                mark: Any = event.start_mark
                problem = f"{event.anchor!r} contains itself"
                raise yaml.composer.ComposerError(None, None, problem, mark)
            self._allowance.take(self._taken[node])
        elif event.anchor is not None:
            self._taken[node] = self._allowance.used_bytes - before
        return node

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        """Build a mapping; ConstructorError, with the place, for a key given twice."""
        seen: set[str] = set()
        for key, _ in node.value:
            if not isinstance(key, yaml.ScalarNode):
                continue
            if key.value in seen:
                raise yaml.constructor.ConstructorError(
                    None, None, f"{key.value!r} is given twice", key.start_mark
                )
            seen.add(key.value)
        return super().construct_mapping(node, deep)


# In YAML 1.1, which PyYAML implements, 1e-3 is text; in YAML 1.2 it is a number.
_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(r"^[-+]?[0-9][0-9_]*(\.[0-9_]*)?[eE][-+]?[0-9]+$"),
    list("-+0123456789"),
)


def load_yaml(text: str) -> Any:
    """Return the content of a YAML text.

    Raises
    ------
    LidarError
        If it has too many values, with aliases written out; yaml.YAMLError if it is not YAML;
        ValueError, OverflowError or RecursionError for a number, a date or a depth that Python
        cannot hold.
    """
    loader = _Loader(text)
    try:
        return loader.get_single_data()
    finally:
        loader.dispose()


def read_yaml(
    path: Path, form: str = "a scenario has sections (scene:, sensor:, poses:, …)"
) -> dict[str, Any]:
    """Read a YAML file that holds one mapping; `form` says in errors what that looks like.

    Raises
    ------
    LidarError
        If the file is missing, unreadable, too large, not UTF-8, not YAML, empty, or holds
        something other than a mapping.
    """
    try:
        with prefixed(path):
            content = load_yaml(read_input_text(path))
    except FileNotFoundError as error:
        raise LidarError(f"{path} does not exist: check the name and the folder.") from error
    except OSError as error:
        raise LidarError(f"{path} cannot be read: {error.strerror or error}.") from error
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        where = f", line {mark.line + 1}" if mark else ""
        raise LidarError(f"{path}{where}: {error.problem or 'not valid YAML'}.") from error
    except (yaml.YAMLError, ValueError, OverflowError, RecursionError) as error:
        # ValueError: not UTF-8, or a date or number that Python cannot hold, such as 2026-99-99.
        reason = " ".join(str(error).partition(";")[0].split())[:200]
        raise LidarError(f"{path} is not valid YAML: {reason}.") from error
    if content is None:
        raise LidarError(f"{path} is empty; {form}.")
    if not isinstance(content, dict):
        kind = "a list" if isinstance(content, list) else f"only {str(content)[:40]!r}"
        raise LidarError(f"{path} holds {kind}; {form}.")
    return content
