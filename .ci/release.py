"""Check that this commit can be released, and write the release notes.

The script prints each fault, and exits with status 1 if there is one. The release notes are a
section of the changelog and are written to build/release-notes.md.
"""

import re
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from datetime import date
from pathlib import Path

ROOT = Path(__file__).parent.parent
NOTES = ROOT / "build" / "release-notes.md"
VERSION_FILES = (
    "kernels/raybeam/_version.py",
    "scheduler/poolpart/_version.py",
    "workflows/lidarsim/_version.py",
)
PROJECTS = (
    "kernels", "scheduler", "workflows/lidarsim", "workflows/lidarfiles", "workflows", ".",
)  # fmt: skip
# Values that are unknown until the project has a public repository and named maintainers.
_PLACEHOLDER = re.compile(r"\bPLACEHOLDER_[A-Z]+\b")


def main() -> None:
    """Check the working tree, versions, the changelog, placeholders and the tag."""
    version = _version(VERSION_FILES[-1])
    faults = [
        *_changed_files(),
        *_versions(version),
        *_changelog(version),
        *_placeholders(),
        *_tag(f"v{version}"),
    ]
    print(*faults, sep="\n", end="\n" if faults else "")
    if faults:
        sys.exit(f"{version} cannot be released: {len(faults)} faults")
    print(f"The release notes of {version} are in {NOTES.relative_to(ROOT)}")


def _read(name: str) -> str:
    return (ROOT / name).read_text("utf-8")


def _git(*arguments: str) -> list[str]:
    done = subprocess.run(["git", *arguments], cwd=ROOT, capture_output=True, text=True, check=True)
    return done.stdout.splitlines()


def _version(name: str) -> str:
    found = re.search(r'^__version__ = "(.*)"$', _read(name), re.MULTILINE)
    return found[1] if found else ""


def _changed_files() -> Iterator[str]:
    for line in _git("status", "--porcelain"):
        yield f"{line[3:]} is not committed"


def _versions(version: str) -> Iterator[str]:
    """Yield the places that state a version other than `version`."""
    if not re.fullmatch(r"\d+\.\d+\.\d+", version):
        yield f"{VERSION_FILES[-1]}: {version} is not a release version"
    for name in VERSION_FILES:
        if _version(name) != version:
            yield f"{name} states version {_version(name)}, not {version}"
    for folder in PROJECTS:
        name = f"{folder}/pyproject.toml".removeprefix("./")
        project = tomllib.loads(_read(name))["project"]
        if project.get("version", version) != version:
            yield f"{name} states version {project['version']}, not {version}"
        for text in project["dependencies"]:
            own = re.match(r"(raybeam|poolpart|lidarsim|lidarfiles|lidarreal)\b.*==(.*)", text)
            if own and own[2] != version:
                yield f"{name} requires {text}, not version {version}"
    if f"\nversion: {version}\n" not in _read("CITATION.cff"):
        yield f"CITATION.cff does not state version {version}"


def _changelog(version: str) -> Iterator[str]:
    """Yield faults in the changelog and write the release notes."""
    sections = re.split(r"^## ", _read("CHANGELOG.md"), flags=re.MULTILINE)[1:]
    titles = [section.partition("\n")[0] for section in sections]
    notes = {
        title: section.partition("\n")[2].strip()
        for title, section in zip(titles, sections, strict=True)
    }
    if notes.get("[Unreleased]"):
        yield "CHANGELOG.md lists unreleased changes"
    title = next((title for title in titles if title.startswith(f"[{version}]")), "")
    found = re.fullmatch(r"\[.*\] - (\d{4}-\d\d-\d\d)", title)
    if not found:
        yield f"CHANGELOG.md has no section '## [{version}] - YYYY-MM-DD'"
        return
    if date.fromisoformat(found[1]) > date.today():
        yield f"CHANGELOG.md dates {version} in the future"
    if f"\ndate-released: {found[1]}\n" not in _read("CITATION.cff"):
        yield f"CITATION.cff does not state the release date {found[1]}"
    NOTES.parent.mkdir(exist_ok=True)
    NOTES.write_text(notes[title] + "\n", "utf-8")


def _placeholders() -> Iterator[str]:
    for name in _git("ls-files"):
        path = ROOT / name
        if (
            name == ".ci/release.py"
            or path.suffix in {".png", ".webp", ".glb"}
            or not path.is_file()
        ):
            continue
        for word in sorted({*_PLACEHOLDER.findall(path.read_text("utf-8", "replace"))}):
            yield f"{name}: replace {word}"


def _tag(tag: str) -> Iterator[str]:
    if tag not in _git("tag", "--points-at", "HEAD"):
        yield f"this commit has no tag {tag}"


if __name__ == "__main__":
    main()
