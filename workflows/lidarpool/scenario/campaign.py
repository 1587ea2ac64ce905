"""Campaigns: many jobs from one description, each with values of its own."""

from __future__ import annotations

import hashlib
import os
import re
import shlex
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence, Set
from contextlib import suppress
from copy import copy
from dataclasses import asdict, replace
from functools import cache, cached_property, partial
from itertools import chain, combinations, count, islice
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, Self

import numpy as np
from pydantic import BaseModel, Field
from pydantic_core import to_json

from lidarsim.base.declared import Seed
from lidarsim.base.errors import LidarError, Mistakes, prefixed
from lidarsim.base.input_files import open_input, read_input_text
from lidarsim.base.textfile import read_text
from lidarsim.base.validation import (
    checked,
    dotted,
    field_hint,
    fields_of,
    is_section,
    sections_in,
    sentences,
    shown,
)
from lidarsim.base.words import did_you_mean, plural
from lidarsim.base.yamlfile import read_yaml

from ..base.fingerprint import fingerprint
from ..base.shard import ALL, Shard
from ..datasets.job_table import Value
from ..export.format_table import check_whole
from ..export.laser_scan import with_laser_scans
from .build import Job, build
from .campaign_sections import (
    COUNT_MOST,
    CampaignSection,
    Choice,
    JobRandom,
    Keep,
    Splits,
    read_rows,
)
from .scenario import Scenario
from .sections import PoolSection, file_states
from .static_scene import SceneCache

_FORM = "a campaign has base:, count:, vary:, keep:, splits:"
_SUFFIXES = (".yaml", ".yml")
SHOWN_MOST = 5  # files of a command that are named
_NOISE = "noise.seed"  # where a job's own seed goes
_KEYS = re.compile(r"""^(?:["']?(?:base|vary)["']?\s*:|\{)""", re.MULTILINE)  # or one mapping {…}
_UNSAFE = re.compile(r"[^\w.-]+", re.ASCII)  # in a name of files


