"""Record of the tests that execute each line, and the choice of tests for a fault."""

import ast
import json
import os
import re
import subprocess
import sys
from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cache
from hashlib import sha256
from pathlib import Path

from tests.mutants.faults import ROOTS, Fault, function_spans

Spans = dict[str, tuple[int, int]]  # first and last line of functions, by qualified name

_TEST_S = 0.05  # added to the time of a test: sets that are alike in time should be small


@dataclass
class Lines:
    """Record of the lines that each test executes, and of the duration of each test.

    Attributes
    ----------
    tests
        Names of the tests.
    seconds
        Duration of each test, in seconds, with set-up and tear-down.
    lines
        Numbers of the tests that execute each line, by file.
    spans
        First and last line of the functions of each file, when it was recorded.
    checksums
        Checksums of the files, when they were recorded.
    counts
        Number of lines that each test executes.
    """

    tests: list[str]
    seconds: dict[str, float]
    lines: dict[str, dict[int, set[int]]]
    spans: dict[str, Spans]
    checksums: dict[str, str]
    counts: Counter[str] = field(default_factory=Counter)

    def __post_init__(self) -> None:
        """Count the lines that each test executes."""
        for by_line in self.lines.values():
            for tests in by_line.values():
                self.counts.update(self.tests[number] for number in tests)

    @classmethod
    def record(
        cls, root: Path, folder: Path, files: Sequence[str], pytest_options: list[str]
    ) -> "Lines":
        """Run tests with `recorder`, write ``lines.json``, and return its content.

        If `files` are given, the records of all other test files are kept.
        """
        for path in folder.glob("gw*.json"):
            path.unlink()
        command = [sys.executable, "-m", "pytest", "-q", "-p", "tests.mutants.recorder"]
        environment = os.environ | {"LIDARPOOL_MUTANTS": str(folder)}
        subprocess.run([*command, *pytest_options, *files], cwd=root, env=environment, check=False)
        path = folder / "lines.json"
        is_update = bool(files) and path.is_file()
        recorded = cls.read(path) if is_update else cls([], {}, {}, {}, {})
        for part in folder.glob("gw*.json"):
            recorded._add(root, json.loads(part.read_text()))
        recorded._write(path)
        return cls.read(path)

    @classmethod
    def read(cls, path: Path) -> "Lines":
        """Read a file written by `record`."""
        content = json.loads(path.read_text())
        lines = {
            file: {int(line): set(tests) for line, tests in by_line.items()}
            for file, by_line in content.pop("lines").items()
        }
        return cls(lines=lines, **content)

    def tests_of(self, root: Path, fault: Fault) -> list[str]:
        """Return the tests that may detect a fault. Quick tests with few lines come first.

        These are the tests that execute the fault's line. No such tests are recorded for compiled
        loops and for lines that only other processes execute. For these, the result contains the
        tests that execute a function in which a name from the fault's module occurs, directly or
        through other compiled loops, or which runs the module as a script.
        """
        numbers = self._executing(root, fault)
        if not numbers:
            numbers = self._using(root, fault.path)
        tests = [self.tests[number] for number in numbers]
        tests = [test for test in tests if _is_there(root, test)]
        return sorted(tests, key=lambda test: self.cost(test) * self.counts[test])

    def cost(self, test: str) -> float:
        """Return the estimated duration of a test in seconds."""
        return self.seconds.get(test, 1.0) + _TEST_S

    def _executing(self, root: Path, fault: Fault) -> set[int]:
        if self.checksums.get(fault.path) == _checksum((root / fault.path).read_text()):
            return self.lines[fault.path].get(fault.line, set())
        span = self.spans.get(fault.path, {}).get(fault.function)
        if span is None:  # a function that is new since the lines were recorded
            return set[int]().union(*self.lines.get(fault.path, {}).values())
        return self._in_span(fault.path, span)

    def _using(self, root: Path, module: str) -> set[int]:
        """Return the tests that execute functions in which a name from the module occurs."""
        numbers: set[int] = set()
        for path, module_names in _importers(root, module).items():
            lines = (root / path).read_text().splitlines()
            spans = [*self.spans.get(path, {}).values()]
            using = [
                (first, last)
                for first, last in spans
                if module_names & {*re.findall(r"\w+", "\n".join(lines[first - 1 : last]))}
            ]
            for span in using or spans:  # a constant may have the name
                numbers |= self._in_span(path, span)
        return numbers

    def _in_span(self, path: str, span: tuple[int, int]) -> set[int]:
        by_line = self.lines.get(path, {})
        found = (by_line.get(line, set()) for line in range(span[0], span[1] + 1))
        return set[int]().union(*found)

    def _add(self, root: Path, record: dict) -> None:
        """Add the record of one process.

        Lines are converted to those of the files when they were first recorded.
        """
        numbers = {name: number for number, name in enumerate(self.tests)}
        own = [numbers.setdefault(name, len(numbers)) for name in record["tests"]]
        self.tests = [*numbers]
        for path, by_line in record["lines"].items():
            source = (root / path).read_text()
            spans = function_spans(source)
            first_spans = self.spans.setdefault(path, spans)
            is_changed = self.checksums.setdefault(path, _checksum(source)) != _checksum(source)
            lines = self.lines.setdefault(path, {})
            for text, tests in by_line.items():
                line = int(text)
                if is_changed:
                    line = _moved(line, spans, first_spans)
                lines.setdefault(line, set()).update(own[test] for test in tests)
        for test, seconds in record["seconds"].items():
            self.seconds[test] = max(seconds, self.seconds.get(test, 0.0))

    def _write(self, path: Path) -> None:
        lines = {
            file: {line: sorted(tests) for line, tests in by_line.items()}
            for file, by_line in self.lines.items()
        }
        content = {**vars(self), "lines": lines}
        del content["counts"]
        path.write_text(json.dumps(content))


