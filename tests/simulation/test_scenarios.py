"""Scenarios: the paper's Table 1 in numbers, the presets of movers, and what is refused."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from vcjax.models.camera import Camera
from vcjax.models.motion import Oscillation
from vcjax.simulation.scenarios import Scenario, paper
from vcjax.simulation.world import Movers, grid, velocities
from vcjax.study.results import describe


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


def test_every_number_is_an_option():
    """Each reaches its place in the scenario, and leaves the others as the named motion has them."""
    usual = paper("curved")
    for option, value in {
        "start": (1.0, 2.0, 30.0),
        "increment": (0.1, 0.02, -1.0),
        "odometry_std": (1.0, 2.0, 3.0, 4.0, 5.0, 6.0),
        "mount": (0.1, 0.2, 0.3, -80.0, 1.0, -70.0),
    }.items():
        changed = paper("curved", **{option: value})
        np.testing.assert_array_equal(getattr(changed, option), value)
        assert describe(replace(changed, **{option: getattr(usual, option)})) == describe(usual)
    camera = {
        "intrinsics_px": (300.0, 200.0, 250.0, 251.0),
        "image_size_px": (600.0, 400.0),
        "distortion": (0.1, -0.02),
    }
    changed = paper("curved", **camera)
    assert describe(changed) == describe(replace(usual, camera=Camera(**camera)))


def test_grid_is_as_asked_for():
    scenario = paper(grid_low_m=-1.0, grid_high_m=3.0, grid_per_side=2, grid_heights_m=(0.5,))
    np.testing.assert_array_equal(scenario.landmarks_m, [[-1, -1, 0.5], [-1, 3, 0.5], [3, -1, 0.5], [3, 3, 0.5]])
    assert scenario.movers.ids.size == 0  # in a static scene the grid may lack the places of the preset
    np.testing.assert_array_equal(paper(grid_low_m=-12.0, grid_high_m=12.0, grid_per_side=13).movers.speed_m_s, 0)


def test_direction_of_movers_is_free_and_its_length_means_nothing():
    movers = paper(dynamic_direction=(3.0, 0.0, -4.0), dynamic_speed_m_s=0.5, dynamic_set=[2]).movers
    np.testing.assert_allclose(velocities(movers, 4)[2], [0.3, 0, -0.4], rtol=1e-15)
    assert paper(dynamic_speed_m_s=0.5).movers.speed_m_s == 0  # no motion named: static


def test_movers_are_found_by_their_places_in_the_order_given():
    places = [(4.0, 2.0, 1.0), (-8.0, -8.0, 0.0), (0.0004, -0.0004, 0.0)]
    scenario = paper(dynamic="lateral", dynamic_places_m=places)
    np.testing.assert_allclose(scenario.landmarks_m[scenario.movers.ids], places, rtol=0, atol=1e-3)
    assert scenario.movers.ids.tolist() == [140, 0, 40]


def test_movers_are_drawn_from_a_seed():
    def ids(num, seed=0):
        return paper(dynamic="lateral", dynamic_drawn=num, dynamic_seed=seed).movers.ids.tolist()

    assert ids(6) == ids(6) and ids(6) != ids(6, seed=1)
    assert ids(6)[:4] == ids(4) and ids(0) == []
    assert sorted(ids(162, seed=5)) == list(range(162))
    often = np.bincount(np.ravel([ids(6, seed) for seed in range(500)]), minlength=162)
    assert stats.chisquare(often).pvalue > 1e-3  # each as likely as any other


@pytest.mark.usefixtures("unchecked")
def test_numbers_may_be_traced():
    """A vector of them, too; ids and the grid may not."""

    def total(speed, step, angle):
        scenario = paper(
            dynamic_direction=(jnp.cos(angle), jnp.sin(angle), 0.0), dynamic_speed_m_s=speed, start=(step, 0.0, 0.0)
        )
        return jnp.sum(velocities(scenario.movers, 162)[:, 1]) + scenario.start[0]

    gradient = jax.jit(jax.grad(total, argnums=(0, 1, 2)))(2.0, 3.0, 0.25)
    np.testing.assert_allclose(gradient, [6 * np.sin(0.25), 1, 12 * np.cos(0.25)], rtol=1e-12)


BAD_PAPERS = {
    "unknown robot": (dict(robot="backward"), r"paper\(robot='backward'\): choose one of \('forward', 'curved'"),
    "unknown motion": (dict(dynamic="up"), r"paper\(dynamic='up'\): choose one of"),
    "unknown noise": (dict(noise="none"), r"paper\(noise='none'\): choose one of"),
    "unknown set": (dict(dynamic_set="all"), r"paper\(dynamic_set='all'\): choose one of \('ahead', 'near_path', 'b"),
    "id too large": (dict(dynamic_set=[5, 162]), r"Scenario\(movers.ids=\[5, 162\]\): there are 162 features"),
    "id negative": (dict(dynamic_set=[-1]), r"Scenario\(movers.ids=\[-1\]\)"),
    "id not whole": (dict(dynamic_set=[1.5]), r"Movers\(ids=\[1.5\]\): .*whole numbers"),
    "id twice": (dict(dynamic_set=[5, 7, 5]), r"Movers\(ids=\[5, 7, 5\]\): feature 5 comes twice; give each once"),
    "ids in a table": (dict(dynamic_set=[[5, 7]]), r"Movers\(ids=\[\[5, 7\]\]\): give a list of feature ids"),
    "place of none": (
        dict(dynamic_places_m=[(4, 0, 0), (4, 0.002, 0)]),
        r"features_at\(places_m\[1\]=\[4.0, 0.002, 0.0\]\): no feature is there; the nearest, 58, is at \[4.0, 0.0, 0",
    ),
    "place of NaN": (
        dict(dynamic_places_m=[(4, 0, np.nan)]),
        r"places_m\[0\]=\[4.0, 0.0, nan\]\): no feature is there",
    ),
    "place twice": (
        dict(dynamic_places_m=[(4, 0, 0), (4, 2, 0), (4, 0, 1e-4)]),
        r"places_m\[2\]=\[4.0, 0.0, 0.0001\]\): feature 58 comes twice",
    ),
    "flat place": (dict(dynamic_places_m=[(4, 0)]), r"places_m\) has shape \(1, 2\): give x, y and z"),
    "too many drawn": (dict(dynamic_drawn=163), r"features_drawn\(num_drawn=163\): .* from 0 to 162"),
    "half drawn": (dict(dynamic_drawn=1.5), r"features_drawn\(num_drawn=1.5\)"),
    "negative seed": (dict(dynamic_drawn=1, dynamic_seed=-1), r"features_drawn\(seed=-1\): give a whole number from 0"),
    "set and places": (
        dict(dynamic_set=[1], dynamic_places_m=[(4, 0, 0)]),
        r"give one of dynamic_set, dynamic_places_m and dynamic_drawn",
    ),
    "places and draw": (
        dict(dynamic_drawn=1, dynamic_places_m=[(4, 0, 0)]),
        r"give one of dynamic_set, dynamic_places",
    ),
    "two motions": (
        dict(dynamic="lateral", dynamic_direction=(1.0, 0.0, 0.0)),
        r"paper\(dynamic='lateral', dynamic_direction=\(1.0, 0.0, 0.0\)\): give one of the two",
    ),
    "no direction": (dict(dynamic_direction=(0, 0, 0)), r"Movers\(direction=\[0.0, 0.0, 0.0\]\): give a direction"),
    "preset without places": (
        dict(dynamic="lateral", grid_per_side=4),
        r"features_at\(places_m\[0\]=\[4.0, -2.0, 0.0\]\): no feature is there",
    ),
    "no grid": (dict(grid_per_side=0), r"grid\(num_per_side=0\): give a whole number of at least 1"),
    "no layer": (dict(grid_heights_m=()), r"grid\(heights_m=\(\)\): give the height of at least one layer"),
    "short start": (dict(start=(0.0, 1.0)), r"Scenario\(start\) has shape \(2,\), but 3 numbers"),
    "many mounts": (dict(mount=np.zeros((2, 6))), r"Scenario\(mount\) has shape \(2, 6\), but one vector is needed"),
    "f at Nyquist": (
        dict(oscillation_frequency_hz=5.0),
        r"frequency_hz=5.0\) is not below half the frame rate of 10.0 Hz; .*steady",
    ),
    "f swept over it": (dict(oscillation_frequency_hz=jnp.array([3.0, 6.0])), r"frequency_hz=\[3.0, 6.0\]\)"),
    "f above a low rate": (dict(frame_rate_hz=5.0), r"frequency_hz=3.0\) is not below half"),
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
    "no movers": (dict(movers=None), r"Scenario\(movers=None\): give an object of the class Movers"),
    "camera's numbers": (
        dict(camera=(320, 240)),
        r"Scenario\(camera=\(320, 240\)\): give an object of the class Camera",
    ),
    "words for features": (dict(landmarks_m="grid"), r"Scenario\(landmarks_m\) has shape \(\)"),
    "no start": (dict(start=(0, np.nan, 0)), r"Scenario\(start=\[0.0, nan, 0.0\]\)"),
}


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(("fields", "message"), BAD_SCENARIOS.values(), ids=BAD_SCENARIOS)
def test_bad_scenario_is_refused_by_name_and_value(fields, message):
    movers = Movers(np.array([0]))
    with pytest.raises(ValueError, match=message):
        Scenario(**dict(landmarks_m=grid(), movers=movers, camera=Camera(), oscillation=Oscillation()) | fields)


@pytest.mark.usefixtures("unchecked")
def test_features_may_be_listed():
    scenario = Scenario(landmarks_m=[(4, 0, 1), (4, 1, 1)], movers=Movers([1]))
    assert scenario.landmarks_m.dtype == np.float64 and scenario.landmarks_m.shape == (2, 3)


def test_bad_direction_is_refused():
    with pytest.raises(ValueError, match=r"Movers\(direction\) has shape \(2,\), but 3 numbers"):
        Movers(np.array([0]), direction=(1, 0))
