"""Archives of arrays that this package has written."""

from __future__ import annotations

import io
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from .errors import LidarpoolError


@contextmanager
def open_archive(path: Path | str, data: bytes | None = None) -> Iterator[Any]:
    """Open an archive for the body, whose errors become LidarpoolError; nothing in it is run.

    With `data`, the content of the file, the path is only its name in errors.
    """
    try:
        # NumPy leaves a file open that it opened itself and cannot read.
        with (
            Path(path).open("rb") if data is None else io.BytesIO(data) as file,
            np.load(file, allow_pickle=False) as archive,
        ):
            yield archive
    except OSError as error:
        raise LidarpoolError(f"{path} cannot be read: {error.strerror or error}.") from error
    except Exception as error:  # zipfile, zlib, NumPy and Scene have many
        reason = " ".join(str(error).split())
        raise LidarpoolError(
            f"{path} is damaged or not of this version of lidarpool ({reason}): run the survey "
            "again."
        ) from error
