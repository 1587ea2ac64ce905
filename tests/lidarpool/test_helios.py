"""Surveys of HELIOS++: their scenarios fire the pulses that its own formulas give."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import numpy as np
import pytest
import yaml
from click.testing import CliRunner

from lidarpool.cli.scenario_commands import import_
from lidarscenario.points.point_scene import surfel_mesh
from lidarscenario.prepare import prepare
from lidarscenario.scenario import Scenario
from lidarscenes.helios import ImportedSurvey, import_survey
from lidarsim import LidarError
from lidarsim.media.materials import MaterialTable
from lidarsim.simulator.rig import Rig
from raybeam import RayCaster

X, Y, Z = np.eye(3)
SQUARE = "v -1 -1 0\nv 1 -1 0\nv 1 1 0\nv -1 1 0\nf 1 2 3\nf 1 3 4\n"
MOUNT = '<scannerMount z="0.5"><rot axis="x" angle_deg="-90"/><rot axis="z" angle_deg="80"/>'
PLANE = f'<platform id="plane" type="linearpath">{MOUNT}</scannerMount></platform>'
TRIPOD = '<platform id="tripod" type="static"><scannerMount z="1.5"/></platform>'
EMITTER = '<beamOrigin y="0.1"><rot axis="x" angle_deg="10"/><rot axis="z" angle_deg="20"/>'
GROUND = """<scene id="field"><part>
  <filter type="objloader"><param type="string" key="filepath" value="parts/ground.obj"/></filter>
  <filter type="scale"><param type="double" key="scale" value="100"/></filter>
  <filter type="translate"><param type="vec3" key="offset" value="5;0;2"/></filter>
</part></scene>"""
ON_GROUND = "newmtl soil\nhelios_isGround true\nhelios_classification 2\nhelios_reflectance 0.3\n"


def scanner(optics, inside=EMITTER + "</beamOrigin>", **values):
    given = {"scanFreqMin_Hz": 1, "scanFreqMax_Hz": 200, "pulseFreqs_Hz": "1000"} | values
    attributes = " ".join(f'{name}="{value}"' for name, value in given.items())
    return f'<scanner id="s" name="S/1" optics="{optics}" {attributes}>{inside}</scanner>'


def legs(settings, *places, platform='movePerSec_m="10"'):
    return "".join(
        f'<leg><platformSettings x="{x}" y="{y}" z="50" {platform}/>'
        f"<scannerSettings {settings}/></leg>"
        for x, y in places or ((0, 0), (3, 4))
    )


def import_checked(survey: Path, out: Path) -> ImportedSurvey:
    """Import a survey as the command does."""
    return import_survey(
        survey, out, check=lambda file: prepare(Scenario.load(file)), surfels=surfel_mesh
    )


def scenario_of(imported: ImportedSurvey) -> Scenario:
    return Scenario.load(imported.path)


@pytest.fixture
def survey(tmp_path):
    """Write a survey, with all that it names, in a folder of its own."""

    def write(
        device, inside, scene=GROUND, platform="plane", around="", names="", parts=()
    ) -> Path:
        root = tmp_path / "helios"
        (root / "parts").mkdir(parents=True, exist_ok=True)
        (root / "deep").mkdir(exist_ok=True)
        (root / "parts" / "ground.obj").write_text("mtllib g.mtl\nusemtl soil\n" + SQUARE)
        (root / "parts" / "g.mtl").write_text(ON_GROUND)
        (root / "spectra").mkdir(exist_ok=True)
        for name, text in dict(parts).items():
            (root / "parts" / name).write_text(text)
        (root / "devices.xml").write_text(f"<document>{device}{PLANE}{TRIPOD}</document>")
        path = root / "deep" / "fly.xml"
        if platform != "interpolated":
            platform = f"devices.xml#{platform}"
        path.write_text(
            f'<?xml version="1.0"?><document>{around}<survey name="fly" scene="deep/fly.xml#field" '
            f'platform="{platform}" scanner="devices.xml#s" {names}>{inside}</survey>{scene}'
            "</document>"
        )
        return path

    return write


@pytest.fixture
def imported(survey, tmp_path):
    """Import a survey; return what was written, its scene and survey."""

    def run(*given, **named):
        made = import_checked(survey(*given, **named), tmp_path / "out")
        built = prepare(scenario_of(made))
        return made, built.scene, built.survey

    return run


def about(axis, degrees):
    """Rotation by the formula of Rodrigues, written out another way than in the importer."""
    c = np.cos(np.radians(degrees))
    s = np.sin(np.radians(degrees))
    x, y, z = axis
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return c * np.eye(3) + s * cross + (1 - c) * np.outer(axis, axis)


def fired(made, number, firings):
    """Directions in the world of firings of a sensor: (k, channels, 3)."""
    carried = made.mounted_sensors[number]
    path = made.path
    firings = np.asarray(firings)
    _, turns = path.poses(0, carried.sensor.begins_ns(firings))
    mount = np.eye(3) if carried.mount.rotation is None else carried.mount.rotation
    return np.einsum("kij,kcj->kci", turns @ mount, carried.sensor.directions(firings))


def expected(deflected, head=0.0):
    """HELIOS++'s product of rotations for the mount and emitter above, heading for (3, 4)."""
    platform = about(Z, np.degrees(np.arctan2(4, 3)) - 90)
    mount = about(Z, 80) @ about(X, -90)
    emitter = about(Z, 20) @ about(X, 10)
    return np.array([platform @ mount @ about(Z, head) @ emitter @ d @ Y for d in deflected])


PULSES = np.array([0, 1, 7, 19])
WIDE = {"scanAngleMax_deg": 120, "scanAngleEffectiveMax_deg": 50}


