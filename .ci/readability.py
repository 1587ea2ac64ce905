"""Check how the sources read: names, first lines of docstrings, and assignments.

Three things make a reader search: a name that does not say what its value is (`found`, `own`), a
docstring whose first line has a pronoun where a noun belongs, and several assignments on one line.
Each source root has limits for their shares, which well-kept projects stay below. A call with seven
or more arguments by position makes a reader count; all source roots together may have a few, such
as launches of CUDA kernels, signatures of compiled loops, and packed headers of packets.

Sentences with more than one fact cost time, too. `HABITS` are wordings of such sentences. A comment
behind code that begins with `FRAGMENT` makes the reader find the noun in the code. Packages in
`PLAIN_PACKAGES` have limits for both, for first lines with a semicolon, and for «see `name`».

Usage: python .ci/readability.py [--list]    (--list prints where they are)
"""

import ast
import io
import re
import sys
import tokenize
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parent.parent
SOURCE_ROOTS = ("kernels", "scheduler", "workflows")
MAX_VAGUE_PERCENT = 3.0  # of all names that are assigned or defined
MAX_PRONOUN_PERCENT = 12.0  # of all docstrings
MAX_PACKED_PER_1000_LINES = 2.0
MANY_POSITIONAL = 7  # arguments by position that a reader must count
MAX_POSITIONAL_CALLS = 20  # calls with so many arguments by position, in all source roots

# Packages whose docstrings and comments say one fact a sentence.
PLAIN_PACKAGES = (
    "kernels/raybeam",
    "scheduler/poolpart",
    "workflows/lidarpool",
    "workflows/lidarscenes",
    "workflows/lidarsim",
    "workflows/lidarview",
)
# {name: (wording, limit per 10,000 words of docstrings and comments)}
HABITS = {
    "which": (re.compile(r"\b(by|of|with|in|from|to) which\b"), 4.0),
    "those of": (re.compile(r"\b(those|that) of\b"), 1.0),
    "is no": (re.compile(r"\b(is|are) no\b(?! longer| more)"), 4.0),
    "also": (re.compile(r"\balso (if|in|by|for|of)\b|\bof (its|their) own\b"), 1.0),
}
FRAGMENT = re.compile(r"#\s*(of|in|by|for|that|to|with|if|as|from|on)\b")
MAX_FRAGMENT_PERCENT = 5.0  # of all comments behind code
MAX_SEMICOLON_PERCENT = 3.0  # of all docstrings
SEE = re.compile(r"\b[Ss]ee `")
MAX_SEE_PER_100_DOCSTRINGS = 0.5

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


def positional_calls(tree: ast.Module) -> Iterator[int]:
    """Yield lines of calls with `MANY_POSITIONAL` or more arguments by position."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Call):
            positional = [part for part in node.args if not isinstance(part, ast.Starred)]
            if len(positional) >= MANY_POSITIONAL:
                yield node.lineno


def check_calls(listing: bool) -> bool:
    """Print the number of calls with many positional arguments; return True if few."""
    findings = [
        f"{path.relative_to(ROOT).as_posix()}:{line}: call with many arguments by position"
        for root in SOURCE_ROOTS
        for path in sorted((ROOT / root).rglob("*.py"))
        for line in positional_calls(ast.parse(path.read_text(encoding="utf-8")))
    ]
    print(f"{len(findings)} calls with {MANY_POSITIONAL} or more arguments by position")
    if listing:
        print("\n".join(findings))
    return len(findings) <= MAX_POSITIONAL_CALLS


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


def docstrings(tree: ast.Module) -> Iterator[tuple[str, int]]:
    """Yield the docstrings of a module, its classes and functions, and their lines."""
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef | ast.Module):
            docstring = ast.get_docstring(node)
            if docstring:
                yield docstring, node.body[0].lineno


def comments(text: str) -> Iterator[tuple[str, int, bool]]:
    """Yield comments, their lines, and whether code stands before a comment."""
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type == tokenize.COMMENT:
            before = token.line[: token.start[1]]
            yield token.string, token.start[0], bool(before.strip())


def check_sentences(package: str, listing: bool) -> bool:
    """Print the measures of a package's sentences, and return True if all are within limits."""
    count: Counter[str] = Counter()
    findings: list[str] = []
    for path in sorted((ROOT / package).rglob("*.py")):
        text = path.read_text(encoding="utf-8")
        relative = path.relative_to(ROOT).as_posix()
        prose: list[str] = []
        for comment, line, is_behind_code in comments(text):
            prose.append(comment)
            count["comments behind code"] += is_behind_code
            if is_behind_code and FRAGMENT.match(comment):
                count["fragments"] += 1
                findings.append(f"{relative}:{line}: comment is a fragment: {comment}")
        for docstring, line in docstrings(ast.parse(text)):
            prose.append(docstring)
            count["docstrings"] += 1
            count["see"] += len(SEE.findall(docstring))
            if ";" in docstring.splitlines()[0]:
                count["semicolons"] += 1
                findings.append(f"{relative}:{line}: first line of a docstring has a semicolon")
        words = re.sub(r"\s+", " ", " ".join(prose))
        count["words"] += len(words.split())
        for name, (wording, _) in HABITS.items():
            for match in wording.finditer(words):
                count[name] += 1
                around = words[max(match.start() - 30, 0) : match.end() + 30]
                findings.append(f"{relative}: {name!r} in «{around}»")
    word_count = max(count["words"], 1)
    docstring_count = max(count["docstrings"], 1)
    measures = [
        (name, 1e4 * count[name] / word_count, limit) for name, (_, limit) in HABITS.items()
    ]
    measures += [
        (
            "% fragments",
            100 * count["fragments"] / max(count["comments behind code"], 1),
            MAX_FRAGMENT_PERCENT,
        ),
        ("% semicolons", 100 * count["semicolons"] / docstring_count, MAX_SEMICOLON_PERCENT),
        (
            "see per 100 docstrings",
            100 * count["see"] / docstring_count,
            MAX_SEE_PER_100_DOCSTRINGS,
        ),
    ]
    print(f"{package}: " + ", ".join(f"{name} {value:.1f}" for name, value, _ in measures))
    if listing:
        print("\n".join(findings))
    excesses = [
        f"{name} {value:.1f}, limit {limit:g}" for name, value, limit in measures if value > limit
    ]
    if excesses:
        print(f"{package} is above a limit: " + "; ".join(excesses))
    return not excesses


def main() -> None:
    """Check source roots, packages and calls, and exit with 1 if a measure is above its limit."""
    listing = "--list" in sys.argv[1:]
    passed = [check(root, listing) for root in SOURCE_ROOTS]
    are_plain = [check_sentences(package, listing) for package in PLAIN_PACKAGES]
    has_few_calls = check_calls(listing)
    if not all(passed):
        sys.exit(
            f"limits: {MAX_VAGUE_PERCENT:g} % vague names, {MAX_PRONOUN_PERCENT:g} % docstrings "
            f"with pronouns, {MAX_PACKED_PER_1000_LINES:g} packed assignments per 1,000 lines; "
            "`python .ci/readability.py --list` prints where"
        )
    if not all(are_plain):
        sys.exit("say one fact a sentence; `python .ci/readability.py --list` prints where")
    if not has_few_calls:
        sys.exit(
            f"at most {MAX_POSITIONAL_CALLS} calls may have so many arguments by position: name "
            "arguments; `python .ci/readability.py --list` prints where"
        )


if __name__ == "__main__":
    main()
