"""Advice for correcting a file.

An example is the section to which an unknown field belongs. The advice recommends moving a field to
a different section only if the file would then be valid. If the name of that section does not show
how to write the field, the advice contains the smallest valid example.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from typing import Any, NamedTuple, get_args, get_origin

from pydantic import GetPydanticSchema, ValidationError
from pydantic.fields import FieldInfo

from ..unit_suffixes import convert_value, factor_between, find_other_unit
from ..words import did_you_mean, join_names, most_similar
from .section_fields import FieldPath, classes_in, fields_by_name, is_section
from .value_texts import format_value

# Function that returns True if the fields in the content of a file contradict each other.
Contradictory = Callable[[Any], bool]

_SYNONYMS = {
    "position": "translation",
    "translation": "position",
    "formats": "write",
}  # pairs that are too different for `did_you_mean`
# {name that users try in any section: (section, field) to use instead, where the field is a list}
_OTHER_PLACES = {"formats": ("output", "write")}
_MAX_DEPTH = 4  # maximum nesting depth of sections
_SUGGESTION = re.compile(r"Did you mean '([^']*)'\?")


class Owner(NamedTuple):
    """A section that has a field."""

    names: tuple[str, ...]  # names of the fields on the path to the section
    forms: tuple[str, ...]  # format of each of these fields: "%s", or "[%s]" for a list
    field: FieldInfo | None  # last field on the path, or None for the file itself
    kind: Any  # class of the section

    @property
    def is_direct(self) -> bool:
        """Whether the path contains no list or mapping.

        In this case, the field names are sufficient to describe the path.
        """
        return all(form == "%s" for form in self.forms)


def owners_by_level(name: str, start: Owner) -> Iterator[list[Owner]]:
    """Yield the sections that have a field, in one list for each nesting level.

    The first list is for `start` itself.
    """
    level = [start]
    for _ in range(_MAX_DEPTH):
        yield [owner for owner in level if name in fields_by_name(owner.kind)]
        level = [inner for owner in level for inner in _inner_sections(owner)]


def owner_of_file(kind: Any) -> Owner:
    """Return an `Owner` for the entire file."""
    return Owner((), (), None, kind)


def _inner_sections(outer: Owner) -> Iterator[Owner]:
    for name, field in fields_by_name(outer.kind).items():
        if any(isinstance(note, GetPydanticSchema) for note in field.metadata):
            continue  # the field is available only in Python
        key = next((next(iter(e), "") for e in field.examples or () if isinstance(e, dict)), "NAME")
        for form, kind in _forms_of(field.annotation, key):
            yield Owner((*outer.names, name), (*outer.forms, form), field, kind)


def _forms_of(annotation: Any, key: str, form: str = "%s") -> Iterator[tuple[str, Any]]:
    """Yield the sections in an annotation, each with its form, such as "[%s]" in a list.

    `key` is an example of a name in a mapping.
    """
    if isinstance(annotation, type) and is_section(annotation):
        yield form, annotation
    if (origin := get_origin(annotation)) in (list, tuple, Sequence):
        form = "[%s]"
    elif origin in (dict, Mapping):
        form = f"{{{key}: %s}}"
    for inner in get_args(annotation):
        yield from _forms_of(inner, key, form)


def place_advice(
    path: FieldPath,
    value: Any,
    field_names: Collection[str],
    file: Any,
    content: Any,
    contradictory: Contradictory,
) -> str:
    """Return advice on an unknown field, or an empty string.

    The advice states a similar name and where the field would be valid. `field_names` are the
    fields of its section, `file` is the class of the entire file, and `content` is the content of
    the file or None.
    """
    name = str(path[-1])
    if known := _known_place(name, value, field_names, file):
        return known
    content = dict(content) if isinstance(content, Mapping) else {}
    starts = [owner_of_file(file)]
    if path[1:]:  # search the section that contains the field first
        starts[:0] = [owner for owner in _inner_sections(starts[0]) if owner.names == path[:-1]]
        if isinstance(section := content.get(path[0]), Mapping):
            content[path[0]] = {key: v for key, v in section.items() if key != name}
    else:
        content.pop(name, None)
    direct: list[str] = []
    examples: list[str] = []
    for owners in (owners for start in starts for owners in owners_by_level(name, start)):
        kinds: list[Any] = []
        for owner in owners:
            right = _right_value(owner.kind, name, value)
            changed = None
            if owner.is_direct:  # other mistakes at the top level do not matter
                kind = owner.kind if owner.names else None
                changed = _with_field(content, owner.names, kind, {name: right})
            if right is None or (changed is not None and contradictory(changed)):
                continue
            if not kinds or kinds[0] not in owner.kind.__mro__[1:]:  # skip derived sections
                kinds.append(owner.kind)
                valid = changed is not None and right == value
                direct += [".".join(owner.names)] if valid else []
                examples += [] if valid or not owner.names else [_example(owner, name, right)]
        if examples or any(direct):
            break
    suggestion = _similar_name(name, value, field_names)
    words = _in_words(path, suggestion, direct, examples)
    return words or _other_unit_elsewhere(name, value, file)


def _known_place(name: str, value: Any, field_names: Collection[str], file: Any) -> str:
    """Return advice on a name that is commonly mistaken for a different field, or ""."""
    if (synonym := _SYNONYMS.get(name)) in field_names:
        return f" Did you mean {synonym!r}?"
    section, field = _OTHER_PLACES.get(name, ("", ""))
    if section not in fields_by_name(file):
        return ""
    values = value if isinstance(value, list) else [value]
    listed = ", ".join(values) if all(isinstance(entry, str) for entry in values) else "…"
    return f" Write {section}: {{{field}: [{listed}]}}."


def _similar_name(name: str, value: Any, field_names: Collection[str]) -> str:
    """Suggest a similar field, converting the value if only the unit differs."""
    similar = most_similar(name, field_names)
    factor = None if similar is None else factor_between(name, similar)
    right = None if factor is None else convert_value(value, factor)
    return (
        did_you_mean(name, field_names)
        if right is None
        else f" Write {similar}: {format_value(right)}."
    )


def _other_unit_elsewhere(name: str, value: Any, file: Any) -> str:
    """Return an example of a field in another section that differs only in its unit, or ""."""
    for owner in _inner_sections(owner_of_file(file)):
        similar = find_other_unit(name, fields_by_name(owner.kind))
        factor = None if similar is None else factor_between(name, similar)
        right = None if factor is None else convert_value(value, factor)
        if similar is not None and right is not None:
            return f" Write {_example(owner, similar, right)}."
    return ""


def _in_words(
    path: FieldPath, suggestion: str, direct: Sequence[str], examples: Sequence[str]
) -> str:
    """Phrase the advice that a field belongs in one of the `direct` sections.

    An empty string in `direct` represents the top level of the file.
    """
    sections = [section for section in direct if section]
    listed = join_names(sections)
    if suggestion and listed:
        return f"{suggestion} {path[-1]!r} is a field of {listed}."
    if suggestion and "" in direct:
        return f"{suggestion} {path[-1]!r} is also a top-level field, next to {path[0]!r}."
    words = suggestion
    if "" in direct:
        words = f" It is a top-level field. Move it next to {path[0]!r}."
    if listed:
        words += f" It is a field of {listed}. Move it there."
    elif examples:
        words += f" {'Or write' if words else 'Write'} {examples[0]}."
    return words


def _right_value(kind: Any, name: str, value: Any) -> Any:
    """Return a field's value if it is valid, otherwise its corrected spelling or None."""
    fields = fields_by_name(kind)
    if value is None:
        return None
    if next(iter(fields)) == name:  # the section itself may validate it, such as a format name
        error = _error(kind, {name: value})
    else:
        error = _error(fields[name].rebuild_annotation(), value)
    if error is None:
        return value
    for detail in error.errors(include_url=False):
        expected = re.findall(r"'([^']*)'", str(detail.get("ctx", {}).get("expected", "")))
        message = did_you_mean(str(value), expected) if expected else detail["msg"]
        if match := _SUGGESTION.search(message):
            return match[1]
    return None


