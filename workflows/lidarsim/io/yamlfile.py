"""YAML loading that accepts plain data only.

Tags and duplicate keys are rejected. Numbers follow YAML 1.2.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import yaml

from ..errors import LidarError, MissingFileError, as_sentence, prefix_errors
from .allowance import Allowance
from .input_files import not_found, read_input_text

_NODE_BYTES = 500  # memory that the loader requires per value


class _Loader(yaml.SafeLoader):
    """SafeLoader that rejects duplicate keys and excessive expansion of aliases.

    PyYAML silently uses the last of several duplicate keys. Although all aliases of a value share
    one object, processing them takes as long as if each alias were a copy of the value.
    """

    def __init__(self, text: str) -> None:
        super().__init__(text)
        self._allowance = Allowance(len(text), "shorten it, or do not use aliases (*name)")
        # {node with an anchor: size in bytes with all aliases expanded}
        self._node_bytes: dict[yaml.Node, int] = {}

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        """Compose a node, counting every use of an alias toward the allowance."""
        event: Any = self.peek_event()
        used_bytes = self._allowance.used_bytes
        self._allowance.reserve(_NODE_BYTES)
        node: Any = super().compose_node(parent, index)
        if isinstance(event, yaml.AliasEvent):
            if node not in self._node_bytes:
                mark: Any = event.start_mark
                problem = f"{event.anchor!r} contains itself"
                raise yaml.composer.ComposerError(None, None, problem, mark)
            self._allowance.reserve(self._node_bytes[node])
        elif event.anchor is not None:
            self._node_bytes[node] = self._allowance.used_bytes - used_bytes
        return node

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        """Construct a mapping. Raise ConstructorError if a key is duplicated."""
        keys: set[str] = set()
        for key, _ in node.value:
            if not isinstance(key, yaml.ScalarNode):
                continue
            if key.value in keys:
                raise yaml.constructor.ConstructorError(
                    None, None, f"the key {key.value!r} is duplicated", key.start_mark
                )
            keys.add(key.value)
        return super().construct_mapping(node, deep)


# PyYAML implements YAML 1.1, in which 1e-3 is a string. In YAML 1.2, it is a number.
_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(r"^[-+]?[0-9][0-9_]*(\.[0-9_]*)?[eE][-+]?[0-9]+$"),
    list("-+0123456789"),
)


def load_yaml(text: str) -> Any:
    """Parse YAML text.

    Raises
    ------
    LidarError
        If the text has too many values once all aliases are expanded.
    yaml.YAMLError
        If the text is not valid YAML.
    ValueError, OverflowError, RecursionError
        If Python cannot represent a number, a date or the nesting depth.
    """
    loader = _Loader(text)
    try:
        return loader.get_single_data()
    finally:
        loader.dispose()


def read_yaml(
    path: Path, form: str = "A scenario is a mapping with sections such as scene, sensor and poses"
) -> dict[str, Any]:
    """Read a YAML file that contains a mapping.

    `form` describes the expected mapping in error messages.

    Raises
    ------
    LidarError
        If the file does not exist, cannot be read, is too large, is not valid YAML in UTF-8, or
        does not contain a mapping.
    """
    try:
        with prefix_errors(path):
            content = load_yaml(read_input_text(path))
    except FileNotFoundError as error:
        raise MissingFileError(not_found(path)) from error
    except OSError as error:
        raise LidarError(f"{path} cannot be read: {error.strerror or error}.") from error
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        line = f", line {mark.line + 1}" if mark else ""
        raise LidarError(f"{path}{line}: {error.problem or 'not valid YAML'}.") from error
    except (yaml.YAMLError, ValueError, OverflowError, RecursionError) as error:
        # A ValueError means that the file is not UTF-8, or that a date or number is invalid.
        reason = " ".join(str(error).partition(";")[0].split())[:200]
        raise LidarError(f"{path} is not valid YAML: {reason}.") from error
    if content is None:
        raise LidarError(f"{path} is empty. {as_sentence(form)}")
    if not isinstance(content, dict):
        kind = "a list" if isinstance(content, list) else f"only {str(content)[:40]!r}"
        raise LidarError(f"{path} contains {kind}. {as_sentence(form)}")
    return content
