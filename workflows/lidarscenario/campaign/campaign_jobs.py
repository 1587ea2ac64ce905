"""Sources that create the jobs of a campaign.

The jobs of a campaign come from a Python function, from a list of scenario files, or from base
scenarios with sampled values.
"""

from __future__ import annotations

import hashlib
import itertools
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence, Set
from contextlib import suppress
from dataclasses import replace
from functools import cache, cached_property, partial
from itertools import chain, combinations, islice
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from pydantic_core import to_json

from lidarfiles.clouds.format_table import check_all_returns
from lidarfiles.datasets.job_table import Value
from lidarfiles.identity.field_words import describe_fields
from lidarfiles.identity.fingerprint import fingerprint
from lidarfiles.identity.versions import plugin_versions
from lidarsim.errors import LidarError, Mistakes, prefix_errors
from lidarsim.io.input_files import open_input
from lidarsim.io.textfile import read_text
from lidarsim.scene.files.mesh_formats import plugin_of
from lidarsim.schema.section_fields import format_path
from lidarsim.schema.value_texts import format_value
from lidarsim.words import plural

from ..field_paths import FieldSteps, find_field, replace_value
from ..job import Job
from ..prepare import PreparedScenario, prepare
from ..scenario import Scenario
from ..sections import file_states
from ..static_scene import SceneCache
from .campaign_file import is_campaign
from .campaign_sections import MAX_JOBS, CampaignSection, JobRandom, ValueRule, read_rows

_NOISE_SEED = "noise.seed"  # path of the seed that differs between jobs
# Maximum number of scenarios whose fields are stored with a run. If the run is resumed with changed
# scenarios, the error message names the fields that differ.
_MAX_DESCRIBED = 20
_UNSAFE = re.compile(r"[^\w.-]+", re.ASCII)  # characters that file names must not contain


class JobSource:
    """Base class of sources, which create the jobs of a campaign.

    A job is created when it is requested by its number.
    """

    count: int
    names: tuple[str, ...] = ()
    choices: Mapping[str, str] = MappingProxyType({})
    files: Set[Path] = frozenset()
    folders: Set[Path] = frozenset()  # folders of the campaign itself
    identity: Mapping[str, str]

    def name(self, number: int) -> str:
        """Return the name of a job for use in file names.

        By default, the name is the number of the job with at least four digits.
        """
        return f"{number:04}"

    def values(self, number: int) -> dict[str, Value | None]:
        """Return those values of a job that vary between jobs."""
        return {}

    def scenario(self, number: int) -> Scenario | None:
        """Return the scenario of a job, or None if the job is created by a function."""
        return None

    @property
    def fields(self) -> dict[str, str]:
        """Text of the fields in the scenarios from which jobs are created."""
        return {}

    def message_prefix(self, file: Path) -> str:
        """Return a message prefix that states where a file name is set, or an empty string.

        The prefix names, for example, a scenario and one of its fields.
        """
        return ""

    def prepare(
        self, number: int, cache: SceneCache | None, columns: Sequence[str], fields: Any
    ) -> PreparedScenario:
        """Prepare the scenario of a job, using the same arguments as `job`."""
        scenario = self.scenario(number)
        assert scenario is not None, "only jobs with a scenario can be prepared"
        hashes = file_hashes(scenario.files)
        fields |= {"values": self.values(number), "input_files": hashes}
        return prepare(scenario, plans=False, cache=cache, columns=columns, **fields)

    def job(
        self, number: int, cache: SceneCache | None, columns: Sequence[str], fields: Any
    ) -> Job:
        """Create a job with additional columns. `fields` contains further fields of `Job`."""
        return self.prepare(number, cache, columns, fields).job


