"""A run stands still when all of its parts have nothing under way, and not before."""

from dataclasses import dataclass

from lidarpool.standstill import Standstill


@dataclass
class Part:
    paused: bool = False
    idle: bool = False


def test_it_stands_still_when_everything_has_arrived():
    wanted, stops, before = [False], [], 0.0
    standstill = Standstill(lambda: wanted[0], lambda: stops.append(standstill.still))
    one, two = Part(idle=True), Part()
    for _ in range(2):
        standstill.look([one, two])
        assert not (one.paused or two.paused or standstill.still)
        wanted[0] = True
        standstill.look([one, two])
        assert one.paused and two.paused
        assert not standstill.still  # one of them is busy
        assert standstill.seconds == before
        two.idle = True
        for _ in range(3):
            standstill.look([one, two])
            assert standstill.still
        wanted[0], two.idle = False, False
        standstill.look([one, two])
        before = standstill.seconds
    assert stops == [True, True]  # once each time
    assert before > 0


def test_it_goes_on_at_once():
    wanted = [True]
    standstill = Standstill(lambda: wanted[0], lambda: None)
    part = Part(idle=True)
    standstill.look([part])
    wanted[0] = False
    standstill.look([part])
    assert not part.paused
    assert not standstill.still
