"""Scenarios: the paper's Table 1 in numbers, the presets of movers, and what is refused."""

import jax.numpy as jnp
import numpy as np
import pytest

from vcjax.models.camera import Camera
from vcjax.models.motion import Oscillation
from vcjax.simulation.scenarios import Scenario, paper
from vcjax.simulation.world import Movers, grid, velocities


def test_defaults_are_table_1():
    scenario = paper()
    assert scenario.landmarks_m.shape == (162, 3)
    np.testing.assert_array_equal(scenario.camera.image_size_px, [640, 480])
    np.testing.assert_array_equal(scenario.camera.intrinsics_px, [320, 240, 320, 320])
    assert 2 * np.rad2deg(np.arctan(320 / scenario.camera.intrinsics_px[2])) == pytest.approx(90)  # field of view
    assert (scenario.num_frames, scenario.frame_rate_hz, scenario.pixel_std_px) == (160, 10.0, 1.0)
    np.testing.assert_array_equal(scenario.increment, [0.05, 0, 0])
    np.testing.assert_array_equal(scenario.odometry_std, [0.005, 0.005, 0, 0, 0, 0.05])
    np.testing.assert_array_equal(scenario.mount, [0, 0, 0.6, -90, 0, -90])
    assert (scenario.oscillation.amplitude_m, scenario.oscillation.frequency_hz) == (0.0, 3.0)
    assert scenario.movers.speed_m_s == 0.0


def test_grid_fills_16_by_16_metres_in_two_layers():
    places = {tuple(p) for p in paper().landmarks_m}
    side = np.arange(-8.0, 9.0, 2.0)
    assert places == {(x, y, z) for x in side for y in side for z in (0.0, 1.0)}


def test_ids_count_by_layer_then_x_then_y():
    np.testing.assert_array_equal(grid()[[0, 1, 9, 81]], [[-8, -8, 0], [-8, -6, 0], [-6, -8, 0], [-8, -8, 1]])


@pytest.mark.parametrize(
    ("robot", "start", "increment"),
    [
        ("forward", (-8, 0, 0), (0.05, 0, 0)),
        ("curved", (-8, -8, 0), (0.05, 0, 0.5)),
        ("lateral", (-4, -4, 0), (0, 0.05, 0)),
    ],
)
def test_robots_start_and_move_as_in_the_paper(robot, start, increment):
    scenario = paper(robot)
    np.testing.assert_array_equal(scenario.start, start)
    np.testing.assert_array_equal(scenario.increment, increment)


def test_six_axis_noise_is_on_all_axes():
    np.testing.assert_array_equal(paper(noise="six_axis").odometry_std, [0.005] * 3 + [0.05] * 3)


PLACES = {
    "ahead": {(4.0, y, z) for y in (-2.0, 0.0, 2.0) for z in (0.0, 1.0)},
    "near_path": {(x, y, 0.0) for x in (0.0, 4.0, 8.0) for y in (-2.0, 2.0)},
}


@pytest.mark.parametrize("preset", PLACES)
def test_six_movers_stand_where_the_preset_says(preset):
    scenario = paper(dynamic="lateral", dynamic_set=preset)
    assert len(scenario.movers.ids) == 6
    assert {tuple(p) for p in scenario.landmarks_m[scenario.movers.ids]} == PLACES[preset]


@pytest.mark.parametrize(("dynamic", "direction"), [("lateral", (0, 1, 0)), ("inverse_forward", (-1, 0, 0))])
def test_movers_have_the_paper_s_direction_and_speed(dynamic, direction):
    movers = paper(dynamic=dynamic, dynamic_speed_m_s=0.25, dynamic_set=[3, 7]).movers
    velocity = velocities(movers, 10)
    np.testing.assert_array_equal(velocity[np.array([3, 7])], 0.25 * np.array([direction] * 2))
    np.testing.assert_array_equal(np.delete(velocity, [3, 7], axis=0), 0)


