"""Decorators that compile functions with numba and cache the result on disk.

Without numba, the functions run as plain Python, about a hundred times slower.
"""

from __future__ import annotations

import gc
import logging
import re
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache, partial
from pathlib import Path
from typing import Any

try:
    import fcntl
except ImportError:  # On Windows, each process compiles for itself.
    fcntl = None  # type: ignore[assignment]

try:
    from llvmlite.binding import add_symbol
    from numba import njit, types
    from numba.core.ccallback import CFunc
    from numba.core.compiler_lock import global_compiler_lock
    from numba.core.runtime.nrt import rtsys
    from numba.core.types.misc import unliteral
    from numba.types import ExternalFunction

    from .loop_files import LoopFiles, remove_unfinished, warn_not_cached
except ImportError:
    njit = None


def _has_cache() -> bool:
    """Return whether numba has a writable folder for compiled code.

    Without one, each process spends about 20 s compiling.
    """
    try:
        njit(cache=True)(_has_cache)
    except (RuntimeError, TypeError):  # no writable folder; a TypeError means that numba is missing
        return False
    return True


_log = logging.getLogger(__name__)
# Total times for all loops. The first `lidarpool check` on a machine took 24 s of CPU time and the
# next one 4 s, or 30 s and 5 s on a busy machine.
COMPILING = "compiling the ray-casting loops, which takes about 20 s the first time"
COMPILING_EACH_TIME = (
    "compiling the ray-casting loops, which takes about 20 s in each process. To cache the "
    "compiled loops, set NUMBA_CACHE_DIR to a writable folder"
)
_LOG_AFTER_S = 1.0  # compiling a single loop takes less time
_seconds_spent = [0.0]  # time that this process has waited for compilation
_is_compiling = [False]  # whether the current loop is being compiled, here or in another process
HAS_CACHE = _has_cache()  # whether compiled loops are cached on disk


_IMPORTS = re.compile(r"^\s*from (\.+)([\w.]*) import (?:\(([^)]*)\)|(.*))$", re.MULTILINE)


@cache
def _imported_files(path: Path) -> tuple[Path, ...]:
    """Return the source files that a module imports with relative imports."""
    files: list[Path] = []
    # Parsing with `ast` would take ten times as long, in each process that starts.
    for dots, module, several, single in _IMPORTS.findall(path.read_text("utf-8")):
        folder = path.parents[len(dots) - 1].joinpath(*module.split("."))
        candidates = [folder.with_suffix(".py")] if module else []
        candidates += [folder / f"{name}.py" for name in re.findall(r"\w+", several or single)]
        files += [candidate for candidate in candidates if candidate.is_file()]
    return tuple(files)


@cache
def _source_stamp(path: Path) -> tuple[int, ...]:
    """Return the modification times and sizes of all source files that affect a compiled loop.

    numba only checks the file that contains the loop. The constants and callees of a loop may also
    come from modules that this file imports, directly or indirectly, and from raybeam. Other
    modules of the package are ignored, so that the loops of the simulator are not recompiled
    whenever a command changes.
    """
    sources: set[Path] = set()
    unread = [path]
    while unread:
        source = unread.pop()
        if source not in sources:
            sources.add(source)
            unread += _imported_files(source)
    sources.update(Path(__file__).parent.glob("*.py"))
    stats = [source.stat() for source in sorted(sources)]
    return tuple(number for stat in stats for number in (stat.st_mtime_ns, stat.st_size))


# Longest total wait for other processes that compile, because such a process may be suspended.
_WAIT_S = 60.0
_STEP_S = 0.02  # pause between attempts to acquire the lock
_lock_depth = [0]  # nesting depth of `_compile_lock` in the thread that holds numba's lock
_locked_folder = [""]  # folder that this process has locked
_wait_left_s = [_WAIT_S]  # remaining time to wait for other processes


@contextmanager
def _compile_lock(folder: str) -> Iterator[None]:
    """Allow only one process at a time to compile the loops in a folder.

    The other processes wait and then load the compiled code. If a hundred workers start with an
    empty cache folder, each loop is compiled once, even if the workers run on different machines.
    """
    # numba's own lock excludes other threads. It is reentrant, because compiling a loop may compile
    # the loops that it calls.
    with global_compiler_lock:
        file = None
        collects = gc.isenabled()
        gc.disable()  # saves an eighth of the time, because most objects outlive the compilation
        try:
            if fcntl is not None and not _lock_depth[0]:
                Path(folder).mkdir(parents=True, exist_ok=True)
                file = (Path(folder) / "raybeam.lock").open("a")
                while _wait_left_s[0] > 0:
                    try:
                        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                        _locked_folder[0] = folder
                        break
                    except BlockingIOError:
                        _is_compiling[0] = True
                        time.sleep(_STEP_S)
                        _wait_left_s[0] -= _STEP_S
        except OSError:  # The file system does not support locks.
            pass
        _lock_depth[0] += 1
        try:
            yield
        finally:
            _lock_depth[0] -= 1
            (gc.enable if collects else gc.disable)()
            if file is not None:
                _locked_folder[0] = ""
                with suppress(OSError):
                    fcntl.flock(file, fcntl.LOCK_UN)  # A forked child may still have the file open.
                file.close()


