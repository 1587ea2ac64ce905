"""Functions that format numbers, names and suggestions for messages."""

from __future__ import annotations

import difflib
import json
import os
import re
from collections.abc import Iterable, Sequence
from fnmatch import fnmatchcase

from .unit_suffixes import factor_between, find_other_unit, unit_of


def did_you_mean(word: str, candidates: Iterable[str]) -> str:
    """Suggest the candidate that is most similar to a misspelled word.

    The suggestion starts with a space, so that it can be appended to a sentence. It is empty if no
    candidate is similar. A candidate that differs only in its unit takes precedence, and the
    suggestion then states the correct unit.

    Examples
    --------
    >>> did_you_mean("layer", ["layers", "step_deg"])
    " Did you mean 'layers'?"
    >>> did_you_mean("step_rad", ["layers", "step_deg"])
    " Did you mean 'step_deg'? Its unit is deg, not rad."
    """
    similar = most_similar(word, candidates)
    if similar is None:
        return ""
    unit = ""
    if factor_between(word, similar) is not None:
        unit = f" Its unit is {unit_of(similar)}, not {unit_of(word)}."
    return f" Did you mean {similar!r}?{unit}"


def did_you_mean_each(words: Sequence[str], candidates: Iterable[str]) -> str:
    """Suggest candidates for several misspelled words in a single question.

    The suggestion is empty if no candidate is similar.

    Examples
    --------
    >>> did_you_mean_each(["layer", "speed", "step"], ["layers", "step_deg"])
    " Did you mean 'layers' for 'layer', 'step_deg' for 'step'?"
    """
    names = [*candidates]
    if len(words) == 1:
        return did_you_mean(words[0], names)
    similar = {word: most_similar(word, names) for word in words}
    pairs = {word: name for word, name in similar.items() if name is not None}
    if not pairs:
        return ""
    suggestions = ", ".join(f"{name!r} for {word!r}" for word, name in pairs.items())
    changed = [word for word, name in pairs.items() if factor_between(word, name) is not None]
    units = f" Convert the units of {join_names(changed)}." if changed else ""
    return f" Did you mean {suggestions}?{units}"


def most_similar(word: str, candidates: Iterable[str]) -> str | None:
    """Return the candidate that is most similar to a word, or None if none is similar."""
    names = [*candidates]
    if (same_quantity := find_other_unit(word, names)) is not None:
        return same_quantity
    lower = {name.lower(): name for name in names}
    matches = difflib.get_close_matches(word.lower(), lower, n=1, cutoff=0.6)
    return lower[matches[0]] if matches else None


def name_hint(pattern: str, names: Sequence[str]) -> str:
    """Suggest the names that are similar to an unknown name or pattern.

    If no name is similar, the first available names are listed. More than two names that differ
    only in a trailing number are listed as a pattern, followed by their count.

    Examples
    --------
    >>> name_hint("Hose", ["House", "Tree"])
    " Did you mean 'House'?"
    >>> name_hint("Lamp*", ["House", "Tree", "Tree.2", "Tree.3"])
    ' Available names: House, Tree* (3).'
    >>> name_hint("hous*", ["Ground", "Site_House_1", "Site_House_2", "Site_House_3"])
    ' Similar names: Site_House* (3).'
    """
    is_pattern = any(sign in pattern for sign in "*?[")
    if similar := "" if is_pattern else did_you_mean(pattern, names):
        return similar
    groups: dict[str, list[str]] = {}
    for name in names:
        groups.setdefault(_LAST_NUMBER.sub("", name), []).append(name)
    entries: list[str] = []
    similar_entries: list[str] = []
    word = max(re.split(r"[*?\[\]]", pattern), key=len).casefold()
    close = {*difflib.get_close_matches(word, map(str.casefold, groups), n=8)}
    for stem, group in groups.items():
        listed_group = [f"{stem}* ({len(group):,})"] if stem and len(group) > 2 else group
        entries += listed_group
        folded = stem.casefold()
        if folded in close or (len(word) > 1 and word in folded):
            similar_entries += listed_group
    if similar_entries:
        return f" Similar names: {list_names(similar_entries, 8)}."
    return f" Available names: {list_names(entries, 8) or 'none'}."


