"""Libraries that are extras: checks for their installation, and errors as sentences."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec

from ..errors import LidarError, message_of, prefixed, unreadable

CHECKOUT = "a checkout of lidarpool (docs/install.md#extras)"
_PARTS = ("./kernels", "./scheduler", "./workflows/lidarsim", ".")  # distributions of a checkout


def install_command(*requirements: str) -> str:
    """Return the command that installs requirements, such as ``lidarpool[las]``, here.

    lidarpool is not on a package index. It is installed from a checkout, and so are its extras.
    """
    from raybeam.installation import install_command  # raybeam imports NumPy

    words: list[str] = []
    for name in requirements:
        # Editable, because a copy next to a checkout would hide changes of the checkout.
        if name == "lidarpool":
            words += [word for part in _PARTS for word in ("-e", part)]
        elif name.startswith("lidarpool["):
            words += ["-e", f".{name.removeprefix('lidarpool')}"]
        else:
            words.append(name)
    command = install_command(*words)
    return command if words == [*requirements] else f"{command} in {CHECKOUT}"


def need(package: str, extra: str, purpose: str) -> None:
    """Check that the package of an extra is installed.

    Raises LidarError if not.

    `purpose` is the subject of the error message, such as "Reading clouds".
    """
    if find_spec(package) is None:
        raise LidarError(
            f"{purpose} requires {package}, which is not installed. Run "
            f"{install_command(f'lidarpool[{extra}]')}."
        )


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
        reason = message_of(error).rstrip(".")
        raise LidarError(f"{name} cannot be read: {reason}{file}.") from error
    except Exception as error:  # libraries raise errors of any class
        raise LidarError(unreadable(name, error)) from error
