"""Waveforms: returns by peaks and by decomposition, and waveforms that are recorded."""

from __future__ import annotations

import math
import struct
from dataclasses import replace

import numpy as np
import pytest
from tests.cloud_counting import counts_of
from tests.shapes import beam_along_x, cast, cast_between, quad, wall

from lidarfiles import save_cloud
from lidarsim import (
    Beams,
    LidarError,
    Material,
    Noise,
    Optics,
    Returns,
    Scene,
    Sensor,
    Spin,
    Survey,
)
from lidarsim.columns.table import AXES, CAUSES, SCAN
from lidarsim.columns.waveforms import WAVEFORM
from lidarsim.pulses.returns import PulseReturns
from lidarsim.pulses.steps.waveform import Digitizer, returns_in
from lidarsim.pulses.steps.waveform_samples import digitize
from lidarsim.sensor.optics import FWHM, LIGHT_M_NS
from lidarsim.simulator.points.batch_columns import columns_of
from lidarsim.simulator.rig import Rig
from raybeam import available_backends

SIGMA_NS = 5 / FWHM
SIGMA_M = SIGMA_NS * LIGHT_M_NS / 2
COLUMNS = ("ray", "range", "intensity", "amplitude", "pulse_width", "return_number", "returns")


def found(apart, decomposes, energies=(2.0, 1.4), sample_ns=1.0):
    """Ranges behind the first hit, in σ, energies and widths of two hits so many σ apart."""
    distance = 100 + np.array([0, apart]) * SIGMA_M
    hits = PulseReturns(np.arange(2), distance, np.zeros(2, np.int32), np.array(energies))
    made = returns_in(hits, Digitizer(SIGMA_NS, sample_ns, decomposes), subrays=2)
    return (made.distance - 100) / SIGMA_M, 2 * made.energy, made.width


# -- closed form ---------------------------------------------------------------------------------


@pytest.mark.parametrize(("apart", "peaks"), [(0.5, 1), (1.9, 1), (1.99, 1), (2.05, 2), (3, 2)])
def test_two_equal_echoes_are_two_peaks_beyond_two_standard_deviations(apart, peaks):
    place, energy, width = found(apart, decomposes=False, energies=(1, 1), sample_ns=0.1)
    assert len(place) == peaks
    assert energy.sum() == pytest.approx(2, rel=1e-4)
    assert place.mean() == pytest.approx(apart / 2, abs=1e-3)
    if peaks == 1:  # the peak is in the middle, and so high
        height = 2 * math.exp(-((apart / 2) ** 2) / 2)
        assert width == pytest.approx([5 * 2 / height], rel=1e-3)


@pytest.mark.parametrize("apart", [1.9, 2.5, 3.0, 5.0, 8.0, 20.0])
def test_decomposition_gives_both_echoes_back(apart):
    place, energy, width = found(apart, decomposes=True)
    assert place == pytest.approx([0, apart], abs=2e-5)
    assert energy == pytest.approx([2.0, 1.4], rel=1e-4)
    assert width == pytest.approx([5, 5], rel=1e-4)


@pytest.mark.parametrize(("apart", "weak"), [(2.3, 0.5), (2.5, 0.45), (3.0, 0.33), (3.5, 0.2)])
def test_a_weak_echo_beside_a_strong_one_is_given_back(apart, weak):
    """It takes the fit more steps."""
    place, energy, _ = found(apart, decomposes=True, energies=(2.0, weak))
    assert place == pytest.approx([0, apart], abs=1e-3)
    assert energy == pytest.approx([2.0, weak], rel=1e-2)


def test_hits_close_together_are_one_echo_in_closed_form():
    for decomposes in (False, True):
        place, energy, width = found(0.2, decomposes)
        mean = 0.2 * 1.4 / 3.4
        share = 2 * 1.4 / 3.4**2
        assert place == pytest.approx([mean])
        assert energy == pytest.approx([3.4])
        assert width == pytest.approx([5 * math.sqrt(1 + share * 0.2**2)])


# -- surfaces ------------------------------------------------------------------------------------