_LAST_NUMBER = re.compile(r"[\s._-]*\d+$")
# Notes contain settings such as <file.up_axis="z">. In Python, each section corresponds to a call.
_SETTING = re.compile(r'<(file|scene|world|materials)\.(\w+)=("?)(\w+)\3>')
_CALLS = {
    "file": "Scene.load(path",
    "scene": "Scene.load(path",
    "world": "Survey(…",
    "materials": "Material(…",
}


def format_as_python(note: str) -> str:
    """Format the settings in a note as Python, for example `Scene.load(path, up_axis="z")`."""
    return _SETTING.sub(lambda m: f"{_CALLS[m[1]]}, {m[2]}={m[3]}{m[4]}{m[3]})", note)


def format_as_scenario(note: str) -> str:
    """Format the settings in a note as scenario YAML, for example `{file: …, up_axis: z}`."""
    form = {"file": "{{file: …, {}: {}}}"}
    return _SETTING.sub(lambda m: form.get(m[1], f"{{}}: {{}} in {m[1]}").format(m[2], m[4]), note)


_EXPONENT_FROM = 1e15  # larger numbers are probably mistakes and keep their exponent


def plural(number: float, noun: str, plural_noun: str = "") -> str:
    """Format a count with its noun, for example "1 worker" or "1,200 workers"."""
    return f"{number:,} {noun if number == 1 else plural_noun or noun + 's'}"


def format_rounded(number: float, digits: int = 3) -> str:
    """Format a number with `digits` significant digits, without an exponent if it is large.

    Examples
    --------
    >>> format_rounded(99.96, 2), format_rounded(1234.5), format_rounded(0.00123456)
    ('100', '1,230', '0.00123')
    """
    text = f"{number:,.{digits}g}"
    return f"{float(text):,.0f}" if "e+" in text and abs(number) < _EXPONENT_FROM else text


def format_scan_counts(scans: int, sweeps: int) -> str:
    """Format scan and sweep counts, for example "36,000 scans (1,000 sweeps)"."""
    return f"{plural(scans, 'scan')} ({plural(sweeps, 'sweep')})"


def natural_sort_key(name: str) -> list[tuple[int, str]]:
    """Return a natural sort key, which sorts GPU-2 before GPU-10."""
    pieces = re.split(r"(\d+)", name)
    return [(int(p), "") if p.isdecimal() else (-1, p) for p in pieces]


def decode_name(name: bytes) -> str:
    """Decode a name as UTF-8, or as Latin-1 if it is not valid UTF-8.

    Older programs write Latin-1.
    """
    try:
        return name.decode("utf-8")
    except UnicodeDecodeError:
        return name.decode("latin-1")


def printable(text: str, max_letters: int = 200) -> str:
    """Sanitize text from a file for printing.

    The result is a single line of at most `max_letters` characters without control characters.
    """
    cleaned = "".join(letter if letter.isprintable() else " " for letter in text)
    return " ".join(cleaned.split())[:max_letters]


def matches_pattern(name: str, pattern: str) -> bool:
    """Return whether a name matches a pattern with the wildcards `*` and `?`.

    Brackets in the pattern have no special meaning.

    Examples
    --------
    >>> matches_pattern("vel_x [m/s]", "vel_x [m/s]"), matches_pattern("vel_x [m/s]", "vel_*")
    (True, True)
    """
    return name == pattern or fnmatchcase(name, pattern.replace("[", "[[]"))


_PLAIN_IN_YAML = re.compile(r"[A-Za-z_][\w./-]*(?: [\w./-]+)*")
_WORDS_OF_YAML = {"null", "true", "false", "yes", "no", "on", "off", "y", "n"}


