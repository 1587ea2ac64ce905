"""Checks for optional libraries, and conversion of their exceptions to readable errors."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec

from ..errors import LidarError, message_of, prefix_errors, unreadable_message

CHECKOUT = "a checkout of lidarpool (docs/install.md#extras)"
# Distributions of a checkout in the order of their requirements, and their folders.
_FOLDERS = {
    "raybeam": "./kernels",
    "poolpart": "./scheduler",
    "lidarsim": "./workflows/lidarsim",
    "lidarfiles": "./workflows/lidarfiles",
    "lidarreal": "./workflows",
    "lidarpool": ".",
}


def install_command(*requirements: str) -> str:
    """Return the command that installs requirements, such as ``lidarpool[las]``.

    Since lidarpool is not available from a package index, its extras are installed from a checkout.
    Where lidarpool itself is not installed, the command names the installed distribution that has
    the extra.
    """
    from raybeam.installation import install_command  # raybeam imports NumPy

    words: list[str] = []
    for name in requirements:
        # The installation is editable so that changes to the checkout take effect.
        if name == "lidarpool":
            words += [word for part in _FOLDERS.values() for word in ("-e", part)]
        elif name.startswith("lidarpool["):
            words += ["-e", f"{_installed_folder()}{name.removeprefix('lidarpool')}"]
        else:
            words.append(name)
    command = install_command(*words)
    return command if words == [*requirements] else f"{command} in {CHECKOUT}"


def _installed_folder() -> str:
    """Return the folder of the highest distribution that is installed."""
    from importlib.metadata import PackageNotFoundError, version  # for errors only: it takes long

    for name in ("lidarpool", "lidarreal", "lidarfiles", "lidarsim"):
        try:
            version(name)
        except PackageNotFoundError:
            continue
        return _FOLDERS[name]
    return _FOLDERS["lidarpool"]  # not installed: the checkout is on the path


def require_package(package: str, extra: str, purpose: str) -> None:
    """Check that a package from an extra is installed.

    `purpose` is the subject of the error message, for example "Reading clouds".

    Raises
    ------
    LidarError
        If the package is not installed.
    """
    if find_spec(package) is None:
        raise LidarError(
            f"{purpose} requires {package}, which is not installed. Run "
            f"{install_command(f'lidarpool[{extra}]')}."
        )


@contextmanager
def reading(name: str) -> Iterator[None]:
    """Convert exceptions from a library that reads a file into a LidarError.

    The message is a single line that starts with the name of the file.
    """
    try:
        with prefix_errors(name):
            yield
    except LidarError:
        raise
    except OSError as error:
        file = "" if error.filename in (None, name) else f", {error.filename}"
        reason = message_of(error).rstrip(".")
        raise LidarError(f"{name} cannot be read: {reason}{file}.") from error
    except Exception as error:  # libraries may raise exceptions of any class
        raise LidarError(unreadable_message(name, error)) from error
