"""Kernel files: read, compiled on first use, launched."""

from __future__ import annotations

import importlib.resources
from functools import lru_cache
from typing import Any

_BLOCK = 128  # threads; the kernels are bound to it


class Kernels:
    """The kernels of one .cu file, compiled for the current device.

    Parameters
    ----------
    cupy
        CuPy, or what stands in for it.
    device
        Number of the current device; compiled modules are kept by it.
    file
        Name of a .cu file of this package.
    flags
        Compiler options, see `options`.
    """

    def __init__(self, cupy: Any, device: int, file: str, flags: tuple[str, ...]) -> None:
        self.module = _module(cupy, device, file, flags)

    def run(self, kernel: str, threads: int, *arguments: Any) -> None:
        """Launch a kernel with one thread an item; nothing happens when there are none.

        A grid has one dimension, of fewer than 2**31 blocks: room for 2**38 items.
        """
        if threads:
            grid = (-(-threads // _BLOCK),)
            self.module.get_function(kernel)(grid, (_BLOCK,), arguments)


def source(file: str) -> str:
    """Text of a .cu file, with its name for the compiler's messages."""
    text = importlib.resources.files(__package__).joinpath(file).read_text("utf-8")
    return f'#line 1 "{file}"\n{text}'


def options(**defined: float) -> tuple[str, ...]:
    """Compiler options; each keyword becomes a macro."""
    return (
        "-std=c++17",
        "-fmad=false",
        *(f"-D{name}={value!r}" for name, value in defined.items()),
    )


@lru_cache(maxsize=64)
def _module(cupy: Any, device: int, file: str, flags: tuple[str, ...]) -> Any:
    """Compile for the current device, once."""
    module = cupy.RawModule(code=source(file), options=flags)
    module.compile()
    return module