def tilted(degrees):
    """A wall across x, 20 m away, turned about z."""
    a = math.radians(degrees)
    across = np.array([-math.sin(a), math.cos(a), 0])
    up = np.array([0, 0, 1.0])
    middle = np.array([20.0, 0, 0])
    corners = [
        middle + s * 30 * across + t * 30 * up for s, t in ((-1, -1), (1, -1), (1, 1), (-1, 1))
    ]
    return quad("W", *corners)


@pytest.mark.parametrize("waveform", ["peaks", "gaussian"])
@pytest.mark.parametrize("degrees", [0, 45, 65, 75])
def test_a_slanted_wall_stretches_the_echo(waveform, degrees):
    """By the standard deviation of ranges in a disc, R tan θ · divergence / 4."""
    returns = Returns(
        "all", subrays=61, divergence_mrad=20, pulse_ns=5, waveform=waveform, sample_ns=0.5
    )
    given = {"returns": returns, "columns": COLUMNS, "materials": [Material("*", 1.0)]}
    echo = cast([tilted(degrees)], **given)
    spread_ns = 20 * math.tan(math.radians(degrees)) * 0.020 / 4 * 2 / LIGHT_M_NS
    width = FWHM * math.hypot(SIGMA_NS, spread_ns)
    assert len(echo["range"]) == 1
    # The near side returns more, which moves the peak by some centimeters.
    assert echo["range"] == pytest.approx([20], abs=0.06 if degrees == 75 else 0.01)
    assert echo["pulse_width"] == pytest.approx([width], rel=0.02)
    energy = math.cos(math.radians(degrees)) / 4
    assert echo["intensity"] == pytest.approx([energy], rel=0.03)
    assert echo["amplitude"] == pytest.approx(echo["intensity"] * 5 / echo["pulse_width"], rel=1e-5)


@pytest.mark.parametrize(
    ("waveform", "apart_m", "echoes"),
    [("none", 0.7, 1), ("peaks", 0.7, 2), ("peaks", 0.6, 1), ("gaussian", 0.6, 2)],
)
def test_what_is_told_apart_at_an_edge(waveform, apart_m, echoes):
    """By c τ / 2, 0.75 m for 5 ns; by peaks 2 σ, 0.64 m; by decomposition less."""
    meshes = [wall("Near", 20, y=(0, 50)), wall("Far", 20 + apart_m)]
    returns = Returns("all", subrays=217, divergence_mrad=1, pulse_ns=5, waveform=waveform)
    echo = cast(meshes, returns=returns, columns=COLUMNS)
    assert len(echo["range"]) == echoes
    if echoes == 2:
        assert echo["object"].tolist() == [0, 1]
        near = 0.001 if waveform == "gaussian" else 0.25  # peaks attract each other
        assert echo["range"] == pytest.approx([20, 20 + apart_m], abs=near)


def test_the_receiver_widens_the_echo():
    """A Gaussian receiver of bandwidth B responds with 0.3120 / B (full width at half maximum)."""
    returns = Returns("all", pulse_ns=3, waveform="peaks", bandwidth_mhz=100)
    echo = cast([wall("W", 10)], returns=returns, columns=COLUMNS)
    assert echo["pulse_width"] == pytest.approx([math.hypot(3, 3.120)], rel=1e-3)


@pytest.mark.extended
def test_heights_decide_which_echoes_are_detected_and_strongest():
    """A slanted wall returns as much light as one at right angles, and half of the height."""
    returns = Returns("all", subrays=61, divergence_mrad=20, pulse_ns=5, waveform="peaks")
    columns = COLUMNS
    seen = cast([tilted(75)], returns=returns, columns=columns)
    assert seen["amplitude"] < 0.7 * seen["intensity"]
    energy = float(seen["intensity"][0])
    # A threshold just below the energy, five standard deviations above the height.
    limit = 10 * math.sqrt(0.1 / (0.95 * energy))
    noise = Noise(detection_range_m=limit)
    lost = [
        len(
            cast([tilted(75)], returns=returns, columns=columns, noise=replace(noise, seed=k))[
                "ray"
            ]
        )
        for k in range(20)
    ]
    assert sum(lost) <= 2, "by energy, more than half of them would be there"


# -- surveys -------------------------------------------------------------------------------------