def test_a_cone_is_that_of_helios(imported):
    device = scanner("conic", scanAngleMax_deg=25, scanFreqMax_Hz=10)
    settings = 'pulseFreq_hz="1000" scanAngle_deg="20" headRotateStart_deg="30"'
    made, scene, of = imported(device, legs(settings))
    there = [about(Y, 3.6 * k) @ about(X, 20) for k in PULSES]
    assert np.allclose(fired(of, 0, PULSES)[:, 0], expected(there, 30), atol=1e-9)
    assert of.ray_count == 500  # 5 m at 10 m/s
    assert of.mounted_sensors[0].sensor.name == "S/1" and made.path.with_name("s_1.yaml").is_file()
    # Where mount and emitter sit does not turn with the platform.
    assert np.allclose(of.path.pose(0).position + scene.origin, [0, 0.1, 50.5])


def test_a_polygon_fires_the_pulses_of_helios_within_its_angles(imported):
    device = scanner("rotating", scanAngleMax_deg=60, scanAngleEffectiveMax_deg=45)
    _, _, of = imported(device, legs('pulseFreq_hz="1000" scanAngle_deg="30" scanFreq_hz="30"'))
    # 33.33 pulses a line: it begins anew after 34, at -60 degrees.
    angles = np.array([-60 + 3.6 * k for k in range(34)])
    kept = np.flatnonzero((angles > -30) & (angles <= 30))
    sensor = of.mounted_sensors[0].sensor
    times = sensor.begins_ns(np.arange(len(kept) + 1))
    assert np.allclose(np.diff(times), [1e6] * (len(kept) - 1) + [(35 - len(kept)) * 1e6])
    there = [about(X, angle) for angle in angles[kept]]
    assert np.allclose(fired(of, 0, np.arange(len(kept)))[:, 0], expected(there), atol=1e-9)


def test_lines_wider_than_the_scanner_end_where_it_does(imported):
    """HELIOS++ 2 refuses them, and its first version left their pulses out."""
    device = scanner("rotating", scanAngleMax_deg=60, scanAngleEffectiveMax_deg=45)
    wide = 'verticalAngleMin_deg="-50" verticalAngleMax_deg="41"'
    _, _, of = imported(device, legs(f'pulseFreq_hz="1000" {wide} scanFreq_hz="30"'))
    angles = np.array([-60 + 3.6 * k for k in range(34)])
    kept = angles[(angles > -45) & (angles <= 41)]
    there = [about(X, angle) for angle in kept]
    assert np.allclose(fired(of, 0, np.arange(len(kept)))[:, 0], expected(there), atol=1e-9)
    assert of.mounted_sensors[0].sensor.head.firings_per_turn == len(kept)


def test_a_swinging_mirror_and_fibers_are_those_of_helios(imported, tmp_path):
    settings = 'pulseFreq_hz="1000" scanAngle_deg="30" scanFreq_hz="10"'
    _, _, of = imported(scanner("oscillating", scanProduct=200), legs(settings))
    there = [about(X, 20 * (abs(4 * (k % 100) / 100 - 2) * -1 + 1)) for k in PULSES]
    assert np.allclose(fired(of, 0, PULSES)[:, 0], expected(there), atol=1e-9)
    (tmp_path / "out").rename(tmp_path / "one")
    _, _, of = imported(scanner("line", numFibers=12, scanAngleMax_deg=30), legs(settings))
    there = [about(X, -30 + 5 * (k % 12)) for k in PULSES]
    assert np.allclose(fired(of, 0, PULSES)[:, 0], expected(there), atol=1e-9)


@pytest.mark.parametrize("angles", [(18, -18), (-18, 18), (12, 15, -3)])
def test_prisms_are_those_of_helios(imported, angles):
    rates = (-77.7, 121.6, 30.1)
    index = 1.51
    incident = np.array([-0.05, 1, 0.02])
    values = {f"rotorFreq{i + 1}_Hz": rate for i, rate in enumerate(rates)}
    values |= {f"angle{i + 1}_deg": angle for i, angle in enumerate(angles)}
    values |= {f"refrIndex{i + 1}": index for i in range(3)}
    beam = '<incidentBeam x="-0.05" y="1" z="0.02"/>'
    device = scanner("risley", EMITTER + "</beamOrigin>" + beam, **values)
    _, _, of = imported(device, legs('pulseFreq_hz="1000"'))

    def refracted(ray, normal, ratio):  # normals against the ray, as its code has them
        cosine = -ray @ normal
        return ratio * ray + (ratio * cosine - np.sqrt(1 - ratio**2 * (1 - cosine**2))) * normal

    rays = []
    for pulse in PULSES:
        ray = incident / np.linalg.norm(incident)
        for wedge, rate in zip(angles, rates, strict=False):
            angle = 2 * np.pi * rate * pulse / 1000
            tilt = np.radians(wedge)
            slope = np.array([np.sin(angle), 0, np.cos(angle)]) * np.sin(tilt)
            faces = [slope - np.cos(tilt) * Y, -Y]
            order = 1 if wedge > 0 else -1
            for face, ratio in zip(faces[::order], (1 / index, index), strict=True):
                ray = refracted(ray, face, ratio)
        rays.append(ray)
    platform = about(Z, np.degrees(np.arctan2(4, 3)) - 90)
    mount = about(Z, 80) @ about(X, -90)
    turn = platform @ mount @ about(Z, 20) @ about(X, 10)
    assert np.allclose(fired(of, 0, PULSES)[:, 0], np.array(rays) @ turn.T, atol=1e-9)