class CampaignSpec:
    """Many jobs (surveys) from one description, into one data set.

    `Campaign.load` reads a campaign file, `Campaign.of_scenarios` takes scenario files as they
    are, and this one asks a function of Python for each job.

    Parameters
    ----------
    make
        ``make(number, rng)`` returns the `Job` of a number from 0 on, with its scene, survey and
        values. `rng` is a ``numpy.random.Generator`` that depends on the seed and the number alone:
        a job is the same however often, in whatever order and wherever it is made.
    count
        How many jobs.
    seed
        Another seed gives other random numbers.
    keep
        Format of the data set: "kitti", "nuscenes", "webdataset", "mcap", "parquet", "images" or
        "folder"; or ``{"format": "mcap", "layout": "ouster"}``.
    splits
        {name: share of the jobs}; they add up to 1.
    license, title
        For the card of the data set.

    Raises
    ------
    LidarError
        If an argument cannot be meant.

    Notes
    -----
    A survey with noise whose seed is 0 gets a seed of the job's own.
    """

    count: int
    seed: int
    keep: Keep
    splits: Mapping[str, float]
    license: str
    title: str
    command: str = ""  # what follows ``lidarpool run``; empty for a function
    description: str = ""  # the file's text, where there is one
    files: Set[Path]  # that its jobs may be made of; some may be missing
    choices: Mapping[str, str]  # {name: how its value is chosen, «0.2 to 20, log_uniform»}
    shard = ALL  # whose jobs a run does
    only_job: None = None  # a survey has one, as `lidarpool.run.job_source.Jobs` says

    @checked
    def __init__(
        self,
        make: Callable[[int, np.random.Generator], Job],
        count: Annotated[int, Field(ge=1, le=COUNT_MOST)],
        *,
        seed: Seed = 0,
        keep: str | Keep | Mapping[str, Any] = "kitti",
        splits: Mapping[str, float] = MappingProxyType({}),
        license: str = "",  # noqa: A002 - as in the file
        title: str = "",
    ) -> None:
        head = _head(keep=keep, splits=splits, seed=seed, license=license, title=title)
        self._begin(_Made(make, count, seed), head)

    def _begin(self, jobs: _JobSource, head: CampaignSection) -> None:
        self.seed = head.seed
        self.keep = head.keep
        self.splits = dict(head.splits)  # a read-only view of it cannot be pickled
        self.license = head.license
        self.title = head.title
        self.count = jobs.count
        self.files = jobs.files
        self.choices = dict(jobs.choices)
        self._jobs = jobs
        self._splits = Splits(self.splits, head.seed)

    @classmethod
    @checked
    def load(cls, path: str | Path) -> CampaignSpec:
        """Read a campaign file, with its bases and tables.

        Raises
        ------
        LidarError
            With the file, the field or path, what was given and what is allowed: if a path leads
            to no field, a value that can be drawn is not valid there, or a file is missing.
        """
        path = Path(path)
        with sentences(CampaignSection, path):
            section = CampaignSection.model_validate(read_yaml(path, _FORM))
        jobs = _Varied(section, path)
        self = cls.__new__(cls)
        self._begin(jobs, section.model_copy(update={"title": section.title or path.stem}))
        self.command, self.description = shlex.quote(path.name), read_input_text(path)
        return self

    @classmethod
    @checked
    def of_scenarios(
        cls,
        paths: Iterable[str | Path],
        *,
        keep: str | Keep | Mapping[str, Any] = "folder",
        splits: Mapping[str, float] = MappingProxyType({}),
        seed: Seed = 0,
        license: str = "",  # noqa: A002 - as in the file
        title: str = "",
    ) -> CampaignSpec:
        """Take scenario or mesh files as jobs, as they are; a job has the name of its file.

        Raises
        ------
        LidarError
            If one of them cannot be used; or an argument cannot be meant.
        """
        jobs, self = _Given([Path(path) for path in paths]), cls.__new__(cls)
        self._begin(jobs, _head(keep=keep, splits=splits, seed=seed, license=license, title=title))
        self.command = shlex.join(path.name for path in jobs.paths[:SHOWN_MOST])
        self.command += " …" * (jobs.count > SHOWN_MOST)
        return self

    def of_shard(self, shard: Shard) -> Self:
        """Return the same campaign, of which a run does the jobs of a shard."""
        made = self if shard == self.shard else copy(self)
        made.shard = shard
        return made

    @property
    def described(self) -> dict[str, Any]:
        """What the card of its data set says, as JSON holds it."""
        names = ("title", "license", "command", "description", "seed", "count", "names")
        return {name: getattr(self, name) for name in names} | {"keep": asdict(self.keep)}

    @property
    def numbers(self) -> range:
        """Numbers of the jobs that a run does."""
        return self.shard.jobs(self.count)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of what differs from job to job, in the order of the table's columns.

        Of a function, those of its first job that can be made, which is made to be asked.
        """
        return self._jobs.names

    def values(self, number: int) -> dict[str, Value]:
        """Return what differs from job to job: {name: value}; of a sample, how many rows.

        A name is missing where the value is none. Of a function, its job is made to be asked.
        """
        return self._jobs.values(self._known(number))

    def name(self, number: int) -> str:
        """Return the name of a job in files: of a given scenario that of its file, else 0017."""
        return self._jobs.name(self._known(number))

    def split(self, number: int) -> str:
        """Return the name of a job's split; empty without splits."""
        return self._splits(self._known(number))

    def scenario(self, number: int) -> Scenario | None:
        """Return what a job is built of; None if a function makes it.

        LidarError if its values do not fit together; the message names it and them.
        """
        return self._jobs.scenario(self._known(number))

    @property
    def pool(self) -> PoolSection:
        """How a cluster runs the jobs, as the first of them says."""
        scenario = self.scenario(0)
        return PoolSection() if scenario is None else scenario.pool

    def job(self, number: int, cache: SceneCache | None = None, columns: Sequence[str] = ()) -> Job:
        """Make a job; the same number gives the same job. Jobs plan no paths.

        `cache` has static scenes of other jobs, which this one may share; `columns` are names of
        columns that the data set needs.

        LidarError if there is no such job, or it cannot be made; the message says why.
        """
        number = self._known(number)
        own = {"number": number, "name": self.name(number), "split": self.split(number)}
        job = self._jobs.job(number, cache, columns, own)
        if job.survey.navigation is not None:
            raise LidarError(
                "navigation is for single surveys, since a data set has no place for its files: "
                "leave it out of the campaign's base."
            )
        survey = with_laser_scans(job.survey, [self.keep.format])
        return job if survey is job.survey else replace(job, survey=survey)

    def _known(self, number: int) -> int:
        if not 0 <= number < self.count:
            raise LidarError(
                f"there is no job {number}: the campaign has jobs 0 to {self.count - 1}."
            )
        return int(number)  # of NumPy, perhaps

    def check_files(self) -> None:
        """Check that all files are there that jobs may be made of, or raise LidarError."""
        mistakes = Mistakes()
        # `Path.exists` fails at names that no file can have.
        lost = [path for path in self.files if not os.path.exists(path)]  # noqa: PTH110
        mistakes.lines += [
            f"{self.command}: {self._jobs.named_in(path)}{str(path)!r} does not exist: check the "
            "name and the folder."
            for path in lost
        ]
        mistakes.tell()

    @cached_property
    def identity(self) -> dict[str, str]:
        """Hashes of what the data set depends on: {name: SHA-256, hexadecimal}.

        Campaigns of the same content have the same, wherever their files are and however many jobs
        they have. Files are no part of it but tables of rows: others are of the jobs that use them.
        """
        shared = {"seed": self.seed, "keep": self.keep}
        own = {name: fingerprint(value) for name, value in shared.items()}
        return own | {"splits": fingerprint(dict(self.splits)), **self._jobs.identity}


