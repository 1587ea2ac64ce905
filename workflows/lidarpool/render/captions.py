"""Words on the pictures: counts, and object names short enough for a legend."""

from __future__ import annotations

from collections.abc import Sequence


def facts(*counted: tuple[int, str]) -> str:
    """Join counts and their nouns into one line, without those that are none.

    Examples
    --------
    >>> facts((6, "object"), (1, "sensor position"))
    '6 objects · 1 sensor position'
    """
    shown = [pair for pair in counted if pair[0]] or counted[:1]
    return " · ".join(f"{n:,} {noun}{'' if n == 1 else 's'}" for n, noun in shown)


def without_common_prefix(names: Sequence[str]) -> list[str]:
    """Leave out the words that all names begin with, where there are at least three names.

    Examples
    --------
    >>> without_common_prefix(["site_a_Wall", "site_a_Floor", "site_a_Lamp_1"])
    ['Wall', 'Floor', 'Lamp_1']
    """
    if len(names) < 3:
        return list(names)
    first, last = min(names), max(names)  # in between they share at least as much
    same = (n for n, pair in enumerate(zip(first, last, strict=False)) if pair[0] != pair[1])
    prefix = first[: next(same, min(len(first), len(last)))]
    end = max(prefix.rfind(mark) for mark in "_./: -") + 1
    shorter = [name[end:] for name in names]
    return shorter if all(shorter) else list(names)
