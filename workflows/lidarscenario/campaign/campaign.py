"""Campaigns that run many jobs with varied values and write a data set."""

from __future__ import annotations

import os
import re
import shlex
from collections.abc import Callable, Iterable, Mapping, Sequence, Set
from copy import copy
from dataclasses import asdict, replace
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import Any, Self

import numpy as np

from lidarfiles.clouds.writing import with_format_columns
from lidarfiles.datasets.job_table import Value
from lidarfiles.identity.field_words import describe_fields
from lidarfiles.identity.fingerprint import fingerprint
from lidarsim.errors import LidarError, Mistakes
from lidarsim.io.input_files import not_found, read_input_text
from lidarsim.io.yamlfile import read_yaml
from lidarsim.schema.checks import check_list, check_number
from lidarsim.schema.error_sentences import convert_validation_errors

from ..job import Job
from ..prepare import PreparedScenario
from ..scenario import Scenario
from ..sections import PoolSection
from ..shard import ALL, Shard
from ..static_scene import SceneCache
from .campaign_jobs import FunctionJobs, JobSource, SampledJobs, ScenarioJobs
from .campaign_sections import MAX_JOBS, CampaignSection, DatasetFormat, Splits

_FORM = "a campaign file contains base:, count:, vary:, keep: and splits:"
MAX_SHOWN_FILES = 5  # maximum number of file names in the recorded command


