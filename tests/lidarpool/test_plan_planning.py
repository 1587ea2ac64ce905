import numpy as np
import pytest

from lidarpool.base.errors import LidarpoolError
from lidarpool.plan import Planning

BAD = {
    "start within": ({"centres": [(25, 24)], "radii": 2}, r"start \(25, 25\) lies within disc 0"),
    "target within": ({"centres": [(0, 0), (-30, -21)], "radii": 2}, "target .* within disc 1"),
    "no way to go": ({"start": (1, 2), "target": (1, 2)}, "nothing to plan"),
    "start not finite": ({"start": (np.nan, 0)}, "start\\[0\\] is nan; it must be a finite number"),
    "target in space": ({"target": (0, 0, 0)}, "target is .* at most 2 items"),
    "start a word": ({"start": "here"}, "start is 'here'"),
    "centres not finite": ({"centres": [(0, np.inf)], "radii": 1}, "centres is .*inf"),
    "centres in space": ({"centres": [(0, 0, 0)], "radii": 1}, r"centres is .*\(m, 2\)"),
    "centres ragged": ({"centres": [(0, 0), (1,)], "radii": 1}, "centres is"),
    "radii too many": ({"centres": [(0, 0)], "radii": [1, 2]}, "one for each disc or one for all"),
    "radius 0": ({"centres": [(0, 0), (5, 5)], "radii": [1, 0]}, "above 0"),
    "radius below 0": ({"centres": [(0, 0)], "radii": -1}, "above 0"),
    "radius not finite": ({"centres": [(0, 0)], "radii": np.inf}, "radii is inf; it must be fin"),
    "no trials": ({"trials": 0}, "trials is 0; it must be 1 to"),
    "half a trial": ({"trials": 1.5}, "trials is 1.5"),
}


@pytest.mark.parametrize(("fields", "message"), BAD.values(), ids=BAD.keys())
def test_bad_values_are_named(fields, message):
    with pytest.raises(LidarpoolError, match=message) as error:
        Planning(**fields)
    assert len(str(error.value).splitlines()) <= 2


def test_one_radius_serves_all_discs():
    planning = Planning(centres=[(0, 0), (5, 5)], radii=2)
    assert planning.radii.tolist() == [2, 2]
    assert planning.centres.shape == (2, 2)
    none = Planning(centres=[], radii=2)
    assert (none.centres.shape, none.radii.shape) == ((0, 2), (0,))


def test_the_description_does_not_change():
    given = np.array([(0.0, 0.0)])
    planning = Planning(centres=given, radii=2)
    given[:] = 25
    assert planning.centres.tolist() == [[0, 0]]
    with pytest.raises(ValueError, match="read-only"):
        planning.centres[:] = 1
