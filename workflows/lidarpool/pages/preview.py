"""Previews of scenarios and meshes, with their scene, sensors, trajectories and first sweeps."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from lidarfiles.picture_file import PictureContent
from lidarscenario.advice import advice
from lidarscenario.campaign.campaign import CampaignSpec
from lidarscenario.campaign.campaign_file import is_campaign
from lidarscenario.job import Job
from lidarscenario.prepare import prepare
from lidarscenario.scenario import Scenario
from lidarsim.columns.cloud import Cloud
from lidarsim.columns.table import AXES, SCAN, TABLE
from lidarsim.errors import LidarError
from lidarsim.simulator.points.batch_columns import columns_of
from lidarsim.simulator.rig import Rig
from lidarview.viewer.point_selection import ScanOrderedPoints
from lidarview.viewer.view import View

from ..report.picture_content import planning_picture

MATERIAL = TABLE["material"]
_PREVIEW = "This preview was simulated before the run and shows the first sweep of each sensor."


def scenario_view(
    path: Path,
    of_mesh: Mapping[str, Any] = MappingProxyType({}),
    report: Callable[[str], None] = lambda note: None,
) -> View:
    """Return a preview of a scenario, of a campaign's first job, or of a mesh file.

    Parameters
    ----------
    path
        File of the scenario, campaign or mesh. A mesh is scanned as by `lidarpool run`.
    of_mesh
        Options of `mesh_data` for a mesh.
    report
        Function that is called with each note on the scene.

    Raises
    ------
    LidarError
        If a file cannot be read, or if fields of the scenario contradict each other.
    """
    is_mesh = path.suffix.lower() not in (".yaml", ".yml")
    note = _PREVIEW
    if not is_mesh and not of_mesh and is_campaign(path):
        campaign = CampaignSpec.load(path)
        job = campaign.job(0)
        note = f"This is job {job.name} of {campaign.count:,} in the campaign. {_PREVIEW}"
    else:
        prepared = prepare(_with_materials(Scenario.load(path, of_mesh)))
        for line in advice(prepared):
            report(line)
        job = prepared.job
    return job_preview(job, note, f"{path.resolve().name} - lidarpool")


def _with_materials(scenario: Scenario) -> Scenario:
    """Return a copy of a scenario in which the material of each point is stored.

    The faces of the scene then have materials as well.
    """
    columns = (*scenario.cloud.columns, MATERIAL.name)
    return scenario.model_copy(update={"cloud": replace(scenario.cloud, columns=columns)})


def job_preview(job: Job, note: str, title: str) -> View:
    """Simulate the first sweeps of a job, and return a view of them."""
    planning = planning_picture(job.planning)
    content, _ = PictureContent.before_casting(job.scene, job.survey, planning)
    cloud = Cloud.concatenate([*first_sweeps(job)])
    if not job.scene.material_names:
        columns = {name: values for name, values in cloud.columns.items() if name != MATERIAL.name}
        cloud = replace(cloud, columns=columns)
    sweeps = job.sweeps
    return View(ScanOrderedPoints(cloud), content, sweeps, note, title, preview=True)


def first_sweeps(job: Job) -> Iterator[Cloud]:
    """Simulate the first sweep of each sensor in this process, and yield them in scan order."""
    sweeps = job.sweeps
    survey = job.survey
    if not len(sweeps):
        raise LidarError("The survey has no sweeps. Set `poses`, or a longer trajectory.")
    rig = Rig(job.scene, survey)
    table = (SCAN, *(column for column in survey.stored_columns if column not in AXES))
    origin = job.scene.origin if survey.coordinates == "world" else np.zeros(3)
    for sensor in range(len(sweeps.sensors)):
        first = int(np.flatnonzero(sweeps.sensor == sensor)[0])
        start, stop = sweeps.scans[first : first + 2].tolist()
        part = columns_of([*rig.cast(start, stop)])
        yield part.cloud(table, survey.precision_m, origin)
