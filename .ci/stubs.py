"""Write `__init__.pyi` of each package whose public names are imported when they are first used.

Type checkers and editors read these files instead of the tables in `__init__.py`.

Usage: python .ci/stubs.py [--check]
"""

import ast
import sys
from collections.abc import Iterator
from pathlib import Path

WORKFLOWS = Path(__file__).parent.parent / "workflows"


def main() -> None:
    """Write the stubs, or with ``--check`` fail if one differs from its table."""
    different = []
    for package in sorted(WORKFLOWS.glob("*/__init__.py")):
        table = _table(package.read_text("utf-8"))
        stub = package.with_suffix(".pyi")
        text = "".join(_lines(table)) if table else ""
        if text and (not stub.exists() or stub.read_text("utf-8") != text):
            different.append(stub.relative_to(WORKFLOWS.parent).as_posix())
            if "--check" not in sys.argv:
                stub.write_text(text, encoding="utf-8")
    if different and "--check" in sys.argv:
        sys.exit(f"{' and '.join(different)} differ: run python .ci/stubs.py")


def _table(source: str) -> dict[str, str]:
    """Return the names of each module, which a package passes to `lazy_names`."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "lazy_names":
            table: dict[str, str] = ast.literal_eval(node.args[1])
            return table
    return {}


def _lines(table: dict[str, str]) -> Iterator[str]:
    for module in sorted(table, key=lambda module: (module.startswith("."), module)):
        for name in table[module].split():
            yield f"from {module} import {name} as {name}\n"
    names = sorted(name for names in table.values() for name in names.split())
    yield "\n__all__ = [\n" + "".join(f'    "{name}",\n' for name in names) + "]\n"


if __name__ == "__main__":
    main()
