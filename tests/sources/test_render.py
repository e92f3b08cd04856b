"""The renderer: its geometry against the camera model, its truth against its pixels."""

import dataclasses

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from rendered import MOVERS, rendered, scenario, tracked

import vcjax as vc
from vcjax.models.frames import compose
from vcjax.recording import Truth
from vcjax.sources.calibration import Calibration
from vcjax.sources.distortion import denormalise
from vcjax.sources.image_sequence import camera_of_robot
from vcjax.sources.recording_file import TrackLabel
from vcjax.sources.render import Surface, cast, render, rough_texture, surfaces_of
from vcjax.sources.rendered_sequence import render_sequence

CAMERA = Calibration(160, 120, 150.0, 140.0, 80.0, 58.0)
ORIGIN = np.array([0.0, 0, 0, 1, 0, 0, 0])  # looks along z, x right, y down


def camera_poses(truth) -> np.ndarray:
    return camera_of_robot(truth.robot, truth.sensor)


def upright(depth, left=-0.5, top=-0.5, size=1.0, grey=255, velocity=(0.0, 0, 0)) -> Surface:
    """A square of one grey, parallel to the image of a camera in the origin."""
    edges = np.array([size, 0, 0]), np.array([0, size, 0])
    return Surface(np.array([left, top, depth]), *edges, np.full((8, 8), grey, np.uint8), np.array(velocity))


def test_a_square_covers_its_pixels():
    """2 m away: 75 × 70 pixels around the principal point, whose borders cut pixels into known parts."""
    image = render([upright(2.0)], CAMERA, ORIGIN, background=0, rays_per_side=10).astype(float) / 255
    covered_u = np.clip(80.0 + 150 / 4 - (np.arange(160) - 0.5), 0, 1) * np.clip(
        np.arange(160) + 0.5 - (80 - 150 / 4), 0, 1
    )
    covered_v = np.clip(58.0 + 140 / 4 - (np.arange(120) - 0.5), 0, 1) * np.clip(
        np.arange(120) + 0.5 - (58 - 140 / 4), 0, 1
    )
    np.testing.assert_allclose(image, np.outer(covered_v, covered_u), atol=0.06)  # ten rays: a tenth of a pixel


def test_what_is_nearer_hides_what_is_behind_in_any_order():
    near, far = upright(2.0, size=0.4, grey=200), upright(4.0, -5.0, -5.0, 10.0, grey=90)
    images = [render(order, CAMERA, ORIGIN) for order in ([near, far], [far, near])]
    np.testing.assert_array_equal(*images)
    assert images[0][58 - 25, 80 - 25] == 200 and images[0][100, 100] == 90


def test_surfaces_move_with_time():
    moving = upright(2.0, size=0.4, velocity=(0.2, 0.0, -0.1))
    stopped = moving._replace(corner_m=moving.corner_m + 3.0 * moving.velocity_m_s, velocity_m_s=np.zeros(3))
    np.testing.assert_array_equal(render([moving], CAMERA, ORIGIN, 3.0), render([stopped], CAMERA, ORIGIN))
    assert np.any(render([moving], CAMERA, ORIGIN, 0.0) != render([stopped], CAMERA, ORIGIN))


def test_surfaces_behind_or_through_the_camera():
    assert np.all(render([upright(-2.0)], CAMERA, ORIGIN, background=7) == 7)
    # A floor 1 m below that reaches from behind to the horizon fills the lower half of the image.
    white = np.full((4, 4), 255, np.uint8)
    floor = Surface(np.array([-100.0, 1, -50]), np.array([200.0, 0, 0]), np.array([0, 0, 1e5]), white)
    image = render([floor], CAMERA, ORIGIN, background=0)
    assert np.all(image[:58] == 0) and np.all(image[60:] == 255)


LENSES = {
    "none": CAMERA,
    "radial": dataclasses.replace(CAMERA, distortion_model="radial_tangential", distortion=(-0.2, 0.03, 0.001, 0.002)),
    "fish eye": dataclasses.replace(CAMERA, distortion_model="equidistant", distortion=(0.01, 0.0, 0.0, 0.0)),
    "wide angle": dataclasses.replace(CAMERA, distortion_model="wide_angle", distortion=(9e-6,)),
}


