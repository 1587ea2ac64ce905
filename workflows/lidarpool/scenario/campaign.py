"""Campaigns: many jobs from a description, each with its values."""

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

from lidarsim.errors import LidarError, Mistakes
from lidarsim.io.input_files import not_found, read_input_text
from lidarsim.io.yamlfile import read_yaml
from lidarsim.schema.checks import check_list, check_number
from lidarsim.schema.error_sentences import convert_validation_errors

from ..clouds.writing import with_format_columns
from ..datasets.job_table import Value
from ..identity.field_words import describe_fields
from ..identity.fingerprint import fingerprint
from ..identity.shard import ALL, Shard
from .campaign_jobs import FunctionJobs, JobSource, ScenarioJobs, VariedJobs
from .campaign_sections import MAX_JOBS, CampaignSection, Keep, Splits
from .job import Job
from .prepare import Prepared
from .scenario import Scenario
from .sections import PoolSection
from .static_scene import SceneCache

_FORM = "a campaign file contains base:, count:, vary:, keep: and splits:"
MAX_SHOWN_FILES = 5  # files of a command that are named


class CampaignSpec:
    """Many jobs, which are surveys, that are written to a data set.

    `Campaign.load` reads a campaign file, and `Campaign.of_scenarios` uses scenario files as jobs.
    The constructor uses a Python function that returns each job.

    Parameters
    ----------
    make
        Function ``make(number, rng)`` that returns the `Job` with a number, counted from 0, with
        its scene, survey and values. `rng` is a ``numpy.random.Generator`` that depends only on the
        seed and the number, so equal numbers result in equal jobs, in any order and on any worker.
    count
        Number of jobs.
    seed
        Seed of the random numbers.
    keep
        Format of the data set, which is "kitti", "nuscenes", "webdataset", "mcap", "parquet",
        "images" or "folder", or a mapping such as ``{"format": "mcap", "layout": "ouster"}``.
    splits
        Mapping from the names of splits to their shares of the jobs. The shares add up to 1.
    license, title
        License and title on the card of the data set.

    Raises
    ------
    LidarError
        If an argument is not valid.

    Notes
    -----
    If the noise of a survey has the seed 0, each job uses a different seed.
    """

    count: int
    seed: int
    keep: Keep
    splits: Mapping[str, float]
    license: str
    title: str
    command: str = ""  # arguments of ``lidarpool run``; empty for a function
    description: str = ""  # text of the campaign file, or empty
    files: Set[Path]  # files that jobs may be made of, existing or not
    choices: Mapping[str, str]  # {name: how its value is chosen, «0.2 to 20, log_uniform»}
    shard = ALL  # whose jobs a run does
    only_job: None = None  # surveys have one (`lidarpool.run.job_source.Jobs`)

    def __init__(
        self,
        make: Callable[[int, np.random.Generator], Job],
        count: int,
        *,
        seed: int = 0,
        keep: str | Keep | Mapping[str, Any] = "kitti",
        splits: Mapping[str, float] = MappingProxyType({}),
        license: str = "",  # noqa: A002 - as in the file
        title: str = "",
    ) -> None:
        check_number("count", count, whole=True, ge=1, le=MAX_JOBS)
        head = _head(keep=keep, splits=splits, seed=seed, license=license, title=title)
        self._begin(FunctionJobs(make, count, seed), head)

    def _begin(self, jobs: JobSource, head: CampaignSection) -> None:
        """Set the fields of a campaign from its jobs and its head."""
        self.seed = head.seed
        self.keep = head.keep
        self.splits = dict(head.splits)  # a read-only view cannot be pickled
        self.license = head.license
        self.title = head.title
        self.count = jobs.count
        self.files = jobs.files
        self.choices = dict(jobs.choices)
        self._jobs = jobs
        self._splits = Splits(self.splits, head.seed)

    changeable = "Only `pool` and `count` may change, and `count` must not decrease."

    @classmethod
    def load(cls, path: str | Path) -> CampaignSpec:
        """Read a campaign file with its bases and tables.

        Raises
        ------
        LidarError
            If a path does not refer to a field, a value that can be drawn is not valid, or a file
            is missing. The message names the file, the field or path, the value and the allowed
            values.
        """
        path = Path(path)
        content = read_yaml(path, _FORM)
        with convert_validation_errors(CampaignSection, path, content):
            section = CampaignSection.model_validate(content)
        jobs = VariedJobs(section, path)
        self = cls.__new__(cls)
        self._begin(jobs, section.model_copy(update={"title": section.title or path.stem}))
        self.command = shlex.quote(path.name)
        self.description = read_input_text(path)
        return self

    @classmethod
    def of_scenarios(
        cls,
        paths: Iterable[str | Path],
        *,
        keep: str | Keep | Mapping[str, Any] = "folder",
        splits: Mapping[str, float] = MappingProxyType({}),
        seed: int = 0,
        license: str = "",  # noqa: A002 - as in the file
        title: str = "",
    ) -> CampaignSpec:
        """Return a campaign whose jobs are scenario or mesh files.

        Each job has the name of its file.

        Raises
        ------
        LidarError
            If a file cannot be used, or an argument is not valid.
        """
        check_list("paths", paths)
        jobs = ScenarioJobs([Path(path) for path in paths])
        self = cls.__new__(cls)
        self._begin(jobs, _head(keep=keep, splits=splits, seed=seed, license=license, title=title))
        self.command = shlex.join(path.name for path in jobs.paths[:MAX_SHOWN_FILES])
        self.command += " …" * (jobs.count > MAX_SHOWN_FILES)
        return self

    def of_shard(self, shard: Shard) -> Self:
        """Return the campaign restricted to the jobs of a shard."""
        campaign = self if shard == self.shard else copy(self)
        campaign.shard = shard
        return campaign

    @property
    def described(self) -> dict[str, Any]:
        """Content of the card of the data set, for JSON."""
        names = ("title", "license", "command", "description", "seed", "count", "names")
        return {name: getattr(self, name) for name in names} | {"keep": asdict(self.keep)}

    @property
    def numbers(self) -> range:
        """Numbers of the jobs in this campaign or shard."""
        return self.shard.jobs(self.count)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the values that differ between jobs, in the order of the table columns.

        If a function makes the jobs, the names are taken from the first job that can be made.
        """
        return self._jobs.names

    def values(self, number: int) -> dict[str, Value | None]:
        """Return the values of a job, as {name: value}.

        The value of a sample is its number of rows, and a field that is not set has the value None.
        If a function makes the jobs, the job is made.
        """
        return self._jobs.values(self._checked_number(number))

    def name(self, number: int) -> str:
        """Return the name of a job in files.

        The name is that of its scenario file, or a number such as 0017.
        """
        return self._jobs.name(self._checked_number(number))

    def split(self, number: int) -> str:
        """Return the name of the split of a job, or an empty string without splits."""
        return self._splits(self._checked_number(number))

    def scenario(self, number: int) -> Scenario | None:
        """Return the scenario of a job, or None if a function makes the job.

        Raises
        ------
        LidarError
            If the values of the job do not fit together. The message names the job and the values.
        """
        return self._jobs.scenario(self._checked_number(number))

    @property
    def pool(self) -> PoolSection:
        """Section `pool` of the first job, which applies to all jobs."""
        scenario = self.scenario(0)
        return PoolSection() if scenario is None else scenario.pool

    def job(self, number: int, cache: SceneCache | None = None, columns: Sequence[str] = ()) -> Job:
        """Make a job.

        Equal numbers result in equal jobs. Jobs do not plan paths.

        Parameters
        ----------
        number
            Number of the job.
        cache
            Static scenes of other jobs that this job may share.
        columns
            Names of the columns that the data set requires.

        Raises
        ------
        LidarError
            If the job does not exist or cannot be made. The message states the reason.
        """
        number = self._checked_number(number)
        return self._for_dataset(self._jobs.job(number, cache, columns, self._fields(number)))

    def prepare(self, number: int, columns: Sequence[str] = ()) -> Prepared:
        """Prepare the scenario of a job, which is made as by `job`.

        A job that a function makes has no scenario.
        """
        number = self._checked_number(number)
        prepared = self._jobs.prepare(number, None, columns, self._fields(number))
        return replace(prepared, job=self._for_dataset(prepared.job))

    def _fields(self, number: int) -> dict[str, Any]:
        """Return the fields of a job that depend on its number only."""
        return {"number": number, "name": self.name(number), "split": self.split(number)}

    def _for_dataset(self, job: Job) -> Job:
        """Return a job with the columns that the data set requires."""
        if job.survey.navigation is not None:
            raise LidarError(
                "`navigation` is not supported in campaigns, because data sets have no files for "
                "it. Remove `navigation` from the base of the campaign."
            )
        survey = with_format_columns(job.survey, [self.keep.of_jobs])
        return job if survey is job.survey else job.with_fields(survey=survey)

    def without_folders(self, message: str) -> str:
        """Return a message without the folders of the campaign's files on this machine.

        The messages of jobs that have failed are in the data set, whose bytes are the same on any
        machine.
        """
        for folder in self._jobs.folders:
            for path in {str(folder), str(folder.absolute()), str(folder.resolve())} - {".", "/"}:
                message = re.sub(rf"(?<![\w./-]){re.escape(path)}/(?=\w|\.)", "", message)
        return message

    def _checked_number(self, number: int) -> int:
        """Return the number of a job as an integer, or raise LidarError."""
        if not 0 <= number < self.count:
            raise LidarError(
                f"Job {number} does not exist. The jobs of the campaign are 0 to {self.count - 1}."
            )
        return int(number)  # converts a number of NumPy

    def check_files(self) -> None:
        """Raise LidarError if a file that jobs may be made of does not exist."""
        mistakes = Mistakes()
        # `Path.exists` fails at names that no file can have.
        lost = [path for path in self.files if not os.path.exists(path)]  # noqa: PTH110
        mistakes.lines += [
            f"{self._jobs.named_in(path) or f'{self.command}: '}{not_found(path)}" for path in lost
        ]
        mistakes.tell()

    @cached_property
    def identity(self) -> dict[str, str]:
        """Hashes of the content that the data set depends on: {name: SHA-256, hexadecimal}.

        Campaigns of the same content have the same hashes, in any folder and with any number of
        jobs. Tables of rows are included; other files belong to the jobs that use them.
        """
        return {
            "seed": fingerprint(self.seed),
            "keep": fingerprint(self.keep),
            "splits": fingerprint(dict(self.splits)),
            **self._jobs.identity,
        }

    @property
    def fields(self) -> dict[str, str]:
        """Fields that the data set depends on, in words: {path of a field: its value}."""
        head = {"seed": self.seed, "keep": asdict(self.keep), "splits": self.splits}
        return dict(describe_fields({**head, "vary": self.choices})) | self._jobs.fields


def _head(**fields: Any) -> CampaignSection:
    """Return a checked section of arguments from Python."""
    plain = {name: dict(v) if isinstance(v, Mapping) else v for name, v in fields.items()}
    with convert_validation_errors(CampaignSection):
        return CampaignSection.model_validate({"base": "-", **plain})
