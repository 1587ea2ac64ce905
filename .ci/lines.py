"""Print the number of lines of each package.

The numbers are only for information: there are no limits.
"""

from pathlib import Path

ROOT = Path(__file__).parent.parent
ENDINGS = {".py", ".cu", ".js"}


def main() -> None:
    """Print one row for each package, the tests, the benchmarks, and the documentation code."""
    packages = [path for root in ("kernels", "scheduler") for path in (ROOT / root).iterdir()]
    packages += (ROOT / "workflows").glob("*/*")
    packages += [ROOT / "tests", ROOT / "benchmarks", ROOT / "docs"]
    for package in sorted(path for path in packages if path.is_dir()):
        sources = [path for path in package.rglob("*") if path.suffix in ENDINGS]
        ours = [path for path in sources if ".min." not in path.name]  # minified: of other projects
        lines = sum(len(path.read_bytes().splitlines()) for path in ours)
        if lines:
            print(f"{package.relative_to(ROOT).as_posix():<36}{lines:>8,}")


if __name__ == "__main__":
    main()