@pytest.mark.parametrize("lens", LENSES.values(), ids=LENSES)
def test_marks_are_where_the_lens_puts_them(lens):
    """Small white squares on a tilted board: the middle of each blob is the projection of its place."""
    texture = np.zeros((640, 640), np.uint8)
    marks = [(u, v) for u in (100, 300, 500) for v in (120, 320, 520)]
    for u, v in marks:
        texture[v - 12 : v + 12, u - 12 : u + 12] = 255
    board = Surface(np.array([-0.9, -0.7, 2.0]), np.array([1.8, 0.1, 0.4]), np.array([0.1, 1.4, -0.3]), texture)
    image = render([board], lens, ORIGIN, background=0, rays_per_side=4)
    _, _, _, middles = cv2.connectedComponentsWithStats((image > 40).astype(np.uint8))
    for u, v in marks:
        place = board.corner_m + u / 640 * board.edge_u_m + v / 640 * board.edge_v_m
        expected = denormalise(lens, place[None, :2] / place[2])[0]
        window = tuple(slice(round(x) - 6, round(x) + 7) for x in expected[::-1])
        weight = image[window].astype(float)
        rows, columns = np.mgrid[window]
        found = np.array([np.sum(columns * weight), np.sum(rows * weight)]) / weight.sum()
        np.testing.assert_allclose(found, expected, atol=0.1)
    assert len(middles) == 10  # with the background


def test_cast_agrees_with_the_image():
    """Where each surface has a grey of its own, the ray through a pixel finds the surface of its grey."""
    rng = np.random.default_rng(0)
    surfaces = [
        Surface(
            np.array([0, 0, 4]) + rng.uniform(-1, 1, 3),
            *rng.normal(size=(2, 3)),
            np.full((4, 4), 10 + 20 * i, np.uint8),
        )
        for i in range(10)
    ]
    image = render(surfaces, CAMERA, ORIGIN, background=0, rays_per_side=1)
    v, u = np.mgrid[0:120, 0:160]
    number = cast(surfaces, CAMERA, ORIGIN, 0.0, np.column_stack([u.ravel(), v.ravel()]).astype(float))
    np.testing.assert_array_equal(np.where(number >= 0, 10 + 20 * number, 0).reshape(120, 160), image)
    assert len(np.unique(number)) > 5


def test_camera_poses_and_patches_are_those_of_the_simulation():
    """A patch's middle is seen where the simulation has the feature, in every frame, with and without movers."""
    world = rendered()
    poses = camera_poses(world.truth)
    is_seen = []
    for t in (0, 13, 29):
        expected = compose(jnp.asarray(world.truth.robot[t]), jnp.asarray(world.truth.sensor[t]))
        np.testing.assert_allclose(poses[t], expected, atol=1e-12)
        for feature, surface in enumerate(world.surfaces[:10]):
            middle = surface.corner_m + 0.5 * (surface.edge_u_m + surface.edge_v_m)
            middle = middle + surface.velocity_m_s * world.sequence.time_s[t]
            np.testing.assert_allclose(middle, world.truth.landmarks_m[t, feature], atol=1e-9)
            assert np.linalg.norm(surface.edge_u_m) == pytest.approx(0.5)
        # Its noise is zero here: the simulated pixel is exact, and another patch is seen there only if it is nearer.
        shown = np.flatnonzero(world.simulated.is_valid[t])
        uv_px = world.simulated.uv_px[t, shown]
        number = cast(world.surfaces, world.sequence.calibration, poses[t], world.sequence.time_s[t], uv_px)
        is_nearer = world.truth.landmarks_m[t, number, 0] < world.truth.landmarks_m[t, shown, 0]
        assert np.all((number == shown) | is_nearer)
        is_seen += (number == shown).tolist()
    assert np.mean(is_seen) > 0.8 and len(is_seen) > 20
    moving = [i for i, surface in enumerate(world.surfaces) if np.any(surface.velocity_m_s)]
    assert tuple(moving) == MOVERS == tuple(np.flatnonzero(world.truth.is_moving))


