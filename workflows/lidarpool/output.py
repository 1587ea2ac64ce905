"""The output folder: all files of a result, or none of them."""

from __future__ import annotations

import json
import os
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from .errors import LidarpoolError
from .plan import Planning
from .ply import write_cloud
from .report import make_report
from .scene import Scene
from .simulate import Result
from .survey import Survey
from .view import draw_cloud, draw_intensity, draw_path, draw_scene, take_shot

ROOM_BYTES = 32 << 20  # what pictures and report may take; the cloud is checked when it is known


def prepare_folder(folder: Path) -> None:
    """Make sure, before anything runs, that a result can be written there.

    Raises
    ------
    LidarpoolError
        If it is a file, cannot be made or written to, or its disk is nearly full.
    """
    if folder.exists() and not folder.is_dir():
        raise LidarpoolError(f"{folder} is a file: give a folder for the results with --out.")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
        free = shutil.disk_usage(folder).free
    except OSError as error:
        raise LidarpoolError(
            f"Cannot write to the folder {folder} ({error.strerror}): give another with --out."
        ) from error
    if free < ROOM_BYTES:
        raise LidarpoolError(
            f"The disk of {folder} has {free / 1e6:.1f} MB free and a result needs at least "
            f"{ROOM_BYTES / 1e6:.0f} MB: make room, or give another folder with --out."
        )


def write_result(
    folder: Path, result: Result, scene: Scene, survey: Survey, planning: Planning | None
) -> dict[str, Any]:
    """Write cloud, pictures and report, and return the report.

    They are made in a temporary folder within `folder` and moved into place together once
    all are there, so that an earlier result stays whole if one cannot be written.

    Raises
    ------
    LidarpoolError
        If a file cannot be written.
    """
    makers: dict[str, Callable[[Path], object]] = {
        "cloud.ply": lambda path: write_cloud(
            path,
            result.cloud.positions,
            result.cloud.scan,
            result.cloud.ring,
            result.cloud.object,
            precision_m=survey.precision_m,
        ),
        **_pictures(result, scene, survey, planning),
    }
    names = [*makers, "report.json"]
    report = make_report(result, scene, survey, planning, names)
    makers["report.json"] = lambda path: path.write_text(
        json.dumps(report, indent=1, allow_nan=False) + "\n", encoding="utf-8"
    )
    try:
        with tempfile.TemporaryDirectory(prefix=".writing-", dir=folder) as made:
            for name, make in makers.items():
                make(Path(made, name))
            for name in makers:
                os.replace(Path(made, name), folder / name)  # noqa: PTH105 - atomic by contract
        if planning is None:  # a path of an earlier run would pass for this one's
            (folder / "path.png").unlink(missing_ok=True)
    except OSError as error:
        raise LidarpoolError(
            f"The result cannot be written to {folder} ({error.strerror or error}): make room or "
            "give another folder with --out. What was there before is as it was."
        ) from error
    return report


def _pictures(
    result: Result, scene: Scene, survey: Survey, planning: Planning | None
) -> dict[str, Callable[[Path], object]]:
    poses = np.array([pose.position for pose in survey.poses]) + scene.origin
    shot = take_shot(scene, poses)
    makers: dict[str, Callable[[Path], object]] = {
        "scene.png": lambda path: draw_scene(path, scene, poses, shot=shot),
        "intensity.png": lambda path: draw_intensity(
            path, scene, result.hit_counts, poses, result.sample_rays + scene.origin, shot=shot
        ),
        "cloud.png": lambda path: draw_cloud(
            path, result.cloud.positions, poses, scene=scene, shot=shot
        ),
    }
    if planning is not None and result.plan is not None:
        plan = result.plan
        makers["path.png"] = lambda path: draw_path(path, planning, plan, result.trials)
    return makers
