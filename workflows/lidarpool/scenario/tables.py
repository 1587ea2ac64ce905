"""Tables of entries for lists of a scenario: one row an entry."""

from __future__ import annotations

import csv
import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, get_args, get_origin

import yaml
from pydantic import BaseModel, TypeAdapter, ValidationError

from ..base.allowance import check_fits
from ..base.errors import LidarpoolError, Mistakes
from ..base.validation import sections_in, validation_errors
from ..base.yamlfile import load_yaml
from ..sensor.calibrations import said

_MARKS = ",;\t"  # between cells
_WHOLE = re.compile(r"[-+]?[0-9]+")
_REAL = re.compile(r"[-+]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][-+]?[0-9]+)?")
_WORDS = {"true": True, "false": False}


def read_rows(path: Path, kind: Any) -> list[Any]:
    """Read entries of a list from a table, whose columns are their fields: box, at.0.position.

    A cell is a number, true or false, or a list or mapping as in YAML, else text; an empty one
    leaves the field out. Lines that begin with # are remarks.

    Parameters
    ----------
    kind
        Annotation of the list.

    Raises
    ------
    LidarpoolError
        If the file cannot be read, the field is no list, or a row is no entry of it; the message
        has the line.
    """
    entry = next(_entries(kind), None)
    if entry is None:
        raise LidarpoolError("sample adds entries to a list, such as actors, and this is none.")
    try:
        check_fits(path)
        lines = path.read_text("utf-8-sig").splitlines()
        first = next((line for line in lines if line.strip() and line.lstrip()[0] != "#"), "")
        mark = max(_MARKS, key=first.count)
        reader = csv.reader(lines, delimiter=mark)
        cells = [
            (reader.line_num, [cell.strip() for cell in row])
            for row in reader
            if any(cell.strip() for cell in row) and not row[0].lstrip().startswith("#")
        ]
        if not cells:
            raise ValueError("it is empty")
        (_, head), *cells = cells
        if twice := next((name for name in head if head.count(name) > 1), None):
            raise ValueError(f"it has the column {twice!r} twice")
    except FileNotFoundError as error:
        raise LidarpoolError(f"{path} does not exist: check the name and the folder.") from error
    except (OSError, ValueError, csv.Error, LidarpoolError) as error:
        raise LidarpoolError(f"{path} is not a usable table: {said(error)}") from error
    model = next(sections_in(entry), BaseModel)
    adapter = TypeAdapter(entry)
    mistakes, rows = Mistakes(), []
    for line, row in cells:
        if len(row) > len(head):
            told = f"{path}, line {line}: it has {len(row)} cells, and the header {len(head)}."
            mistakes.lines.append(told)
            continue
        try:
            rows.append(_checked(adapter, dict(zip(head, row, strict=False))))
        except ValidationError as error:
            found = validation_errors(error, model)
            mistakes.lines += [f"{path}, line {line}: {words}" for words in found]
    mistakes.tell()
    return rows


def _checked(adapter: TypeAdapter[Any], cells: dict[str, str]) -> Any:
    values = {name: _value(cell) for name, cell in cells.items() if cell}
    try:
        return adapter.validate_python(_nested(values))
    except ValidationError as error:
        # A field that takes text may have a number: the name of a car is 7.
        wrong = {".".join(map(str, detail["loc"])) for detail in error.errors()}
        text = {name: cells[name] for name in wrong & values.keys()}
        if not text:
            raise
        try:
            return adapter.validate_python(_nested(values | text))
        except ValidationError:
            raise error from None


def _value(cell: str) -> Any:
    if _WHOLE.fullmatch(cell):
        return int(cell)
    if _REAL.fullmatch(cell):
        return float(cell)
    if cell[0] in "[{":
        try:
            return json.loads(cell)  # a hundred times as fast, where it will do
        except ValueError:
            pass
        try:
            return load_yaml(cell)
        except (yaml.YAMLError, ValueError, OverflowError, RecursionError):
            return cell
    return _WORDS.get(cell.lower(), cell)


def _nested(values: dict[str, Any]) -> Any:
    """Return mappings and lists of names with dots: {"box.0": 4} is {"box": [4]}."""
    out: dict[str, Any] = {}
    for name, value in values.items():
        *outer, last = name.split(".")
        node = out
        for step in outer:
            node = node.setdefault(step, {})
            if not isinstance(node, dict):
                return out | {name: value}  # refused as a name that is no field
        node[last] = value
    return _lists(out)


def _lists(node: Any) -> Any:
    if not isinstance(node, dict):
        return node
    inner = {key: _lists(value) for key, value in node.items()}
    numbered = bool(inner) and list(inner) == [str(i) for i in range(len(inner))]
    return list(inner.values()) if numbered else inner


def _entries(kind: Any) -> Iterator[Any]:
    """Annotations of the entries of lists in an annotation, such as `tuple[X, ...] | None`."""
    args = get_args(kind)
    if get_origin(kind) is tuple and len(args) == 2 and args[1] is Ellipsis:
        yield args[0]
    else:
        for inner in args:
            yield from _entries(inner)
