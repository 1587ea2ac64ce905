"""Detect whether several copies of lidarpool are installed. Python imports only one."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from importlib.metadata import PackageNotFoundError, distribution
from importlib.util import find_spec
from pathlib import Path
from urllib.parse import urlsplit
from urllib.request import url2pathname

from lidarfiles.identity.versions import PACKAGES
from lidarsim.environment.extras import install_command

_FOLDERS_OF_CHECKOUT = ("kernels", "scheduler", "workflows")


def find_second_copy() -> str:
    """Return a warning if a second copy of the packages is installed, or an empty string."""
    roots = {name: root for name in PACKAGES if (root := _root_of(name)) is not None}
    root = roots.get("lidarpool")
    if root is None:
        return ""
    for name, other in roots.items():
        if other != root:
            return (
                f"There are two copies of lidarpool's packages: {name} is imported from {other}, "
                f"and lidarpool from {root}. {_REMEDY}"
            )
    if _is_chosen(root, os.environ):
        return ""
    for checkout in (_editable_checkout(), _checkout_of(Path.cwd())):
        if checkout not in (None, root):
            return (
                f"There are two copies of lidarpool: it is imported from {root}, so changes in "
                f"{checkout} have no effect. {_REMEDY}"
            )
    return ""


_REMEDY = (
    f"Uninstall lidarpool, lidarreal, lidarfiles, lidarsim, poolpart and raybeam, then "
    f"run {install_command('lidarpool')}"
)


def _root_of(package: str) -> Path | None:
    """Return the checkout or site-packages folder from which Python imports a package."""
    spec = find_spec(package)
    if spec is None or spec.origin is None:
        return None
    folder = Path(spec.origin).resolve().parents[1]
    return folder.parent if folder.name in _FOLDERS_OF_CHECKOUT else folder


def _is_chosen(root: Path, environment: Mapping[str, str]) -> bool:
    """Return True if PYTHONPATH contains the checkout."""
    entries = environment.get("PYTHONPATH", "").split(os.pathsep)
    return any(Path(entry).resolve().is_relative_to(root) for entry in entries if entry)


def _editable_checkout() -> Path | None:
    """Return the checkout of an editable installation, or None if there is none."""
    try:
        text = distribution("lidarpool").read_text("direct_url.json")
    except PackageNotFoundError:
        return None
    source = json.loads(text or "{}")
    if not source.get("dir_info", {}).get("editable"):
        return None
    return Path(url2pathname(urlsplit(source["url"]).path)).resolve()


def _checkout_of(folder: Path) -> Path | None:
    for candidate in (folder.resolve(), *folder.resolve().parents):
        if (candidate / "workflows" / "lidarpool" / "__init__.py").is_file():
            return candidate
    return None
