"""Command-line options shared by the programs that draw plots and images."""

from __future__ import annotations

import argparse
from pathlib import Path

IMAGES = Path(__file__).parents[1] / "images"


def file_parser(doc: str | None, suffix: str) -> argparse.ArgumentParser:
    """Return the parser of a program that writes one file."""
    parser = argparse.ArgumentParser(description=doc)
    parser.add_argument("file", type=Path, help=f"{suffix} file to write")
    return parser


def folder_parser(doc: str | None, folder: Path) -> argparse.ArgumentParser:
    """Return the parser of a program that writes one image for each name into a folder."""
    parser = argparse.ArgumentParser(description=doc)
    parser.add_argument("folder", nargs="?", type=Path, default=folder, help="output folder")
    parser.add_argument(
        "--only", nargs="*", default=[], help="draw only the images with these names"
    )
    return parser