def is_campaign(path: str | Path) -> bool:
    """Whether a file is that of a campaign: YAML with the key `base` or `vary`."""
    path = Path(path)
    if path.suffix.lower() not in _SUFFIXES:
        return False
    try:
        if not _KEYS.search(read_input_text(path)):
            return False  # without reading all poses of a scenario as YAML
        return bool({"base", "vary"} & read_yaml(path).keys())
    except (OSError, ValueError, LidarError):
        return False  # what is wrong, the reader of scenarios says


def _head(**given: Any) -> CampaignSection:
    """Check the fields that Python gives."""
    plain = {name: dict(v) if isinstance(v, Mapping) else v for name, v in given.items()}
    with sentences(CampaignSection):
        return CampaignSection.model_validate({"base": "-", **plain})


class _JobSource:
    """Where the jobs of a campaign come from."""

    count: int
    names: tuple[str, ...] = ()
    choices: Mapping[str, str] = MappingProxyType({})
    files: Set[Path] = frozenset()
    identity: Mapping[str, str]

    def name(self, number: int) -> str:
        return f"{number:04}"  # however many there are

    def values(self, number: int) -> dict[str, Value]:
        return {}

    def scenario(self, number: int) -> Scenario | None:
        return None

    def named_in(self, file: Path) -> str:
        """Where a file is named, for messages: a table and its line; empty if in none."""
        return ""

    def job(self, number: int, cache: SceneCache | None, columns: Sequence[str], own: Any) -> Job:
        scenario = self.scenario(number)
        assert scenario is not None, "of a file"
        made_of = hashes(scenario.files)
        built = build(scenario, plans=False, cache=cache, columns=columns)
        return built.job(values=self.values(number), made_of=made_of, **own)


