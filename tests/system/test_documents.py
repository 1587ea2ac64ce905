"""What the documents say is so: the files, links and tests that they name exist."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
DOCUMENTS = [ROOT / "README.md", *sorted(ROOT.glob("docs/**/*.md"))]


def test_the_readme_shows_the_example_as_it_is():
    example = (ROOT / "examples/survey.py").read_text(encoding="utf-8").split('"""', 2)[2].strip()
    assert example in (ROOT / "README.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("path", [*sorted(ROOT.glob("*.md")), *DOCUMENTS[1:]])
def test_links_lead_somewhere(path):
    text = path.read_text(encoding="utf-8")
    for target in re.findall(r"\]\(([^)#\s]+)[^)]*\)", text):
        if not target.startswith("https://"):
            assert (path.parent / target).exists(), target


def test_tests_that_the_documents_name_exist():
    written = {
        (path.name, node.name)
        for path in (ROOT / "tests").rglob("test_*.py")
        for node in ast.parse(path.read_text(encoding="utf-8")).body
        if isinstance(node, ast.FunctionDef)
    }
    named = {
        (file, name)
        for path in DOCUMENTS
        for file, name in re.findall(r"`(test_\w+\.py)::(test_\w+)`", path.read_text("utf-8"))
    }
    assert len(named) > 30
    assert named - written == set()


def test_files_that_the_architecture_names_exist():
    text = (ROOT / "ARCHITECTURE.md").read_text(encoding="utf-8")
    tree = {
        str(p.relative_to(ROOT))
        for d in ("kernels", "scheduler", "workflows")
        for p in (ROOT / d).rglob("*")
    }
    named = set(re.findall(r"`([\w/.]+\.(?:py|cu|yaml))(?::[^`]*)?`", text)) - {"scenario.yaml"}
    assert len(named) > 10
    assert [
        name for name in sorted(named) if not any(f"/{f}".endswith(f"/{name}") for f in tree)
    ] == []
