"""Recognition of campaign files.

The module imports nothing of campaigns, so that commands for a single scenario start faster.
"""

from __future__ import annotations

import re
from pathlib import Path

from lidarsim.errors import LidarError
from lidarsim.io.input_files import read_input_text
from lidarsim.io.yamlfile import read_yaml

_CAMPAIGN_SUFFIXES = (".yaml", ".yml")
# Matches the keys `base` and `vary`, and the start of a flow mapping, which may contain them.
_KEYS = re.compile(r"""^(?:["']?(?:base|vary)["']?\s*:|\{)""", re.MULTILINE)


def is_campaign(path: str | Path) -> bool:
    """Return whether a file is a campaign file, which is YAML with the key `base` or `vary`.

    Files that cannot be read are not campaign files.
    """
    path = Path(path)
    if path.suffix.lower() not in _CAMPAIGN_SUFFIXES:
        return False
    try:
        if not _KEYS.search(read_input_text(path)):
            return False  # avoids parsing all poses of a large scenario as YAML
        return bool({"base", "vary"} & read_yaml(path).keys())
    except (OSError, ValueError, LidarError):
        return False  # loading the file as a scenario reports the error