class FunctionJobs(JobSource):
    """Source that creates jobs with a Python function."""

    def __init__(self, make: Callable[..., Any], count: int, seed: int) -> None:
        self._make = make
        self.count = count
        self._seed = seed

    @cached_property
    def names(self) -> tuple[str, ...]:  # type: ignore[override]  # computed on first use
        """Names of the values in the first job that can be created."""
        for number in range(self.count):
            with suppress(LidarError):  # a failed job must not stop the others
                return tuple(self._call(number).values)
        return ()

    @property
    def identity(self) -> dict[str, str]:  # type: ignore[override]
        """Hash of the function, as {"make": hash}."""
        return {"make": fingerprint(self._make)}

    def values(self, number: int) -> dict[str, Value | None]:
        """Create a job, and return its values."""
        return dict(self.job(number, None, (), {}).values)

    def job(
        self, number: int, cache: SceneCache | None, columns: Sequence[str], fields: Any
    ) -> Job:
        """Create a job, and validate its values.

        If the seed of the noise is 0, it is replaced by a seed that depends on the job.
        """
        job = self._call(number)
        if extra := [name for name in job.values if name not in self.names]:
            raise LidarError(
                f"Job {number} has a value {extra[0]!r}, which the first job does not have. Use "
                "the same names for all jobs, with None for missing values."
            )
        values: dict[str, Value | None] = dict.fromkeys(self.names)
        for name, value in job.values.items():
            plain = value.item() if isinstance(value, np.generic) else value
            if not isinstance(name, str) or not isinstance(plain, Value | None):
                raise LidarError(
                    "The values of a job must be numbers, text, True or False, and their names "
                    f"must be text, but job {number} has {{{name!r}: {format_value(plain)}}}."
                )
            values[name] = plain
        survey = job.survey
        seed = _noise_seed(self._seed, number)
        check_all_returns(columns, survey.keep_every)
        survey = replace(
            survey,
            noise=_with_seed(survey.noise, seed),
            sensors=[
                replace(mounted, noise=_with_seed(mounted.noise, seed))
                for mounted in survey.sensors
            ],
            columns=(*survey.columns, *columns),
        )
        return Job(job.scene, survey, values=values, **fields)

    def _call(self, number: int) -> Job:
        """Call the function that creates a job.

        Raise LidarError if the function fails or does not return a job.
        """
        with prefix_errors(f"job {number}"):
            try:
                job = self._make(number, JobRandom(self._seed, number, "make").generator())
            except LidarError:
                raise
            except Exception as error:  # a failed job must not stop the others
                message = f"the function raised {type(error).__name__}: {error}"
                raise LidarError(message) from error
            if not isinstance(job, Job):
                raise LidarError(
                    "the function must return a Job(scene, survey), but returned "
                    f"{format_value(job)}."
                )
        return job


class ScenarioJobs(JobSource):
    """Source that creates one job from each scenario or mesh file."""

    def __init__(self, paths: Sequence[Path]) -> None:
        if not paths:
            raise LidarError("A campaign requires at least one scenario.")
        self.paths = paths
        self.folders = {path.parent for path in paths}
        self.count = len(paths)
        mistakes = Mistakes()
        files: set[Path] = set()
        fingerprints: list[str] = []
        for path in paths:
            with mistakes.collect():
                if is_campaign(path):
                    raise LidarError(f"{path} is a campaign with its own jobs. Run it separately.")
                scenario = Scenario.load(path)
                fingerprints.append(_fingerprint(scenario))
                files.update(scenario.files)
        mistakes.raise_if_any()
        self.files = files
        self.identity = {"scenarios": fingerprint(fingerprints)}
        self._names = _unique_names([path.stem for path in paths])

    @property
    def fields(self) -> dict[str, str]:
        """Text of the fields in the first scenarios."""
        paths = self.paths[:_MAX_DESCRIBED]
        return _describe_scenarios({path.name: Scenario.load(path) for path in paths})

    def name(self, number: int) -> str:
        """Return the name of a job, which is its file name without the extension."""
        return self._names[number]

    def message_prefix(self, file: Path) -> str:
        """Return a message prefix with the scenario and the field in which a file is named."""
        return next(
            filter(None, (Scenario.load(path).message_prefix(file) for path in self.paths)), ""
        )

    def scenario(self, number: int) -> Scenario:
        """Read the scenario of a job."""
        return Scenario.load(self.paths[number])


def _unique_names(stems: Iterable[str]) -> list[str]:
    """Return unique job names that are derived from file names, such as "hall" and "hall-2"."""
    unique_names: list[str] = []
    lower_case: set[str] = set()  # some file systems are case-insensitive
    for stem in stems:
        first = _UNSAFE.sub("_", stem).lstrip(".") or "job"
        names = chain([first], (f"{first}-{number}" for number in itertools.count(2)))
        name = next(name for name in names if name.lower() not in lower_case)
        lower_case.add(name.lower())
        unique_names.append(name)
    return unique_names


