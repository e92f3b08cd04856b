"""Movers on courses, buses, drawn movers and a jittering camera: against plain loops, by property, and what is kept."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from vcjax.recording import Truth, moves_in_frame
from vcjax.simulation.courses import COURSES, Course, named_course
from vcjax.simulation.scenarios import BUSES, HARDER, harder, paper
from vcjax.simulation.simulate import simulate as simulate_unjitted
from vcjax.simulation.world import Movers, moved

KEY = jax.random.key(0)
simulate = jax.jit(simulate_unjitted)
START = np.array([[4.0, 0.0, 1.0], [2.0, -2.0, 0.0]])


def walked(course: Course, velocity, number, time_s, step_s=1e-3):
    """How far a mover has gone, by adding up small steps."""
    change, place, t = list(np.asarray(course.change_s)), np.zeros(3), 0.0
    pace, heading = (np.broadcast_to(a, (2, len(change) + 1)) for a in (course.pace, course.heading_deg))
    for _ in range(round(time_s / step_s)):
        leg = sum(t + step_s / 2 > moment for moment in change)
        angle = np.deg2rad(heading[number, leg])
        turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
        place = place + step_s * pace[number, leg] * turn @ velocity
        t += step_s
    return place


@pytest.mark.parametrize("name", COURSES)
def test_movers_are_where_small_steps_lead(name):
    course = named_course(name, 4.0)
    movers = Movers(np.array([1]), (1.0, 2.0, 0.5), 0.7, course)
    time_s = np.array([0.3, 1.0, 1.4, 2.6, 3.9])
    places, is_moving = moved(movers, jnp.asarray(START), jnp.asarray(time_s))
    velocity = 0.7 * np.array([1.0, 2.0, 0.5]) / np.sqrt(5.25)
    for t, place in zip(time_s, places, strict=True):
        np.testing.assert_allclose(place[1] - START[1], walked(course, velocity, 0, t), rtol=0, atol=1e-9)
    np.testing.assert_array_equal(places[:, 0], np.broadcast_to(START[0], (5, 3)))
    assert is_moving.tolist() == [False, True]


def test_each_mover_may_have_its_own_legs():
    course = Course((1.0,), np.array([[1.0, 0.0], [0.5, 2.0]]), np.array([[0.0, 0.0], [90.0, -30.0]]))
    places, _ = moved(Movers(np.array([1, 0]), (1.0, 0.0, 0.0), 0.5, course), jnp.asarray(START), jnp.array([0.4, 2.2]))
    for mover, feature in enumerate((1, 0)):
        for t, place in zip((0.4, 2.2), places, strict=True):
            expected = walked(course, np.array([0.5, 0, 0]), mover, t)
            np.testing.assert_allclose(place[feature] - START[feature], expected, rtol=0, atol=1e-9)


legs = st.integers(1, 4).flatmap(
    lambda n: st.tuples(
        st.lists(st.floats(0.05, 3.0), min_size=n - 1, max_size=n - 1),
        st.lists(st.floats(0.0, 2.0), min_size=n, max_size=n),
        st.lists(st.floats(-400.0, 400.0), min_size=n, max_size=n),
    )
)


@given(legs)
def test_a_mover_is_never_faster_than_its_fastest_leg_and_stands_where_its_pace_is_zero(drawn):
    lengths, pace, heading = drawn
    change = np.cumsum(lengths)
    course = Course(tuple(change), tuple(pace), tuple(heading))
    time_s = np.linspace(0.0, change[-1] + 1 if len(change) else 1.0, 41)
    places, _ = moved(Movers(np.array([0]), (0.0, 1.0, 0.0), 1.0, course), jnp.zeros((1, 3)), jnp.asarray(time_s))
    steps = np.linalg.norm(np.diff(np.asarray(places)[:, 0], axis=0), axis=1)
    assert np.all(steps <= max(pace) * np.diff(time_s) * (1 + 1e-9) + 1e-12)
    for leg, (begin, end) in enumerate(zip([0.0, *change], [*change, np.inf], strict=True)):
        inside = (time_s[:-1] >= begin) & (time_s[1:] <= end)
        np.testing.assert_allclose(steps[inside], pace[leg] * np.diff(time_s)[inside], rtol=0, atol=1e-9)


def truth_of(scenario) -> Truth:
    """Its landmarks, without the path."""
    time_s = jnp.arange(1, scenario.num_frames + 1) / scenario.frame_rate_hz
    nowhere = jnp.zeros((scenario.num_frames, 7))
    return Truth(nowhere, nowhere, *moved(scenario.movers, jnp.asarray(scenario.landmarks_m), time_s))


def test_one_leg_is_a_constant_velocity():
    usual = paper(dynamic="lateral", dynamic_speed_m_s=0.5)
    one_leg = dataclasses.replace(usual, movers=dataclasses.replace(usual.movers, course=Course()))
    expected, truth = truth_of(usual), truth_of(one_leg)
    np.testing.assert_allclose(truth.landmarks_m, expected.landmarks_m, rtol=0, atol=1e-14)
    np.testing.assert_array_equal(truth.is_moving, expected.is_moving)


def test_the_truth_says_when_a_feature_moves():
    for name, expected in {
        "late": [False, True, True, True],
        "stops": [True, True, False, False],
        "stops_and_starts": [True, False, True, True],
        "turns": [True] * 4,
    }.items():
        scenario = harder(name, num_frames=40)
        truth, ids = truth_of(scenario), scenario.movers.ids
        moves = np.asarray(moves_in_frame(truth))
        np.testing.assert_array_equal(moves[:, ids], np.repeat(expected, 10)[:, None] & np.ones(6, bool))
        assert not np.delete(moves, ids, axis=1).any()
        np.testing.assert_array_equal(np.flatnonzero(truth.is_moving), ids)
    later = dataclasses.replace(scenario.movers, course=Course((5.0,), (0.0, 1.0), (0.0, 0.0)))
    truth = truth_of(dataclasses.replace(scenario, movers=later))  # of 4 s
    assert not truth.is_moving.any() and not moves_in_frame(truth).any()
    one = moves_in_frame(truth_of(harder("stops", num_frames=1)))
    np.testing.assert_array_equal(np.flatnonzero(one[0]), ids)


def test_a_bus_moves_as_one_and_larger_ones_add_to_smaller():
    camera, before = np.array([-8.0, 0.0]), set()
    for name, num in BUSES.items():
        scenario = harder(name, num_frames=20)
        truth = truth_of(scenario)
        ids, landmarks = np.asarray(scenario.movers.ids), np.asarray(scenario.landmarks_m)
        assert len(ids) == num and before <= set(ids.tolist())
        before = set(ids.tolist())
        gone = np.asarray(truth.landmarks_m)[-1, ids] - landmarks[ids]
        np.testing.assert_allclose(gone, np.broadcast_to([0, 1, 0], (num, 3)), rtol=0, atol=1e-12)
        ahead, side = (landmarks[ids, :2] - camera).T
        assert np.all(np.abs(side) < ahead)  # in view from the start: the camera sees 90° wide
        far = np.linalg.norm(landmarks - [4.0, 0.0, 0.5], axis=1)
        assert far[ids].max() <= np.delete(far, ids).min() + 1e-9
    with pytest.raises(ValueError, match=r"features_near\(num=12\): give a whole number from 0 to 8"):
        paper(dynamic="lateral", dynamic_set="bus_12", grid_per_side=2)


def test_directions_and_speeds_are_drawn_from_a_seed():
    def course(num=6, seed=0):
        return paper(dynamic="drawn", dynamic_drawn=num, dynamic_seed=seed).movers.course

    np.testing.assert_array_equal(course().heading_deg, course().heading_deg)
    np.testing.assert_array_equal(course(4).heading_deg, course().heading_deg[:4])
    np.testing.assert_array_equal(course(4).pace, course().pace[:4])
    assert np.all(course(seed=1).heading_deg != course().heading_deg)
    heading, pace = (np.ravel([getattr(course(162, s), name) for s in range(8)]) for name in ("heading_deg", "pace"))
    assert stats.kstest(heading / 360, "uniform").pvalue > 1e-3
    assert stats.kstest(pace, "uniform", (0.5, 1.0)).pvalue > 1e-3
    assert abs(np.corrcoef(heading, pace)[0, 1]) < stats.norm.isf(1e-4) / np.sqrt(heading.size)
    both = paper(dynamic="drawn", dynamic_course="stops")
    assert both.movers.course.pace.shape == (6, 2) and np.all(both.movers.course.pace[:, 1] == 0)
    ids = [paper(dynamic=how, dynamic_drawn=6, dynamic_seed=5).movers.ids for how in ("drawn", "lateral")]
    np.testing.assert_array_equal(*ids)  # which move does not depend on where to


def jitter_of(**options):
    recording, truth = simulate(paper(oscillation_amplitude_m=0.05, **options), KEY)
    return recording, np.asarray(truth.sensor)[:, 1] - np.cumsum(np.asarray(recording.sensor_shift_m)[:, 1])


def test_the_camera_jitters_about_what_is_commanded():
    usual, none = jitter_of()
    np.testing.assert_allclose(none, 0, rtol=0, atol=1e-15)
    recording, jitter = jitter_of(oscillation_error_std_m=0.002)
    np.testing.assert_array_equal(recording.sensor_shift_m, usual.sensor_shift_m)  # what the filter is told
    np.testing.assert_array_equal(recording.odometry, usual.odometry)
    low, high = stats.chi2.interval(0.999, 160)
    white = jitter / 0.002
    assert low < np.sum(white**2) < high and abs(white.mean()) < stats.norm.isf(5e-4) / np.sqrt(160)
    assert abs(np.corrcoef(white[1:], white[:-1])[0, 1]) < stats.norm.isf(5e-4) / np.sqrt(159)
    _, larger = jitter_of(oscillation_error_std_m=0.005)
    np.testing.assert_allclose(larger, 2.5 * jitter, rtol=0, atol=1e-15)
    _, same = jitter_of(oscillation_error_std_m=0.002, dynamic="lateral")
    np.testing.assert_array_equal(same, jitter)
    # The pixels have the noise they had: where the camera is, they are those of a camera steered there.
    moved_px = np.asarray(recording.uv_px - usual.uv_px)
    _, truth = simulate(paper(oscillation_amplitude_m=0.05, oscillation_error_std_m=0.002), KEY)
    depth = np.asarray(truth.landmarks_m[:, :, 0] - truth.robot[:, :1])
    near = depth > 0.5
    np.testing.assert_allclose(moved_px[..., 0][near], (320 * jitter[:, None] / depth)[near], rtol=0, atol=1e-8)
    np.testing.assert_allclose(moved_px[..., 1][near], 0, rtol=0, atol=1e-8)


@pytest.mark.parametrize(
    "options",
    [
        dict(oscillation_error_std_m=0.005, noise="six_axis"),
        dict(dynamic="drawn", dynamic_set="bus_12", dynamic_course="turns", noise="six_axis"),
    ],
    ids=["jitter", "courses"],
)
def test_draws_are_those_of_their_keys(options):
    """Of odometry and pixels as ever, whatever is drawn beside them."""
    recording, _ = simulate(paper(**options), KEY)
    clean, _ = simulate(paper(**options, pixel_error_std_px=0.0), KEY)
    odometry, pixels = jax.random.split(KEY)
    std = np.array([0.005] * 3 + [np.deg2rad(0.05)] * 3)
    white = jax.random.normal(odometry, (160, 6))
    np.testing.assert_allclose((recording.odometry - np.array([0.05, 0, 0, 0, 0, 0])) / std, white, atol=1e-9)
    near = np.abs(clean.uv_px).max(axis=-1) < 1e4
    noise = np.asarray(recording.uv_px - clean.uv_px)[near]
    np.testing.assert_allclose(noise, np.asarray(jax.random.normal(pixels, (160, 162, 2)))[near], atol=1e-9)


def test_moments_and_paces_are_traced():
    """Derivatives against finite differences; another value, or a batch, compiles nothing new."""
    scenario = harder("stops_and_starts", num_frames=20)

    @jax.jit
    @eqx.debug.assert_max_traces(max_traces=1)
    def place(change, pace):
        course = dataclasses.replace(scenario.movers.course, change_s=change, pace=pace)
        moving = dataclasses.replace(scenario, movers=dataclasses.replace(scenario.movers, course=course))
        return simulate(moving, KEY)[1].landmarks_m[-1, moving.movers.ids[0], 1]

    change, pace, h = jnp.array([0.52, 1.03]), jnp.array([1.0, 0.0, 0.7]), 1e-6
    expected = -2.0 + 0.5 * (0.52 + 0.7 * (2.0 - 1.03))
    np.testing.assert_allclose(place(change, pace), expected, rtol=1e-12)
    for i, slope in enumerate((0.5, -0.35)):
        e = jnp.zeros(2).at[i].set(h)
        np.testing.assert_allclose((place(change + e, pace) - place(change - e, pace)) / (2 * h), slope, rtol=1e-6)

    def gone(change, pace):
        movers = dataclasses.replace(scenario.movers, course=Course(change, pace, jnp.zeros(3)))
        return moved(movers, jnp.asarray(scenario.landmarks_m), jnp.array([2.0]))[0][-1, movers.ids[0], 1]

    by_change, by_pace = jax.grad(gone, (0, 1))(change, pace)
    np.testing.assert_allclose(by_change, [0.5, -0.35], rtol=1e-12)
    np.testing.assert_allclose(by_pace, [0.5 * 0.52, 0.5 * 0.51, 0.5 * 0.97], rtol=1e-12)


BAD = {
    "falling": (lambda: Course((2.0, 1.0), (1.0,) * 3, (0.0,) * 3), r"Course\(change_s=\[2.0, 1.0\]\): .* rise"),
    "at once": (lambda: Course((0.0,), (1.0, 1.0), (0.0, 0.0)), r"Course\(change_s=\[0.0\]\)"),
    "backwards": (lambda: Course((1.0,), (1.0, -1.0), (0.0, 0.0)), r"Course\(pace=\[1.0, -1.0\]\): a pace is at least"),
    "lost": (lambda: Course((1.0,), (1.0, 1.0), (0.0, np.nan)), r"Course\(heading_deg=\[0.0, nan\]\)"),
    "a leg too few": (lambda: Course((1.0,), (1.0,), (0.0, 0.0)), r"Course\(pace\) has shape \(1,\), but 2 legs need"),
    "no row": (lambda: Course((), 1.0), r"Course\(pace\) has shape \(\), but 1 legs need"),
    "other movers": (
        lambda: Movers(np.array([1, 2]), course=Course((), np.ones((3, 1)))),
        r"Movers\(course.pace\) has shape \(3, 1\), but there are 2 movers",
    ),
    "no course": (lambda: Movers(np.array([1]), course="late"), r"Movers\(course='late'\): give a Course, or None"),
    "unknown course": (
        lambda: paper(dynamic_course="flies"),
        r"dynamic_course='flies': choose one of \('late', 'stops'",
    ),
    "unknown scene": (lambda: harder("hardest"), r"harder\('hardest'\): choose one of \('late', 'stops',"),
    "negative jitter": (
        lambda: paper(oscillation_error_std_m=-0.1),
        r"Scenario\(oscillation_std_m=-0.1\): a standard deviation is at least 0",
    ),
}


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(("make", "message"), BAD.values(), ids=BAD)
def test_bad_courses_are_refused_by_name_and_value(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_every_harder_scene_is_one_change_of_the_same_scene():
    usual = paper(dynamic="lateral", dynamic_speed_m_s=0.5, oscillation_amplitude_m=0.05)
    for name in HARDER:
        scenario = harder(name)
        assert scenario.oscillation == usual.oscillation and scenario.movers.speed_m_s == 0.5
        assert scenario.oscillation_std_m == {"jitter_2_mm": 0.002, "jitter_5_mm": 0.005}.get(name, 0.0)
    assert harder("bus_3", dynamic="inverse_forward", num_frames=9).num_frames == 9
    assert len(harder("drawn").movers.ids) == 12
