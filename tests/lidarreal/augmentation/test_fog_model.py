"""Fog on recorded sweeps, compared with an independent implementation of a published model.

M. Hahner, C. Sakaridis, D. Dai, L. Van Gool: "Fog Simulation on Real LiDAR Point Clouds for 3D
Object Detection in Adverse Weather", ICCV 2021. The received power is the convolution of the
transmitted pulse, P₀ sin²(π t / (2 τ)), with the response of the hard target and of the fog in
front of it. The functions below are written from the equations of the paper.

The model assumes the same extinction at all wavelengths, but lidarpool's extinction decreases with
the wavelength. Both models are therefore compared at the same extinction.
"""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from tests.made_recordings import made_recording

from lidarreal.augmentation.augmenter import Augmenter
from lidarreal.augmentation.effects import Effects
from lidarsim import Material, Noise, Pose, Scanner, Scene, Survey, load_sensor
from lidarsim.columns.sweep import Sweep
from lidarsim.media.weather import Weather
from lidarsim.scene.scene_mesh import SceneMesh
from lidarsim.sensor.optics import LIGHT_M_NS

PULSE_NS = 5.0
VISIBILITIES_KM = (0.03, 0.05, 0.1, 0.2)
CROSSOVER_M = (0.9, 1.0)  # ranges between which the receiver begins to see the beam
REFERENCE_M = 10.0
REFLECTANCE = 0.5


def pulse_shape(path_m):
    """Return the transmitted power at distances behind the front of the pulse."""
    length_m = LIGHT_M_NS * PULSE_NS  # the pulse lasts 2 τ
    inside = (path_m >= 0) & (path_m <= length_m)
    return np.where(inside, np.sin(np.pi * path_m / length_m) ** 2, 0.0)


def crossover(range_m):
    """Return the fraction of the beam that the receiver sees (ξ)."""
    lower, upper = CROSSOVER_M
    return np.clip((range_m - lower) / (upper - lower), 0, 1)


def hard_power(range_m, extinction):
    """Return the peak power from a white surface, relative to a distance of 10 m in clear air."""
    return crossover(range_m) * (REFERENCE_M / range_m) ** 2 * np.exp(-2 * extinction * range_m)


def soft_power(range_m, extinction, end_m=np.inf):
    """Return the power from fog in front of `end_m`, on the same scale.

    `range_m` is the range of a hard target whose peak would be received at the same time.
    """
    late_m = np.linspace(0, LIGHT_M_NS * PULSE_NS, 1001)
    fog_m = np.asarray(range_m)[:, None] + LIGHT_M_NS * PULSE_NS / 2 - late_m
    backscatter = 0.046 / np.log(20) * extinction
    present = (fog_m > CROSSOVER_M[0]) & (fog_m < end_m)
    power = hard_power(np.maximum(fog_m, CROSSOVER_M[0]), extinction)
    response = np.pi * backscatter * np.where(present, power, 0.0)
    return np.trapezoid(pulse_shape(late_m) * response, late_m, axis=1)


@pytest.fixture(scope="module")
def sensor():
    """A sensor that receives fog from a distance of 1 m, like that of the paper."""
    model = load_sensor("velodyne/vlp16")
    optics = replace(model.optics, pulse_ns=PULSE_NS)
    noise = Noise(detection_range_m=2000.0, overlap_m=CROSSOVER_M[1])
    return replace(model, optics=optics, noise=noise, min_range_m=float(np.mean(CROSSOVER_M)))


@pytest.fixture(scope="module")
def recording(sensor):
    """A sweep in a box with walls at distances of 8 to 40 m."""
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    corners = [(40, -15), (40, 15), (-8, 15), (-8, -15), (40, -15)]
    walls = [
        SceneMesh(f"wall {k}", np.array([[*a, -50], [*b, -50], [*b, 50], [*a, 50]], float), faces)
        for k, (a, b) in enumerate(pairwise(corners))
    ]
    scanner = Scanner(
        Scene.from_meshes(walls),
        sensor,
        columns=["intensity"],
        materials=[Material("*", REFLECTANCE)],
        coordinates="sensor",
        precision_m=1e-4,
    )
    cloud = scanner.sweep(Pose((0, 0, 0)))
    columns = {name: cloud[name] for name in ("channel", "intensity")}
    sweep = Sweep(np.asarray(cloud.positions, np.float64), columns)
    return made_recording("box", 1, lambda _: sweep, energy_unit=1.0)


def augment(recording, sensor, visibility_km):
    effects = Effects(weather=Weather(visibility_km=visibility_km), mode="all")
    return Augmenter(recording, effects, sensor).sweep(0)


@pytest.mark.parametrize("visibility_km", VISIBILITIES_KM)
def test_attenuation_of_hard_targets(visibility_km, recording, sensor):
    result = augment(recording, sensor, visibility_km)
    kept = np.flatnonzero(result.is_recorded)
    recorded = recording[0].select(result.template[kept])
    range_m = np.linalg.norm(recorded.points, axis=1)
    extinction = Weather(visibility_km=visibility_km).extinction_at(sensor.optics.simulated_nm)
    expected = hard_power(range_m, extinction) / hard_power(range_m, 0.0)
    ratio = result.sweep.columns["intensity"][kept] / recorded.columns["intensity"]
    assert len(kept) > 1000
    np.testing.assert_allclose(ratio, expected, rtol=0.005)


def soft_peak(extinction):
    range_m = np.arange(0.5, 10, 0.001)
    power = soft_power(range_m, extinction)
    return range_m[power.argmax()], power.max()


@pytest.mark.extended(every=4)
@pytest.mark.parametrize("visibility_km", VISIBILITIES_KM)
def test_range_and_power_of_the_soft_peak(visibility_km, recording, sensor):
    result = augment(recording, sensor, visibility_km)
    added = np.flatnonzero(~result.is_recorded)
    range_m = np.linalg.norm(result.sweep.points[added], axis=1)
    extinction = Weather(visibility_km=visibility_km).extinction_at(sensor.optics.simulated_nm)
    peak_m, peak = soft_peak(extinction)
    assert range_m.mean() == pytest.approx(peak_m, rel=0.05)
    power = result.sweep.columns["intensity"][added].mean()
    # The slab is as long as the pulse at half of its power, so it does not reach beyond the peak.
    assert power == pytest.approx(1.14 * peak, rel=0.02)


@pytest.mark.parametrize("visibility_km", VISIBILITIES_KM)
def test_power_of_fog_behind_the_peak(visibility_km, sensor):
    """The energy of a slab that is half a pulse long is that of the convolution at its center."""
    survey = Survey(sensor, poses=[(0, 0, 0)], visibility_km=visibility_km)
    edges = np.arange(2, 60) * (LIGHT_M_NS * PULSE_NS / 2)
    edges = edges[edges > 2]
    backscatter = survey.backscatter_at(sensor.optics.simulated_nm)
    slabs = survey.air(0).backscatter_energy(backscatter, edges[:-1], edges[1:])
    extinction = survey.extinction_at(sensor.optics.simulated_nm)
    expected = soft_power((edges[1:] + edges[:-1]) / 2, extinction)
    np.testing.assert_allclose(slabs, expected, rtol=0.02)
