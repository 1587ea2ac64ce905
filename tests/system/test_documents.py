"""What the documents say is so: the files, links and tests that they name exist."""

from __future__ import annotations

import ast
import re
from importlib import import_module
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
DOCUMENTS = [ROOT / "README.md", *sorted(ROOT.glob("docs/**/*.md"))]


def test_the_readme_shows_the_example_as_it_is():
    example = (ROOT / "examples/survey.py").read_text(encoding="utf-8").split('"""', 2)[2].strip()
    assert example in (ROOT / "README.md").read_text(encoding="utf-8")


def test_scripts_of_the_readme_exist_as_make_targets_and_commands():
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    targets = re.findall(r"^([a-z]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.M)
    used = set(re.findall(r"\bmake ([a-z]+)", text))
    assert {"demo", "test"} <= used <= set(targets)


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


def test_a_site_that_asks_the_network_is_refused(tmp_path, monkeypatch):
    mkdocs = pytest.importorskip("mkdocs.exceptions", reason="needs the extra docs")
    monkeypatch.syspath_prepend(ROOT / "docs/hooks")
    pages = import_module("pages")
    page, config = tmp_path / "index.html", {"site_dir": str(tmp_path)}
    page.write_text(
        '<a href="https://example.org">there</a> <img src="images/live.png">'
        '<link rel="canonical" href="https://example.org/"> <script src="assets/a.js"></script>'
    )
    pages.on_post_build(config)  # links are only followed when they are clicked
    for fetched in ('<script src="https://cdn.example/a.js">', "<link href=//fonts.example/a.css>"):
        page.write_text(fetched)
        with pytest.raises(mkdocs.PluginError, match=r"index\.html: .*example"):
            pages.on_post_build(config)
