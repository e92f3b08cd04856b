"""The models' values and Jacobians are the golden ones of tests/golden/functions.json, to 1e-10."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vcjax.models import frames, landmarks
from vcjax.models.camera import Camera
from vcjax.models.motion import move_by_odometry


def unit_scalar(v):
    return frames.unit(v, scalar_derivative=True)


def back_project_scalar(robot, sensor, k, pixel, rho):
    return landmarks.back_project_landmark(Camera(k), robot, sensor, pixel, rho, scalar_derivative=True)


def project_ahp(robot, sensor, k, landmark):
    return landmarks.project_landmark(Camera(k), robot, sensor, landmark)[0]


def project_euclidean(robot, sensor, k, p):
    return project_ahp(robot, sensor, k, landmarks.euclidean(p))


# golden name: function, names of its arguments, of its value, of its Jacobians (None: not in the golden file)
FUNCTIONS = {
    "q2R": (lambda q: frames.rotation_matrix(q).T.ravel(), ["q"], "R", ["R_q"]),
    "qProd": (frames.quaternion_product, ["q1", "q2"], "q", ["Q_q1", "Q_q2"]),
    "v2q": (frames.quaternion_from_rotation_vector, ["v"], "q", ["Q_v"]),
    "e2q": (frames.quaternion_from_euler, ["e_rpy"], "q", ["Q_e"]),
    "normvec_scalar": (unit_scalar, ["v"], "vn", ["J_scalar_method"]),
    "fromFrame": (frames.from_frame, ["F", "p_F"], "p_W", ["J_F", "J_p"]),
    "toFrame": (frames.to_frame, ["F", "p_W"], "p_F", ["J_F", "J_p"]),
    "odo3": (move_by_odometry, ["F", "u"], "F_out", ["F_r", "F_u"]),
    "projEuc": (project_euclidean, ["rob", "sen", "k", "p"], "pix", ["U_r", "U_s", "U_k", "U_l"]),
    "projAhm": (project_ahp, ["rob", "sen", "k", "ahm"], "pix", ["U_r", "U_s", "U_k", "U_l"]),
    "retroAhm": (back_project_scalar, ["rob", "sen", "k", "pix", "rho"], "ahm", ["L_r", "L_s", None, "L_pix", "L_rho"]),
    "ahm2euc": (landmarks.to_point, ["ahm"], "p", ["P_ahm"]),
}


def column(cases, name):
    """One argument or value of all cases, stacked."""
    return jnp.array([case[name] for case in cases], float)


def assert_golden(ours, theirs):
    """Equal to 1e-10, absolutely."""
    np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-10)


@pytest.mark.parametrize("name", FUNCTIONS)
def test_value_and_derivative_are_golden(golden, name):
    function, arguments, value, jacobians = FUNCTIONS[name]
    cases = golden("functions.json")[name]
    columns = [column(cases, a) for a in arguments]
    # A matrix is golden column by column.
    expected = column(cases, value).mT.reshape(len(cases), -1) if name == "q2R" else column(cases, value)

    def twice(*arguments):
        result = function(*arguments)
        return result, result

    derivative = jax.jacfwd(twice, tuple(range(len(columns))), has_aux=True)
    ours, result = jax.jit(jax.vmap(derivative))(*columns)
    assert_golden(result, expected)
    for got, wanted in zip(ours, jacobians, strict=True):
        if wanted is not None:
            assert_golden(got, column(cases, wanted))


@pytest.mark.parametrize(("name", "point"), [("projEuc", "p"), ("projAhm", "ahm")])
def test_projection_gives_its_depth_and_its_own_jacobians(golden, name, point):
    def project(robot, sensor, k, landmark):
        landmark = landmark if name == "projAhm" else landmarks.euclidean(landmark)
        return landmarks.project_landmark(Camera(k), robot, sensor, landmark)

    cases = golden("functions.json")[name]
    pixel, depth, U_r, U_s, U_l = jax.jit(jax.vmap(project))(*(column(cases, a) for a in ("rob", "sen", "k", point)))
    assert_golden(pixel, column(cases, "pix"))
    assert_golden(depth, column(cases, "depth"))
    assert_golden(U_r, column(cases, "U_r"))
    assert_golden(U_s, column(cases, "U_s"))
    assert_golden(U_l[..., : 3 if name == "projEuc" else 7], column(cases, "U_l"))


def test_written_out_jacobians_are_golden(golden):
    cases = golden("functions.json")["ahm2euc"]
    assert_golden(jax.vmap(landmarks.to_point_jacobian)(column(cases, "ahm")), column(cases, "P_ahm"))
    cases = golden("functions.json")["normvec_scalar"]
    jacobian = jax.vmap(lambda v: frames.unit_jacobian(v, scalar_derivative=True))(column(cases, "v"))
    assert_golden(jacobian, column(cases, "J_scalar_method"))


def test_linearity_index_is_golden(golden):
    cases = golden("functions.json")["ahmLinearTest"]
    robot, sensor, ahp, variance = (column(cases, name) for name in ("rob", "sen", "ahm", "var_rho"))
    ours = jax.jit(jax.vmap(landmarks.linearity_index))(robot, sensor, ahp, jnp.sqrt(variance))
    assert_golden(ours, column(cases, "Ld"))