class _Made(_JobSource):
    """Jobs that a function makes."""

    def __init__(self, make: Callable[..., Any], count: int, seed: int) -> None:
        self._make, self.count, self._seed = make, count, seed

    @cached_property
    def names(self) -> tuple[str, ...]:  # type: ignore[override]  # found out when it is asked for
        for number in range(self.count):
            with suppress(LidarError):  # one that fails must not end the others
                return tuple(self._made(number).values)
        return ()

    @property
    def identity(self) -> dict[str, str]:  # type: ignore[override]
        return {"make": fingerprint(self._make)}

    def values(self, number: int) -> dict[str, Value]:
        return dict(self.job(number, None, (), {}).values)

    def job(self, number: int, cache: SceneCache | None, columns: Sequence[str], own: Any) -> Job:
        made = self._made(number)
        if extra := [name for name in made.values if name not in self.names]:
            raise LidarError(
                f"job {number} has the value {extra[0]!r}, which the first has not: give all jobs "
                "the same names, with None where there is no value."
            )
        values: dict[str, Value] = {}
        for name, value in made.values.items():
            plain = value.item() if isinstance(value, np.generic) else value
            if not isinstance(name, str) or not isinstance(plain, Value | None):
                raise LidarError(
                    f"job {number} has the value {name!r}: {shown(plain)}; values are numbers, "
                    "text, True or False, by names."
                )
            if plain is not None:
                values[name] = plain
        survey, seed = made.survey, _noise_seed(self._seed, number)
        check_whole(columns, survey.keep_every)
        survey = replace(
            survey,
            noise=_seeded(survey.noise, seed),
            sensors=[replace(one, noise=_seeded(one.noise, seed)) for one in survey.sensors],
            columns=(*survey.columns, *columns),
        )
        return Job(made.scene, survey, values=values, **own)

    def _made(self, number: int) -> Job:
        with prefixed(f"job {number}"):
            try:
                made = self._make(number, JobRandom(self._seed, number, "make").generator())
            except LidarError:
                raise
            except Exception as error:  # one job's failure must not end the others
                told = f"the function raised {type(error).__name__}: {error}"
                raise LidarError(told) from error
            if not isinstance(made, Job):
                told = f"the function returned {shown(made)}; it must return a Job(scene, survey)."
                raise LidarError(told)
        return made


class _Given(_JobSource):
    """Scenario and mesh files as they are."""

    def __init__(self, paths: Sequence[Path]) -> None:
        if not paths:
            raise LidarError("a campaign needs a scenario at least: name one or more files.")
        self.paths, self.count = paths, len(paths)
        mistakes, files, prints = Mistakes(), set[Path](), []
        for path in paths:
            with mistakes.noted():
                if is_campaign(path):
                    told = f"{path} is a campaign, with jobs of its own: run it by itself."
                    raise LidarError(told)
                read = Scenario.load(path)
                prints.append(_print(read))
                files.update(read.files)
        mistakes.tell()
        self.files, self.identity = files, {"scenarios": fingerprint(prints)}
        self._names = _unique([path.stem for path in paths])

    def name(self, number: int) -> str:
        return self._names[number]

    def scenario(self, number: int) -> Scenario:
        return Scenario.load(self.paths[number])


def _unique(stems: Iterable[str]) -> list[str]:
    """Names for files, each once: «hall», «hall-2»."""
    out: list[str] = []
    taken: set[str] = set()
    for stem in stems:
        first = _UNSAFE.sub("_", stem).lstrip(".") or "job"
        names = chain([first], (f"{first}-{number}" for number in count(2)))
        # Some systems know no capitals.
        name = next(name for name in names if name.lower() not in taken)
        taken.add(name.lower())
        out.append(name)
    return out