class SampledJobs(JobSource):
    """Source of the jobs in a campaign file. Each job is a base scenario with sampled values."""

    def __init__(self, section: CampaignSection, path: Path) -> None:
        self._vary = section.vary
        self._seed = section.seed
        self._source = str(path)
        self.folders = {path.parent}
        mistakes = Mistakes()
        self._bases: list[_Base] = []
        tables: dict[Any, list[Any]] = {}  # {(file, annotation, ignored columns): rows}
        for name in section.base:
            with mistakes.collect(), prefix_errors(path):
                file = path.parent / Path(name).expanduser()
                if is_campaign(file):
                    raise LidarError(f"base must be a scenario, but {name!r} is a campaign.")
                label = f"vary for {file.name}" if section.base[1:] else "vary"
                self._bases.append(_Base(file, section.vary, tables, label))
        mistakes.raise_if_any()
        for base in self._bases:
            base.check(self._source, mistakes)
        mistakes.raise_if_any()
        self.files = {path for base in self._bases for path in base.files}
        # {path of a field with `each`: number of consecutive jobs with the same value}
        self._strides: dict[str, int] = {}
        grid = len(self._bases)
        for text, choice in section.vary.items():
            if choice.each is not None:
                self._strides[text] = grid
                grid *= len(choice.options)
        drawn = [text for text in section.vary if text not in self._strides]
        if section.count is None and drawn:
            raise LidarError(
                f"{path}: count is required, because values of {drawn[0]} are drawn at random."
            )
        if section.count is None and grid > MAX_JOBS:
            raise LidarError(
                f"{path}: count is required, because the grid of all values would have {grid:,} "
                f"jobs and the limit is {MAX_JOBS:,}."
            )
        self.count = section.count or grid
        self.choices = {text: choice.words for text, choice in section.vary.items()}
        if len(self._bases) > 1:
            bases = ValueRule(each=tuple(base.name for base in self._bases))
            self.choices = {"base": bases.words, **self.choices}
        self.names = tuple(self.choices)

    @cached_property
    def identity(self) -> dict[str, str]:  # type: ignore[override]
        """Hashes of the varied fields, the bases and the tables."""
        return {
            "vary": fingerprint({t: c.model_dump() for t, c in self._vary.items()}, [*self._vary]),
            "base": fingerprint([(base.name, _fingerprint(base.scenario)) for base in self._bases]),
            "tables": fingerprint(to_json([base.tables for base in self._bases])),
        }

    @property
    def fields(self) -> dict[str, str]:
        """Text of the fields in the bases and of the rows in the tables."""
        bases = self._bases[:_MAX_DESCRIBED]
        tables = {f"rows of {text}": rows for base in bases for text, rows in base.tables.items()}
        words = describe_fields({name: to_json(rows).decode() for name, rows in tables.items()})
        return _describe_scenarios({base.name: base.scenario for base in bases}) | dict(words)

    def message_prefix(self, file: Path) -> str:
        """Return a message prefix with the field in which a file is named.

        If the file is named in a table, the prefix also contains the table and the line.
        """
        tables = {path: text for base in self._bases for text, path in base.table_files.items()}
        for table, text in tables.items():
            for number, line in enumerate(read_text(table).splitlines(), 1):
                if file.name in line and not line.lstrip().startswith("#"):
                    return f"{self._source}: {text}: {table}, line {number}: "
        scenarios = [base.scenario for base in self._bases]
        scenarios += [base.files[file] for base in self._bases if file in base.files]
        return next(filter(None, (scenario.message_prefix(file) for scenario in scenarios)), "")

    def values(self, number: int) -> dict[str, Value | None]:
        """Return the values of a job for the job table."""
        return self._draw(number)[0]

    def scenario(self, number: int) -> Scenario:
        """Return the base scenario of a job, modified by the job's values."""
        values, changes = self._draw(number)
        base = self._bases[number % len(self._bases)]
        noise_seed = _noise_seed(self._seed, number)
        try:
            return base.with_values(changes, f"{self._source}: job {number}", noise_seed)
        except LidarError as error:
            listed = ", ".join(
                f"{name}: {'none' if value is None else value}" for name, value in values.items()
            )
            raise LidarError(
                f"{error}\nThe values of the job are {listed or 'those of the base'}."
            ) from error

    def _draw(self, number: int) -> tuple[dict[str, Value | None], dict[str, Any]]:
        """Draw the values of a job.

        Returns the values for the job table, and the changes to the base scenario.
        """
        base = self._bases[number % len(self._bases)]
        values: dict[str, Value | None] = {"base": base.name} if len(self._bases) > 1 else {}
        changes: dict[str, Any] = {}  # {path: value, or rows to append}
        for text, choice in self._vary.items():
            rng = JobRandom(self._seed, number, text)
            if choice.sample is not None:
                chosen = rng.integer(*choice.sample.count)
                table = base.tables[text]
                rows = [table[i] for i in rng.subset(len(table), chosen)]
                changes[text] = rows
                values[text] = chosen
            elif choice.each is not None:
                option = number // self._strides[text] % len(choice.options)
                changes[text], values[text] = choice.options[option]
            else:
                changes[text], values[text] = choice.draw(rng)
        return values, changes


