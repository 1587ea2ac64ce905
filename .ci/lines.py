"""Print the number of lines of each package and of the folders in it.

Usage: python .ci/lines.py [--write|--check]

``--write`` writes the numbers of the packages to ARCHITECTURE.md, in thousands. ``--check`` fails
if a number there is wrong by more than two thousand lines.
"""

import re
import sys
from pathlib import Path

ROOT = Path(__file__).parent.parent
PAGE = ROOT / "ARCHITECTURE.md"
ENDINGS = {".py", ".cu", ".js"}
# A row of the table of packages: the words before the number, the package, the number, the rest.
ROW = re.compile(r"^(\| `\w+/` \| `(\w+)` \|[^|]*\| )(\d+)( \|.*)$", re.MULTILINE)
TOLERANCE = 2  # thousand lines


def main() -> None:
    """Print a row for each package, each folder in it, and each folder of other code."""
    packages = [path for root in ("kernels", "scheduler") for path in (ROOT / root).iterdir()]
    packages += (ROOT / "workflows").iterdir()
    folders = [*packages, *(ROOT / "workflows").glob("*/*")]
    folders += [ROOT / "tests", ROOT / "benchmarks", ROOT / "docs"]
    lines = {path: _lines(path) for path in sorted(folders) if path.is_dir()}
    for path, count in lines.items():
        if count:
            print(f"{path.relative_to(ROOT).as_posix():<36}{count:>8,}")
    thousands = {path.name: round(lines[path] / 1000) for path in packages if path in lines}
    text = PAGE.read_text("utf-8")
    stated = {found[2]: int(found[3]) for found in ROW.finditer(text)}
    if "--write" in sys.argv:
        PAGE.write_text(ROW.sub(lambda row: f"{row[1]}{thousands[row[2]]}{row[4]}", text), "utf-8")
    elif "--check" in sys.argv:
        wrong = [name for name in stated if abs(stated[name] - thousands[name]) > TOLERANCE]
        if wrong or len(stated) != sum(count > 0 for count in thousands.values()):
            sys.exit("The lines of ARCHITECTURE.md are wrong: run python .ci/lines.py --write")


def _lines(folder: Path) -> int:
    sources = [path for path in folder.rglob("*") if path.suffix in ENDINGS]
    ours = [path for path in sources if ".min." not in path.name]  # minified: of other projects
    return sum(len(path.read_bytes().splitlines()) for path in ours)


if __name__ == "__main__":
    main()
