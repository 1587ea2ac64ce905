"""Installation commands that are shown in error messages."""

from __future__ import annotations

import sys
from importlib.util import find_spec
from pathlib import Path


def install_command(*requirements: str) -> str:
    """Return the command that installs the given requirements in this process's environment.

    A requirement may have a version, for example ``pye57>=0.4``. Environments created by uv do not
    contain pip, and conda environments may lack it.
    """
    words = [f'"{word}"' if {*word} & {*"[]<>="} else word for word in requirements]
    pip_install = " ".join(["pip install", *words])
    if find_spec("pip") is not None:
        return pip_install
    prefix = Path(sys.prefix)
    if (prefix / "conda-meta").is_dir():
        return f"conda install pip && {pip_install}"
    if _created_by_uv(prefix):
        return f"uv {pip_install}"
    return f"python -m ensurepip && python -m {pip_install}"


def _created_by_uv(prefix: Path) -> bool:
    """Return whether uv created a given virtual environment."""
    try:
        settings = (prefix / "pyvenv.cfg").read_text("utf-8")
    except OSError:
        return False
    return any(line.partition("=")[0].strip() == "uv" for line in settings.splitlines())
