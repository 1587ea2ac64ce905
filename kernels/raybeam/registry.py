"""The list of engines, and choosing one."""

from __future__ import annotations

from .backend import Backend, BackendUnavailable
from .cuda_backend import CudaBackend
from .embree_backend import EmbreeBackend
from .numpy_backend import NumpyBackend

# In the order in which "auto" tries them. Add new backends here.
_BACKENDS: tuple[type[Backend], ...] = (CudaBackend, EmbreeBackend, NumpyBackend)


def available_backends() -> dict[str, str]:
    """Backends by name, fastest first: "" for a usable one, else why it is not usable.

    Examples
    --------
    >>> available_backends()["numpy"]
    ''
    """
    return {backend.name: backend.missing() for backend in _BACKENDS}


def backend_build(name: str) -> str:
    """Describe what the bits of a backend depend on, beside NumPy's version.

    Two processes in which these and NumPy's are the same give the same hits, to the bit.

    Raises
    ------
    ValueError, BackendUnavailable
        As of `RayCaster`, if there is no such backend here.
    """
    return choose(name).build()


def choose(name: str) -> type[Backend]:
    """Return the backend of that name, or for "auto" the first that can be used.

    Raises
    ------
    ValueError
        If there is no backend of that name.
    BackendUnavailable
        If it cannot be used on this machine.
    """
    if name == "auto":
        return next(backend for backend in _BACKENDS if not backend.missing())
    by_name = {backend.name: backend for backend in _BACKENDS}
    if name not in by_name:
        raise ValueError(f"There is no backend {name!r}: use auto, {', '.join(by_name)}.")
    reason = by_name[name].missing()
    if reason:
        raise BackendUnavailable(
            f"Backend {name!r} cannot be used here: {reason}. Backend 'auto' takes what works."
        )
    return by_name[name]
