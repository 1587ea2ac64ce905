"""Standard output and standard error whose readers leave."""

import io
import os
import sys
from contextlib import contextmanager
from pathlib import Path

import click
import pytest

from lidarpool import LidarpoolError
from lidarpool.cli.listeners import leaving_listeners

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="Windows has other errors")


@contextmanager
def ending_at(name, descriptor, monkeypatch):
    """Let a standard stream end at a descriptor."""
    with os.fdopen(descriptor, "w", buffering=1) as stream, monkeypatch.context() as patch:
        patch.setattr(sys, name, stream)
        with leaving_listeners():
            yield


def pipe_without_reader():
    reader, writer = os.pipe()
    os.close(reader)
    return writer


@pytest.mark.parametrize("name", ["stdout", "stderr"])
def test_a_reader_that_has_left_is_not_missed(name, monkeypatch):
    with ending_at(name, pipe_without_reader(), monkeypatch):
        for _ in range(3):
            click.echo("x" * 100_000, err=name == "stderr")
            print("more", file=getattr(sys, name))


def test_a_reader_gets_everything_until_it_leaves(monkeypatch):
    reader, writer = os.pipe()
    with ending_at("stdout", writer, monkeypatch):
        click.echo("first é")
        assert os.read(reader, 100) == "first é\n".encode(sys.stdout.encoding)
        os.close(reader)
        click.echo("second")
        assert sys.stdout.fileno() == writer
        assert not sys.stdout.isatty()


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no /dev/full")
def test_a_full_disk_is_an_error_of_what_is_wanted_alone(monkeypatch):
    def full():
        return os.open("/dev/full", os.O_WRONLY)

    with ending_at("stderr", full(), monkeypatch):
        click.echo("progress", err=True)
    with ending_at("stdout", full(), monkeypatch):
        with pytest.raises(LidarpoolError, match="cannot be written: No space left on device"):
            click.echo("figures")
        click.echo("more")  # told once


def test_streams_that_are_none_are_left_alone(monkeypatch):
    text = io.StringIO()
    monkeypatch.setattr(sys, "stdout", text)
    monkeypatch.setattr(sys, "stderr", None)  # as where it was closed
    with leaving_listeners():
        assert sys.stdout is text
        click.echo("heard")
        click.echo("unheard", err=True)
    assert text.getvalue() == "heard\n"
    assert sys.stderr is None
