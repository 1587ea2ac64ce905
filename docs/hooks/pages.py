"""Add pages to the site: README files, the reference, and sources that pages link to.

MkDocs calls the functions whose names begin with `on_`.
"""

from __future__ import annotations

import posixpath
import re
from pathlib import Path
from typing import Any

from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files

# MkDocs puts this folder on the path while it loads hooks.
from reference_pages import (
    campaign_page,
    columns_page,
    command_page,
    members_page,
    scenario_page,
    vehicle_page,
)

ROOT = Path(__file__).parents[2]

# Pages that are kept elsewhere in the repository. {file: page}
_ELSEWHERE = {
    "README.md": "index.md",
    "ARCHITECTURE.md": "architecture.md",
    "CHANGELOG.md": "changelog.md",
    "CONTRIBUTING.md": "contributing.md",
    "benchmarks/README.md": "benchmarks.md",
}
# Sources that the reference shows in a better way. {file: page}
_SHOWN = {"workflows/lidarsim/columns/table.py": "reference/columns.md"}
# Input files of examples, which readers download. Sources of other kinds are shown as pages.
_DOWNLOADS = {".csv", ".glb", ".gz", ".obj", ".png", ".tif", ".urdf", ".usdc"}
_LINK = re.compile(r"(\]\()([^)#\s]+)([^)]*\))")
# What a browser would fetch by itself, from elsewhere.
_FETCHED = re.compile(
    r"""(?:<(?:script|img|iframe)\b[^>]*\bsrc=|<link\b(?![^>]*\bcanonical)[^>]*\bhref=)"""
    r"""["']?(?:https?:)?//[^\s"'>]+""",
)


def on_config(config: Any) -> Any:
    """Replace folders in the navigation, such as `how-to/mesh-formats/`, with their pages."""
    config["nav"] = _with_pages(config["nav"], Path(config["docs_dir"]))
    return config


def _with_pages(nav: list[Any], docs: Path) -> list[Any]:
    """Replace the folders in a navigation with their pages, sorted by file name."""
    entries: list[Any] = []
    for entry in nav:
        if isinstance(entry, str) and entry.endswith("/"):
            entries += [f"{entry}{page.name}" for page in sorted((docs / entry).glob("*.md"))]
        elif isinstance(entry, dict):
            entries.append(
                {
                    title: _with_pages(inner, docs) if isinstance(inner, list) else inner
                    for title, inner in entry.items()
                }
            )
        else:
            entries.append(entry)
    return entries


def on_files(files: Files, config: Any) -> Files:
    """Add the README and similar files, the reference, and all sources that pages link to."""
    pages = {
        page: _relinked((ROOT / file).read_text("utf-8"), file, page, files, config)
        for file, page in _ELSEWHERE.items()
    }
    pages["reference/command.md"] = command_page()
    pages["reference/scenario.md"] = scenario_page()
    pages["reference/campaign.md"] = campaign_page()
    pages["reference/vehicle.md"] = vehicle_page()
    pages["reference/columns.md"] = columns_page()
    for package in ("lidarpool", "poolpart", "poolpart.deploy", "raybeam"):
        pages[f"reference/{package}.md"] = members_page(package)
    # Pages of linked sources must be there before MkDocs reads the first page of docs/.
    for file in list(files.documentation_pages()):
        _relinked(file.content_string, f"docs/{file.src_uri}", file.src_uri, files, config)
    for page, content in pages.items():
        files.append(File.generated(config, page, content=content))
    return files


def on_page_markdown(markdown: str, page: Any, config: Any, files: Files) -> str:
    """Redirect links from docs/ to other folders to the corresponding pages of the site."""
    if page.file.abs_src_path is None:  # generated: done already
        return markdown
    path = page.file.src_uri
    return _relinked(markdown, f"docs/{path}", path, files, config)


def on_post_build(config: Any) -> None:
    """Reject a site whose pages would load resources from other servers."""
    found = [
        f"{path.relative_to(config['site_dir'])}: {match}"
        for path in sorted(Path(config["site_dir"]).rglob("*.html"))
        for match in _FETCHED.findall(path.read_text("utf-8"))
    ]
    if found:
        raise PluginError("The site asks the network for\n" + "\n".join(found))


def _relinked(text: str, file: str, page: str, files: Files, config: Any) -> str:
    """Adjust the links in a repository file for its page on the site."""

    def relink(match: re.Match[str]) -> str:
        target = match[2]
        if "://" in target or target.startswith("mailto:"):
            return match[0]
        in_repository = posixpath.normpath(posixpath.join(posixpath.dirname(file), target))
        in_site = _page_of(in_repository, files, config)
        relative = posixpath.relpath(in_site, posixpath.dirname(page) or ".")
        return f"{match[1]}{relative}{match[3]}"

    return _LINK.sub(relink, text)


def _page_of(path: str, files: Files, config: Any) -> str:
    """Return the path on the site that shows a repository file.

    Source files have pages on the site, and input files are copied to it.
    """
    if shown := (_ELSEWHERE | _SHOWN).get(path):
        return shown
    if path.startswith("docs/"):
        return path.removeprefix("docs/")
    source = ROOT / path
    if not source.is_file():
        return path  # MkDocs warns of it
    is_download = source.suffix in _DOWNLOADS
    page = f"sources/{path}" if is_download else f"sources/{path}.md"
    if files.get_file_from_path(page) is None and is_download:
        files.append(File.generated(config, page, abs_src_path=str(source)))
    elif files.get_file_from_path(page) is None:
        kind = {".py": "python", ".yaml": "yaml", ".sh": "sh"}.get(source.suffix, "text")
        fence = "`" * 4
        content = f"# {path}\n\n{fence}{kind}\n{source.read_text('utf-8')}\n{fence}\n"
        added = File.generated(config, page, content=content)
        files.append(added)
    return page
