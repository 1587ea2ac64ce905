"""List the available backends, and select one of them."""

from __future__ import annotations

from .backend import Backend, BackendUnavailable
from .cuda_backend import CudaBackend
from .numpy_backend import NumpyBackend
from .tile_backend import TileBackend

# "auto" tries them in this order. Add new backends here.
BACKENDS: tuple[type[Backend], ...] = (CudaBackend, TileBackend, NumpyBackend)


def available_backends() -> dict[str, str]:
    """Return the availability of each backend by name, starting with the fastest backend.

    The value is "" if a backend can be used. Otherwise, it states the reason and a remedy.

    Examples
    --------
    >>> available_backends()["numpy"]
    ''
    """
    return {backend.name: backend.unavailable_reason() for backend in BACKENDS}


def backend_versions(name: str) -> str:
    """Return the versions of software, except NumPy, that affect a backend's results.

    Two processes with the same versions, and with the same version of NumPy, return bit-identical
    hits.

    Raises
    ------
    ValueError
        If no backend has this name.
    BackendUnavailable
        If the backend cannot be used on this machine.
    """
    return choose_backend(name).versions()


def choose_backend(name: str) -> type[Backend]:
    """Return the named backend, or the first available one if the name is "auto".

    Raises
    ------
    ValueError
        If no backend has this name.
    BackendUnavailable
        If the backend cannot be used on this machine.
    """
    if name == "auto":
        return next(backend for backend in BACKENDS if not backend.unavailable_reason())
    by_name = {backend.name: backend for backend in BACKENDS}
    if name not in by_name:
        raise ValueError(f"Unknown backend {name!r}. The backends are auto, {', '.join(by_name)}.")
    reason = by_name[name].unavailable_reason()
    if reason:
        raise BackendUnavailable(
            f"Backend {name!r} cannot be used: {reason}. Use 'auto' to select an available backend."
        )
    return by_name[name]