class CampaignSpec:
    """Set of jobs whose results are written to a data set.

    Each job is a survey. `Campaign.load` reads a campaign file, and `Campaign.from_scenarios` uses
    scenario files as jobs. The constructor uses a Python function that returns each job.

    Parameters
    ----------
    make
        Function ``make(number, rng)`` that returns the `Job` with the given number, including its
        scene, survey and values. Numbers start at 0. `rng` is a ``numpy.random.Generator`` that
        depends only on the seed and the number, so the same number always results in the same job,
        regardless of the order of the jobs and the worker.
    count
        Number of jobs.
    seed
        Random seed.
    keep
        Format of the data set: "kitti", "nuscenes", "webdataset", "mcap", "parquet",
        "images" or "folder", or a mapping such as ``{"format": "mcap", "layout": "ouster"}``.
    splits
        Mapping from the names of splits to their shares of the jobs. The shares add up to 1.
    license, title
        License and title in the data set card.

    Raises
    ------
    LidarError
        If an argument is invalid.

    Notes
    -----
    If the noise of a survey has the seed 0, each job uses a different seed.
    """

    count: int
    seed: int
    keep: DatasetFormat
    splits: Mapping[str, float]
    license: str
    title: str
    command: str = ""  # arguments of `lidarpool run`, or empty if a function creates the jobs
    description: str = ""  # text of the campaign file, or empty if there is none
    files: Set[Path]  # files that jobs may read, including missing files
    # {name of a value: how it is chosen}, for example "0.2 to 20, log_uniform"
    choices: Mapping[str, str]
    shard = ALL  # shard whose jobs are run
    only_job: None = None  # only set for single surveys (`lidarpool.run.job_source.Jobs`)

    def __init__(
        self,
        make: Callable[[int, np.random.Generator], Job],
        count: int,
        *,
        seed: int = 0,
        keep: str | DatasetFormat | Mapping[str, Any] = "kitti",
        splits: Mapping[str, float] = MappingProxyType({}),
        license: str = "",  # noqa: A002 - same name as in campaign files
        title: str = "",
    ) -> None:
        check_number("count", count, whole=True, ge=1, le=MAX_JOBS)
        section = _section(keep=keep, splits=splits, seed=seed, license=license, title=title)
        self._set_fields(FunctionJobs(make, count, seed), section)

    def _set_fields(self, jobs: JobSource, section: CampaignSection) -> None:
        self.seed = section.seed
        self.keep = section.keep
        self.splits = dict(section.splits)  # a read-only view cannot be pickled
        self.license = section.license
        self.title = section.title
        self.count = jobs.count
        self.files = jobs.files
        self.choices = dict(jobs.choices)
        self._jobs = jobs
        self._splits = Splits(self.splits, section.seed)

    changeable = "Only `pool` and `count` may change, and `count` must not decrease."

    @classmethod
    def load(cls, path: str | Path) -> CampaignSpec:
        """Read a campaign file, including its base scenarios and tables.

        Raises
        ------
        LidarError
            If a path does not refer to a field, a possible value is invalid, or a file is missing.
            The message names the file, the field or path, the value and the allowed values.
        """
        path = Path(path)
        content = read_yaml(path, _FORM)
        with convert_validation_errors(CampaignSection, path, content):
            section = CampaignSection.model_validate(content)
        jobs = SampledJobs(section, path)
        self = cls.__new__(cls)
        self._set_fields(jobs, section.model_copy(update={"title": section.title or path.stem}))
        self.command = shlex.quote(path.name)
        self.description = read_input_text(path)
        return self

    @classmethod
    def from_scenarios(
        cls,
        paths: Iterable[str | Path],
        *,
        keep: str | DatasetFormat | Mapping[str, Any] = "folder",
        splits: Mapping[str, float] = MappingProxyType({}),
        seed: int = 0,
        license: str = "",  # noqa: A002 - same name as in campaign files
        title: str = "",
    ) -> CampaignSpec:
        """Create a campaign from scenario or mesh files, with one job per file.

        Each job is named after its file.

        Raises
        ------
        LidarError
            If a file cannot be used, or if an argument is invalid.
        """
        check_list("paths", paths)
        jobs = ScenarioJobs([Path(path) for path in paths])
        self = cls.__new__(cls)
        section = _section(keep=keep, splits=splits, seed=seed, license=license, title=title)
        self._set_fields(jobs, section)
        self.command = shlex.join(path.name for path in jobs.paths[:MAX_SHOWN_FILES])
        self.command += " …" * (jobs.count > MAX_SHOWN_FILES)
        return self

    def for_shard(self, shard: Shard) -> Self:
        """Return the campaign restricted to the jobs of a shard."""
        campaign = self if shard == self.shard else copy(self)
        campaign.shard = shard
        return campaign

    @property
    def card_content(self) -> dict[str, Any]:
        """Content of the dataset card as a dictionary for JSON."""
        names = ("title", "license", "command", "description", "seed", "count", "names")
        return {name: getattr(self, name) for name in names} | {"keep": asdict(self.keep)}

    @property
    def numbers(self) -> range:
        """Numbers of the jobs in this campaign or shard."""
        return self.shard.jobs(self.count)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the values that vary between jobs, in the order of the table columns.

        If a function creates the jobs, the names are taken from the first job that it can create.
        """
        return self._jobs.names

    def values(self, number: int) -> dict[str, Value | None]:
        """Return the values of a job as a mapping from names to values.

        The value of a sample is its number of rows. A field that is not set has the value None. If
        a function creates the jobs, it is called to create the job.
        """
        return self._jobs.values(self._checked_number(number))

    def name(self, number: int) -> str:
        """Return the name of a job for use in file names.

        The name is that of the scenario file, or a number such as 0017.
        """
        return self._jobs.name(self._checked_number(number))

    def split(self, number: int) -> str:
        """Return the split of a job, or an empty string if the campaign has no splits."""
        return self._splits(self._checked_number(number))

    def scenario(self, number: int) -> Scenario | None:
        """Return the scenario of a job, or None if the job is created by a function.

        Raises
        ------
        LidarError
            If the values of the job cannot be combined. The message names the job and the values.
        """
        return self._jobs.scenario(self._checked_number(number))

    @property
    def pool(self) -> PoolSection:
        """Section `pool` of the first job, which applies to all jobs."""
        scenario = self.scenario(0)
        return PoolSection() if scenario is None else scenario.pool

    def job(self, number: int, cache: SceneCache | None = None, columns: Sequence[str] = ()) -> Job:
        """Create a job.

        The same number always results in the same job. Jobs do not plan paths.

        Parameters
        ----------
        number
            Number of the job.
        cache
            Cache of static scenes that this job may share with other jobs.
        columns
            Names of columns to add to the cloud.

        Returns
        -------
        Job
            The job, with all columns that the data set requires.

        Raises
        ------
        LidarError
            If the job does not exist or cannot be created. The message states the reason.
        """
        number = self._checked_number(number)
        return self._for_dataset(self._jobs.job(number, cache, columns, self._fields(number)))

    def prepare(self, number: int, columns: Sequence[str] = ()) -> PreparedScenario:
        """Prepare the scenario of a job, and create the job from it.

        This method must not be called if a function creates the jobs, because such jobs have no
        scenario.
        """
        number = self._checked_number(number)
        prepared = self._jobs.prepare(number, None, columns, self._fields(number))
        return replace(prepared, job=self._for_dataset(prepared.job))

    def _fields(self, number: int) -> dict[str, Any]:
        """Return the number, name and split of a job as fields of `Job`."""
        return {"number": number, "name": self.name(number), "split": self.split(number)}

    def _for_dataset(self, job: Job) -> Job:
        """Return a job with the columns that the data set requires.

        Raise LidarError if the survey has `navigation`.
        """
        if job.survey.navigation is not None:
            raise LidarError(
                "`navigation` is not supported in campaigns, because data sets have no files for "
                "it. Remove `navigation` from the base of the campaign."
            )
        survey = with_format_columns(job.survey, [self.keep.export_spec])
        return job if survey is job.survey else job.with_fields(survey=survey)

    def strip_folders(self, message: str) -> str:
        """Return a message without the paths of the campaign's folders on this machine.

        The messages of failed jobs are written to the data set, which must not depend on the
        machine.
        """
        for folder in self._jobs.folders:
            for path in {str(folder), str(folder.absolute()), str(folder.resolve())} - {".", "/"}:
                message = re.sub(rf"(?<![\w./-]){re.escape(path)}/(?=\w|\.)", "", message)
        return message

    def _checked_number(self, number: int) -> int:
        """Return the number of a job as an integer, or raise LidarError if there is no such job."""
        if not 0 <= number < self.count:
            raise LidarError(
                f"Job {number} does not exist. The jobs of the campaign are 0 to {self.count - 1}."
            )
        return int(number)  # the number may be a NumPy integer

    def check_files(self) -> None:
        """Raise LidarError if a file that a job may read does not exist."""
        mistakes = Mistakes()
        # `Path.exists` raises an error for names that are not valid file names.
        missing = [path for path in self.files if not os.path.exists(path)]  # noqa: PTH110
        mistakes.lines += [
            f"{self._jobs.message_prefix(path) or f'{self.command}: '}{not_found(path)}"
            for path in missing
        ]
        mistakes.raise_if_any()

    @cached_property
    def identity(self) -> dict[str, str]:
        """Names and SHA-256 hashes of the contents that determine the data set.

        Campaigns with the same content have the same hashes, regardless of their folder and their
        number of jobs. The hashes include tables of rows. Other files are part of the identity of
        the jobs that use them.
        """
        return {
            "seed": fingerprint(self.seed),
            "keep": fingerprint(self.keep),
            "splits": fingerprint(dict(self.splits)),
            **self._jobs.identity,
        }

    @property
    def fields(self) -> dict[str, str]:
        """Values of the fields that determine the data set, as text, keyed by field path."""
        own_fields = {"seed": self.seed, "keep": asdict(self.keep), "splits": self.splits}
        return dict(describe_fields({**own_fields, "vary": self.choices})) | self._jobs.fields


def _section(**fields: Any) -> CampaignSection:
    """Validate arguments from Python, and convert them to a section."""
    plain = {name: dict(v) if isinstance(v, Mapping) else v for name, v in fields.items()}
    with convert_validation_errors(CampaignSection):
        return CampaignSection.model_validate({"base": "-", **plain})