def test_a_head_turns_from_start_to_stop_while_its_mirror_draws_lines(imported):
    wide = {"scanAngleMax_deg": 120, "scanAngleEffectiveMax_deg": 50}
    emitter = '<beamOrigin z="0.2"><rot axis="x" angle_deg="5"/></beamOrigin>'
    device = scanner("rotating", emitter, headRotatePerSecMax_deg=60, **wide)
    head = 'headRotatePerSec_deg="12" headRotateStart_deg="{}" headRotateStop_deg="{}"'
    common = 'pulseFreq_hz="1000" scanFreq_hz="20" verticalAngleMin_deg="-40" '
    upright = common + 'verticalAngleMax_deg="60" '
    inside = legs(upright + head.format(0, 25), (0, 0), platform='onGround="true"')
    inside += legs(common + head.format(90, 60).replace('"12"', '"-12"'), (3, 4))
    inside += legs(common + head.format(90, 60).replace('"12"', '"-12"') + ' active="0"', (3, 4))
    _, scene, of = imported(device, inside, platform="tripod")
    elevations = [-120 + 4.8 * k for k in range(50)]
    kept = [e for e in elevations if -40 < e <= 60]
    assert [carried.name for carried in of.mounted_sensors] == ["leg0", "leg1"]
    assert of.steps_each == (3, 3)
    for line in (0, 1, 41):
        made = fired(of, 0, [line])[0]
        for channel, elevation in enumerate(kept):
            turned = 12 * (line * 50 + channel) / 1000
            assert np.allclose(made[channel], about(Z, turned) @ about(X, elevation + 5) @ Y)
    back = fired(of, 1, [0])[0]
    assert np.allclose(back[0], about(Z, 90) @ about(X, elevations[17] + 5) @ Y)
    lines = of.mounted_sensors[1].sensor.firings(2)[1]
    assert lines == 50 and of.scan(3).firings == (0, 17)  # 30 degrees at 12 a second, 20 lines
    last = fired(of, 1, [49])[0, 0]
    assert np.allclose(last, about(Z, 90 - 12 * 49 / 20) @ about(X, elevations[17] + 5) @ Y)
    starts = [of.pose(scan).position + scene.origin for scan in (0, 3)]
    assert np.allclose(starts, [[0, 0, 2 + 1.7], [3, 4, 51.7]])
    assert of.begins_ns(3) == pytest.approx((25 / 12 + 0.001) * 1e9)


LASER = scanner("conic", "", scanAngleMax_deg=20, scanFreqMax_Hz=10)
FLY = legs('pulseFreq_hz="1000"')
WARMUP = ' opticsWarmupPhase_s="{}"'.format


def test_a_cone_is_ahead_by_its_warmup(imported):
    device = scanner("conic", scanAngleMax_deg=25, scanFreqMax_Hz=10)
    settings = 'pulseFreq_hz="1000" scanAngle_deg="20" headRotateStart_deg="30"'
    _, _, of = imported(device, legs(settings + WARMUP("0.0374")))  # 37 pulses
    there = [about(Y, 3.6 * (k + 37)) @ about(X, 20) for k in PULSES]
    assert np.allclose(fired(of, 0, PULSES)[:, 0], expected(there, 30), atol=1e-9)
    assert of.ray_count == 500 and of.begins_ns(0) == 0  # the leg is as long as without


@pytest.mark.parametrize("warmup_s", ["0", "-1"])
def test_warmup_has_no_effect_unless_it_is_positive(imported, tmp_path, warmup_s):
    made, *_ = imported(LASER, FLY)
    files = {file.name: file.read_text() for file in made.path.parent.iterdir()}
    made.path.parent.rename(tmp_path / "without")
    made, *_ = imported(LASER, FLY.replace("/></leg>", f"{WARMUP(warmup_s)}/></leg>"))
    assert {file.name: file.read_text() for file in made.path.parent.iterdir()} == files


def test_prisms_are_ahead_by_the_warmup_of_a_template(imported, tmp_path):
    rates = (-77.7, 121.6)
    values = {f"rotorFreq{i + 1}_Hz": rate for i, rate in enumerate(rates)}
    values |= {"angle1_deg": 18, "angle2_deg": -12, "refrIndex1": 1.5, "refrIndex2": 1.5}
    device = scanner("risley", **values)
    _, _, of = imported(device, legs('pulseFreq_hz="1000"'))
    (tmp_path / "out").rename(tmp_path / "without")
    template = f'<scannerSettings id="t" pulseFreq_hz="1000"{WARMUP(0.25)}/>'
    _, _, ahead = imported(device, legs('template="t"'), around=template)
    assert ahead.ray_count == of.ray_count
    assert np.allclose(fired(ahead, 0, PULSES), fired(of, 0, PULSES + 250), atol=1e-9)


def test_mirrors_start_with_the_first_complete_line_after_the_warmup(imported, tmp_path):
    oscillating = scanner("oscillating", scanProduct=200)
    fibers = scanner("line", numFibers=12, scanAngleMax_deg=30)
    polygon = scanner("rotating", scanAngleMax_deg=60, scanAngleEffectiveMax_deg=45)
    settings = 'pulseFreq_hz="1000" scanAngle_deg="30" scanFreq_hz="10"'
    for device, line in ((oscillating, 100), (fibers, 12), (polygon, 100)):
        made, _, of = imported(device, legs(settings))
        made.path.parent.rename(tmp_path / f"{line}{made.path.parent.name}")
        for warmup, delay in ((0, 0), (1, line - 1), (line, 0), (3 * line + 5, line - 5)):
            made, _, ahead = imported(device, legs(settings + WARMUP(warmup / 1000)))
            assert ahead.begins_ns(0) == pytest.approx(delay * 1e6, abs=1)
            # The same line is drawn, from another position.
            assert np.allclose(fired(ahead, 0, PULSES), fired(of, 0, PULSES), atol=1e-9)
            stop_s = ahead.mounted_sensors[0].sensor.begins_ns(np.array([ahead.ray_count]))
            assert stop_s[0] + delay * 1e6 == pytest.approx(5e8, abs=line * 1e6)
            shutil.rmtree(made.path.parent)
        shutil.rmtree(tmp_path / f"{line}out")