class _Base:
    """Base scenario, and the fields that a campaign varies in it."""

    def __init__(
        self, path: Path, vary: Mapping[str, ValueRule], tables: dict[Any, list[Any]], label: str
    ) -> None:
        self._label = label  # used in messages
        self.scenario = Scenario.load(path)
        self.name = path.name
        self._vary = vary
        self._noise_seed_steps, _ = find_field(self.scenario, _NOISE_SEED)
        self._steps: dict[str, FieldSteps] = {}
        self.tables: dict[str, list[Any]] = {}
        self.table_files: dict[str, Path] = {}
        self.files: dict[Path, Scenario] = {}  # {file that a job may read: scenario that names it}
        mistakes = Mistakes()
        for text, choice in vary.items():
            with mistakes.collect(), prefix_errors(label):
                self._steps[text], kind = find_field(self.scenario, text)
                if choice.sample is None:
                    continue
                self.table_files[text] = table = self.scenario.path(choice.sample.file)
                with prefix_errors(text):
                    ignore = choice.sample.ignore
                    if (key := (table, repr(kind), ignore)) not in tables:
                        tables[key] = read_rows(table, kind, ignore)
                    self.tables[text] = tables[key]
                    max_rows = choice.sample.count[1]
                    if max_rows > len(tables[key]):
                        rows = plural(len(tables[key]), "row")
                        raise LidarError(
                            f"count allows up to {max_rows:,} rows, but {table} has only {rows}."
                        )
        with mistakes.collect(), prefix_errors(label):
            self._check_disjoint()
        mistakes.raise_if_any()

    def _check_disjoint(self) -> None:
        """Raise LidarError if two varied paths overlap.

        Paths overlap if they refer to the same field, or if one field contains the other and is
        replaced as a whole.
        """
        keys = {text: tuple(key for key, _ in steps) for text, steps in self._steps.items()}
        for first, second in combinations(keys, 2):
            short, long = sorted((second, first), key=lambda text: len(keys[text]))
            if keys[short] == keys[long]:
                raise LidarError(
                    f"{first} and {second} refer to the same field. Remove one of them."
                )
            within = keys[long][: len(keys[short])] == keys[short]
            if within and self._vary[short].sample is None:
                raise LidarError(
                    f"{short} and {long} cannot be combined, because {short} replaces {long}."
                )

    def check(self, source: str, mistakes: Mistakes) -> None:
        """Add any invalid values to `mistakes`, and collect the files that jobs may read.

        The first values of all paths are tried together, then the second values, and so on. If a
        trial fails, the paths are tried one by one to identify the invalid value.
        """
        trials = {text: self._trials(text) for text in self._vary}
        for index in range(max([1, *map(len, trials.values())])):
            changes = {text: values[index % len(values)] for text, values in trials.items()}
            try:
                scenario = self.with_values(changes, f"{source}: {self._label}")
            except LidarError as error:
                wrong = [
                    line for text in self._vary for line in islice(self._invalid_values(text), 1)
                ]
                mistakes.lines += [f"{source}: {self._label}: {line}" for line in wrong]
                mistakes.lines += () if wrong else str(error).splitlines()
                return
            self.files |= dict.fromkeys(scenario.files, scenario)

    def _trials(self, text: str) -> list[Any]:
        """Return representative values for a path, which are validated instead of all values.

        The rows of a table are divided into groups that are as large as the largest sample.
        """
        choice = self._vary[text]
        if choice.sample is None:
            return choice.limit_values
        min_rows, max_rows = choice.sample.count
        table = self.tables[text]
        starts = range(0, len(table), max(1, max_rows)) if max_rows else ()
        groups = [table[start : start + max_rows] for start in starts]
        return [table[:min_rows], *groups]

    def _invalid_values(self, text: str) -> Iterator[str]:
        """Yield a line for each value that is not valid at a path in the base scenario."""
        choice = self._vary[text]
        field = format_path([key for key, _ in self._steps[text]])
        for value in () if choice.sample else choice.limit_values:
            try:
                self.with_values({text: value}, "")
            except LidarError as error:
                lines = str(error).replace("\n  ", " ")  # join the continuation lines of a list
                message = lines.partition("\n")[0].removeprefix(": ")
                value_line = f"{text} can be {format_value(value)}"
                invalid = f"{field} cannot be {format_value(value)}."
                start, _, end = message.partition(f", but is {format_value(value)}.")
                if start.startswith(f"{field} must ") and start != message:
                    requirement = start.removeprefix(f"{field} ")
                    yield f"{value_line}, but {requirement}.{end}{choice.hint(requirement)}"
                elif message.startswith(invalid):
                    yield f"{value_line}.{message.removeprefix(invalid)}"
                else:
                    yield f"{value_line}: {message}"

    def with_values(self, changes: Mapping[str, Any], source: str, noise_seed: int = 0) -> Scenario:
        """Return the scenario with some of its values replaced.

        If the seed of the noise is 0, it is replaced by `noise_seed`.
        """

        def new_value(text: str, value: Any) -> Any:
            if text not in changes:  # the noise seed, which is replaced only if it is 0
                return value or noise_seed
            adds_rows = self._vary[text].sample is not None
            return [*(value or ()), *changes[text]] if adds_rows else changes[text]

        steps_by_path = {text: self._steps[text] for text in changes}
        if noise_seed:
            steps_by_path.setdefault(_NOISE_SEED, self._noise_seed_steps)
        result: Any = self.scenario
        for text, steps in steps_by_path.items():
            result = replace_value(result, steps, partial(new_value, text))
        sections = {str(name): result[name] for (name, _), *_ in steps_by_path.values()}
        return self.scenario.with_sections(sections, source=source)


