"""Values that a twin computes from its rays, each against a closed form."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from tests.made_recordings import made_recording

from lidarreal.reconstruction.alignment import AlignedSweep, Alignment
from lidarreal.reconstruction.blocked_directions import PulseCounts
from lidarreal.reconstruction.free_space import RangeImage, find_stationary_points, locate
from lidarreal.reconstruction.held_out import HeldOutRays
from lidarreal.reconstruction.labels import SurfelMaterial, labels_of, split_by_object
from lidarreal.reconstruction.motion import Motion, MotionStep
from lidarreal.reconstruction.odometry import RecordedPoses
from lidarreal.reconstruction.porosity import Crossings, Porosity
from lidarreal.reconstruction.range_noise import RingNeighbors
from lidarreal.reconstruction.recorded_sweeps import RecordedSweeps
from lidarreal.reconstruction.reflectances import (
    IntensityModel,
    Response,
    fit_response,
    incidence_factors,
)
from lidarreal.reconstruction.submaps import AlignedSubmap, merge_alignments, split_into_submaps
from lidarreal.reconstruction.surface_map import (
    Observations,
    SurfaceMap,
    build_surface_map,
    median_shifts,
)
from lidarreal.reconstruction.surfels import Surfels, principal_axes, surfel_mesh
from lidarreal.reconstruction.vehicle_detection import find_vehicle_returns
from lidarreal.reconstruction.vehicle_returns import VehicleReturns
from lidarreal.reconstruction.visibility import estimate_visibility
from lidarreal.scan_patterns.lasers import RingLasers
from lidarscenario.points.point_scene import CLASS_MATERIAL
from lidarsim.columns.sweep import Sweep
from lidarsim.media.materials import extinction
from lidarsim.scene.colors import Colors
from lidarsim.scene.face_materials import FaceMaterials

pytest.importorskip("scipy")


def observed(surfels=240, rays=40, seed=1, rings=4):
    """Return rays that end on surfels at several ranges and incidences, and their reflectances."""
    rng = np.random.default_rng(seed)
    surfel = np.repeat(np.arange(surfels), rays)
    range_m = rng.uniform(6, 39, surfels)[surfel] * rng.uniform(0.6, 1.4, len(surfel))
    cosine = rng.uniform(0.25, 1, len(surfel))
    ring = rng.integers(0, rings, len(surfel))
    reflectance = rng.uniform(0.1, 0.8, surfels)
    intensity = np.full(len(surfel), np.nan)
    return Observations(surfel, ring, range_m, cosine, intensity), reflectance[surfel]


@pytest.mark.parametrize("exponent", [0, 2])
@pytest.mark.parametrize("visibility_m", [60.0, 250.0])
def test_the_visibility_explains_the_attenuation(exponent, visibility_m):
    """Intensities may be energies or compensated for range, and depend on the incidence."""
    rays, reflectance = observed()
    alpha = extinction(visibility_m / 1000, 905.0)
    light = reflectance * rays.cosine**1.3 / rays.range_m**exponent
    noise = np.random.default_rng(2).lognormal(0, 0.02, len(light))
    foggy = rays._replace(intensity=light * np.exp(-2 * alpha * rays.range_m) * noise)
    parts = [foggy.select_surfels(np.arange(240) % 2 == half) for half in (0, 1)]
    assert estimate_visibility(parts, 905.0) == pytest.approx(visibility_m, rel=0.05)
    assert estimate_visibility([rays._replace(intensity=light * noise)], 905.0) is None
    assert estimate_visibility([foggy.select(np.arange(len(light)) < 4000)], 905.0) is None
    same = foggy._replace(range_m=np.full(len(light), 20.0))
    assert estimate_visibility([same], 905.0) is None


def test_surfels_of_several_parts_keep_their_rays():
    rays, _ = observed(3, 2)
    joined = Observations.concatenate([rays, rays])
    assert joined.surfel.tolist() == [0, 0, 1, 1, 2, 2, 3, 3, 4, 4, 5, 5]
    np.testing.assert_array_equal(joined.range_m, np.tile(rays.range_m, 2))
    chosen = joined.select_surfels(np.array([False, True, False, False, True, True]))
    assert chosen.surfel.tolist() == [0, 0, 1, 1, 2, 2]
    np.testing.assert_array_equal(chosen.range_m, joined.range_m[[2, 3, 8, 9, 10, 11]])


RINGS = np.array([0.8, 1.0, 1.1, 1.3])


@pytest.mark.parametrize("model", list(IntensityModel))
def test_a_response_explains_intensities_at_other_ranges_and_incidences(model):
    """Rings are differently sensitive, and close ranges return less light, as in a receiver."""
    rays, reflectance = observed(400)

    def white(ring, range_m, cosine):
        near = np.interp(range_m, [5, 15], [0.6, 1.0])
        law = (10 / range_m) ** 2 * cosine if model is IntensityModel.ENERGIES else 1.0
        return 40 * RINGS[ring] * near * law

    rays = rays._replace(intensity=reflectance * white(rays.ring, rays.range_m, rays.cosine))
    response = fit_response([rays], 4, are_energies=model is IntensityModel.ENERGIES)
    assert response.model is model
    assert response.incidence_exponent == model.incidence_exponent
    np.testing.assert_allclose(
        response.by_ring[:, 4] / response.by_ring[:, 4].mean(), RINGS / RINGS.mean(), rtol=0.05
    )
    centers = np.random.default_rng(3).uniform(0, 100, (400, 3))
    found = response.reflectances(rays, centers)
    ratio = found.surfels / reflectance[::40]
    assert np.quantile(np.abs(ratio / np.median(ratio) - 1), 0.9) < 0.1
    assert found.spreads.max() <= 0.1
    range_m = np.array([15.0, 20.0, 35.0, 12.0])
    cosine = np.array([0.9, 0.5, 1.0, 0.3])
    ring = np.array([3, 0, 1, 2])
    surfel = np.array([0, 50, 100, 399])
    expected = reflectance[::40][surfel] * white(ring, range_m, cosine)
    np.testing.assert_allclose(found.intensities(surfel, range_m, cosine, ring), expected, rtol=0.2)
    figures = response.figures()
    assert figures["model"] == model.value
    assert np.shape(figures["by_ring"]) == (4, 11)


@pytest.mark.parametrize("exponent", [0.4, 1.7, 2.5])
@pytest.mark.parametrize("model", list(IntensityModel))
def test_the_incidence_exponent_is_that_of_the_intensities(model, exponent):
    rays, reflectance = observed(400)
    intensity = 30 * reflectance * RINGS[rays.ring] * rays.cosine**exponent
    if model is IntensityModel.ENERGIES:
        intensity = intensity * (10 / rays.range_m) ** 2
    response = fit_response(
        [rays._replace(intensity=intensity)], 4, are_energies=model is IntensityModel.ENERGIES
    )
    assert response.model is model
    assert response.incidence_exponent == pytest.approx(exponent, abs=0.1)
    by_ring = response.by_ring[:, 4]
    np.testing.assert_allclose(by_ring / by_ring.mean(), RINGS / RINGS.mean(), rtol=0.05)


def test_only_energies_decrease_with_the_range():
    range_m = np.array([5.0, 10.0, 20.0])
    np.testing.assert_allclose(IntensityModel.ENERGIES.attenuation(range_m), [4, 1, 0.25])
    np.testing.assert_allclose(IntensityModel.COMPENSATED.attenuation(range_m), 1)
    cosine = np.array([0.5, 1.0])
    np.testing.assert_allclose(IntensityModel.ENERGIES.law(range_m[1:], cosine), [0.5, 0.25])
    np.testing.assert_allclose(incidence_factors(cosine, 1.0), cosine)
    np.testing.assert_allclose(incidence_factors(cosine, 2.0), cosine**2)
    np.testing.assert_allclose(incidence_factors(cosine, 0.0), 1)


def test_surfels_without_rays_have_the_reflectance_of_the_nearest_known_ones():
    centers = np.array([[0.0, 0, 0], [1, 0, 0], [50, 0, 0], [51, 0, 0], [53, 0, 0]])
    rays = Observations(
        np.array([0] * 50 + [2] * 50), np.zeros(100, int), np.full(100, 10.0), np.ones(100),
        np.array([0.2] * 50 + [0.8] * 50),
    )  # fmt: skip
    response = Response(IntensityModel.COMPENSATED, np.ones((1, 11)), 0.0, 1.0, 5.0, 0.4, 1.0)
    # All five are neighbors, whose mean of 0.5 counts as three rays.
    found = response.reflectances(rays, centers).surfels
    np.testing.assert_allclose(found[[0, 2]], [(50 * 0.2 + 1.5) / 53, (50 * 0.8 + 1.5) / 53])
    np.testing.assert_allclose(found[[1, 3, 4]], 0.5)
    unknown = rays._replace(intensity=np.full(100, np.nan))
    np.testing.assert_allclose(response.reflectances(unknown, centers).surfels, 0.4)
    assert fit_response([unknown], 1, are_energies=False) is None


def test_statistics_of_held_out_rays():
    nan = np.nan
    rays = HeldOutRays(
        sweep=np.array([4, 4, 4, 4, 9, 9, 9, 9]),
        ring=np.array([0, 0, 1, 1, 0, 0, 1, 1]),
        range_m=np.array([2.0, 6.0, 12.0, nan, 30.0, 50.0, nan, nan]),
        simulated_m=np.array([2.02, 5.9, nan, 14.0, 30.3, 50.01, 7.0, nan]),
        intensity=np.array([1.0, 2.0, nan, nan, 3.0, 4.0, nan, nan]),
        simulated_intensity=np.array([2.0, 3.0, 1.0, 1.0, 4.0, 5.0, 1.0, nan]),
        standing=np.array([1, 1, 1, 0, 0, 1, 0, 0], bool),
        moving=np.array([0, 0, 0, 0, 1, 0, 0, 0], bool),
        on_object=np.array([0, 1, 0, 1, 1, 0, 1, 0], bool),
    )
    found = rays.figures()
    every = found["all"]
    assert (every["rays"], every["no_surface"]) == (5, pytest.approx(0.2))
    assert every["median_difference_m"] == pytest.approx(0.015)
    assert every["median_abs_difference_m"] == pytest.approx(0.06)
    assert every["p90_abs_difference_m"] == pytest.approx(0.24)
    assert every["rank_correlation"] == pytest.approx(1)
    assert every["mean_intensity_difference"] == pytest.approx(3.5 / 2.5 - 1)
    assert found["stationary"]["rays"] == 4
    assert found["stationary"]["median_difference_m"] == pytest.approx(0.01)
    # Rays 3 and 6 hit objects where nothing returned; ray 1 returned from the same surface.
    moving = found["moving"]
    assert moving["rays"] == 1 and moving["median_difference_m"] == pytest.approx(0.3)
    assert moving["ghosts"] == pytest.approx(2 / 6)
    assert moving["ghosts_on_objects"] == pytest.approx(2 / 4)
    assert found["points"] == pytest.approx(6 / 5)
    assert found["points_by_ring"] == pytest.approx(np.median([0, 1]))
    assert found["no_return"]["recorded"] == pytest.approx(3 / 8)
    assert found["no_return"]["simulated"] == pytest.approx(2 / 8)
    assert found["no_return"]["f1"] == pytest.approx(2 * 1 / 5)
    assert [(row["from_m"], row["to_m"], row["rays"]) for row in found["by_range"]] == [
        (0, 5, 1), (5, 10, 1), (10, 20, 1), (20, 40, 1), (40, 80, 1),
    ]  # fmt: skip
    assert [row["points"] for row in found["by_range"]] == [1, 2, 1, 1, 1]
    assert [(row["sweep"], row["rays"]) for row in found["by_sweep"]] == [(4, 3), (9, 2)]
    still = replace(rays, moving=np.zeros(8, bool), on_object=np.zeros(8, bool)).figures()
    assert still["moving"] is None
    returned = rays.select(rays.return_mask).figures()
    assert returned["no_return"] is None
    assert returned["points"] == pytest.approx(4 / 5)


@settings(deadline=None)
@given(st.floats(-3.1, 3.1), st.floats(4, 60), st.floats(-0.5, 0.5), st.floats(-0.25, 0.25))
def test_three_pulses_on_a_plane_have_no_range_noise(normal_azimuth, apart_m, tilt, elevation):
    """The inverse range on a plane is a constant plus a sine of the azimuth."""
    normal = np.array([np.cos(normal_azimuth) * np.cos(tilt),
                       np.sin(normal_azimuth) * np.cos(tilt), np.sin(tilt)])  # fmt: skip
    azimuth = normal_azimuth + np.linspace(-0.6, 0.6, 241)
    directions = np.stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth),
         np.full(241, np.sin(elevation))], axis=1,
    )  # fmt: skip
    inward = directions @ normal
    range_m = apart_m / inward
    points = range_m[:, None] * directions
    lasers = RingLasers.at_origin(np.array([elevation]))
    sweep = Sweep(points, {"row": np.zeros(241, int)})
    triples = RingNeighbors.from_sweep(sweep, lasers)
    if np.ptp(np.arctan2(points[:, 1], points[:, 0])) > 2:
        return  # across the back
    assert len(triples.at) == 239
    np.testing.assert_allclose(triples.span, 0.01, rtol=1e-6)
    np.testing.assert_allclose(triples.share, 0.5, rtol=1e-6)
    curved = 1 - normal[2] * directions[triples.at, 2] / inward[triples.at]
    assert np.abs(triples.deviations(range_m, curved)).max() < 1e-6 * range_m.max()
    # An error of the middle range alone is reduced by its own part in the variance.
    noisy_m = range_m.copy()
    noisy_m[120] += 0.1
    found = triples.deviations(noisy_m, curved)
    at = np.flatnonzero(triples.at == 120)[0]
    assert found[at] == pytest.approx(0.1 / np.sqrt(1.5), abs=1e-4)


def test_pulses_of_other_rings_and_distant_pulses_are_no_neighbors():
    azimuth = np.radians([0, 1, 2, 3, 4, 7, 8, 0.5, 1.5, 2.6])
    ring = np.array([0] * 7 + [1] * 3)
    points = np.stack([np.cos(azimuth), np.sin(azimuth), 0 * azimuth], axis=1)
    shuffled = np.array([9, 3, 0, 7, 5, 1, 8, 2, 6, 4])
    sweep = Sweep(points[shuffled], {"row": ring[shuffled]})
    triples = RingNeighbors.from_sweep(sweep, RingLasers.at_origin(np.zeros(2)))
    found = {tuple(shuffled[[a, b, c]].tolist()): s
             for a, b, c, s in zip(triples.before, triples.at, triples.after, triples.share,
                                   strict=True)}  # fmt: skip
    assert set(found) == {(0, 1, 2), (1, 2, 3), (2, 3, 4), (7, 8, 9)}
    assert found[7, 8, 9] == pytest.approx(1 / 2.1)


def test_a_range_image_tells_what_is_in_front_of_and_behind_surfaces():
    elevation = np.radians(np.arange(6, -7, -1.0))
    azimuth = np.radians(np.arange(-179.75, 180, 0.25))
    ring, column = (part.ravel() for part in np.indices((13, len(azimuth))))
    directions = np.stack(
        [np.cos(elevation[ring]) * np.cos(azimuth[column]),
         np.cos(elevation[ring]) * np.sin(azimuth[column]), np.sin(elevation[ring])], axis=1,
    )  # fmt: skip
    range_m = np.where(azimuth[column] > 0, 20.0, 10.0)  # closer on the right
    lasers = RingLasers.at_origin(elevation)
    points = range_m[:, None] * directions
    window = (np.abs(azimuth[column] - 2) < 0.3) & (np.abs(elevation[ring]) < 0.06)
    image = RangeImage.from_points(points[~window], lasers)

    def classified(range_m, azimuth_rad, elevation_deg):
        level = np.cos(np.radians(elevation_deg))
        point = range_m * np.array([level * np.cos(azimuth_rad), level * np.sin(azimuth_rad),
                                    np.sin(np.radians(elevation_deg))])  # fmt: skip
        return tuple(bool(mask[0]) for mask in image.classify(point[None]))

    passed, confirmed, neither = (True, False), (False, True), (False, False)
    assert classified(20.0, 1.0, 0.4) == confirmed
    assert classified(20.0 - 0.35, 1.0, 0.4) == confirmed
    assert classified(20.0 - 0.45, 1.0, 0.4) == passed
    assert classified(20.0 + 0.35, 1.0, 0.4) == confirmed
    assert classified(20.0 + 0.45, 1.0, 0.4) == neither
    assert classified(9.6, -1.0, -3.4) == passed
    assert classified(9.8, -1.0, -3.4) == confirmed
    assert classified(10.35, -1.0, -3.4) == neither
    # At an edge, a point is neither in front of nor behind the surfaces on both sides.
    assert classified(15.0, 0.0, 0.4) == confirmed
    assert classified(15.0, 2.0, 0.0) == neither, "no ray returned from there"
    assert classified(5.0, 1.0, 6.1) == passed and classified(5.0, 1.0, -6.1) == passed
    assert classified(5.0, 1.0, 6.3) == neither and classified(5.0, 1.0, -6.3) == neither
    cells, found, found_m = locate(points, lasers, 1440)
    np.testing.assert_array_equal(cells[0], ring)
    np.testing.assert_allclose(found, elevation[ring], atol=1e-9)
    np.testing.assert_allclose(found_m, range_m)


def test_only_the_vehicle_blocks_pulses_within_surfaces_at_close_range():
    """Cells by ring: blocked, a window of few pulses, the sky, a far wall, and the ground."""
    counts = PulseCounts.zeros(6, 72)
    ring, column = (part.ravel() for part in np.indices((6, 72)))
    azimuth = np.radians(5 * column - 177.5)
    kinds = {
        "blocked": (column >= 10) & (column < 14) & (ring < 2),
        "single": (column == 40) & (ring == 0),
        "sky": (column >= 20) & (column < 24) & (ring < 2),
        "far": (column >= 30) & (column < 34) & (ring < 2),
        "seldom": (column >= 50) & (column < 54) & (ring < 2),
        "ground": (column >= 10) & (column < 14) & (ring == 3),
        "apart": (column >= 60) & (column < 64) & (ring == 5),
    }
    ranges_m = {"sky": np.nan, "far": 25.0, "ground": np.nan, "apart": np.nan}
    lost = np.any([*kinds.values()], axis=0)
    for _ in range(10):
        counts.add_returned(azimuth[~lost], ring[~lost], np.full((~lost).sum(), 8.0))
    for name, cells in kinds.items():
        gone = 4 if name == "seldom" else 10
        for number in range(10):
            if number < gone:
                counts.add_lost(
                    azimuth[cells], ring[cells], np.full(cells.sum(), ranges_m.get(name, 8.0))
                )
            else:
                counts.add_returned(azimuth[cells], ring[cells], np.full(cells.sum(), 8.0))
    blocked = counts.blocked(np.radians([5.0, 2.0, -1.0, -5.0, -10.0, -15.0]))
    expected = kinds["blocked"] | kinds["ground"]
    np.testing.assert_array_equal(blocked.contains(azimuth, ring), expected)
    level = counts.blocked(np.radians([5.0, 2.0, -1.0, -2.0, -10.0, -15.0]))
    np.testing.assert_array_equal(level.contains(azimuth, ring), kinds["blocked"])
    assert counts.returned.sum() + counts.lost.sum() == 10 * 6 * 72


def test_returns_in_front_of_the_vehicle_belong_to_it():
    farthest = np.full((2, 720), -np.inf, np.float32)
    farthest[1, 540] = 1.5  # 90° to 90.5°
    vehicle = VehicleReturns(farthest, 0.1)
    azimuth = np.radians(90.2)
    ahead = np.array([np.cos(azimuth), np.sin(azimuth), 0])
    points = np.array([1.4, 1.59, 1.61, 1.4])[:, None] * ahead
    found = vehicle.contain(Sweep(points, {"row": np.array([1, 1, 1, 0])}))
    assert found.tolist() == [True, True, False, False]
    assert vehicle.are_found and not VehicleReturns(np.full((2, 720), -np.inf)).are_found


def plates(distances, size=4.0, dark=None):
    """Return upright surfels across the x axis that face the origin."""
    half = size / 2
    corners = [[(x, half, -half), (x, -half, -half), (x, -half, half), (x, half, half)]
               for x in distances]  # fmt: skip
    surfels = Surfels(surfel_mesh("plates", np.array(corners, float)), np.zeros(len(corners), bool))
    return surfels if dark is None else replace(surfels, dark=np.array(dark))


def rays_to(ends, origins=(0.0, 0.0, 0.0)):
    """Return a sweep whose rays end at some points."""
    ends = np.array(ends, float)
    origins = np.broadcast_to(origins, ends.shape)
    return AlignedSweep(ends, ends, origins, np.zeros(len(ends), int), None, None)


def test_rays_end_on_surfels_pass_them_or_end_before_them():
    surface = SurfaceMap.from_surfels(plates([10.0]))
    ends = [
        (10, 0, 0),
        (10.1, 1, 0.5),
        (10.2, 0, 0),
        (9.8, 0, 0),
        (13, 0, 0),
        (7, 0, 0),
        (10, 9, 0),
    ]
    hits = surface.cast(rays_to(ends))
    assert hits.rays.tolist() == [0, 1, 2, 3, 4, 5]
    factor = np.linalg.norm(np.array(ends)[:6] / np.array(ends)[:6, :1], axis=1)
    np.testing.assert_allclose(hits.distance_m, 10 * factor, rtol=1e-6)
    np.testing.assert_allclose(hits.off_plane_m, [0, 0.1, 0.2, 0.2, 3, 3], atol=1e-6)
    np.testing.assert_allclose(hits.cosine, 1 / factor, rtol=1e-6)
    np.testing.assert_allclose(hits.inward, -1 / factor, rtol=1e-6)
    np.testing.assert_allclose(hits.farther_m[[2, 3, 4, 5]], [0.2, -0.2, 3, -3], atol=1e-5)
    assert hits.ends.tolist() == [True, True, False, False, False, False]
    assert hits.passes.tolist() == [False, False, True, False, True, False]
    assert hits.votes.tolist() == [4, 4, -1, 0, -1, 0]
    assert hits.dark_votes.tolist() == [-2, -2, -2, 0, -2, 0]
    some = surface.cast(rays_to(ends), np.array([False, True, False, False, True, False, True]))
    assert some.rays.tolist() == [1, 4]
    behind = surface.cast(rays_to([(10, 0, 0)], (20.0, 0, 0)))
    np.testing.assert_allclose(behind.inward, [1])
    # Along the surface, a point that is far away on the ray may still be on its plane.
    grazing = surface.cast(rays_to([(10.05, 1.9, 0)], (9.95, -3, 0)))
    assert grazing.ends.tolist() == [True]


def test_rays_cross_several_surfels_in_order():
    surface = SurfaceMap.from_surfels(plates([10.0, 5.0, 15.0]))
    sweep = rays_to([(12.0, 0.3, 0.2), (20.0, 0.5, 0)])
    whole = surface.crossings(sweep)
    assert whole.surfel[:, :4].tolist() == [[1, 0, 2, -1], [1, 0, 2, -1]]
    length = np.linalg.norm([1.0, 0.3 / 12, 0.2 / 12])
    np.testing.assert_allclose(whole.distance_m[0, :3], length * np.array([5, 10, 15]), rtol=1e-5)
    to_returns = surface.crossings_to_returns(sweep, np.array([True, False]))
    assert to_returns.surfel[:, :3].tolist()[0][:2] == [1, 0]
    assert len(to_returns.surfel) == 1
    porous = replace(surface, porosity=Porosity(np.array([0.2, 0.8, 0.0]), np.zeros(3)))
    likely = porous.cast_likely(sweep)
    assert likely.surfel.tolist() == [0, 0], "80 % of the rays pass the first surfel"
    np.testing.assert_allclose(likely.distance_m[0], 10 * length, rtol=1e-5)
    lost = whole.as_lost()
    assert np.isinf(lost.range_m).all()
    first = whole.select(whole.surfel == 0)
    assert first.surfel[:, :2].tolist() == [[0, -1], [0, -1]]
    np.testing.assert_allclose(first.distance_m[0, 0], 10 * length, rtol=1e-5)


@pytest.mark.parametrize("first", [0, 1, 2])
def test_surfels_shift_by_the_median_of_their_rays(first):
    """The first surfels may have no rays."""
    surfel = np.array([3, 1, 1, 1, 3, 0]) + first
    offsets = np.array([0.4, 0.3, -0.5, 0.1, 0.2, -0.6])
    found = median_shifts(surfel, offsets, 5 + first)
    expected = [0] * first + [-0.6 / 2, 0.1 * 3 / 4, 0, 0.3 * 2 / 3, 0]
    np.testing.assert_allclose(found, expected)


def lattice(columns, rows, voxel_m=0.1):
    """Return one point in each voxel of an upright plane."""
    y, z = np.meshgrid(np.arange(columns), np.arange(rows), indexing="ij")
    return (np.stack([0 * y, y, z], axis=-1).reshape(-1, 3) + 0.5) * voxel_m


@pytest.mark.parametrize(
    ("range_m", "incidence_deg", "half_m"),
    [
        (25.0, 0, 0.55 * 0.25),  # reaches beyond the middle between two rings 0.25 m apart
        (25.0, 30, 0.55 * 0.25 / np.cos(np.pi / 6)),
        (32.0, 0, 0.55 * 0.32),
        (90.0, 0, 0.2),  # limited by the distance of the neighbors
    ],
)
def test_surfels_of_a_plane_close_the_gap_between_rings(range_m, incidence_deg, half_m):
    points = lattice(20, 20)
    incidence = np.radians(incidence_deg)
    outward = np.tile(range_m * np.array([np.cos(incidence), np.sin(incidence), 0]), (400, 1))
    surfels = Surfels.from_points("plane", points, outward, 0.1, 0.01)
    inner = (np.abs(surfels.centers[:, 1:] - 1) < 0.7).all(axis=1)
    assert inner.sum() > 100
    np.testing.assert_allclose(surfels.normals @ [1.0, 0, 0], 1, atol=1e-6)
    across_m = np.linalg.norm(surfels.half_sides[1], axis=1)
    np.testing.assert_allclose(across_m[inner], half_m, rtol=1e-6)


@pytest.mark.parametrize(("range_m", "half_m"), [(5.0, 0.3), (40.0, 0.4), (90.0, 0.46)])
def test_surfels_of_sparse_points_are_limited_by_voxels_or_the_gap_between_rings(range_m, half_m):
    """Points are 0.5 m apart, and voxels have an edge length of 0.1 m."""
    points = np.floor(lattice(20, 20, 0.5) / 0.1) * 0.1 + 0.05
    outward = np.tile([range_m, 0, 0], (400, 1))
    surfels = Surfels.from_points("plane", points, outward, 0.1, 0.01)
    inner = (np.abs(surfels.centers[:, 1:] - 5) < 3).all(axis=1)
    along_m = np.linalg.norm(surfels.half_sides[0], axis=1)[inner]
    np.testing.assert_allclose(along_m, half_m, rtol=0.03)


@pytest.mark.parametrize(("range_m", "is_pole"), [(5.0, True), (20.0, True), (50.0, False)])
@pytest.mark.parametrize("is_upright", [True, False])
def test_lines_across_several_rings_are_poles_that_face_the_sensor(range_m, is_pole, is_upright):
    """At 50 m, neighbors on the line extend over one ring. Horizontal lines belong to one ring."""
    points = lattice(1, 100) if is_upright else lattice(100, 1)
    outward = np.tile([0.6 * range_m, -0.8 * range_m, 0], (100, 1))
    surfels = Surfels.from_points("pole", points, outward, 0.1, 0.01)
    half_m = np.linalg.norm(surfels.half_sides[1], axis=1)
    is_thin = np.isclose(half_m, 0.05)  # half a voxel
    assert (is_thin == (is_pole and is_upright)).all()
    np.testing.assert_allclose(surfels.normals[is_thin] @ [0.6, -0.8, 0], 1)


@pytest.mark.parametrize(("range_m", "is_pole"), [(20.0, True), (30.0, False)])
def test_poles_below_the_sensor_appear_shorter(range_m, is_pole):
    """The neighbors have a standard deviation of 0.35 m, of which 80 % are across the beams."""
    outward = np.tile([0, -0.8 * range_m, 0.6 * range_m], (100, 1))
    surfels = Surfels.from_points("pole", lattice(1, 100), outward, 0.1, 0.01)
    inner = np.abs(surfels.centers[:, 2] - 5) < 4
    is_thin = np.isclose(np.linalg.norm(surfels.half_sides[1], axis=1), 0.05)
    assert (is_thin[inner] == is_pole).all()
    np.testing.assert_allclose(surfels.normals[is_thin] @ [0, -1.0, 0], 1)


def test_surfels_of_lost_pulses_face_the_sensor():
    """A wall with a window that returns no pulses, seen from two positions."""
    turns = np.stack(np.meshgrid(np.linspace(-0.4, 0.4, 161), np.linspace(-0.2, 0.2, 81)), axis=-1)
    tangents = np.tan(turns.reshape(-1, 2))
    directions = np.column_stack([np.ones(len(tangents)), tangents])
    directions /= np.linalg.norm(directions, axis=1)[:, None]

    def observed(number):
        origin = np.array([0.0, number - 0.5, 1.0])
        range_m = 10 / directions[:, 0]
        ends = origin + directions * range_m[:, None]
        is_lost = (np.abs(ends[:, 1:] - [0.5, 1]) < [1.5, 1]).all(axis=1)
        sweeps = []
        for rows, world in ((~is_lost, ends), (is_lost, origin + directions)):
            origins = np.tile(origin, (rows.sum(), 1))
            ring = np.zeros(rows.sum(), int)
            sweeps.append(AlignedSweep(world[rows], world[rows], origins, ring, None, None))
        return sweeps[0], sweeps[1]._replace(gap_range_m=range_m[is_lost])

    sweeps = SimpleNamespace(
        name="wall",
        recorded=SimpleNamespace(gap_rad=0.005),
        read=lambda number: observed(number)[0],
        read_with_lost=observed,
    )
    stationary = {number: np.ones(len(observed(number)[0].world), bool) for number in (0, 1)}
    surfels = build_surface_map(sweeps, stationary, 0.15).surfels
    dark = surfels.dark
    assert dark.sum() > 100 and (~dark).sum() > 500
    np.testing.assert_allclose(surfels.centers[:, 0], 10, atol=1e-6)
    np.testing.assert_allclose(surfels.normals @ [-1.0, 0, 0], 1, atol=1e-6)
    in_window = (np.abs(surfels.centers[:, 1:] - [0.5, 1]) < [1.5, 1]).all(axis=1)
    assert (in_window == dark).mean() > 0.95


def test_surfels_of_a_tilted_plane_lie_in_it_and_face_the_sensor():
    rng = np.random.default_rng(5)
    rotation = Rotation.from_rotvec((0.5, -0.3, 0.2)).as_matrix()
    flat = rng.uniform((-3, -2, 0), (3, 2, 0), (12_000, 3))
    points = flat @ rotation.T + np.array([40.0, -30.0, 5.0])
    sensor = np.array([0.0, 0.0, 2.0])
    surfels = Surfels.from_points("plane", points, sensor - points, 0.25, 0.005)
    normal = rotation[:, 2] * np.sign(rotation[:, 2] @ (sensor - points[0]))
    np.testing.assert_allclose(surfels.normals @ normal, 1, atol=1e-6)
    offsets = surfels.centers - np.array([40.0, -30.0, 5.0])
    assert np.abs(offsets @ rotation[:, 2]).max() < 1e-6
    assert 16 * 24 * 0.8 < len(surfels) < 16 * 24 * 2.5
    # Together they close the plane, and extend by less than a surfel beyond it.
    local = (surfels.mesh.vertices - np.array([40.0, -30.0, 5.0])) @ rotation
    assert (np.abs(local).max(axis=0)[:2] < (3.8, 2.8)).all()
    inner = rng.uniform((-2.8, -1.8, 0), (2.8, 1.8, 0), (2_000, 3)) @ rotation.T
    hits = SurfaceMap.from_surfels(surfels).cast(
        rays_to(inner + (points - flat @ rotation.T)[0], sensor)
    )
    assert len(hits.rays) > 0.995 * 2_000
    assert hits.ends.all()
    assert not Surfels.are_enough(points[:150], 0.25) and Surfels.are_enough(points, 0.25)


def test_principal_axes_are_those_of_the_spread():
    rng = np.random.default_rng(1)
    rotation = Rotation.from_rotvec((0.2, 1.0, -0.4)).as_matrix()
    around = rng.normal(0, (3.0, 0.1, 1.0), (2, 4000, 3)) @ rotation.T + np.array([9.0, -5, 1])
    variances, axes = principal_axes(around)
    np.testing.assert_allclose(variances, [[0.01, 1, 9]] * 2, rtol=0.1)
    for found, column in zip(axes[0], (1, 2, 0), strict=True):
        assert abs(found @ rotation[:, column]) == pytest.approx(1, abs=1e-3)


def test_each_object_has_its_surfels_and_each_class_its_material():
    labels = [0, 7, (3 + 1) << 16 | 7, (0 + 1) << 16, 7]
    points = np.zeros((5, 3))
    sweep = Sweep(
        points,
        {"class": np.array([0, 7, 7, -1, 7]), "object": np.array([-1, -1, 3, 0, -1])},
    )
    assert labels_of(sweep).tolist() == labels
    only = Sweep(points, {"class": np.array([0, 7, 70_000, -1, 65_535])})
    assert labels_of(only).tolist() == [0, 7, 0, 0, 65_535]
    assert labels_of(Sweep(points)) is None
    surfels = plates([10.0, 20, 30, 40, 50])
    names = [f"{CLASS_MATERIAL}{label}" if label else "" for label in labels]
    distinct = tuple(dict.fromkeys(names))
    index = np.array([distinct.index(name) for name in names], np.int32).repeat(2)
    grays = (
        np.repeat([10, 20, 30, 40, 50], 2)[:, None].repeat(3, axis=1) + np.tile([0, 1], 5)[:, None]
    )
    colors = Colors.from_face_colors(grays.astype(np.uint8))
    mesh = replace(surfels.mesh, materials=FaceMaterials(distinct, index), colors=colors)
    porosity = Porosity(np.array([0, 0.4, 0, 0, 0]), np.array([0, 0.06, 0, 0, 0]))
    parts = split_by_object(mesh, porosity, np.array([0, 0, 0.3, 0, 0]))
    assert [part.name for part in parts] == ["object 0", "object 3", "plates"]
    distances = [part.vertices.reshape(-1, 4, 3)[:, 0, 0].tolist() for part in parts]
    assert distances == [[40], [30], [10, 20, 50]]
    shown = [part.colors.corners[:, 0, 0].tolist() for part in parts]
    assert shown == [[40, 41], [30, 31], [10, 11, 20, 21, 50, 51]]
    assert parts[0].materials is None
    found = SurfelMaterial.from_name(parts[1].materials.names[0])
    assert found == SurfelMaterial(7, 0.0, 0.0, 0.3)
    static = parts[2].materials
    by_surfel = [static.names[number] for number in static.index[::2]]
    assert by_surfel == ["", "class 7, gaps 0.4, spread 0.06", "class 7"]
    assert SurfelMaterial(7, 0.4, 0.06, 0.0).entry() == {
        "material": "class 7, gaps 0.4, spread 0.06", "class": 7, "gap_fraction": 0.4,
        "range_spread_m": 0.06,
    }  # fmt: skip


def test_crossings_behind_dark_surfels_do_not_count():
    surfel = np.array([[0, 1, 2], [1, 2, -1]], np.int32)
    crossings = Crossings(surfel, np.array([[1, 2, 3], [2, 3, np.inf]], np.float32),
                          np.zeros((2, 3), np.uint8), np.array([3.0, 3.0]))  # fmt: skip
    porosity = Porosity(np.array([0.9, 0.6, 0.0]), np.zeros(3))
    # Shares of returns: 0.1, 0.9 * 0.4, 0.54 and 0.4, 0.6.
    assert porosity.likely_crossings(crossings, np.zeros(3, bool)).tolist() == [2, 1]
    assert porosity.likely_crossings(crossings, np.array([False, True, False])).tolist() == [0, 0]
    assert porosity.select(np.array([True, False, True])).gap_fraction.tolist() == [0.9, 0.0]


def test_overlapping_submaps_are_blended_with_their_rotations():
    count = 200
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, 3] = np.arange(count)[:, None] * np.array([0.5, -0.1, 0.0])
    first = Alignment(poses, 0.1 * np.arange(count), 0.1, 0.2, Motion.TIMED, np.zeros((2, 3)))
    submaps = split_into_submaps(poses[:, :3, 3])
    assert len(submaps) == 2
    turned = np.eye(4)
    turned[:3, :3] = Rotation.from_rotvec((0, 0, 0.02)).as_matrix()
    aligned = [
        AlignedSubmap(
            poses[submap.numbers] @ (turned if index else np.eye(4)),
            np.full((2, 3), [0.01, 0.03][index]),
            np.array([0.04, 0.02]) * (1 + index),
            np.full(len(submap.numbers), [0.005, 0.007][index]),
        )
        for index, submap in enumerate(submaps)
    ]
    merged = merge_alignments(first, submaps, aligned)
    yaw = np.arctan2(merged.poses[:, 1, 0], merged.poses[:, 0, 0])
    assert yaw[0] == pytest.approx(0) and yaw[-1] == pytest.approx(0.02)
    assert (np.diff(yaw) >= -1e-12).all()
    border = submaps[1].own_numbers[0]
    assert yaw[border] == pytest.approx(0.01, abs=2e-3)
    np.testing.assert_allclose(merged.poses[:, :3, 3], poses[:, :3, 3], atol=1e-9)
    np.testing.assert_allclose(merged.ring_offsets, 0.02)
    np.testing.assert_allclose(merged.thickness_m, [0.06, 0.03])
    assert set(merged.plane_distance_m.tolist()) == {0.005, 0.007}
    step = MotionStep.between(merged.poses[0], merged.poses[1])
    np.testing.assert_allclose(step.translation, [0.5, -0.1, 0], atol=1e-9)


@pytest.mark.parametrize("speed_m", [0.6, -0.6, 0.0])
def test_only_what_moves_with_the_sensor_is_the_vehicle(speed_m):
    """A bonnet in front on the left and a post beside the road, in a street between walls."""
    elevation = np.radians(np.linspace(8, -24, 24))
    azimuth = np.radians(np.arange(-179.75, 180, 0.5))
    ring, column = (part.ravel() for part in np.indices((24, len(azimuth))))
    vectors = np.stack(
        [np.cos(elevation[ring]) * np.cos(azimuth[column]),
         np.cos(elevation[ring]) * np.sin(azimuth[column]), np.sin(elevation[ring])], axis=1,
    )  # fmt: skip
    degrees = np.degrees(azimuth[column])
    is_bonnet = (ring >= 18) & (degrees > 20) & (degrees < 50)

    def read(number):
        with np.errstate(divide="ignore"):
            wall_m = np.where(vectors[:, 1] > 0, 9, -6) / vectors[:, 1]
            ground_m = np.where(vectors[:, 2] < 0, -1.8 / vectors[:, 2], np.inf)
        range_m = np.minimum(np.minimum(wall_m, ground_m), 60)
        # A post of 0.6 m is 3 m to the right of the path at x = 4.
        x = 4 - speed_m * number
        apart = x * np.sin(azimuth[column]) + 3 * np.cos(azimuth[column])
        along = (x * np.cos(azimuth[column]) - 3 * np.sin(azimuth[column])) / np.cos(
            elevation[ring]
        )
        range_m = np.where((np.abs(apart) < 0.3) & (along > 0), np.minimum(range_m, along), range_m)
        range_m = np.where(is_bonnet, 1.5 + 0.01 * np.sin(number), range_m)
        order = np.lexsort((ring, column))
        return Sweep((range_m[:, None] * vectors)[order], {"ring": ring[order]})

    recorded = RecordedSweeps.from_recording(made_recording("street", 26, read))
    poses = np.tile(np.eye(4), (26, 1, 1))
    poses[:, 0, 3] = speed_m * np.arange(26)
    given = RecordedPoses(poses, 0.1 * np.arange(26), "given", np.zeros(3))
    vehicle = find_vehicle_returns(recorded, given)
    if not speed_m:
        assert not vehicle.are_found, "a sensor that stands sees everything in the same place"
        return
    sweep = recorded.read(9)
    found = vehicle.contain(sweep)
    at = np.degrees(np.arctan2(sweep.points[:, 1], sweep.points[:, 0]))
    truth = np.linalg.norm(sweep.points, axis=1) < 1.6
    assert truth.sum() == is_bonnet.sum()
    assert found[truth].all()
    # Cells next to the bonnet are its edge, up to its range.
    assert not found[~truth].any(), at[found & ~truth]
    assert vehicle.share == pytest.approx(is_bonnet.mean(), rel=0.02)


@pytest.mark.parametrize("has_rings", [True, False])
def test_points_that_a_later_ray_passed_have_moved(has_rings):
    """A sensor that turns and drives in a round hall; a box is there in one sweep of five."""
    elevation = np.radians(np.arange(12.0, -9.0, -1.0))
    azimuth = np.radians(np.arange(0.25, 360, 0.5))
    rays = np.stack(np.meshgrid(elevation, azimuth, indexing="ij"), axis=-1).reshape(-1, 2)
    local = np.column_stack(
        [np.cos(rays[:, 0]) * np.cos(rays[:, 1]), np.cos(rays[:, 0]) * np.sin(rays[:, 1]),
         np.sin(rays[:, 0])]
    )  # fmt: skip
    hall = np.array([480_000.0, -5_400_000.0, 300.0])
    aligned = {}
    poses = np.tile(np.eye(4), (5, 1, 1))
    boxed = {}
    for number in range(5):
        turn = Rotation.from_euler("z", 25 * number, degrees=True).as_matrix()
        position = np.array([0.5 * number, -0.2 * number, 0.0])
        toward = local @ turn.T
        # The distance to a cylinder with a radius of 14 m.
        level = np.hypot(toward[:, 0], toward[:, 1])
        b = toward[:, :2] @ position[:2] / level
        range_m = (-b + np.sqrt(b**2 - position[:2] @ position[:2] + 14**2)) / level
        is_boxed = np.zeros(len(local), bool)
        if number == 3:
            direction = np.degrees(np.arctan2(toward[:, 1], toward[:, 0]))
            is_boxed = (np.abs(direction - 70) < 8) & (np.abs(rays[:, 0]) < np.radians(5.5))
            range_m[is_boxed] = 6.0
        poses[number, :3, :3] = turn
        poses[number, :3, 3] = hall + position
        points = local * range_m[:, None]
        aligned[number] = SimpleNamespace(points=points, world=points @ turn.T + hall + position)
        boxed[number] = is_boxed
    lasers = RingLasers.at_origin(elevation if has_rings else np.empty(0))
    sweeps = SimpleNamespace(
        read=aligned.__getitem__,
        recorded=SimpleNamespace(lasers=lasers),
        alignment=SimpleNamespace(poses=poses),
    )
    masks = find_stationary_points(sweeps, [0, 1, 2, 3, 4])
    assert [*masks] == [0, 1, 2, 3, 4]
    assert (~masks[3])[boxed[3]].mean() > 0.9
    for number, mask in masks.items():
        assert mask[~boxed[number]].mean() > 0.995
    # An earlier or a later sweep is sufficient.
    for pair in ([2, 3], [3, 4]):
        assert (~find_stationary_points(sweeps, pair)[3])[boxed[3]].mean() > 0.9
    # Without the other sweeps, nothing is known to have moved.
    assert find_stationary_points(sweeps, [3])[3].all()