def _log_if_slow(seconds: float) -> None:
    """Add to the total compilation time. Once the total is long, log a single message.

    Loops are compiled one after the other when modules are imported. If they take more than a
    second in total, many of them are being compiled, so a message is helpful.
    """
    if not _is_compiling[0]:
        return
    _is_compiling[0] = False
    before_s = _seconds_spent[0]
    _seconds_spent[0] += seconds
    if before_s < _LOG_AFTER_S <= _seconds_spent[0]:
        _log.info(COMPILING if HAS_CACHE else COMPILING_EACH_TIME)


def _cached(dispatcher: Any, function: Any) -> Any:
    """Make a dispatcher cache its compiled code on disk until the sources change."""
    if not HAS_CACHE:
        dispatcher.compile = _timed(dispatcher.compile)
        return dispatcher
    dispatcher.enable_caching()
    cache = dispatcher._cache
    stamp = _source_stamp(Path(function.__code__.co_filename))
    cache._cache_file = LoopFiles(cache._cache_path, cache._impl.filename_base, stamp)
    cache.load_overload = partial(_load_compiled, cache)
    cache.save_overload = partial(_save_compiled, cache)
    compile_now = dispatcher.compile
    folder = cache._cache_path

    def compile_in_turn(*signature: Any) -> Any:
        with _compile_lock(folder):
            return compile_now(*signature)

    dispatcher.compile = _timed(compile_in_turn)
    return dispatcher


def _timed(compile_now: Callable[..., Any]) -> Callable[..., Any]:
    """Wrap a compile function so that the time spent in it is recorded."""

    def compile_and_count(*signature: Any) -> Any:
        if _lock_depth[0]:  # The loop is called by a loop whose time is already measured.
            return compile_now(*signature)
        started_s = time.perf_counter()
        _is_compiling[0] = not HAS_CACHE
        code = compile_now(*signature)
        _log_if_slow(time.perf_counter() - started_s)
        return code

    return compile_and_count


def _load_compiled(cache: Any, signature: Any, target_context: Any) -> Any:
    """Load compiled code from the cache on disk, or return None if it is not there.

    `FunctionCache.load_overload` would first import everything that numba needs for compiling,
    including `scipy.linalg`, which accounts for more than half of the time needed to load all
    loops. When numba does compile, it imports these modules anyway.
    """
    rtsys.initialize(target_context)  # compiled code may allocate memory
    code = cache._load_overload(signature, target_context)
    if code is None:
        _is_compiling[0] = True
    return code


def _save_compiled(cache: Any, signature: Any, code: Any) -> None:
    """Store compiled code on disk, or log a warning if this fails."""
    remove_unfinished(cache._cache_path, is_locked=_locked_folder[0] == cache._cache_path)
    try:
        cache._save_overload(signature, code)
    except OSError as error:
        warn_not_cached(cache._cache_path, error)


def compiled(*signature: Any) -> Callable[[Any], Any]:
    """Compile a function for the given numba signatures, or on its first call if there are none."""
    if njit is None:
        return lambda function: function

    def make(function: Any) -> Any:
        dispatcher = _cached(
            njit(nogil=True, error_model="numpy", no_cfunc_wrapper=True)(function), function
        )
        for types in signature:
            dispatcher.compile(types)
        return dispatcher

    return make


def called_by_address(signature: Any) -> Callable[[Any], Any]:
    """Compile a function that other compiled functions call by its address.

    With `noinline`, the function would be compiled again with each of its callers, and with their
    callers. Callers must pass all arguments by position, because a call by address does not support
    keywords.
    """

    def make(function: Any) -> Any:
        kinds = (signature.args, signature.return_type)
        c_function = _cached(CFunc(function, kinds, {}, {"error_model": "numpy"}), function)
        c_function.compile()
        _called_by_address.append(c_function)
        name = f"raybeam_{function.__module__}_{function.__name__}"
        add_symbol(name, c_function.address)
        return ExternalFunction(name, c_function._sig)

    return make


# Argument type of functions decorated with `called_by_address`, which take numbers and addresses.
# It is a tuple, so that ``4 * INT64`` denotes four arguments.
INT64 = (types.int64,) if njit is not None else ()
_called_by_address: list[Any] = []  # keeps code alive whose address is compiled into other code


def inlined(function: Any) -> Any:
    """Compile a function that is inlined into the compiled functions that call it."""
    return _compile_inner(function, forceinline=True)


def noinline(function: Any) -> Any:
    """Compile a function that is not inlined into the compiled functions that call it.

    LLVM vectorizes the loops of such a function. In the middle of a longer function, this often
    fails.
    """
    return _compile_inner(function)


def _compile_inner(function: Any, **options: Any) -> Any:
    """Compile a function that is only called by compiled functions.

    No wrapper for calls from Python is generated, which saves compile time. Python can call the
    original function as `py_func`. Literal integers are treated as plain integers, so that there is
    a single version for all of them.
    """
    if njit is None:
        return function
    wrappers = {"no_cfunc_wrapper": True, "no_cpython_wrapper": True}
    dispatcher = njit(error_model="numpy", **wrappers, **options)(function)
    get_template = dispatcher.get_call_template
    dispatcher.get_call_template = lambda args, keywords: get_template(
        tuple(map(unliteral, args)), {name: unliteral(kind) for name, kind in keywords.items()}
    )
    return dispatcher
