"""The step of a pattern: rows from one firing of a channel to its next."""

import numpy as np
import pytest

from raybeam import Pattern, SubRays


def grid(rings, firings, fov_deg, *, sector_deg=360.0):
    """Directions (firings, rings, 3) of evenly spaced azimuths and elevations."""
    elevation = np.radians(np.linspace(-fov_deg / 2, fov_deg / 2, rings))
    azimuth = np.radians(sector_deg) * np.arange(firings)[:, None] / firings
    x = np.cos(elevation) * np.cos(azimuth)
    y = np.cos(elevation) * np.sin(azimuth)
    return np.stack([x, y, np.broadcast_to(np.sin(elevation), x.shape)], axis=-1)


@pytest.mark.extended
@pytest.mark.parametrize("fov_deg", [0.4, 10.0, 33.2, 120.0])
@pytest.mark.parametrize("firings", [36, 360, 1024, 1800])
@pytest.mark.parametrize("rings", [4, 5, 8, 16, 31, 64, 100, 128, 255, 256])
def test_the_step_of_a_grid_is_found(rings, firings, fov_deg):
    """Firing after firing from below or from above, and ring after ring."""
    directions = grid(rings, firings, fov_deg)
    assert Pattern(directions.reshape(-1, 3)).step == rings
    assert Pattern(directions[:, ::-1].reshape(-1, 3)).step == rings
    assert Pattern(directions[::-1].reshape(-1, 3)).step == rings
    assert Pattern(directions.swapaxes(0, 1).reshape(-1, 3)).step == 1
    assert Pattern(directions.swapaxes(0, 1)[::-1].reshape(-1, 3)).step == 1


@pytest.mark.parametrize("rings", [4, 64, 200])
def test_the_step_of_other_grids_is_found(rings):
    rng = np.random.default_rng(rings)
    directions = grid(rings, 1024, 33.2)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    order = rng.permutation(rings)
    swung = grid(rings, 1024, 20, sector_deg=80) @ turn
    for firings in (directions @ turn, directions[:, order], directions.astype(np.float32), swung):
        assert Pattern(firings.reshape(-1, 3)).step == rings
        assert Pattern(firings.swapaxes(0, 1).reshape(-1, 3)).step == 1


def test_the_step_is_a_cycle_where_a_firing_has_not_all_channels():
    """Of 12 channels, all fire in every other firing, and the first five in between."""
    directions = grid(12, 900, 24)
    rows = [directions[k, : 12 if k % 2 == 0 else 5] for k in range(900)]
    assert Pattern(np.concatenate(rows)).step == 17


def test_a_given_step_is_taken():
    directions = grid(8, 90, 20).reshape(-1, 3)
    pattern = Pattern(directions, step=24)
    assert pattern.step == 24
    assert pattern.with_sub_rays(SubRays(np.zeros((2, 2)))).step == 24
    assert Pattern(directions[:8], step=8).step == 8  # a single firing, which the head turns
    for step in (0, -1):
        with pytest.raises(ValueError, match=f"step must be at least 1, .* but is {step}"):
            Pattern(directions, step=step)


@pytest.mark.parametrize("count", [0, 1, 2, 3, 40, 5_000])
def test_any_rays_have_some_step(count):
    directions = np.random.default_rng(1).normal(size=(count, 3))
    assert 1 <= Pattern(directions).step <= max(count, 1)
    assert Pattern(np.tile([0.0, 0, 1], (count, 1))).step == 1
