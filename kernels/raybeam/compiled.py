"""Loops that numba compiles; without it they are plain Python, a hundred times slower."""

from __future__ import annotations

import ast
import gc
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import Any

try:
    import fcntl
except ImportError:  # Windows: each process compiles for itself
    fcntl = None  # type: ignore[assignment]

try:
    from llvmlite.binding import add_symbol
    from numba import njit
    from numba.core.ccallback import CFunc
    from numba.core.compiler_lock import global_compiler_lock
    from numba.core.types.misc import unliteral
    from numba.types import ExternalFunction
except ImportError:
    njit = None


def _keeps() -> bool:
    """Whether numba has a folder for compiled code; else each process compiles it in 20 s."""
    try:
        njit(cache=True)(_keeps)
    except (RuntimeError, TypeError):  # neither beside this file nor in the user's home; no numba
        return False
    return True


_KEEPS = _keeps()


@cache
def _imported(path: Path) -> tuple[Path, ...]:
    """Return the files that a module names in its relative imports."""
    files: list[Path] = []
    for node in ast.walk(ast.parse(path.read_bytes())):
        if isinstance(node, ast.ImportFrom) and node.level:
            package = path.parents[node.level - 1]
            module = package.joinpath(*(node.module or "").split("."))
            candidates = [module.with_suffix(".py")] if node.module else []
            candidates += [module / f"{alias.name}.py" for alias in node.names]
            files += [candidate for candidate in candidates if candidate.is_file()]
    return tuple(files)


@cache
def _stamp(path: Path) -> tuple[int, ...]:
    """Return a value that changes with each source file that a loop may depend on.

    Numba itself watches only the file of the loop. Its constants and callees come from the modules
    that this file imports, directly or not, and from raybeam. The rest of a package does not count:
    loops of the simulator need not be compiled again when a command changes.
    """
    sources: set[Path] = set()
    unread = [path]
    while unread:
        source = unread.pop()
        if source not in sources:
            sources.add(source)
            unread += _imported(source)
    sources.update(Path(__file__).parent.glob("*.py"))
    stats = [source.stat() for source in sorted(sources)]
    return tuple(number for stat in stats for number in (stat.st_mtime_ns, stat.st_size))


# in all, for processes that compile: one may have been stopped
_WAIT_S = 60.0
_STEP_S = 0.02
_held = [0]  # how often the lock is held, by the thread that has numba's lock
_patience = [_WAIT_S]  # which a process that was waited for in vain has used up


@contextmanager
def _in_turn(folder: str) -> Iterator[None]:
    """Let one process compile at a time: the others, on any machine, then load what it kept.

    A hundred workers that start with an empty folder compile each loop once.
    """
    with global_compiler_lock:  # of the threads; compiling one loop may compile another
        file = None
        collects = gc.isenabled()
        gc.disable()  # an eighth of the time: numba keeps most of the many objects that it makes
        try:
            if fcntl is not None and not _held[0]:
                Path(folder).mkdir(parents=True, exist_ok=True)
                file = (Path(folder) / "raybeam.lock").open("a")
                while _patience[0] > 0:
                    try:
                        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                        break
                    except BlockingIOError:
                        time.sleep(_STEP_S)
                        _patience[0] -= _STEP_S
        except OSError:  # a file system without locks
            pass
        _held[0] += 1
        try:
            yield
        finally:
            _held[0] -= 1
            (gc.enable if collects else gc.disable)()
            if file is not None:
                with suppress(OSError):
                    fcntl.flock(file, fcntl.LOCK_UN)  # also of a child that was forked meanwhile
                file.close()


def _kept(made: Any, function: Any) -> Any:
    """Let compiled code be loaded if this very version of the package had compiled it."""
    if not _KEEPS:
        return made
    made.enable_caching()
    made._cache._cache_file._source_stamp = _stamp(Path(function.__code__.co_filename))
    alone = made.compile
    folder = made._cache._cache_path

    def compile_in_turn(*signature: Any) -> Any:
        with _in_turn(folder):
            return alone(*signature)

    made.compile = compile_in_turn
    return made


def compiled(*signature: Any) -> Callable[[Any], Any]:
    """Compile a function of a signature of numba's; without one when it is called first."""
    if njit is None:
        return lambda function: function

    def make(function: Any) -> Any:
        made = _kept(
            njit(nogil=True, error_model="numpy", no_cfunc_wrapper=True)(function), function
        )
        for one in signature:
            made.compile(one)
        return made

    return make


def callback(signature: Any) -> Callable[[Any], Any]:
    """Compile a function that C calls."""

    def make(function: Any) -> Any:
        kind = signature.args, signature.return_type
        made = _kept(CFunc(function, kind, {}, {"error_model": "numpy"}), function)
        made.compile()
        return made

    return make


def external(name: str, made: Any) -> Any:
    """Let compiled functions call a callback by its address, under a name."""
    add_symbol(name, made.address)
    return ExternalFunction(name, made._sig)


def inlined(function: Any) -> Any:
    """Let a function become part of compiled ones."""
    return _inner(function, forceinline=True)


def stage(function: Any) -> Any:
    """Compile a function by itself before others call it: so its loops become vector instructions.

    As a part of a longer function they do not.
    """
    return _inner(function)


def _inner(function: Any, **options: Any) -> Any:
    """Compile a function that only compiled ones may call: from Python, call its `py_func`.

    Wrappers for Python would take long to compile, and so would a version for each literal number.
    """
    if njit is None:
        return function
    wrappers = {"no_cfunc_wrapper": True, "no_cpython_wrapper": True}
    made = njit(error_model="numpy", **wrappers, **options)(function)
    found = made.get_call_template
    made.get_call_template = lambda args, more: found(tuple(map(unliteral, args)), more)
    return made