class _Varied(_JobSource):
    """Jobs of a campaign file: a base with other values."""

    def __init__(self, section: CampaignSection, path: Path) -> None:
        self._vary, self._seed, self._source = section.vary, section.seed, str(path)
        mistakes = Mistakes()
        self._bases: list[_Base] = []
        tables: dict[Any, list[Any]] = {}  # {file and kind of entry: entries}
        for name in section.base:
            with mistakes.noted(), prefixed(path):
                file = path.parent / Path(name).expanduser()
                if is_campaign(file):
                    raise LidarError(f"base {name!r} is a campaign; give a scenario.")
                where = f"vary, of {file.name}" if section.base[1:] else "vary"
                self._bases.append(_Base(file, section.vary, tables, where))
        mistakes.tell()
        for one in self._bases:
            one.check(self._source, mistakes)
        mistakes.tell()
        self.files = {path for base in self._bases for path in base.files}
        self._strides: dict[str, int] = {}  # {path with each: jobs until its value changes}
        grid = len(self._bases)
        for text, choice in section.vary.items():
            if choice.each is not None:
                self._strides[text] = grid
                grid *= len(choice.options)
        drawn = [text for text in section.vary if text not in self._strides]
        if section.count is None and drawn:
            raise LidarError(
                f"{path}: count is missing: {drawn[0]} is drawn, so say how many jobs."
            )
        if section.count is None and grid > COUNT_MOST:
            raise LidarError(
                f"{path}: count is missing: all values of each are {grid:,} jobs, of at most "
                f"{COUNT_MOST:,}."
            )
        self.count = section.count or grid
        self.choices = {text: choice.words for text, choice in section.vary.items()}
        if len(self._bases) > 1:
            bases = Choice(each=tuple(base.name for base in self._bases))
            self.choices = {"base": bases.words, **self.choices}
        self.names = tuple(self.choices)

    @cached_property
    def identity(self) -> dict[str, str]:  # type: ignore[override]
        return {
            "vary": fingerprint({t: c.model_dump() for t, c in self._vary.items()}, [*self._vary]),
            "base": fingerprint([(base.name, _print(base.scenario)) for base in self._bases]),
            "tables": fingerprint(to_json([base.tables for base in self._bases])),
        }

    def named_in(self, file: Path) -> str:
        tables = {path: text for base in self._bases for text, path in base.table_files.items()}
        for table, text in tables.items():
            for number, line in enumerate(read_text(table).splitlines(), 1):
                if file.name in line and not line.lstrip().startswith("#"):
                    return f"{text}: {table}, line {number}: "
        return ""

    def values(self, number: int) -> dict[str, Value]:
        return self._drawn(number)[0]

    def scenario(self, number: int) -> Scenario:
        told, changes = self._drawn(number)
        base, seed = self._bases[number % len(self._bases)], _noise_seed(self._seed, number)
        try:
            return base.changed(changes, f"{self._source}: job {number}", seed)
        except LidarError as error:
            shown = ", ".join(f"{name}: {value}" for name, value in told.items())
            raise LidarError(f"{error}\nIts values are {shown or 'those of the base'}.") from error

    def _drawn(self, number: int) -> tuple[dict[str, Value], dict[str, Any]]:
        """Draw what a job has of its own: for the table of jobs, and for the scenario."""
        base = self._bases[number % len(self._bases)]
        told: dict[str, Value | None] = {"base": base.name} if len(self._bases) > 1 else {}
        changes: dict[str, Any] = {}  # {path: value, or rows to be added}
        for text, choice in self._vary.items():
            draw = JobRandom(self._seed, number, text)
            if choice.sample is not None:
                chosen = draw.integer(*choice.sample.count)
                table = base.tables[text]
                rows = [table[i] for i in draw.subset(len(table), chosen)]
                changes[text], told[text] = rows, chosen
            elif choice.each is not None:
                turn = number // self._strides[text] % len(choice.options)
                changes[text], told[text] = choice.options[turn]
            else:
                changes[text], told[text] = choice.drawn(draw)
        return {name: value for name, value in told.items() if value is not None}, changes


