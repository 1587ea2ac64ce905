"""Count the imported names that would run upwards if lidarpool were divided into smaller packages.

Lidar files, scenarios, recordings and live programs are going to be packages of their own. Until
then, this script checks that a module imports nothing from a module that will be in a package above
its own.

Usage: python .ci/planned_packages.py
"""

import ast
import sys
from collections.abc import Iterator
from pathlib import Path

WORKFLOWS = Path(__file__).parent.parent / "workflows"
# From top to bottom. Packages in the same row do not import each other.
LAYERS = [
    ("lidarpool",),
    ("lidarlive",),
    ("lidarreal",),
    ("lidarscenario",),
    ("lidarview", "lidarscenes"),
    ("lidarfiles",),
    ("lidarsim",),
]
# Packages of the modules whose names begin like this. The longest beginning counts.
PLANNED = {
    "lidarsim": "lidarsim",
    "lidarscenes": "lidarscenes",
    "lidarview": "lidarview",
    "lidarpool": "lidarpool",
    **{
        f"lidarpool.{name}": "lidarfiles"
        for name in (
            "clouds", "recordings", "datasets", "columns", "open3d_access", "plugins", "work",
            "identity.fingerprint", "identity.sealed", "identity.field_words", "identity.versions",
            "processes.per_process", "processes.processors", "processes.freed_memory",
        )
    },
    "lidarfiles.picture_file": "lidarfiles",
    "lidarfiles.color_table": "lidarfiles",
    **{
        f"lidarpool.{name}": "lidarscenario"
        for name in ("scenario", "plan", "mounting", "occupancy", "identity.shard")
    },
    **{
        f"lidarpool.{name}": "lidarreal"
        for name in ("scan_patterns", "comparing", "augmentation", "reconstruction")
    },
    **{
        f"lidarpool.{name}": "lidarlive"
        for name in ("playback", "following", "serving", "viewers")
    },
    **{
        f"lidarsim.packets.{name}": "lidarlive"
        for name in (
            "hesai_ptc", "http_service", "livox_commands", "livox_service", "ouster_api",
            "tcp_service", "velodyne_api", "send", "sender_process",
        )
    },
}  # fmt: skip


def main() -> None:
    """Print the upward imports, and fail if there are more than allowed."""
    modules = dict(_modules())
    found = sorted(line for name in modules for line in _upward_imports(name, modules))
    print(f"names imported from a package above, as planned: {len(found)}")
    if found:
        print(*found, sep="\n")
        sys.exit("Import from a package below, or move what is shared down.")


def _modules() -> Iterator[tuple[str, Path]]:
    for path in WORKFLOWS.rglob("*.py"):
        parts = path.relative_to(WORKFLOWS).with_suffix("").parts
        yield ".".join(parts[:-1] if parts[-1] == "__init__" else parts), path


def _upward_imports(name: str, modules: dict[str, Path]) -> Iterator[str]:
    levels = {package: level for level, row in enumerate(LAYERS) for package in row}
    own = _package(name)
    for target in _imports(name, modules):
        other = _package(target)
        if other != own and levels[other] <= levels[own]:
            yield f"{own}: {name} -> {other}: {target}"


def _package(module: str) -> str:
    parts = module.split(".")
    beginnings = (".".join(parts[:count]) for count in range(len(parts), 0, -1))
    return next(PLANNED[beginning] for beginning in beginnings if beginning in PLANNED)


def _imports(name: str, modules: dict[str, Path]) -> Iterator[str]:
    """Yield the modules that a module imports, anywhere in its code."""
    path = modules[name]
    package = name if path.name == "__init__.py" else name.rpartition(".")[0]
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            named = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            parts = package.split(".")
            start = parts[: len(parts) - node.level + 1] if node.level else []
            module = ".".join([*start, *([node.module] if node.module else [])])
            named = [f"{module}.{alias.name}" for alias in node.names]
            named = [one if one in modules else module for one in named]  # one for each name
        else:
            continue
        yield from (one for one in named if one in modules)


if __name__ == "__main__":
    main()
