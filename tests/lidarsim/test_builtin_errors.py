"""Errors that mean the same as errors of Python are these errors, too."""

import pickle

import pytest

from lidarsim import LidarError, Pose, Scene, load_sensor
from lidarsim.errors import MissingFileError, explain_os_errors, prefix_errors


@pytest.mark.parametrize(("load", "name"), [(Scene.load, "a.glb"), (load_sensor, "a.yaml")])
def test_a_file_that_does_not_exist(load, name, tmp_path):
    with pytest.raises(FileNotFoundError, match=name) as raised:
        load(tmp_path / name)
    assert isinstance(raised.value, LidarError)


def test_an_argument_that_does_not_fit():
    with pytest.raises(
        ValueError, match="position must be a list of 3 finite numbers, but is 'a'"
    ) as raised:
        Pose("a")
    assert isinstance(raised.value, LidarError)


def test_another_error_stays_alone(tmp_path):
    path = tmp_path / "empty.stl"
    path.touch()
    with pytest.raises(LidarError) as raised:
        Scene.load(path)
    assert not isinstance(raised.value, OSError | ValueError)


def test_the_kind_outlives_prefixes_processes_and_further_explanations(tmp_path):
    with (
        pytest.raises(MissingFileError) as raised,
        explain_os_errors("The run cannot start"),
        prefix_errors("leg 3"),
        explain_os_errors("the table cannot be read"),
    ):
        (tmp_path / "nope.csv").read_text()
    copy = pickle.loads(pickle.dumps(raised.value))
    expected = "leg 3: the table cannot be read: No such file or directory."
    assert str(copy) == str(raised.value) == expected
    assert isinstance(copy, FileNotFoundError)