class _Base:
    """A scenario, and where the paths of a campaign lead in it."""

    def __init__(
        self, path: Path, vary: Mapping[str, Choice], tables: dict[Any, list[Any]], where: str
    ) -> None:
        self._where = where  # for messages
        self.scenario, self.name = Scenario.load(path), path.name
        self._vary, (self._noise, _) = vary, find_field(self.scenario, _NOISE)
        self._steps: dict[str, FieldSteps] = {}
        self.tables: dict[str, list[Any]] = {}
        self.table_files: dict[str, Path] = {}
        self.files: set[Path] = set()  # that a job may read
        mistakes = Mistakes()
        for text, choice in vary.items():
            with mistakes.noted(), prefixed(where):
                self._steps[text], kind = find_field(self.scenario, text)
                if choice.sample is None:
                    continue
                self.table_files[text] = table = self.scenario.path(choice.sample.file)
                with prefixed(text):
                    ignore = choice.sample.ignore
                    if (key := (table, repr(kind), ignore)) not in tables:
                        tables[key] = read_rows(table, kind, ignore)
                    self.tables[text] = tables[key]
                    if (most := choice.sample.count[1]) > (there := len(tables[key])):
                        has = plural(there, "row")
                        raise LidarError(f"count is up to {most:,}, and {table} has {has}.")
        with mistakes.noted(), prefixed(where):
            self._check_apart()
        mistakes.tell()

    def _check_apart(self) -> None:
        """Refuse paths that lead to the same field, or into one that is replaced as a whole."""
        places = {text: tuple(key for key, _ in steps) for text, steps in self._steps.items()}
        for other, one in combinations(places, 2):
            short, long = sorted((one, other), key=lambda text: len(places[text]))
            if places[short] == places[long]:
                raise LidarError(f"{other} and {one} lead to the same field: leave one out.")
            within = places[long][: len(places[short])] == places[short]
            if within and self._vary[short].sample is None:
                raise LidarError(
                    f"{short} is chosen as a whole, and {long} is a part of it: leave one out."
                )

    def check(self, source: str, mistakes: Mistakes) -> None:
        """Note values that are not valid, and find out which files jobs may be made of.

        The first values of all paths are tried together, then the second, and so on; only if
        something is wrong, each alone, to find out which.
        """
        trials = {text: self._trials(text) for text in self._vary}
        for turn in range(max([1, *map(len, trials.values())])):
            changes = {text: tried[turn % len(tried)] for text, tried in trials.items()}
            try:
                found = self.changed(changes, f"{source}: {self._where}")
            except LidarError as error:
                wrong = [line for text in self._vary for line in islice(self._tried(text), 1)]
                mistakes.lines += [f"{source}: {self._where}: {line}" for line in wrong]
                mistakes.lines += () if wrong else str(error).splitlines()
                return
            self.files.update(found.files)

    def _trials(self, text: str) -> list[Any]:
        """Return values for a path, valid if all jobs are; of a table, all rows in pieces."""
        choice = self._vary[text]
        if choice.sample is None:
            return choice.ends
        (least, most), table = choice.sample.count, self.tables[text]
        begins = range(0, len(table), max(1, most)) if most else ()
        pieces = [table[begin : begin + most] for begin in begins]
        return [table[:least], *pieces]

    def _tried(self, text: str) -> Iterator[str]:
        """Yield lines on the values of a path that are not valid in the base."""
        choice, place = self._vary[text], dotted([key for key, _ in self._steps[text]])
        for value in () if choice.sample else choice.ends:
            try:
                self.changed({text: value}, "")
            except LidarError as error:
                told = str(error).partition("\n")[0].removeprefix(": ")
                own = told.partition("; ")[2] if told.startswith(f"{place} is ") else ""
                given = f"{text} can be {shown(value)}"
                yield f"{given}; {own}{choice.hint(own)}" if own else f"{given}: {told}"

    def changed(self, changes: Mapping[str, Any], source: str, noise_seed: int = 0) -> Scenario:
        """Return the scenario with other values, and with a seed of its noise if it has none."""

        def changed(text: str, there: Any) -> Any:
            if text not in changes:  # the seed
                return there or noise_seed
            added = self._vary[text].sample is not None
            return [*(there or ()), *changes[text]] if added else changes[text]

        ways = {text: self._steps[text] for text in changes}
        if noise_seed:
            ways.setdefault(_NOISE, self._noise)
        made: Any = self.scenario
        for text, steps in ways.items():
            made = put(made, steps, partial(changed, text))
        sections = {str(name): made[name] for (name, _), *_ in ways.values()}
        return self.scenario.with_sections(sections, source=source)


def _noise_seed(seed: int, number: int) -> int:
    return JobRandom(seed, number, _NOISE).bits(63) or 1


def _seeded(noise: Any, seed: int) -> Any:
    """Give noise a seed where there is noise without one."""
    return noise if noise is None or noise.seed else replace(noise, seed=seed)


def _print(scenario: Scenario) -> str:
    """Fingerprint of a scenario; how a cluster runs it is no part."""
    return fingerprint(scenario.model_dump(exclude={"pool"}))


def hashes(files: Iterable[Path]) -> list[tuple[str, str]]:
    """Name and SHA-256 of files that can be read, in order: the same wherever they are.

    Files that mesh files refer to (images, buffers) are not read.
    """
    found = set()
    for state in file_states(files):
        with suppress(OSError):
            found.add((state[0].name, _hash(*state)))
    return sorted(found)


