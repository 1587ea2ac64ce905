"""Loops that numba compiles, or plain Python a hundred times slower without numba."""

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
except ImportError:  # Windows: each process compiles for itself
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
    """Return whether numba has a folder for compiled code.

    Without a folder each process compiles for 20 s.
    """
    try:
        njit(cache=True)(_has_cache)
    except (RuntimeError, TypeError):  # neither beside this file nor in the user's home; no numba
        return False
    return True


_log = logging.getLogger(__name__)
# Of all loops together: a first `lidarpool check` took 24 s of processor time, a later check 4 s,
# and 30 and 5 s while the machine was busy.
COMPILING = "compiling the ray-casting loops, which takes about 20 s the first time"
COMPILING_EACH_TIME = (
    "compiling the ray-casting loops, which takes about 20 s in each process. To cache the "
    "compiled loops, set NUMBA_CACHE_DIR to a writable folder"
)
_LOG_AFTER_S = 1.0  # a single loop that has changed is compiled sooner
_seconds_spent = [0.0]  # what this process has waited for loops that were not compiled
_is_compiling = [False]  # whether the loop at hand is compiled, here or in another process
HAS_CACHE = _has_cache()  # whether compiled loops are kept for later processes


_IMPORTS = re.compile(r"^\s*from (\.+)([\w.]*) import (?:\(([^)]*)\)|(.*))$", re.MULTILINE)


@cache
def _imported_files(path: Path) -> tuple[Path, ...]:
    """Return the files that a module names in its relative imports."""
    files: list[Path] = []
    # Not by `ast`, which takes ten times as long in each process that starts.
    for dots, module, several, single in _IMPORTS.findall(path.read_text("utf-8")):
        folder = path.parents[len(dots) - 1].joinpath(*module.split("."))
        candidates = [folder.with_suffix(".py")] if module else []
        candidates += [folder / f"{name}.py" for name in re.findall(r"\w+", several or single)]
        files += [candidate for candidate in candidates if candidate.is_file()]
    return tuple(files)


@cache
def _source_stamp(path: Path) -> tuple[int, ...]:
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
            unread += _imported_files(source)
    sources.update(Path(__file__).parent.glob("*.py"))
    stats = [source.stat() for source in sorted(sources)]
    return tuple(number for stat in stats for number in (stat.st_mtime_ns, stat.st_size))


_WAIT_S = 60.0  # total for processes that compile: a process may have been stopped
_STEP_S = 0.02
_lock_depth = [0]  # depth of nested holds of the lock, by the thread that has numba's lock
_locked_folder = [""]  # folder whose lock this process has
_wait_left_s = [_WAIT_S]  # rest of the wait in this process; 0 after a wait in vain


@contextmanager
def _compile_lock(folder: str) -> Iterator[None]:
    """Let a single process compile at a time, so that further processes load the compiled code.

    A hundred workers, on any machines, that start with an empty folder compile each loop once.
    """
    with global_compiler_lock:  # keeps threads apart; compiling a loop may compile further loops
        file = None
        collects = gc.isenabled()
        gc.disable()  # an eighth of the time: numba keeps most of the objects of a compilation
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
        except OSError:  # a file system without locks
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
                    fcntl.flock(file, fcntl.LOCK_UN)  # for a forked child, too
                file.close()


def _log_if_slow(seconds: float) -> None:
    """Count the time that a loop has taken, and log once that loops are being compiled.

    Loops are compiled when modules are imported, one after the other: after the first second it is
    certain that many of them are.
    """
    if not _is_compiling[0]:
        return
    _is_compiling[0] = False
    before_s = _seconds_spent[0]
    _seconds_spent[0] += seconds
    if before_s < _LOG_AFTER_S <= _seconds_spent[0]:
        _log.info(COMPILING if HAS_CACHE else COMPILING_EACH_TIME)


def _cached(dispatcher: Any, function: Any) -> Any:
    """Cache compiled code on disk, for processes with the same sources of the package."""
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
    """Return a function that compiles or loads a loop, and counts the time."""

    def compile_and_count(*signature: Any) -> Any:
        if _lock_depth[0]:  # a loop that the loop at hand calls
            return compile_now(*signature)
        started_s = time.perf_counter()
        _is_compiling[0] = not HAS_CACHE
        code = compile_now(*signature)
        _log_if_slow(time.perf_counter() - started_s)
        return code

    return compile_and_count


def _load_compiled(cache: Any, signature: Any, target_context: Any) -> Any:
    """Return compiled code from the cache on disk, or None without whole files of the code.

    `FunctionCache.load_overload` first imports all that numba needs to compile, among it
    `scipy.linalg`: more than the half of what loading all loops takes. numba imports the same when
    it compiles.
    """
    rtsys.initialize(target_context)  # compiled code may allocate memory
    code = cache._load_overload(signature, target_context)
    if code is None:
        _is_compiling[0] = True
    return code


def _save_compiled(cache: Any, signature: Any, code: Any) -> None:
    """Keep compiled code on disk, if the disk has room and the folder can be written."""
    remove_unfinished(cache._cache_path, is_locked=_locked_folder[0] == cache._cache_path)
    try:
        cache._save_overload(signature, code)
    except OSError as error:
        warn_not_cached(cache._cache_path, error)


def compiled(*signature: Any) -> Callable[[Any], Any]:
    """Compile a function for signatures of numba or, without a signature, on the first call."""
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
    """Compile a function that compiled code calls by its address.

    As a stage it would be compiled again with each of its callers, and with the callers of these.
    Callers pass all arguments by position, since an address does not come with names.
    """

    def make(function: Any) -> Any:
        kinds = (signature.args, signature.return_type)
        c_function = _cached(CFunc(function, kinds, {}, {"error_model": "numpy"}), function)
        c_function.compile()
        _parts.append(c_function)
        name = f"raybeam_{function.__module__}_{function.__name__}"
        add_symbol(name, c_function.address)
        return ExternalFunction(name, c_function._sig)

    return make


INT64 = (types.int64,) if njit is not None else ()  # argument of a part: a number or an address
_parts: list[Any] = []  # whose addresses compiled code holds


def inlined(function: Any) -> Any:
    """Compile a function as a part of its compiled callers."""
    return _compile_inner(function, forceinline=True)


def stage(function: Any) -> Any:
    """Compile a function apart from its callers, so that its loops become vector instructions.

    As parts of a longer function the loops do not.
    """
    return _compile_inner(function)


def _compile_inner(function: Any, **options: Any) -> Any:
    """Compile a function for calls by compiled functions only.

    Python may call its `py_func`.

    Wrappers for Python would take long to compile, and so would a version for each literal number.
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
