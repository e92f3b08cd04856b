"""Frames, quaternions, the pin-hole camera and point landmarks, one formula per function.

A frame is (7,) = [t, q]: p_parent = R(q) p + t. Quaternions are Hamilton, (w, x, y, z). R(q) is the homogeneous
quadratic form, not divided by |q|^2. A landmark is Euclidean (3,) = p, or an anchored homogeneous point (AHP) (7,) =
[anchor p0, direction m, inverse depth rho] with p = p0 + m / rho.

Every function takes its vectors along the first axis and broadcasts over the others, and is analytic in them: so
`jacobians` gets exact derivatives from one complex evaluation, and no derivative is written by hand anywhere.
"""

import numpy as np

COMPLEX_STEP = 1e-30


def jacobians(function, *args):
    """d function / d arg for each (n,) argument, (m, n): Im f(x + i h e_j) / h, exact to rounding."""
    x = np.concatenate(args)
    ends = np.cumsum([len(arg) for arg in args])[:-1]
    perturbed = x[:, None] + 1j * COMPLEX_STEP * np.eye(len(x))
    jacobian = function(*np.split(perturbed, ends)).imag / COMPLEX_STEP
    return np.split(jacobian, ends, axis=1)


# ---- quaternions ----------------------------------------------------------------------------------------------------


def norm(v):
    """sqrt(v . v): the Euclidean norm, continued analytically (np.linalg.norm would conjugate)."""
    return np.sqrt(np.sum(v * v, axis=0))


def unit(v, scalar_jacobian=False):
    """v / |v|. With `scalar_jacobian` |v| is held constant: the derivative is I / |v|, not (I - u u^T) / |v|."""
    return v / norm(v.real if scalar_jacobian else v)


def q_to_matrix(q):
    """R(q), (3, 3): the matrix of v -> q v q*."""
    w, x, y, z = q
    return np.array([
        [w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z],
    ])  # fmt: skip


def rotate(q, v):
    """R(q) v, (3,)."""
    return np.einsum("ij...,j...->i...", q_to_matrix(q), v)


def rotate_back(q, v):
    """R(q)^T v, (3,)."""
    return np.einsum("ji...,j...->i...", q_to_matrix(q), v)


def q_product(a, b):
    """a (x) b, (4,): R(a (x) b) = R(a) R(b)."""
    aw, ax, ay, az = a
    bw, bx, by, bz = b
    return np.array([
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    ])  # fmt: skip


def q_from_rotation_vector(v):
    """[cos(|v|/2), sin(|v|/2) v/|v|], (4,); below 1e-6 rad its series [1 - |v|^2/8, v/2]."""
    squared = np.sum(v * v, axis=0)
    if np.all(squared.real < 1e-12):
        return np.concatenate([[1 - squared / 8], v / 2])
    angle = np.sqrt(squared)
    return np.concatenate([[np.cos(angle / 2)], np.sin(angle / 2) / angle * v])


def q_from_euler(rpy):
    """Quaternion of R = Rz(yaw) Ry(pitch) Rx(roll), (4,), from [roll, pitch, yaw]."""
    cos, sin = np.cos(rpy / 2), np.sin(rpy / 2)
    zero = 0 * cos[0]
    roll, pitch, yaw = ([cos[i], *(sin[i] if axis == i else zero for axis in range(3))] for i in range(3))
    return q_product(q_product(yaw, pitch), roll)


# ---- frames ---------------------------------------------------------------------------------------------------------


def from_frame(frame, p):
    """R(q) p + t, (3,): a point of the frame, in the parent."""
    return rotate(frame[3:], p) + frame[:3]


def to_frame(frame, p):
    """R(q)^T (p - t), (3,): a point of the parent, in the frame."""
    return rotate_back(frame[3:], p - frame[:3])


def move(frame, u):
    """[t + R(q) u_t, q (x) q(u_theta)], (7,): the frame after the increment u = [position, rotation vector] in it."""
    return np.concatenate([from_frame(frame, u[:3]), q_product(frame[3:], q_from_rotation_vector(u[3:]))])


# ---- camera and landmarks -------------------------------------------------------------------------------------------


def camera_vector(robot, sensor, landmark):
    """The landmark in the camera, (3,); for an AHP times rho, R_cw^T (m + rho (p0 - t_c)), finite at infinity."""
    anchor = to_frame(sensor, to_frame(robot, landmark[:3]))
    if len(landmark) == 3:
        return anchor
    direction = rotate_back(sensor[3:], rotate_back(robot[3:], landmark[3:6]))
    return direction + landmark[6] * anchor


def project(robot, sensor, landmark, intrinsics):
    """[u0 + au vx / vz, v0 + av vy / vz], (2,): the pixel of a landmark; intrinsics = [u0, v0, au, av]."""
    vx, vy, vz = camera_vector(robot, sensor, landmark)
    u0, v0, au, av = intrinsics
    return np.array([u0 + au * vx / vz, v0 + av * vy / vz])


def depth(robot, sensor, landmark):
    """The landmark's coordinate along the optical axis, scalar."""
    vz = camera_vector(robot, sensor, landmark)[2]
    return vz if len(landmark) == 3 else vz / landmark[6]


def back_project(robot, sensor, pixel, rho, intrinsics, scalar_jacobian=False):
    """The AHP (7,) seen at `pixel` with inverse depth rho (1,): [camera centre, unit ray in the world, rho]."""
    u0, v0, au, av = intrinsics
    u, v = pixel
    ray = np.array([(u - u0) / au, (v - v0) / av, 1 + 0 * u])
    centre = from_frame(robot, sensor[:3])
    direction = rotate(robot[3:], rotate(sensor[3:], unit(ray, scalar_jacobian)))
    return np.concatenate([centre, direction, rho])


def ahp_to_euclidean(landmark):
    """p0 + m / rho, (3,)."""
    return landmark[:3] + landmark[3:6] / landmark[6]


def linearity(robot, sensor, landmark, rho_variance):
    """4 sigma_d / d1 |cos a|, scalar: how far an AHP still is from a Gaussian in Euclidean coordinates.

    sigma_d = sqrt(var rho) / rho^2; d1 is the distance of the point from the camera, a the angle between that line
    and the AHP's direction m.
    """
    to_point = ahp_to_euclidean(landmark) - from_frame(robot, sensor[:3])
    distance = norm(to_point)
    cosine = to_point @ landmark[3:6] / (distance * norm(landmark[3:6]))
    return 4 * np.sqrt(rho_variance) / landmark[6] ** 2 / distance * abs(cosine)
