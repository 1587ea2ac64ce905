"""Variants of effects. A campaign augments a recording several times with varied values."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from lidarfiles.datasets.job_table import Value, format_cell
from lidarfiles.identity.fingerprint import fingerprint
from lidarscenario.campaign.campaign_jobs import SampledJobs, file_hashes
from lidarscenario.campaign.campaign_sections import CampaignSection, Splits
from lidarsim.errors import LidarError, Mistakes
from lidarsim.io.yamlfile import read_yaml
from lidarsim.schema.error_sentences import convert_validation_errors

from .effects import Effects, Insertion
from .recorded_sections import check_sections

TABLE_FILE = "variants.csv"
_FORM = "a campaign file contains base:, count:, vary: and splits:"
_FIELDS = {  # {field of a campaign: why it has no effect, and a remedy}
    "keep": "because the format is that of the recording. Use `--format` to choose another.",
    "license": "because the license is that of the recording. Remove `license`.",
    "title": "because the data set is that of the recording. Remove `title`.",
}


class Variants:
    """Variants of effects, of which there is one by default.

    Parameters
    ----------
    effects
        Effects of the only variant.
    """

    is_campaign = False
    count = 1
    names: Sequence[str] = ()  # names of the values that vary

    def __init__(self, effects: Effects) -> None:
        self._effects = effects

    @property
    def identity(self) -> str:
        """Hash of the effects of all variants."""
        return fingerprint(self._effects)

    def effects(self, number: int) -> Effects:
        """Return the effects of a variant.

        Raises
        ------
        LidarError
            If a file cannot be read, or if the effects cannot be applied to a recording.
        """
        del number
        return self._effects

    def values(self, number: int) -> Mapping[str, Value | None]:
        """Return those values of a variant that vary between variants."""
        del number
        return {}

    def split(self, number: int) -> str:
        """Return the split of a variant, or an empty string if there are no splits."""
        del number
        return ""


class CampaignVariants(Variants):
    """Variants of a campaign, whose base is an effects file.

    Parameters
    ----------
    path
        Path of the campaign file. Values are drawn as by `lidarpool run`, with random numbers that
        are hashes of the campaign's seed, the number of the variant and the path of the field.
    insertions
        Objects that are inserted in all variants.

    Raises
    ------
    LidarError
        If the file is invalid, or if effects cannot be applied to a recording.
    """

    is_campaign = True

    def __init__(self, path: Path, insertions: tuple[Insertion, ...] = ()) -> None:
        content = read_yaml(path, _FORM)
        mistakes = Mistakes()
        mistakes.lines += [
            f"{path}: `{name}` cannot be applied to a recording, {reason}"
            for name, reason in _FIELDS.items()
            if name in content
        ]
        mistakes.raise_if_any()
        with convert_validation_errors(CampaignSection, path, content):
            section = CampaignSection.model_validate(content)
        self._jobs = SampledJobs(section, path)
        self._insertions = insertions
        self._splits = Splits(section.splits, section.seed)
        self._made_of = (section.seed, dict(section.splits))
        self.count = self._jobs.count
        self.names = self._jobs.names
        for number in range(min(self.count, len(section.base))):
            check_sections(self._jobs.scenario(number))

    @property
    def identity(self) -> str:
        """Hash of the campaign and its files. Independent of the number of variants."""
        files = file_hashes(self._jobs.files)
        return fingerprint(self._made_of, dict(self._jobs.identity), files, self._insertions)

    def effects(self, number: int) -> Effects:
        """Return the effects of a variant. The seed is a hash of its number."""
        try:
            effects = Effects.from_scenario(self._jobs.scenario(number))
        except LidarError as error:
            raise LidarError(f"Variant {number}: {error}") from error
        return replace(effects, insertions=self._insertions)

    def values(self, number: int) -> Mapping[str, Value | None]:
        """Return those values of a variant that vary between variants."""
        return self._jobs.values(number)

    def split(self, number: int) -> str:
        """Return the split of a variant, or an empty string if there are no splits."""
        return self._splits(number)


_OUTPUT = re.compile(r"\d{4,}(\.[\w.]+)?")


def outputs_in_table(table: Path) -> list[str]:
    """Return the names of the outputs in a table, or an empty list if there is none."""
    try:
        with table.open(newline="") as file:
            names = [row[0] for row in csv.reader(file) if row]
    except (OSError, UnicodeDecodeError, csv.Error):
        return []
    return [name for name in names if _OUTPUT.fullmatch(name)]


def variants_table(
    variants: Variants, outputs: Sequence[str], points: Sequence[Mapping[str, int]]
) -> bytes:
    """Return a CSV table with the values and point counts of all variants.

    Parameters
    ----------
    variants
        The variants.
    outputs
        Names of the outputs, one for each variant.
    points
        Point counts of each variant, with the same keys for all variants.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    counts = [*points[0]] if points else []
    writer.writerow(["variant", "split", *variants.names, *counts])
    for number, (output, row) in enumerate(zip(outputs, points, strict=True)):
        values = variants.values(number)
        cells = [format_cell(values.get(name)) for name in variants.names]
        writer.writerow([output, variants.split(number), *cells, *row.values()])
    return text.getvalue().encode()
