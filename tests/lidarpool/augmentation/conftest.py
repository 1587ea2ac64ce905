"""Fixtures of the tests of augmentation."""

from tests.written_drives import written  # noqa: F401 - a fixture
