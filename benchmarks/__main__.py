"""List the benchmarks: `python -m benchmarks`."""

from __future__ import annotations

import argparse
import ast
from pathlib import Path


def summaries() -> dict[str, str]:
    """Return the first docstring line of each benchmark, keyed by module name."""
    docstrings = {
        path.stem: ast.get_docstring(ast.parse(path.read_text("utf-8"))) or ""
        for path in sorted(Path(__file__).parent.glob("*.py"))
    }
    return {
        name: docstring.partition("\n")[0]
        for name, docstring in docstrings.items()
        if f"python -m benchmarks.{name}" in docstring
    }


if __name__ == "__main__":
    argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__).parse_args()
    for name, summary in summaries().items():
        print(f"{name:<14}{summary}")