def _noise_seed(seed: int, number: int) -> int:
    return JobRandom(seed, number, _NOISE_SEED).bits(63) or 1


def _with_seed(noise: Any, seed: int) -> Any:
    """Return noise with the given seed if its own seed is 0.

    Returns None if `noise` is None.
    """
    return noise if noise is None or noise.seed else replace(noise, seed=seed)


def _describe_scenarios(scenarios: Mapping[str, Scenario]) -> dict[str, str]:
    """Return the fields of scenarios as text, excluding the `pool` sections.

    `scenarios` is a mapping from scenario names to scenarios.
    """
    words: dict[str, str] = {}
    for name, scenario in scenarios.items():
        content = scenario.model_dump(exclude={"pool"}, exclude_unset=True)
        words |= {f"{name}: {field}": text for field, text in describe_fields(content)}
    return words


def _fingerprint(scenario: Scenario) -> str:
    """Return the fingerprint of a scenario, excluding its `pool` section."""
    return fingerprint(scenario.model_dump(exclude={"pool"}))


def file_hashes(files: Iterable[Path]) -> list[tuple[str, str]]:
    """Return the names and SHA-256 hashes of files, sorted by name.

    The result does not depend on the folder of the files, and skips files that cannot be read. For
    each mesh file that a plug-in reads, it also contains the distribution of the plug-in with its
    version and the hash of its sources. Files that mesh files refer to, such as images and buffers,
    are not included.
    """
    pairs = set()
    for state in file_states(files):
        with suppress(OSError):
            pairs.add((state[0].name, _hash(*state)))
        if (plugin := plugin_of(state[0])) is not None:
            pairs.add((plugin.distribution, plugin_versions([plugin])[plugin]))
    return sorted(pairs)


@cache
def _hash(path: Path, *_: int) -> str:
    """Return the SHA-256 hash of a file.

    The hash is cached by the state of the file, so the file is read again only after it changes.
    """
    with open_input(path) as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
