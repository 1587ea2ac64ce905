"""Clouds in memory of surveys that are simulated in this process."""

from __future__ import annotations

from dataclasses import replace

from lidarsim import Cloud, Scene, Survey
from lidarsim.columns.table import SCAN
from lidarsim.simulator.points.batch_columns import columns_of
from lidarsim.simulator.rig import Rig
from lidarsim.sweeps.sweeps import Sweeps


def simulated_points(scene: Scene, survey: Survey) -> Cloud:
    """Return the points of all scans, with the stored columns of the survey."""
    part = columns_of(list(Rig(scene, survey, "auto").cast(0, survey.scan_count)))
    return part.cloud((SCAN, *survey.stored_columns[3:]), survey.precision_m, scene.origin)


def simulated_drive(scene: Scene, survey: Survey) -> Cloud:
    """Return the points of all scans, as a cloud that has sweeps."""
    sweeps = Sweeps.from_survey(survey, scene)
    return replace(simulated_points(scene, survey), sweeps=lambda: sweeps)