def test_heads_have_already_turned_during_the_warmup(imported):
    """Heads of stationary platforms reach their stop earlier."""
    device = scanner("rotating", "", headRotatePerSecMax_deg=60, **WIDE)
    head = 'headRotatePerSec_deg="{}" headRotateStart_deg="0" headRotateStop_deg="{}"'
    common = 'pulseFreq_hz="1000" scanFreq_hz="20" '
    inside = legs(common + head.format(12, 36) + WARMUP(0.11), (0, 0))
    inside += legs(common + head.format(-12, -36) + WARMUP(0.1), (3, 4))
    made, _, of = imported(device, inside, platform="tripod")
    assert not made.unsupported
    elevations = [-120 + 4.8 * k for k in range(50)]
    kept = [e for e in elevations if -50 < e <= 50]
    # A line takes 50 ms. The first leg starts 10 ms after the third line, and lasts until 2.89 s.
    for number, lines, sign, first in ((0, 57, 1, 3), (1, 58, -1, 2)):
        for line in (0, lines - 1):
            made = fired(of, number, [line])[0]
            for channel, elevation in enumerate(kept):
                turned = sign * 12 * ((line + first) * 50 + channel) / 1000
                assert np.allclose(made[channel], about(Z, turned) @ about(X, elevation) @ Y)
        last_step = of.steps_each[number] - 1
        assert of.mounted_sensors[number].sensor.firings(last_step)[1] == lines
    second = of.steps_each[0]
    assert of.begins_ns(0) == pytest.approx(0.04e9)
    assert of.begins_ns(second) == pytest.approx((2.89 + 0.001) * 1e9)


def test_legs_without_a_complete_line_after_the_warmup_start_with_it(imported):
    device = scanner("rotating", "", headRotatePerSecMax_deg=60, **WIDE)
    head = 'headRotatePerSec_deg="12" headRotateStart_deg="0" headRotateStop_deg="36"'
    settings = f'pulseFreq_hz="1000" scanFreq_hz="20" maxDuration_s="0.08" {head}{WARMUP(0.01)}'
    made, _, of = imported(device, legs(settings, (0, 0)), platform="tripod")
    assert made.unsupported == [
        "opticsWarmupPhase_s of leg 0 (the leg is shorter than two scan lines)"
    ]
    assert of.begins_ns(0) == 0 and of.ray_count == 2 * 21
    assert np.allclose(fired(of, 0, [0])[0, 0], about(Z, 12 * 0.05) @ about(X, -48) @ Y)


def test_heads_that_pass_their_stop_during_the_warmup_are_refused(imported):
    device = scanner("rotating", "", headRotatePerSecMax_deg=60, **WIDE)
    head = 'headRotatePerSec_deg="12" headRotateStart_deg="0" headRotateStop_deg="36"'
    inside = legs(f'pulseFreq_hz="1000" scanFreq_hz="20" {head}{WARMUP(3)}', (0, 0))
    with pytest.raises(LidarError, match=r"leg 0: the head reaches headRotateStop_deg during"):
        imported(device, inside, platform="tripod")


def test_lines_over_the_zenith_go_down_behind(imported):
    """As those of HELIOS++'s panoramic scanner, from -150 to 150 degrees."""
    wide = {"scanAngleMax_deg": 180, "scanAngleEffectiveMax_deg": 150}
    device = scanner("rotating", "", headRotatePerSecMax_deg=60, **wide)
    head = 'headRotatePerSec_deg="12" headRotateStart_deg="0" headRotateStop_deg="36"'
    _, _, of = imported(
        device, legs(f'pulseFreq_hz="1000" scanFreq_hz="20" {head}', (0, 0)), platform="tripod"
    )
    kept = [e for e in (-180 + 7.2 * k for k in range(50)) if -150 < e <= 150]
    made = fired(of, 0, [3])[0]
    assert len(made) == len(kept) == 41
    there = [about(Z, 12 * (150 + k) / 1000) @ about(X, e) @ Y for k, e in enumerate(kept)]
    order = [np.abs(made - one).sum(axis=1).argmin() for one in there]
    assert sorted(order) == list(range(41))
    assert np.allclose(made[order], there)


def test_channels_of_a_mirror_that_stands_are_the_beams_of_a_head_that_turns(imported):
    origin = '<beamOrigin><rot axis="x" angle_deg="{}"/></beamOrigin>'
    beams = "".join(f'<channel id="{e}">{origin.format(e)}</channel>' for e in (-15, 15))
    inside = f"<channels>{beams}</channels>"
    limits = {"scanAngleMax_deg": 1, "scanAngleEffectiveMax_deg": 1, "scanFreqMin_Hz": 0}
    device = scanner("rotating", inside, headRotatePerSecMax_deg=3600, **limits)
    head = 'headRotatePerSec_deg="3600" headRotateStart_deg="0" headRotateStop_deg="720"'
    _, _, of = imported(device, legs(f'pulseFreq_hz="18000" {head}', (0, 0)), platform="tripod")
    assert [c.name for c in of.mounted_sensors] == ["leg0--15", "leg0-15"] and of.ray_count == 7200
    for number, elevation in enumerate((-15, 15)):
        there = about(Z, 0.2 * 7) @ about(X, elevation) @ Y
        assert np.allclose(fired(of, number, [7])[0, 0], there)


def test_the_cloud_of_a_flight_lies_on_the_ground_and_knows_its_legs(imported):
    template = '<scannerSettings id="t" pulseFreq_hz="1000" scanAngle_deg="20" active="true"/>'
    template += '<platformSettings id="p" movePerSec_m="10"/>'
    device = scanner("conic", "", scanAngleMax_deg=20, scanFreqMax_Hz=10, accuracy_m=0.01, maxNOR=3)
    inside = "".join(
        f'<leg><platformSettings template="p" x="{x}" y="{y}" z="20"/>'
        f'<scannerSettings template="t" active="{active}"/></leg>'
        for x, y, active in ((0, 0, 1), (10, 0, 0), (10, 10, "true"), (0, 10, 1))
    )
    inside = '<FWFSettings beamSampleQuality="2"/><detectorSettings accuracy_m="0"/>' + inside
    made, scene, of = imported(device, inside, around=template)
    assert scenario_of(made).returns.subrays == 7 and scenario_of(made).noise.range_m == 0
    assert made.unsupported == ["maxNOR=3 of S/1 (all returns of a pulse are kept)"]
    (batch,) = Rig(scene, of, "numpy").cast(0, 3)
    columns = {column.name: column.make(batch) for column in of.stored_columns}
    assert np.ptp(columns["z"]) <= 1 and len(columns["z"]) == 300
    assert np.allclose(columns["range"], 18.5 / np.cos(np.radians(20)), atol=0.01)
    assert of.scan_count == 20 and of.begins_ns(10) == pytest.approx(2.002e9)


