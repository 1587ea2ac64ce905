"""Wavelengths of sensors: unknown ones are noted where reflectances depend on them."""

import numpy as np
import pytest

from lidarscenario.advice import advice
from lidarscenario.prepare import prepare
from lidarscenario.scenario import Scenario
from lidarsim import Sensor, load_sensor
from lidarsim.sensor.export import fired_rays
from lidarsim.sensor.optics import Optics

LEAF = {"objects": "*", "spectrum": "leaf, green"}
SAME = {"objects": "*", "spectrum": "asphalt shingle, red"}  # 0.07 at both wavelengths
UNKNOWN = "drone/riegl-vux1uav"
KNOWN = "velodyne/vlp16"


def notes_of(*materials, **sensors):
    scene = {"copies": [{"name": "Wall", "box": [1, 9, 9], "at": [[5, 0, 0]]}]}
    data = {"scene": scene, "materials": [*materials], "poses": [[0, 0, 2]], "steps": 1, **sensors}
    return [note for note in advice(prepare(Scenario.from_data(data))) if "wavelength" in note]


@pytest.mark.parametrize(
    ("model", "nm"), [(KNOWN, 903), ("ouster/os1-64", 865), (UNKNOWN, None), ("hesai/ot128", None)]
)
def test_models_state_the_wavelength_that_a_source_states(model, nm):
    optics = load_sensor(model).optics
    assert optics.wavelength_nm == nm
    assert optics.simulated_nm == (nm or 905)


def test_a_wavelength_that_is_unknown_is_not_exported():
    assert fired_rays(load_sensor(UNKNOWN), revolutions=1).light.wavelength_nm is None
    assert fired_rays(load_sensor(KNOWN), revolutions=1).light.wavelength_nm == 903
    assert "905 nm (assumed)" in load_sensor(UNKNOWN)._repr_html_()
    assert "903 nm<" in load_sensor(KNOWN)._repr_html_()
    assert Sensor.grid().optics == Optics()


def test_spectra_at_an_unknown_wavelength_are_noted():
    (note,) = notes_of(LEAF, sensor=UNKNOWN)
    assert "the wavelength of RIEGL VUX-1UAV is unknown and simulated as 905 nm" in note
    assert "the spectrum 'leaf, green' is 0.47 at 905 nm and 0.26 at 1550 nm" in note
    (note,) = notes_of(LEAF, sensors={"a": UNKNOWN, "b": KNOWN, "c": "hesai/ot128"})
    assert "the wavelength of RIEGL VUX-1UAV and Hesai OT128 is unknown" in note


def test_fog_at_an_unknown_wavelength_is_noted_and_dust_is_not():
    fog = {"weather": {"visibility_km": 1.0}, "noise": {"detection_range_m": 90}}
    (note,) = notes_of({"objects": "*", "reflectance": 0.4}, sensor=UNKNOWN, **fog)
    assert "the wavelength of RIEGL VUX-1UAV is unknown and simulated as 905 nm, but" in note
    # Kruse et al. (1962) with 3/km at 550 nm and an exponent of 0.585 · 1.306 ** (1/3)
    expected = [
        np.log(20) * (nm / 550) ** -(0.585 * (np.log(50) / np.log(20)) ** (1 / 3))
        for nm in (905, 1550)
    ]
    near, far = expected
    assert (
        f"the extinction by fog depends on it: it is {near:.3g}/km at 905 nm and {far:.3g}/km"
        in note
    )
    assert len(notes_of(LEAF, sensor=UNKNOWN, **fog)) == 2
    assert notes_of(LEAF, sensor=KNOWN, **fog) == []
    dust = {"weather": {"dust_mg_m3": 100.0}, "noise": {"detection_range_m": 90}}
    assert notes_of({"objects": "*", "reflectance": 0.4}, sensor=UNKNOWN, **dust) == []


@pytest.mark.parametrize(
    ("material", "sensor"),
    [
        (LEAF, KNOWN),
        (SAME, UNKNOWN),
        ({"objects": "*", "reflectance": 0.4}, UNKNOWN),
        (LEAF, {"layers": 8}),  # a sensor that is no product has no wavelength to look up
    ],
)
def test_surveys_that_do_not_depend_on_an_unknown_wavelength_have_no_note(material, sensor):
    assert notes_of(material, sensor=sensor) == []