def fence():
    """Pales at several distances, which beams hit two or three of."""
    pales = range(60)
    return Scene.from_meshes(
        [wall(f"P{k}", 5 + 0.3 * (7 * k % 10), y=(0.2 * k, 0.2 * k + 0.25)) for k in pales]
    )


def survey(**given):
    beams = Beams(np.radians([-30, -15, -8, 0]))
    sensor = Sensor(beams, Spin(1800, 10), 0, 100, optics=Optics(divergence_mrad=30))
    returns = given.pop("returns", Returns("all", subrays=19, waveform="gaussian", pulse_ns=4))
    options = {"poses": [(0, 0, 1)], "steps": 8, "columns": COLUMNS, "returns": returns}
    return Survey(sensor, **options | given)


@pytest.mark.extended
@pytest.mark.parametrize("waveform", ["peaks", "gaussian"])
def test_scans_in_one_cast_or_each_by_itself_are_the_same(waveform):
    noise = Noise(range_m=0.02, angle_deg=0.1, detection_range_m=60)
    made = survey(noise=noise, returns=Returns("all", subrays=19, waveform=waveform, pulse_ns=4))
    rig = Rig(fence(), made, "numpy")
    whole, tally = cast_between(rig, made, [0, 8])
    assert len(whole["x"]) > 4 * 400
    assert cast_between(rig, made, range(9)) == (whole, tally)


@pytest.mark.skipif("tiles" not in available_backends(), reason="needs numba")
def test_tiles_and_numpy_agree():
    rigs = [Rig(fence(), survey(), backend) for backend in ("numpy", "tiles")]
    first, second = (cast_between(rig, rig.survey, [0, 8]) for rig in rigs)
    assert first == second


def test_what_does_not_fit_together_is_refused():
    with pytest.raises(LidarError, match=r"sample_ns must be at most 0.5, .* but is 1"):
        survey(returns=Returns(waveform="peaks", pulse_ns=1))
    assert Returns(pulse_ns=5).system_ns(Optics()) == pytest.approx(SIGMA_NS)


# -- recorded ------------------------------------------------------------------------------------


def cloud_of(made, scene=None):
    """Cloud of all scans of a survey, as its part has it."""
    rig = Rig(scene or fence(), made, "numpy")
    part = columns_of(list(rig.cast(0, made.scan_count)))
    table = (SCAN, *(c for c in made.stored_columns if c not in AXES and c.name != WAVEFORM))
    return part.cloud(table, made.precision_m, np.zeros(3))


def test_a_recorded_waveform_is_the_sum_of_the_echoes():
    meshes = [wall("Near", 20, y=(0, 50)), wall("Far", 22)]
    beam = beam_along_x(divergence_mrad=1)
    returns = Returns("all", subrays=217, pulse_ns=5, waveform="gaussian")
    options = {"returns": returns, "columns": COLUMNS, "waveform_samples": 60}
    made = Survey(beam, poses=[(0, 0, 0)], steps=1, precision_m=1e-6, **options)
    cloud = cloud_of(made, Scene.from_meshes(meshes))
    waves = cloud.waveforms
    assert len(cloud) == 2
    assert waves.samples.shape == (2, 60)
    assert np.array_equal(waves.samples[0], waves.samples[1]), "one pulse, one window"
    assert waves.location_ns == pytest.approx(cloud["range"] * 2 / LIGHT_M_NS, abs=1e-5)
    model = sum(
        height * np.exp(-0.5 * ((waves.times_ns[0] - at) / SIGMA_NS) ** 2)
        for height, at in zip(cloud["amplitude"], waves.location_ns, strict=True)
    )
    step = 2.0 ** np.ceil(np.log2(model.max() / 63_487))
    assert waves.samples[0] == pytest.approx(model, abs=step + 2e-3 * model.max())


def test_windows_that_overlap_have_the_same_samples():
    meshes = [wall("Near", 20, y=(0, 50)), wall("Far", 25)]
    returns = Returns("all", subrays=217, pulse_ns=5, waveform="gaussian")
    made = Survey(
        beam_along_x(divergence_mrad=1),
        poses=[(0, 0, 0)],
        steps=1,
        returns=returns,
        columns=COLUMNS,
        waveform_samples=50,
        noise=Noise(detection_range_m=30),
    )
    waves = cloud_of(made, Scene.from_meshes(meshes)).waveforms
    times_ns = np.round(waves.times_ns, 6)
    shared_ns, first, second = np.intersect1d(times_ns[0], times_ns[1], return_indices=True)
    assert 10 < len(shared_ns) < 40
    step = waves.samples.max(axis=1).sum() / 63_487  # both are rounded
    assert waves.samples[0, first] == pytest.approx(waves.samples[1, second], abs=step)
    assert waves.samples[0, first].std() > 20 * step