def test_folder_holds_what_was_simulated():
    world = rendered()
    sequence, simulated = world.sequence, world.simulated
    assert len(sequence) == 30 and sequence.read(3).shape == (240, 320)
    np.testing.assert_array_equal(sequence.time_s, simulated.time_s)
    np.testing.assert_array_equal(sequence.odometry.increment, simulated.odometry)
    np.testing.assert_array_equal(sequence.odometry.cov, simulated.odometry_cov)
    np.testing.assert_array_equal(sequence.odometry.sensor_shift_m, simulated.sensor_shift_m)
    np.testing.assert_allclose(sequence.calibration.T_r_s, simulated.sensor_start, atol=1e-15)
    # From the camera's true poses, back to the robot's, though the camera oscillates on it.
    np.testing.assert_allclose(sequence.true_robot_poses(), world.truth.robot, atol=1e-9)
    cut = sequence.part(11, 20)
    np.testing.assert_allclose(cut.true_robot_poses(), world.truth.robot[11:20], atol=1e-9)


def test_images_can_be_rendered_again_the_same():
    world = rendered()
    surfaces = surfaces_of(scenario(), world.truth, patch_m=0.5)
    again = render(surfaces, world.sequence.calibration, camera_poses(world.truth)[7], world.sequence.time_s[7])
    np.testing.assert_array_equal(again, world.sequence.read(7))


def test_bad_orders_are_refused_before_work(tmp_path):
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "notes.txt").touch()
    with pytest.raises(FileExistsError, match="a: not empty; give a new folder"):
        render_sequence(tmp_path / "a", scenario(), jax.random.key(0))
    for options, message in (
        ({"patch_m": 0.0}, r"patch_m=0.0\): give a positive length"),
        ({"rays_per_side": 0}, r"rays_per_side=0\): give a whole number from 1"),
    ):
        with pytest.raises(ValueError, match=message):
            render_sequence(tmp_path / "c", scenario(), jax.random.key(0), **options)
    assert not (tmp_path / "c").exists()


def test_paper_world_can_be_rendered_too():
    camera = {"intrinsics_px": (80.0, 60.0, 80.0, 80.0), "image_size_px": (160.0, 120.0)}
    world = vc.scenarios.paper(dynamic="lateral", num_frames=1, **camera)
    robot, mount = np.array([[-8.0, 0, 0, 1, 0, 0, 0]]), np.array([[0, 0, 0.6, 0.5, -0.5, 0.5, -0.5]])
    truth = Truth(robot, mount, np.asarray(world.landmarks_m)[None], np.zeros(162, bool))
    surfaces = surfaces_of(world, truth)
    assert len(surfaces) == 166
    image = render(surfaces, Calibration.from_camera(world.camera), camera_poses(truth)[0], 0.1)
    assert image.std() > 20  # texture everywhere
    assert rough_texture(3).tobytes() == rough_texture(3).tobytes() != rough_texture(4).tobytes()


def test_tracks_are_given_to_the_right_patch():
    """In the middle of a patch there is no doubt: labels agree with the ray through the pixel."""
    world, tracks = rendered(), tracked()
    followed = world.followed(tracks)
    poses = camera_poses(world.truth)
    is_checked = 0
    for row in range(0, len(tracks.frame), 7):
        t = tracks.frame[row]
        around = tracks.uv_px[row] + np.array([[0.0, 0], [6, 0], [-6, 0], [0, 6], [0, -6]])
        numbers = cast(world.surfaces, world.sequence.calibration, poses[t], world.sequence.time_s[t], around)
        track = np.searchsorted(followed.track_id, tracks.track_id[row])
        if np.all(numbers == numbers[0]) and followed.labels.label[track] != TrackLabel.BAD:
            assert followed.surface[track] == numbers[0]
            is_checked += 1
    assert is_checked > 100
    for surface in range(10):
        label = followed.labels.label[followed.surface == surface]
        expected = TrackLabel.MOVING if surface in MOVERS else TrackLabel.STATIC
        assert np.all((label == expected) | (label == TrackLabel.BAD)) and np.any(label == expected), surface