def test_waveform_settings_become_those_of_returns(imported):
    """HELIOS++ counts the time of one way."""
    visibility = {"atmosphericVisibility_km": 10}  # at a contrast of 2 %
    device = scanner(
        "conic", "", scanAngleMax_deg=20, scanFreqMax_Hz=10, pulseLength_ns=4, **visibility
    )
    legs = "".join(
        f'<leg><platformSettings x="{x}" y="0" z="20" movePerSec_m="10"/>'
        '<scannerSettings pulseFreq_hz="1000" scanAngle_deg="20" active="1"/></leg>'
        for x in (0, 10)
    )
    settings = '<FWFSettings binSize_ns="0.3" winSize_ns="1" maxFullwaveRange_ns="100"/>'
    made, _, of = imported(device, settings + legs)
    assert (scenario_of(made).returns.waveform, scenario_of(made).returns.sample_ns) == (
        "peaks",
        0.6,
    )
    assert made.unsupported == ["maxFullwaveRange_ns (waveforms are as long as their echoes)"]
    assert of.returns_each[0].system_ns(of.mounted_sensors[0].sensor.optics) == pytest.approx(
        4 / 2.35482
    )
    assert of.visibility_km == pytest.approx(10 * np.log(20) / 3.91)
    nm = of.mounted_sensors[0].sensor.optics.simulated_nm
    assert 1000 * of.extinction_at(nm) == pytest.approx(3.91 / 10 * (nm / 550) ** -1.3)


def test_parts_turn_grow_move_and_fall_as_in_helios(imported):
    scene = GROUND.replace(
        "</scene>",
        """<part><filter type="objloader">
  <param type="string" key="efilepath" value="parts/box_.*[.]obj"/>
  <param type="string" key="up" value="y"/></filter>
  <filter type="translate"><param type="integer" key="onGround" value="1"/>
    <param type="vec3" key="offset" value="1;2;30"/></filter>
  <filter type="scale"><param type="double" key="scale" value="2"/></filter>
  <filter type="rotate"><param type="rotation" key="rotation">
    <rot axis="x" angle_deg="90"/><rot axis="z" angle_deg="90"/></param></filter>
</part></scene>""",
    )
    device = scanner("conic", "", scanAngleMax_deg=20, scanFreqMax_Hz=10)
    boxes = {f"box_{n}.obj": f"o B{n}\nv 0 0 0\nv {n} 0 0\nv 0 3 0\nf 1 2 3\n" for n in (1, 2)}
    made, built, of = imported(device, legs('pulseFreq_hz="1000"'), scene, parts=boxes)
    assert built.names == ("ground", "B1", "B2")
    low, high = np.moveaxis(built.object_bounds + built.origin, 1, 0)
    # Up is y: (x, y, z) -> (x, -z, y); then x, then z turn, twice as large, onto the ground at 2.
    assert np.allclose(low[1:], [[1, 2, 2], [1, 2, 2]])
    assert np.allclose(high[1:], [[7, 4, 2], [7, 6, 2]])
    ground = scenario_of(made).materials[0]
    assert (ground.objects, ground.reflectance, ground.semantic_class) == (("ground",), 0.3, 2)
    MaterialTable.build(of.materials, built.surface_kinds)  # every object has one


def test_classes_and_reflectances_are_those_of_the_faces(imported):
    # One object of three materials, of which HELIOS++ knows two; another object of one.
    house = (
        "mtllib house.mtl\no House\n"
        + "".join(f"v {x} {y} 0\n" for x in range(4) for y in (0, 1))
        + "usemtl wall\nf 1 3 4 2\nusemtl red roof[1]\nf 3 5 6 4\nusemtl other\nf 5 7 8 6\n"
        + "o Shed\nusemtl wall\nf 1 5 6\n"
    )
    library = (
        "newmtl wall\nhelios_reflectance 0.2\nhelios_classification 6\n"
        "newmtl red roof[1]\nhelios_reflectance 60\nhelios_classification 7\nnewmtl other\n"
    )
    part = """<part><filter type="objloader">
  <param type="string" key="filepath" value="parts/house.obj"/></filter></part></scene>"""
    device = scanner("conic", "", scanAngleMax_deg=20, scanFreqMax_Hz=10)
    made, scene, of = imported(
        device,
        legs('pulseFreq_hz="1000"'),
        GROUND.replace("</scene>", part),
        parts={"house.obj": house, "house.mtl": library},
    )
    assert "class" in scenario_of(made).cloud.columns
    assert scene.names == ("ground", "House", "Shed")
    kinds = scene.surface_kinds
    table = MaterialTable.build(of.materials, scene.surface_kinds)
    rows = zip(kinds.object, kinds.material, table.semantic_class, table.reflectance, strict=True)
    found = {(kinds.names[owner], name): (int(c), float(share)) for owner, name, c, share in rows}
    assert found == {
        ("ground", "soil"): (2, 0.3),
        ("House", "wall"): (6, 0.2),
        ("House", "red roof[1]"): (7, 0.6),
        ("House", "other"): (0, 0.5),
        ("Shed", "wall"): (6, 0.2),
    }


