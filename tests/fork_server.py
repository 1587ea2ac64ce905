"""A process that has imported a library, and forks itself for each file: a quarter of the time."""

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from types import SimpleNamespace
from typing import Any

USD_CORE = """
from pxr import Usd, UsdGeom, UsdUtils
UsdGeom.Mesh.Define(Usd.Stage.CreateInMemory(), "/Mesh")  # which loads most of the library
UsdUtils.CoalescingDiagnosticDelegate()
"""

IFCOPENSHELL = "import ifcopenshell.geom, ifcopenshell.util.geolocation, ifcopenshell.util.unit"


class ForkServer:
    """Takes the place of `subprocess.Popen` for `lidarscenes.files.child_process`."""

    def __init__(self, preload: str) -> None:
        pipes: Any = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
        self._process = subprocess.Popen([sys.executable, "-P", __file__, preload], **pipes)

    def close(self) -> None:
        self._process.communicate()

    @contextmanager
    def __call__(self, args: list[Any], **options: Any) -> Iterator[Any]:
        with TemporaryDirectory() as folder:
            os.mkfifo(pipe := f"{folder}/pipe")
            asked = [*map(str, args[2:])], str(options["cwd"]), options["env"], pipe
            print(json.dumps(asked), file=self._process.stdin, flush=True)
            with open(pipe, "rb") as read:  # noqa: PTH123
                wait = cache(lambda: int(self._process.stdout.readline()))
                try:
                    yield SimpleNamespace(stdout=read, wait=wait, kill=read.close)
                finally:
                    read.close()
                    wait()


def serve() -> None:
    exec(sys.argv[1], {})
    compiled = cache(lambda path: compile(Path(path).read_text(), path, "exec"))
    for line in sys.stdin:
        args, cwd, env, pipe = json.loads(line)
        code = compiled(args[0])
        if (child := os.fork()) == 0:
            os.dup2(os.open(pipe, os.O_WRONLY), 1)
            os.closerange(3, 256)
            os.chdir(cwd)
            os.environ.update(env)
            sys.argv = args
            exec(code, {"__name__": "__main__"})
        sys.stdout.write(f"{os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])}\n")
        sys.stdout.flush()


if __name__ == "__main__":
    serve()