def _moved(line: int, spans: Spans, first_spans: Spans) -> int:
    """Return the recorded first line of the function that contains a line.

    Return 0 if there was no such function.
    """
    names = [name for name, (first, last) in spans.items() if first <= line <= last]
    return next((first_spans[name][0] for name in names if name in first_spans), 0)


@cache
def _content(path: Path) -> str:
    return path.read_text() if path.is_file() else ""


def _is_there(root: Path, test: str) -> bool:
    """Return whether a recorded test still exists with the same name."""
    path, _, name = test.partition("::")
    return f"def {name.rpartition('::')[2]}(" in _content(root / path)


def _importers(root: Path, path: str) -> dict[str, set[str]]:
    """Return the files that import a file, directly or through modules with compiled loops.

    Each file is mapped to the public names of the modules through which it imports the file.
    """
    imports = _imports(root)
    found: dict[str, set[str]] = defaultdict(set)
    waiting = [path]
    seen = {path}
    while waiting:
        module = waiting.pop()
        names = {Path(module).stem, *_public_names((root / module).read_text())}
        for importer, imported in imports.items():
            if module not in imported:
                continue
            found[importer] |= names
            if importer not in seen and _has_loops((root / importer).read_text()):
                seen.add(importer)
                waiting.append(importer)
    return found


def _public_names(source: str) -> list[str]:
    """Return the names of all functions and classes in a module."""
    kinds = ast.FunctionDef | ast.ClassDef
    return [node.name for node in ast.parse(source).body if isinstance(node, kinds)]


def _has_loops(source: str) -> bool:
    return "raybeam.compiled" in source or "from .compiled import" in source


_known_imports: dict[Path, dict[str, set[str]]] = {}


def _imports(root: Path) -> dict[str, set[str]]:
    """Return the imported source files of each source file."""
    if root not in _known_imports:
        files = {
            path.relative_to(root).as_posix(): path
            for source_root in ROOTS
            for path in (root / source_root).rglob("*.py")
        }
        _known_imports[root] = {name: _imported(root, path, files) for name, path in files.items()}
    return _known_imports[root]


def _imported(root: Path, path: Path, files: dict[str, Path]) -> set[str]:
    candidates: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Constant) and str(node.value).endswith(".py"):
            # A script beside the module, which runs in a process of its own.
            candidates.add(path.relative_to(root).with_name(Path(str(node.value)).name).as_posix())
        if not isinstance(node, ast.ImportFrom):
            continue
        words = (node.module or "").split(".") if node.module else []
        if node.level:
            folders = [path.parents[node.level - 1]]
        else:
            folders = [root / source_root for source_root in ROOTS]
        for folder in folders:
            module = folder.joinpath(*words)
            candidates.add(module.with_suffix(".py").relative_to(root).as_posix())
            for alias in node.names:
                candidates.add((module / f"{alias.name}.py").relative_to(root).as_posix())
    return candidates & files.keys()


def _checksum(source: str) -> str:
    return sha256(source.encode()).hexdigest()
