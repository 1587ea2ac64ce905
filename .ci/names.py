"""Check names in the sources.

Public classes must have unique names, and modules named in comments must exist. The script prints
each fault, and exits with status 1 if there is one.
"""

import ast
import io
import re
import sys
import tokenize
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parent.parent
SOURCES = ("kernels", "scheduler", "workflows")
OTHERS = ("tests", "benchmarks", "examples")
# A path such as lidarsim/io/tables.py.
_MODULE = re.compile(r"(?<![\w./*{}-])(?:\w+/)*\w+\.(?:py|cu)\b")


def main() -> None:
    """Check the sources of all packages."""
    texts = {path: path.read_text("utf-8") for path in _files(SOURCES, "*.py")}
    faults = [*_repeated_classes(texts), *_missing_modules(texts)]
    print(*faults, sep="\n", end="\n" if faults else "")
    sys.exit(bool(faults))


def _files(folders: tuple[str, ...], pattern: str) -> list[Path]:
    return [path for folder in folders for path in sorted((ROOT / folder).rglob(pattern))]


def _repeated_classes(texts: dict[Path, str]) -> Iterator[str]:
    places = defaultdict[str, list[str]](list)
    for path, text in texts.items():
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                places[node.name].append(f"{path.relative_to(ROOT)}:{node.lineno}")
    for name, found in places.items():
        if len(found) > 1:
            yield f"class {name} is defined in {' and '.join(found)}"


def _missing_modules(texts: dict[Path, str]) -> Iterator[str]:
    """Yield a message for each nonexistent module that a comment or docstring names."""
    paths = [*texts, *_files(OTHERS, "*.py"), *_files(SOURCES, "*.cu")]
    known = {"/".join(path.parts[-count:]) for path in paths for count in range(1, 5)}
    for path, text in texts.items():
        for name in sorted({name for note in _notes(text) for name in _MODULE.findall(note)}):
            if name not in known:
                yield f"{path.relative_to(ROOT)} names {name}, which does not exist"


def _notes(source: str) -> Iterator[str]:
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT:
            yield token.string
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)):
            yield ast.get_docstring(node) or ""


if __name__ == "__main__":
    main()