def _with_field(content: Any, names: Sequence[str], kind: Any, field: Mapping[str, Any]) -> Any:
    """Add a field to a section of a file's content.

    The result is None if this makes the section invalid.
    """
    if not isinstance(content, Mapping):  # the content is in its short form
        return None
    if not names:
        section = {**content, **field}
        return section if kind is None or _error(kind, section) is None else None
    inner = _with_field(content.get(names[0]) or {}, names[1:], kind, field)
    return None if inner is None else {**content, names[0]: inner}


def _error(annotation: Any, value: Any) -> ValidationError | None:
    """Return the error from validating a value against an annotation, or None."""
    from pydantic import TypeAdapter  # slow to import

    try:
        TypeAdapter(annotation).validate_python(value)
    except ValidationError as error:
        return error
    return None


def _example(owner: Owner, name: str, value: Any) -> str:
    """Return the smallest valid example of a field in a section.

    An example is `sensors: {roof: {model: …, …}}`.
    """
    fields = fields_by_name(owner.kind)
    first = next(iter(fields))
    entries = [
        entry
        for example in (owner.field.examples if owner.field else None) or ()
        for entry in (example if isinstance(example, list) else [example])
        if isinstance(entry, Mapping)
    ]
    samples = {key: v for entry in entries for key, v in entry.items()}
    needed = [key for key, field in fields.items() if field.is_required()]
    if not needed and str in classes_in(fields[first].annotation):
        needed = [first]  # for example, the model of a sensor
    for keys in (needed, *([*entry] for entry in entries if name in entry)):
        sample = {key: samples.get(key, "x") for key in keys}
        if value is None or _error(owner.kind, {**sample, name: value}) is None:
            needed = keys
            break
    shown_value = str(value) if isinstance(value, (str, int, float)) else "…"
    shown_value = shown_value.lower() if isinstance(value, bool) else shown_value
    text = ", ".join([*(f"{key}: …" for key in needed if key != name), f"{name}: {shown_value}"])
    is_short = first == name and isinstance(value, str) and set(needed) <= {name}
    text = shown_value if is_short else f"{{{text}}}"
    for step, form in zip(reversed(owner.names), reversed(owner.forms), strict=True):
        text = f"{{{step}: {form % text}}}"
    return text[1:-1]


def list_advice(annotation: Any, value: Any) -> str:
    """Suggest writing a value as a list with one entry.

    The result is an empty string if such a list is invalid.
    """
    is_plain = isinstance(value, (str, int, float))
    return f" Write [{value}]." if is_plain and _error(annotation, [value]) is None else ""


def name_advice(path: FieldPath, file: Any) -> str:
    """Return advice if the names of a mapping's entries were omitted.

    The advice contains an example. For instance, `sensors: {model: …, mount: …}` lacks the name of
    the sensor. If no name was omitted, return an empty string.
    """
    for owner in _inner_sections(owner_of_file(file)):
        is_table = owner.names == path[:-1] and owner.forms[0].startswith("{")
        if is_table and path[-1] in fields_by_name(owner.kind):
            return f" Each entry has a name: {_example(owner, str(path[-1]), None)}."
    return ""
