"""Check how the sources read: names, first lines of docstrings, and assignments.

Three things make a reader search: a name that does not say what its value is (`found`, `own`), a
docstring whose first line has a pronoun where a noun belongs, and several assignments on one line.
Each source root has limits for their shares, which well-kept projects stay below.

Usage: python .ci/readability.py [--list]    (--list prints where they are)
"""

import ast
import re
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parent.parent
SOURCE_ROOTS = ("kernels", "scheduler", "workflows")
MAX_VAGUE_PERCENT = 3.0  # of all names that are assigned or defined
MAX_PRONOUN_PERCENT = 12.0  # of all docstrings
MAX_PACKED_PER_1000_LINES = 2.0

VAGUE_NAMES = frozenset(
    """
    one ones some others other another each both all_ few many more most least rest such same this
    that these those it its what who whose whom where when here there then now again already own
    mine ours theirs thing things stuff lot way ways place places made found given told kept wanted
    needed seen taken gone done got had met asked answered known left right_ far near high low wide
    about around along before after at of out on off goes so thus turn turns ends begins lasts whole
    """.split()  # noqa: SIM905 - a list of words reads better
)
PRONOUNS = re.compile(
    r"\b(those|them|it|one|ones|so many|so much|some|others?|what|whom?|which of|that of|all of"
    r"|something|nothing|anything)\b"
)


def defined_names(tree: ast.Module) -> Iterator[tuple[str, int]]:
    """Yield names that a module assigns or defines, and their lines."""
    for node in ast.walk(tree):
        match node:
            case ast.Name(id=name, ctx=ast.Store()):
                yield name, node.lineno
            case ast.Attribute(attr=name, ctx=ast.Store()):
                yield name.lstrip("_"), node.lineno
            case ast.arg(arg=name) if name not in ("self", "cls"):
                yield name, node.lineno
            case ast.FunctionDef(name=name) | ast.AsyncFunctionDef(name=name):
                yield name.strip("_"), node.lineno
            case ast.ClassDef(name=name):
                yield name.strip("_").lower(), node.lineno


def docstring_heads(tree: ast.Module) -> Iterator[tuple[str, int]]:
    """Yield first lines of the docstrings of classes and functions, and their lines."""
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            docstring = ast.get_docstring(node)
            if docstring:
                yield docstring.splitlines()[0], node.lineno


def packed_assignments(tree: ast.Module) -> Iterator[int]:
    """Yield lines of assignments of a tuple to a tuple that are no swaps."""
    for node in ast.walk(tree):
        if not isinstance(node, ast.Assign):
            continue
        targets = node.targets[0]
        if isinstance(targets, ast.Tuple) and isinstance(node.value, ast.Tuple):
            names = {ast.unparse(target) for target in targets.elts}
            if names != {ast.unparse(value) for value in node.value.elts}:
                yield node.lineno


def check(root: str, listing: bool) -> bool:
    """Print the shares of a source root; return True if they are within the limits."""
    count: Counter[str] = Counter()
    places: list[str] = []
    for path in sorted((ROOT / root).rglob("*.py")):
        text = path.read_text(encoding="utf-8")
        tree = ast.parse(text)
        count["lines"] += len(text.splitlines())
        relative = path.relative_to(ROOT).as_posix()
        for name, line in defined_names(tree):
            count["names"] += 1
            if name in VAGUE_NAMES:
                count["vague"] += 1
                places.append(f"{relative}:{line}: vague name {name!r}")
        for head, line in docstring_heads(tree):
            count["docstrings"] += 1
            if pronoun := PRONOUNS.search(head):
                count["pronouns"] += 1
                places.append(f"{relative}:{line}: docstring has {pronoun[0]!r} for a noun")
        for line in packed_assignments(tree):
            count["packed"] += 1
            places.append(f"{relative}:{line}: several assignments on one line")
    vague = 100 * count["vague"] / max(count["names"], 1)
    pronouns = 100 * count["pronouns"] / max(count["docstrings"], 1)
    packed = 1000 * count["packed"] / max(count["lines"], 1)
    print(
        f"{root}: {vague:.1f} % vague names, {pronouns:.0f} % docstrings with pronouns, "
        f"{packed:.1f} packed assignments per 1,000 lines"
    )
    if listing:
        print("\n".join(places))
    return (
        vague <= MAX_VAGUE_PERCENT
        and pronouns <= MAX_PRONOUN_PERCENT
        and packed <= MAX_PACKED_PER_1000_LINES
    )


def main() -> None:
    """Check each source root; exit with 1 if one is above a limit."""
    listing = "--list" in sys.argv[1:]
    passed = [check(root, listing) for root in SOURCE_ROOTS]
    if not all(passed):
        sys.exit(
            f"limits: {MAX_VAGUE_PERCENT:g} % vague names, {MAX_PRONOUN_PERCENT:g} % docstrings "
            f"with pronouns, {MAX_PACKED_PER_1000_LINES:g} packed assignments per 1,000 lines; "
            "`python .ci/readability.py --list` prints where"
        )


if __name__ == "__main__":
    main()