BAD_PAPERS = {
    "unknown robot": (dict(robot="backward"), r"paper\(robot='backward'\): choose one of \('forward', 'curved'"),
    "unknown motion": (dict(dynamic="up"), r"paper\(dynamic='up'\): choose one of"),
    "unknown noise": (dict(noise="none"), r"paper\(noise='none'\): choose one of"),
    "unknown set": (dict(dynamic_set="all"), r"paper\(dynamic_set='all'\): choose one of \('ahead', 'near_path'\)"),
    "id too large": (dict(dynamic_set=[5, 162]), r"Scenario\(movers.ids=\[5, 162\]\): there are 162 features"),
    "id negative": (dict(dynamic_set=[-1]), r"Scenario\(movers.ids=\[-1\]\)"),
    "id not whole": (dict(dynamic_set=[1.5]), r"paper\(dynamic_set=\[1.5\]\): .*whole numbers"),
    "f at Nyquist": (dict(oscillation_frequency_hz=5.0), r"frequency_hz=5.0\) is at or above half the .* \(10.0 Hz\)"),
    "f swept over it": (dict(oscillation_frequency_hz=jnp.array([3.0, 6.0])), r"frequency_hz=\[3.0, 6.0\]\)"),
    "f above a low rate": (dict(frame_rate_hz=5.0), r"frequency_hz=3.0\) is at or above"),
    "negative amplitude": (dict(oscillation_amplitude_m=-0.05), r"Oscillation\(amplitude_m=-0.05\)"),
    "negative speed": (dict(dynamic="lateral", dynamic_speed_m_s=-1), r"Movers\(speed_m_s=-1.0\)"),
    "negative noise": (dict(pixel_error_std_px=-1.0), r"Scenario\(pixel_std_px=-1.0\)"),
    "no frames": (dict(num_frames=0), r"Scenario\(num_frames=0\): give a whole number of at least 1"),
    "half a frame": (dict(num_frames=1.5), r"Scenario\(num_frames=1.5\)"),
    "no rate": (dict(frame_rate_hz=0, oscillation_frequency_hz=0), r"Scenario\(frame_rate_hz=0.0\)"),
    "endless step": (dict(step_m=np.inf), r"Scenario\(increment=\[inf"),
}


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(("fields", "message"), BAD_PAPERS.values(), ids=BAD_PAPERS)
def test_bad_experiment_is_refused_by_name_and_value(fields, message):
    with pytest.raises(ValueError, match=message):
        paper(**fields)


BAD_SCENARIOS = {
    "no features": (dict(landmarks_m=np.zeros((0, 3))), r"Scenario\(landmarks_m\) has shape \(0, 3\)"),
    "flat features": (dict(landmarks_m=np.zeros((5, 2))), r"Scenario\(landmarks_m\) has shape \(5, 2\)"),
    "lost feature": (dict(landmarks_m=np.full((3, 3), np.nan)), r"Scenario\(landmarks_m=\[\[nan"),
    "negative odometry noise": (dict(odometry_std=(0, 0, 0, 0, 0, -0.1)), r"Scenario\(odometry_std=.*-0.1\]\)"),
    "short odometry noise": (dict(odometry_std=(0.1, 0.1)), r"Scenario\(odometry_std\) has shape \(2,\)"),
    "short mount": (dict(mount=(0, 0, 0.6)), r"Scenario\(mount\) has shape \(3,\)"),
    "no start": (dict(start=(0, np.nan, 0)), r"Scenario\(start=\[0.0, nan, 0.0\]\)"),
}


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(("fields", "message"), BAD_SCENARIOS.values(), ids=BAD_SCENARIOS)
def test_bad_scenario_is_refused_by_name_and_value(fields, message):
    movers = Movers(np.array([0]))
    with pytest.raises(ValueError, match=message):
        Scenario(**dict(landmarks_m=grid(), movers=movers, camera=Camera(), oscillation=Oscillation()) | fields)


def test_bad_direction_is_refused():
    with pytest.raises(ValueError, match=r"Movers\(direction\) has shape \(2,\), but 3 numbers"):
        Movers(np.array([0]), direction=(1, 0))