@pytest.mark.parametrize("known", [True, False])
def test_reflectances_are_those_of_spectra_at_the_wavelength(imported, known):
    device = scanner("conic", "", scanAngleMax_deg=20, scanFreqMax_Hz=10, wavelength_nm=1500)
    parts = {"g.mtl": "newmtl soil\nhelios_spectra loam\n"}
    if known:
        parts["../spectra/loam.txt"] = "Name: loam\n\n1.0\t20.0\n2.0\t40.0 \n"
    made, _, _ = imported(device, legs('pulseFreq_hz="1000"'), parts=parts)
    assert [m.reflectance for m in scenario_of(made).materials] == [0.3, None] * known
    assert ("the spectrum 'loam', which is missing" in " ".join(made.unsupported)) != known


def test_a_trajectory_of_its_own_is_followed(imported):
    rows = "".join(f"{t},{a},0,{90 + a},{10 * t},2,30\n" for t, a in ((5, 0), (6, 4), (7, 8)))
    names = '#HEADER: "t", "roll", "pitch", "yaw", "x", "y", "z"\n'
    inside = '<scannerMount z="0.5"/>' + "".join(
        f'<leg><platformSettings trajectory="parts/way.trj" {times}/>'
        '<scannerSettings pulseFreq_hz="1000" scanAngle_deg="20"/></leg>'
        for times in ("", 'tStart="6" tEnd="6.5"')
    )
    made, scene, of = imported(
        scanner("conic", "", scanAngleMax_deg=20, scanFreqMax_Hz=10),
        inside,
        platform="interpolated",
        parts={"way.trj": names + rows},
    )
    assert (made.path.parent / "trajectory.tum").is_file()
    assert [c.sensor.start_ns for c in of.mounted_sensors] == [0, 1e9]
    assert [of.scan(s).firings[1] for s in (19, 24)] == [2000, 500]
    assert np.allclose(of.pose(20).position + scene.origin, [60, 2, 30.5])
    platform = about(-Z, 94) @ about(Y, 4)  # ARINC 705
    assert np.allclose(fired(of, 1, [0])[0, 0], platform @ about(X, 20) @ Y)


def test_times_of_a_trajectory_must_be_seconds(imported):
    inside = (
        '<leg><platformSettings trajectory="parts/way.trj"/>'
        '<scannerSettings pulseFreq_hz="1000" scanAngle_deg="20"/></leg>'
    )
    rows = "".join(f"{1403636580 + t}000000000,0,0,90,{t},2,30\n" for t in range(3))
    words = r"way\.trj cannot be used .* probably nanoseconds[.] HELIOS\+\+ expects seconds"
    with pytest.raises(LidarError, match=words):
        imported(
            scanner("conic", "", scanAngleMax_deg=20, scanFreqMax_Hz=10),
            inside,
            platform="interpolated",
            parts={"way.trj": rows},
        )


@pytest.mark.parametrize(
    ("names", "words"),
    [
        ('"t", "roll", "pitch", "heading", "x", "y", "z"', "Unknown names: 'heading'"),
        ('"t", "x", "pitch", "yaw", "x", "y", "z"', "A name occurs twice"),
        ('"t", "x", "y", "z"', "7 columns, named t, x, y, z"),
    ],
)
def test_columns_of_a_trajectory_are_known_or_refused(imported, names, words):
    inside = (
        '<leg><platformSettings trajectory="parts/way.trj"/>'
        '<scannerSettings pulseFreq_hz="1000" scanAngle_deg="20"/></leg>'
    )
    rows = "".join(f"{t},0,0,90,{10 * t},2,30\n" for t in (5, 6, 7))
    with pytest.raises(LidarError, match=words):
        imported(
            scanner("conic", "", scanAngleMax_deg=20, scanFreqMax_Hz=10),
            inside,
            platform="interpolated",
            parts={"way.trj": f"#HEADER: {names}\n{rows}"},
        )


def test_what_is_not_taken_over_is_named(imported, survey, tmp_path):
    part = GROUND.partition("<part>")[2].partition("</part>")[0]
    scene = GROUND.replace(
        "</scene>",
        f"""<part><filter type="detailedvoxels"><param key="filepath" value="c.vox"/>
<param key="intersectionMode" value="fixed"/></filter></part>
{f"<part>{part}<swap/></part>" * 30}</scene>""",
    ).replace("</part>", '<dmotion id="m"/></part>', 1)
    device = scanner("rotating", scanAngleMax_deg=60, scanAngleEffectiveMax_deg=60)
    device = device.replace("</scanner>", '<deflectionError expr="1"/></scanner>')
    inside = '<positionXNoise type="NORMAL"/>' + legs('pulseFreq_hz="1000" scanFreq_hz="30"')
    result = CliRunner().invoke(
        import_, [str(survey(device, inside, scene)), "-o", str(tmp_path / "out")]
    )
    assert result.exit_code == 0, result.output
    told = [line for line in result.output.splitlines() if line.startswith("not supported: ")]
    assert told == [
        "not supported: platform noise (positionXNoise)",
        "not supported: <deflectionError> of S/1",
        "not supported: <dmotion> in part 0 (the part is static)",
        "not supported: <swap> in 30 parts, part 2 to part 31 (the parts are static)",
        "not supported: part 1, detailedvoxels of c.vox with intersectionMode fixed (skipped)",
    ]
    head = (tmp_path / "out" / "scenario.yaml").read_text().splitlines()
    assert head[1:6] == [f"# N{line[1:]}." for line in told]
    again = CliRunner().invoke(import_, [str(survey(device, inside)), "-o", str(tmp_path / "out")])
    assert "already exists. Pass another folder" in str(again.exception)


VOX = """VOXEL SPACE
#min_corner: 0 0 0
#max_corner: 1 1 2
#split: 1 1 2
#res: 1
i j k PadBVTotal angleMean
0 0 0 0.5 45
0 0 1 1.5 45
"""
CROWN = """<part><filter type="detailedvoxels">
  <param type="string" key="filepath" value="parts/crown.vox"/>
  <param type="string" key="matfile" value="parts/leaf.mtl"/>
  <param type="string" key="matname" value="leaf"/>{more}</filter>
  <filter type="translate"><param type="vec3" key="offset" value="3;4;5"/></filter>
</part></scene>"""


