"""Values in memory that processes of a machine share."""

import os
import subprocess
import sys
import textwrap

import numpy as np
import pytest

from lidarpool.processes.shared_memory import Pickled, SharedHandle, SharedValue

linux = pytest.mark.skipif(not hasattr(os, "memfd_create"), reason="shares no memory")


def value():
    grid = np.arange(3_000_000, dtype=np.float64).reshape(1000, 3000)
    return {"grid": grid, "transposed": grid.T, "name": "hall", "none": np.zeros((0, 3), np.int32)}


def same(first, second):
    names = first.keys()
    return names == second.keys() and all(np.array_equal(first[n], second[n]) for n in names)


def test_a_copy_of_a_pickled_value_can_be_written_to():
    original = value()
    copy = Pickled.from_value(original).copy().load()
    assert same(copy, original)
    copy["grid"][0, 0] = 5
    assert original["grid"][0, 0] == 0


@linux
def test_a_loaded_value_is_the_shared_one_until_it_is_written_to():
    original = value()
    shared = SharedValue(Pickled.from_value(original))
    first, second = shared.handle.load(), shared.handle.load()
    shared.close()
    assert same(first, original) and same(second, original)
    assert all(array.ctypes.data % 64 == 0 for array in (first["grid"], first["transposed"]))
    first["grid"][0, 0] = 5
    assert second["grid"][0, 0] == original["grid"][0, 0] == 0


@pytest.mark.extended
@linux
def test_another_process_loads_it_as_long_as_the_owner_lives():
    owner = subprocess.Popen(
        [sys.executable, "-c", textwrap.dedent("""
            import sys, numpy as np
            from lidarpool.processes.shared_memory import Pickled, SharedValue
            shared = SharedValue(Pickled.from_value(np.arange(100_000)))
            print(tuple(shared.handle), flush=True)
            sys.stdin.read()
        """)],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    handle = SharedHandle(*eval(owner.stdout.readline()))
    loaded = handle.load()
    with pytest.raises(OSError, match="a different file"):
        handle._replace(name="lidarpool-0123456789abcdef").load()
    owner.communicate("")
    with pytest.raises(OSError, match="No such file"):
        handle.load()
    assert np.array_equal(loaded, np.arange(100_000))  # which keeps the memory
