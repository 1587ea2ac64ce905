from __future__ import annotations

import logging
import sys
import warnings
from collections.abc import Iterator

import pytest

from lidarpool.cli.log_file import logged_to


@pytest.fixture
def library() -> Iterator[logging.Logger]:
    """A logger as Dask's: with a handler for stderr of its own, and no way up."""
    logger = logging.getLogger("test_log_file.library")
    handler = logging.StreamHandler(sys.stderr)
    logger.handlers[:], logger.propagate = [handler], False
    logger.setLevel(logging.INFO)
    yield logger
    assert handler in logger.handlers  # pytest adds its own
    logger.handlers.clear()


def test_warnings_go_to_the_file_and_nowhere_else(tmp_path, library, capfd):
    path = tmp_path / "log"
    with logged_to(path) as log:
        library.warning("the worker is %s", "unwell")
        library.info("of interest")
        logging.getLogger("test_log_file.other").error("from below the root")
        with warnings.catch_warnings():
            # Not of any kind: what is collected just then may warn that it was not closed.
            warnings.simplefilter("always", DeprecationWarning)
            logging.captureWarnings(True)
            warnings.warn("that is deprecated", DeprecationWarning, stacklevel=1)
    text = path.read_text()
    assert log.written
    assert text.count("WARNING") == 2 and text.count("ERROR") == 1
    assert "the worker is unwell" in text and "that is deprecated" in text
    assert "of interest" not in text
    assert capfd.readouterr() == ("", "")


def test_there_is_no_file_where_there_was_nothing_to_say(tmp_path, library):
    with logged_to(tmp_path / "log") as log:
        library.info("of interest")
    assert not log.written and list(tmp_path.iterdir()) == []


def test_verbose_keeps_more_at_once_and_the_traceback_of_an_error(tmp_path, library):
    path = tmp_path / "log"

    def fail() -> None:
        with logged_to(path, verbose=True):
            library.info("of interest")
            assert "of interest" in path.read_text()
            raise ValueError("as it happens")

    with pytest.raises(ValueError, match="as it happens"):
        fail()
    assert "Traceback" in path.read_text() and "as it happens" in path.read_text()


def test_an_interrupt_leaves_the_folder_as_it_was(tmp_path, library):
    def interrupt() -> None:
        with logged_to(tmp_path / "log"):
            library.warning("workers are leaving")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupt()
    assert list(tmp_path.iterdir()) == []


def test_it_is_heard_also_where_logs_were_silenced_and_they_are_again_after(tmp_path, library):
    logging.disable(logging.CRITICAL)
    try:
        with logged_to(tmp_path / "log"):
            library.error("heard")
        library.error("not heard")
        assert logging.root.manager.disable == logging.CRITICAL
    finally:
        logging.disable(logging.NOTSET)
    assert (tmp_path / "log").read_text().endswith(": heard\n")


def test_a_file_that_cannot_be_written_stops_nothing(tmp_path, library, capfd):
    with logged_to(tmp_path / "missing" / "log", verbose=True) as log:
        library.warning("nobody hears this")
    assert not log.written
    assert capfd.readouterr() == ("", "")


def test_many_messages_are_not_held_in_memory(tmp_path, library):
    with logged_to(tmp_path / "log"):
        for number in range(1000):
            library.warning("message %d", number)
        assert (tmp_path / "log").read_text().count("\n") >= 800
    assert (tmp_path / "log").read_text().count("\n") == 1000


def test_names_that_cannot_be_encoded_are_written_too(tmp_path, library):
    (tmp_path / "log").write_text("before\n")
    with logged_to(tmp_path / "log"):
        library.warning("after \udcff")  # as names of files may be
    lines = (tmp_path / "log").read_text().splitlines()
    assert lines[0] == "before" and lines[1].endswith(r"after \udcff")
