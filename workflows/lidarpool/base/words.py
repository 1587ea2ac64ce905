"""Words of messages."""

from __future__ import annotations

import difflib
import json
import re
from collections.abc import Iterable


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """Return " Did you mean 'x'?", or nothing where no known word is near.

    Examples
    --------
    >>> did_you_mean("layer", ["layers", "step_deg"])
    " Did you mean 'layers'?"
    """
    lower = {name.lower(): name for name in known}
    near = difflib.get_close_matches(word.lower(), lower, n=1, cutoff=0.6)
    return f" Did you mean {lower[near[0]]!r}?" if near else ""


# In a note, a field of a scenario and its value; and the calls of Python that take those fields.
_SETTING = re.compile(r"<(scene\.files|cloud|materials)\.(\w+)=(\w+)>")
_CALLS = {
    "scene.files": "Scene.load(path, {})",
    "cloud": "Survey(…, {})",
    "materials": "Material(…, {})",
}
_OPTION = " (lidarpool init --mesh FILE --{} {})"  # of a file in `scene.files`


def as_python(note: str) -> str:
    """Return a note with its settings as arguments in Python.

    Examples
    --------
    >>> note = "give <scene.files.up_axis=y>"
    >>> as_python(note)
    'give Scene.load(path, up_axis="y")'
    >>> as_scenario(note)
    'give up_axis: y in scene.files (lidarpool init --mesh FILE --up-axis y)'
    """
    return _SETTING.sub(
        lambda m: _CALLS[m[1]].format(f"{m[2]}={m[3] if m[3].isdigit() else json.dumps(m[3])}"),
        note,
    )


def as_scenario(note: str) -> str:
    """Return a note with its settings as fields of a scenario."""

    def said(m: re.Match[str]) -> str:
        option = _OPTION.format(m[2].replace("_", "-"), m[3]) if m[1] == "scene.files" else ""
        return f"{m[2]}: {m[3]} in {m[1]}{option}"

    return _SETTING.sub(said, note)


def plural(number: float, what: str, several: str = "") -> str:
    """Return number and noun: «1 worker», «1,200 workers»."""
    return f"{number:,} {what if number == 1 else several or what + 's'}"


def natural(name: str) -> list[tuple[int, str]]:
    """Sort key: GPU-2 before GPU-10."""
    pieces = re.split(r"(\d+)", name)
    return [(int(p), "") if p.isdecimal() else (-1, p) for p in pieces]


def as_text(name: bytes) -> str:
    """Name in UTF-8, or in Latin-1 from old programs."""
    try:
        return name.decode("utf-8")
    except UnicodeDecodeError:
        return name.decode("latin-1")


def printable(text: str) -> str:
    """Text from a file as one line of 200 letters at most, without control characters."""
    kept = "".join(c if c.isprintable() else " " for c in text)
    return " ".join(kept.split())[:200]