def test_voxels_are_scene_files_where_light_goes_through_them(survey, tmp_path):
    mode = '<param type="string" key="intersectionMode" value="{}"/>'.format
    ladlut = '<param type="string" key="ladlut" value="l.txt"/>'
    scene = GROUND.replace("</scene>", CROWN.format(more=mode("Transmittive") + ladlut))
    scene = scene.replace("</scene>", CROWN.format(more=mode("scaled")))
    leaf = "newmtl wood\nhelios_reflectance 10\nnewmtl leaf\nhelios_reflectance 50\n"
    parts = {"crown.vox": VOX, "leaf.mtl": leaf}
    device = scanner("rotating", scanAngleMax_deg=60, scanAngleEffectiveMax_deg=60)
    made = import_checked(
        survey(device, legs('pulseFreq_hz="1000" scanFreq_hz="30"'), scene, parts=parts),
        tmp_path / "out",
    )
    built = prepare(scenario_of(made))
    assert built.scene.has_voxels.tolist() == [False, True]
    bounds = built.scene.object_bounds[1]
    assert bounds == pytest.approx(np.array([[3, 4, 5], [4, 5, 7]]), abs=0.021)
    table = MaterialTable.build(built.survey.materials, built.scene.surface_kinds)
    assert table.reflectance.tolist() == [0.3, 0.5]
    assert made.unsupported[-2:] == [
        "ladlut in part 1 (leaf angles are spherical)",
        "part 2, detailedvoxels of parts/crown.vox with intersectionMode scaled (skipped)",
    ]


@pytest.mark.parametrize(("separator", "ends"), [(None, ""), (" ", "0 0 1 255 0 0"), (",;", "0,1")])
def test_points_become_surfels_a_cell_of_voxel_size(survey, tmp_path, separator, ends):
    """A floor of 4 x 3 m and a wall at its end, by columns apart as the separator says."""
    side = np.arange(0.05, 4, 0.1)
    floor = [(x, y, 2) for x in side for y in side[:30]]
    wall = [(4, y, 2 + z) for y in side[:30] for z in side]
    gap = "," if separator == ",;" else " "
    rows = [gap.join(map(str, [*point, *ends.split()])) for point in floor + wall]
    params = '<param key="filepath" value="parts/scan.txt"/><param key="voxelSize" value="0.25"/>'
    params += f'<param key="separator" value="{separator}"/>' if separator else ""
    part = f"""<part><filter type="xyzloader">{params}</filter>
  <filter type="translate"><param key="offset" value="10;20;0"/></filter></part></scene>"""
    parts = {"scan.txt": "\n".join(["// x y z", *rows])}
    inside = legs('pulseFreq_hz="1000"', platform='onGround="true"')
    path = survey(LASER, inside, GROUND.replace("</scene>", part), parts=parts)
    made = import_checked(path, tmp_path / "out")
    assert {p.name for p in made.path.parent.glob("*.glb")} == {"scan-1.glb"}
    scene = prepare(scenario_of(made)).scene
    assert scene.names == ("ground", "scan") and not made.unsupported
    low, high = scene.object_bounds[1] + scene.origin
    assert np.allclose([low, high], [[10, 20, 2], [14, 23, 6]], atol=0.25)
    here = np.array([[12, 21.5, 4]] * 2) - scene.origin
    hits = RayCaster(scene.vertices, scene.faces, "numpy").cast(here, np.stack([-Z, X]))
    assert np.allclose(hits.distance, 2, atol=0.02)
    faces = (scene.face_object == 1).sum()
    assert faces / 2 == pytest.approx(16 * 12 + 16 * 12, rel=0.2)  # surfels of cells


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ("1 2 nan", "has points that are not finite, or more than 100,000 km away"),
        ("1e300 2 3", "has points that are not finite, or more than 100,000 km away"),
        ("// x y z", "has no points"),
    ],
)
def test_files_without_usable_points_are_refused(survey, tmp_path, rows, message):
    part = """<part><filter type="xyzloader"><param key="filepath" value="parts/scan.txt"/></filter>
</part></scene>"""
    inside = legs('pulseFreq_hz="1000"', platform='onGround="true"')
    path = survey(LASER, inside, GROUND.replace("</scene>", part), parts={"scan.txt": rows})
    with pytest.raises(LidarError, match=message) as caught:
        import_checked(path, tmp_path / "out")
    assert "scan.txt" in str(caught.value) and "\n" not in str(caught.value)