def test_recorded_noise_is_a_fifth_of_the_threshold():
    noise = Noise(detection_range_m=30)
    made = survey(noise=noise, waveform_samples=100)
    waves = cloud_of(made).waveforms
    tail = waves.samples[:, -20:][waves.samples.max(axis=1) < 50 * noise.threshold]
    quiet = tail[np.abs(tail) < noise.threshold]
    assert len(quiet) > 2000
    assert quiet.std() == pytest.approx(noise.threshold / 5, rel=0.1)
    assert quiet.mean() == pytest.approx(0, abs=noise.threshold / 50)


@pytest.mark.parametrize("power", [-160, -126, -60, -11, 0, 1, 40, 110])
def test_samples_are_rounded_to_the_smallest_step_that_holds_them(power):
    random = np.random.default_rng(7)
    samples = np.ldexp(random.uniform(-0.02, 1, (20, 16)) * random.uniform(1, 4, (20, 1)), power)
    samples[:3] *= -1  # noise below zero decides
    steps, exponents = digitize(samples)
    step = np.ldexp(1.0, exponents.astype(int))[:, None]
    assert np.all(np.abs((steps - 2048.0) * step - samples) <= step / 2)
    halves = samples / (step / 2)
    outside = (halves.max(axis=1) >= 65_535 - 2048) | (halves.min(axis=1) <= -2048)
    assert np.all(outside | (exponents == -126))
    assert digitize(np.zeros((1, 4)))[0].tolist() == [[2048] * 4]


def test_chunks_of_rays_change_no_record(monkeypatch):
    made = survey(steps=1, noise=Noise(range_m=0.02, detection_range_m=60), waveform_samples=64)
    rig = Rig(fence(), made, "numpy")
    whole, tally = cast_between(rig, made, [0, 1])
    assert len(whole["x"]) > 4 * 50
    monkeypatch.setattr("lidarsim.pulses.pulses.CHUNK_RAYS", 1000)
    assert cast_between(rig, made, [0, 1]) == (whole, tally)


@pytest.mark.extended
def test_recording_changes_no_point_and_no_batch_changes_a_record():
    made = survey(noise=Noise(range_m=0.02, detection_range_m=60), waveform_samples=64)
    rig = Rig(fence(), made, "numpy")
    whole, tally = cast_between(rig, made, [0, 8])
    assert cast_between(rig, made, range(9)) == (whole, tally)
    without = replace(made, waveform_samples=0)
    bare, _ = cast_between(Rig(fence(), without, "numpy"), without, [0, 8])
    assert whole.keys() - bare.keys() == {WAVEFORM}
    assert all(whole[name] == values for name, values in bare.items())


@pytest.mark.extended
def test_fog_and_false_alarms_have_waveforms_too():
    noise = Noise(detection_range_m=60, false_alarm_hz=3e6)
    fog = {"visibility_km": 0.05, "fog_lidar_ratio_sr": 65}
    made = survey(noise=noise, **fog, waveform_samples=64, columns=(*COLUMNS, "cause"))
    rig = Rig(fence(), made, "numpy")
    whole, tally = cast_between(rig, made, [0, 8])
    assert cast_between(rig, made, range(9)) == (whole, tally)
    cloud = cloud_of(made)
    alarms = cloud["cause"] == CAUSES.index("false alarm")
    assert alarms.sum() > 20
    assert (cloud["cause"] == CAUSES.index("air")).sum() > 5
    assert (cloud["pulse_width"][alarms] == 0).all(), "no echo"
    assert (cloud["pulse_width"][~alarms] > 3.99).all()
    assert np.array_equal(cloud["amplitude"][alarms], cloud["intensity"][alarms])
    quiet = np.abs(cloud.waveforms.samples[alarms]).max(axis=1)
    assert np.median(quiet) < 2 * noise.threshold


