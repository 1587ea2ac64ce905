"""Libraries that are extras: checks for their installation, and errors as sentences."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec

from .errors import LidarError, prefixed, unreadable


def install_command(*requirements: str) -> str:
    """Return the command that installs requirements, such as ``lidarpool[las]``, here."""
    from raybeam.installation import install_command  # raybeam imports NumPy

    return install_command(*requirements)


def need(package: str, extra: str, purpose: str) -> None:
    """Check that the package of an extra is installed; LidarError if not.

    `purpose` starts the error: «clouds are read».
    """
    if find_spec(package) is None:
        raise LidarError(f"{purpose} by {package}: {install_command(f'lidarpool[{extra}]')}.")


@contextmanager
def reading(name: str) -> Iterator[None]:
    """Turn the errors of a library that reads a file into a LidarError of a line."""
    try:
        with prefixed(name):
            yield
    except LidarError:
        raise
    except OSError as error:
        file = "" if error.filename in (None, name) else f", {error.filename}"
        raise LidarError(f"{name} cannot be read: {error.strerror or error}{file}.") from error
    except Exception as error:  # libraries raise errors of any class
        raise LidarError(unreadable(name, error)) from error