def format_yaml_list(names: Iterable[str]) -> str:
    """Format names from a file as a YAML list, with quotes where YAML requires them.

    Examples
    --------
    >>> print(format_yaml_list(["fix", "vel_x [m/s]", "on"]))
    [fix, "vel_x [m/s]", "on"]
    """
    return f"[{', '.join(map(_scalar_in_yaml, names))}]"


def _scalar_in_yaml(name: str) -> str:
    text = printable(name)
    if _PLAIN_IN_YAML.fullmatch(text) and text.lower() not in _WORDS_OF_YAML:
        return text
    return json.dumps(text, ensure_ascii=False)


def make_distinct(names: Iterable[str]) -> list[str]:
    """Make names unique by appending numbers to repeated names.

    Examples
    --------
    >>> make_distinct(["x", "ring", "ring", "ring"])
    ['x', 'ring', 'ring_2', 'ring_3']
    """
    unique: dict[str, None] = {}
    for name in names:
        number = 2
        candidate = name
        while candidate in unique:
            candidate = f"{name}_{number}"
            number += 1
        unique[candidate] = None
    return list(unique)


def shorten_name(name: str, max_letters: int = 18) -> str:
    """Shorten a name to `max_letters` characters by removing its middle.

    Control characters are replaced by the Unicode replacement character.
    """
    name = "".join(letter if letter.isprintable() else "\ufffd" for letter in name)
    tail = (max_letters - 1) // 2
    return name if len(name) <= max_letters else f"{name[: max_letters - 1 - tail]}…{name[-tail:]}"


def remove_common_prefix(names: Sequence[str]) -> list[str]:
    """Remove the words that all names start with, if there are at least three names.

    Examples
    --------
    >>> remove_common_prefix(["site_a_Wall", "site_a_Floor", "site_a_Lamp_1"])
    ['Wall', 'Floor', 'Lamp_1']
    """
    if len(names) < 3:
        return list(names)
    prefix = os.path.commonprefix(list(names))  # noqa: RUF071 - compares characters on purpose
    end = max(prefix.rfind(mark) for mark in "_./: -") + 1
    shorter = [name[end:] for name in names]
    return shorter if all(shorter) else list(names)


def join_names(names: Sequence[str]) -> str:
    """Join names with commas and a final "and".

    Examples
    --------
    >>> join_names(["x", "y", "z"])
    'x, y and z'
    """
    return " and ".join(filter(None, [", ".join(names[:-1]), *names[-1:]]))


def join_alternatives(names: Sequence[str]) -> str:
    """Join alternatives with commas and a final "or".

    A quoted alternative may itself be such an enumeration.

    Examples
    --------
    >>> join_alternatives(["'even' or 'gaussian'", "a number", "None"])
    "'even', 'gaussian', a number or None"
    """
    *others, last = names
    flat = (name.replace("' or '", "', '") for name in others)
    return " or ".join(filter(None, [", ".join(flat), last]))


def list_names(names: Sequence[str], max_names: int = 3) -> str:
    """Join the first names and append the number of remaining names.

    Examples
    --------
    >>> list_names(["a", "b", "c", "d", "e"])
    'a, b, c and 2 more'
    """
    further = len(names) - max_names
    return ", ".join(names[:max_names]) + (f" and {further:,} more" if further > 0 else "")


def distinct_names(paths: Sequence[str]) -> list[str]:
    """Return the last parts of paths, with as many parent folders as required to distinguish them.

    Examples
    --------
    >>> distinct_names(["before/cloud.las", "after/cloud.las"])
    ['before/cloud.las', 'after/cloud.las']
    >>> distinct_names(["/data/before.las", "results/after/"])
    ['before.las', 'after']
    """
    parts = [path.rstrip("/").split("/") for path in paths]
    for count in range(1, max(map(len, parts), default=1)):
        names = ["/".join(part[-count:]) for part in parts]
        if len({*names}) == len(paths):
            return names
    return [path.rstrip("/") for path in paths]