def read_packets(path):
    """Waveform packets of a LAS file by the specification: head, descriptors, samples by point."""
    data = path.read_bytes()
    start, first, count = struct.unpack_from("<QQI", data, 227)
    assert (first, count) == (start, 1)
    _, user, kind, size, _ = struct.unpack_from("<H16sHQ32s", data, start)
    assert (user.rstrip(b"\0"), kind, size) == (b"LASF_Spec", 65_535, len(data) - start - 60)
    return data, start


@pytest.mark.parametrize("ending", ["las", "laz"])
def test_las_files_hold_waveforms_that_lead_to_the_points(tmp_path, ending):
    laspy = pytest.importorskip("laspy")
    columns = (*COLUMNS, "red", "green", "blue")
    made = survey(waveform_samples=48, columns=columns, precision_m=1e-4)
    cloud = cloud_of(made)
    path = tmp_path / f"cloud.{ending}"
    save_cloud(cloud, path, precision_m=1e-4)
    las = laspy.read(path)
    data, start = read_packets(path)
    assert las.header.point_format.id == 10
    assert las.header.global_encoding.waveform_data_packets_internal
    told = {
        vlr.record_id - 99: vlr.parsed_record for vlr in las.header.vlrs.get("WaveformPacketVlr")
    }
    waves = cloud.waveforms
    several = 0
    for row in range(0, len(cloud), 7):
        kind = told[las.wavepacket_index[row]]
        assert (kind.bits_per_sample, kind.number_of_samples) == (16, 48)
        assert kind.temporal_sample_spacing == 1000
        offset = las.wavepacket_offset[row]
        size = las.wavepacket_size[row]
        raw = np.frombuffer(data, "<u2", 48, start + offset)
        assert size == 96
        samples = kind.digitizer_offset + kind.digitizer_gain * raw.astype(float)
        assert np.array_equal(samples, waves.samples[row])
        # The sensor is on the line of the waveform, as far before sample 0 as light took.
        toward = np.array([las.x_t[row], las.y_t[row], las.z_t[row]], np.float64)
        at = las.return_point_wave_location[row] / 1000
        back_ps = 1000 * (waves.times_ns[row, 0] + at)
        assert np.linalg.norm(toward) == pytest.approx(LIGHT_M_NS / 2000, rel=1e-6)
        assert las.xyz[row] + back_ps * toward == pytest.approx([0, 0, 1], abs=1e-3)
        several += las.number_of_returns[row] > 1
        # The height of the waveform at the return is its amplitude, if nothing is near.
        if las.number_of_returns[row] == 1:
            height = np.interp(at, np.arange(48), samples)
            assert height == pytest.approx(cloud["amplitude"][row], rel=0.1)
    assert several > 10
    assert len({*las.wavepacket_offset.tolist()}) < len(cloud), "returns of a pulse share packets"


def test_a_window_that_holds_no_echo_is_refused():
    with pytest.raises(LidarError, match=r"waveform_samples must be at least \d+, .* but is 8"):
        survey(waveform_samples=8)
    with pytest.raises(LidarError, match="has no waveforms"):
        _ = cloud_of(survey()).waveforms


def test_samples_that_are_no_whole_picoseconds_apart_are_refused():
    sensor = beam_along_x()
    with pytest.raises(LidarError, match=r"whole picoseconds. Set it to 0\.333"):
        Survey(sensor, poses=[(0, 0, 0)], returns=Returns(sample_ns=1 / 3), waveform_samples=160)
    for sample_ns in (0.333, 1.25, 0.1, 0.007):
        returns = Returns(sample_ns=sample_ns)
        Survey(sensor, poses=[(0, 0, 0)], returns=returns, waveform_samples=4096)


def test_other_formats_leave_waveforms_out(tmp_path):
    cloud = cloud_of(survey(waveform_samples=48))
    save_cloud(cloud, tmp_path / "cloud.ply")
    assert b"waveform" not in (tmp_path / "cloud.ply").read_bytes()[:2000]
    assert "waveform" not in cloud.to_dataframe().columns
    numbers = counts_of(cloud, objects=60)
    assert numbers.by_object.sum() == len(cloud)
    assert "range" in numbers.limits and WAVEFORM not in numbers.limits