def test_rasters_of_heights_are_scene_files(imported, tmp_path):
    rasterio = pytest.importorskip("rasterio")
    (tmp_path / "helios" / "parts").mkdir(parents=True)
    place = rasterio.transform.from_origin(0, 30, 10, 10)
    heights = np.array([[1, 1, 1], [1, 5, 1], [1, 1, -9999]], np.float32)
    with rasterio.open(
        tmp_path / "helios" / "parts" / "hill.tif", "w", driver="GTiff", width=3, height=3,
        count=1, dtype="float32", transform=place, nodata=-9999,
    ) as file:  # fmt: skip
        file.write(heights, 1)
    scene = """<scene id="field"><part><filter type="geotiffloader">
  <param type="string" key="filepath" value="parts/hill.tif"/>
  <param type="string" key="matfile" value="parts/g.mtl"/>
  <param type="string" key="matname" value="soil"/></filter>
  <filter type="translate"><param type="vec3" key="offset" value="100;0;7"/></filter>
</part></scene>"""
    inside = legs('pulseFreq_hz="1000"', (115, 15), (120, 15), platform='onGround="true"')
    made, built, of = imported(LASER, inside, scene)
    assert not made.unsupported and built.names == ("hill",)
    bounds = built.object_bounds[0] + built.origin
    assert np.allclose(bounds, [[105, 5, 8], [125, 25, 12]])  # middles of the pixels
    assert built.triangles == 6  # of cells whose corners all have heights
    assert of.pose(0).position[2] + built.origin[2] == pytest.approx(12.5)  # on the ground
    assert scenario_of(made).materials[0].reflectance == 0.3


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("<survey", "<survey <"), "fly.xml is not valid XML"),
        (("<document", '<!DOCTYPE a [<!ENTITY e "">]><document'), "declares the XML entity 'e'"),
        (("devices.xml#s", "devices.xml#t"), "devices.xml has no <scanner> 't'"),
        (("devices.xml#s", "lasers.xml#s"), "the file 'lasers.xml' is neither.*--assets"),
        (('scanner="devices.xml#s"', ""), "<survey> has no scanner"),
        (("ground.obj", "grund.obj"), "scene 'field', part 0: the file .*grund.obj' is neither"),
        (("objloader", "xyzloader"), "part 0: .*ground.obj has rows that are not points"),
        (('x="3"', 'x="three"'), "leg 1: x is 'three'; it must be a number"),
        (('x="3" y="4"', 'x="0" y="0"'), "all legs have the same position"),
        (('movePerSec_m="10"', 'movePerSec_m="0"'), "leg 0: movePerSec_m is 0; it must be above 0"),
        (("<scannerSettings ", '<scannerSettings template="none" '), "no <scannerSettings> 'none'"),
        (
            ('pulseFreq_hz="1000"', 'pulseFreq_hz="0"'),
            "leg 0: S/1 must have a pulseFreq_hz above 0",
        ),
        (('pulseFreq_hz="1000"', 'active="false"'), "no leg has an active scanner"),
        (
            ('pulseFreq_hz="1000"', 'pulseFreq_hz="1000" opticsWarmupPhase_s="1e9"'),
            "leg 0: opticsWarmupPhase_s is 1e\\+09; it must be at most 86,400",
        ),
        (
            ('pulseFreq_hz="1000"', 'pulseFreq_hz="1000" opticsWarmupPhase_s="long"'),
            "leg 0: opticsWarmupPhase_s is 'long'; it must be a number",
        ),
        (("#plane", "#tripod"), "leg 0: neither the platform nor the head moves"),
        (('pulseFreq_hz="1000"', 'headRotatePerSec_deg="9"'), "supported only for rotating optics"),
        (
            ('optics="conic"', 'optics="flash"'),
            "optics 'flash'; it must be one of rotating, oscillating",
        ),
    ],
)
def test_mistakes_are_told_in_a_line_and_nothing_is_written(survey, tmp_path, change, message):
    device = LASER.replace("></scanner>", ' headRotatePerSecMax_deg="9"></scanner>')
    path = survey(device, FLY)
    for file in (path, path.parents[1] / "devices.xml"):
        text = file.read_text()
        file.write_text(text.replace(*change))
    with pytest.raises(LidarError, match=message) as told:
        import_checked(path, tmp_path / "out")
    assert str(told.value).startswith(str(path)) and "\n" not in str(told.value)
    assert [entry.name for entry in tmp_path.iterdir()] == ["helios"]


@pytest.mark.parametrize("named", ["parts/ground.obj", "g.mtl"])
@pytest.mark.parametrize("target", ["{outside}", "../../{outside}", "link"])
def test_files_outside_of_the_folders_of_a_survey_are_refused(
    survey, tmp_path, tmp_path_factory, named, target
):
    outside = tmp_path_factory.mktemp("outside") / "file"
    outside.write_text(SQUARE if named.endswith("obj") else ON_GROUND)
    deep = tmp_path / "1/2/3/4/5"  # the five folders above do not hold the file
    deep.mkdir(parents=True)
    path = survey(LASER, FLY)
    path.parents[1].rename(deep / "helios")
    root = deep / "helios"
    if target == "link":
        (root / "parts" / "link").symlink_to(outside)
        name = "link" if named == "g.mtl" else "parts/link"
    else:
        name = os.path.relpath(outside, root / "parts")
        name = str(outside) if target == "{outside}" else name
    file = root / ("parts/ground.obj" if named == "g.mtl" else "deep/fly.xml")
    file.write_text(file.read_text().replace(named, name))
    with pytest.raises(
        LidarError, match=r"refers to the file .*, which is neither in its folder"
    ) as told:
        import_checked(root / "deep" / "fly.xml", tmp_path / "out")
    assert repr(name) in str(told.value) and not (tmp_path / "out").exists()


def test_angular_resolutions_set_the_rates(imported):
    wide = {"scanAngleMax_deg": 90, "scanAngleEffectiveMax_deg": 50}
    device = scanner("rotating", "", headRotatePerSecMax_deg=99, **wide)
    fine = 'pulseFreq_hz="9000" verticalResolution_deg="2" horizontalResolution_deg="0.5" '
    ends = 'headRotateStart_deg="0" headRotateStop_deg="50"'
    made, _, of = imported(device, legs(fine + ends, (0, 0)), platform="tripod")
    head = of.mounted_sensors[0].sensor.head
    assert head.firings_per_turn == pytest.approx(720) and head.rate_hz == pytest.approx(50 / 360)
    assert of.ray_count == 100 * 50  # lines half a degree apart, of -48 to 50 degrees by 2
    assert scenario_of(made).sensors["leg0"].steps == 5


def test_a_scenario_that_the_check_refuses_is_not_written(survey, tmp_path):
    path = survey(LASER, FLY)
    checked = []

    def refuse(file: Path) -> None:
        checked.append(yaml.safe_load(file.read_text()))
        raise LidarError(f"{file}: no such sensor.")

    with pytest.raises(LidarError) as refused:
        import_survey(path, tmp_path / "out", check=refuse, surfels=surfel_mesh)
    assert str(refused.value).endswith(
        f"cannot be converted to a scenario: {tmp_path / 'out/scenario.yaml'}: no such sensor."
    )
    assert list(checked[0]["sensors"]) == ["leg0"]
    assert [entry.name for entry in tmp_path.iterdir()] == ["helios"]