@cache
def _hash(path: Path, *_: int) -> str:
    """SHA-256 of a file, which is read once for each of its states."""
    with open_input(path) as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


# Keys and numbers of entries, each with the value there; of a section that is left out, one of
# defaults.
FieldSteps = tuple[tuple[str | int, Any], ...]


def find_field(scenario: Scenario, text: str) -> tuple[FieldSteps, Any]:
    """Find out where a path such as ``sensors.roof.model`` leads in a scenario.

    Returns
    -------
    The steps to the field, and its annotation.

    Raises
    ------
    LidarError
        If it leads to no field; the message has the nearest name.
    """
    node: Any = scenario
    kind: Any = type(scenario)
    rest = text.split(".")
    steps: list[tuple[str | int, Any]] = []
    key: str | int
    while rest:
        at = ".".join(text.split(".")[: -len(rest)])
        if node is None and not rest[0].isdecimal() and (sections := list(sections_in(kind))):
            model = issubclass(sections[0], BaseModel)  # of defaults
            node = sections[0].model_construct() if model else object.__new__(sections[0])
            steps[-1] = (steps[-1][0], node)
        if is_section(type(node)):
            key, node, kind = _field(node, rest[0], at)
            used = 1
        elif isinstance(node, dict):
            keys = {str(key): key for key in node}  # of classes, numbers
            name, used = _named([*keys], rest, at)
            node = node[key := keys[name]]
        elif isinstance(node, (tuple, list)):
            key, used = _entry(node, rest, at)
            node = node[key]
        else:
            what = f"the base has no {at}" if node is None else f"{at} has no fields of its own"
            raise LidarError(f"{text} leads to no field: {what}.")
        steps.append((key, node))
        rest = rest[used:]
    return tuple(steps), kind


def _field(node: BaseModel, name: str, at: str) -> tuple[str, Any, Any]:
    fields = {field.alias or own: own for own, field in fields_of(type(node)).items()}
    if name not in fields:
        place = f"a field of {at}" if at else "a section of a scenario"
        raise LidarError(f"{name!r} is not {place}.{field_hint(name, fields, Scenario)}")
    own = fields[name]
    return name, getattr(node, own, None), fields_of(type(node))[own].annotation


def _named(names: Sequence[str], rest: Sequence[str], at: str) -> tuple[str, int]:
    """Return the longest of the names that a path goes on with, for a name may have dots."""
    for used in range(len(rest), 0, -1):
        if (name := ".".join(rest[:used])) in names:
            return name, used
    hint = did_you_mean(rest[0], names) or (f" It has {', '.join(names[:5])}." if names else "")
    raise LidarError(f"{at} of the base has no {rest[0]!r}.{hint}")


def _entry(entries: Sequence[Any], rest: Sequence[str], at: str) -> tuple[int, int]:
    if rest[0].isdecimal():
        if (number := int(rest[0])) < len(entries):
            return number, 1
        raise LidarError(
            f"{at} of the base has {plural(len(entries), 'entry', 'entries')}, counted from 0, "
            f"and no entry {number}."
        )
    names = [name for one in entries if isinstance(name := getattr(one, "name", None), str)]
    name, used = _named(names, rest, at)
    return next(i for i, one in enumerate(entries) if getattr(one, "name", None) == name), used


def put(node: Any, steps: FieldSteps, change: Callable[[Any], Any]) -> Any:
    """Return a section with what `change` makes of the value where the steps lead.

    The original stays as it is. Sections on the way become mappings of their own fields, to be
    checked again; those beside it stay as they are.
    """
    if not steps:
        return change(node)
    (key, base), *rest = steps
    own: Any
    if is_section(type(node)):
        fields, given = fields_of(type(node)), getattr(node, "model_fields_set", vars(node))
        own = {f.alias or n: getattr(node, n) for n, f in fields.items() if n in given}
    else:
        own = list(node) if isinstance(node, (tuple, list)) else dict(node)
    below = own[key] if isinstance(own, list) else own.get(key, base)  # type: ignore[index]
    own[key] = put(base if below is None else below, tuple(rest), change)
    return own
