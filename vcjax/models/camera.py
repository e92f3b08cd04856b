"""Pin-hole camera with optional radial distortion.

Camera axes: x right, y down, z forward. With a = v_x/v_z, b = v_y/v_z and r² = a² + b²,
pixel = (u0 + αu·a·s, v0 + αv·b·s), s = 1 + d1 r² + d2 r⁴ + …
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from vcjax.fields import require, vector

Pixel = Float[Array, "2"]

# Newton steps of the inverse of the distortion. The map is smooth and near the identity inside a usable image;
# five steps reach rounding error for distortions up to half the radius, the rest is margin.
UNDISTORTION_STEPS = 8


class Camera(eqx.Module):
    """Image size and intrinsic calibration. Default: the camera of the paper's Table 1."""

    intrinsics_px: tuple[float, float, float, float] = eqx.field(converter=vector, default=(320.0, 240.0, 320.0, 320.0))
    """[u0, v0, αu, αv]: principal point and focal lengths, px."""
    image_size_px: tuple[float, float] = eqx.field(converter=vector, default=(640.0, 480.0))
    """Width and height, px."""
    distortion: tuple[float, ...] = eqx.field(converter=vector, default=())
    """Radial distortion coefficients d1, d2, …; none by default."""

    def __check_init__(self):
        require(self, "intrinsics_px", np.isfinite, "give finite u0 v0 au av in pixels.", length=4)
        positive = "focal lengths au av (the last two) must be positive."
        require(self, "intrinsics_px", lambda k: k[..., 2:] > 0, positive, length=4)
        require(self, "image_size_px", lambda size: size > 0, "give a positive width and height in pixels.", length=2)
        require(self, "distortion", np.isfinite, "give finite coefficients, or none.", length=None)


def distort(camera: Camera, point: Float[Array, "2"]) -> Float[Array, "2"]:
    """Normalised image point (a, b) to its distorted place (a, b)·(1 + d1 r² + d2 r⁴ + …). Derivative exact."""
    return point * _scale(camera, jnp.sum(point * point))[0]


def undistort(camera: Camera, point: Float[Array, "2"]) -> Float[Array, "2"]:
    """Inverse of `distort`, by Newton's method on the radius; valid where the distortion is monotonic."""
    if np.shape(camera.distortion)[-1] == 0:
        return point
    radius2 = jnp.sum(point * point)
    is_centre = radius2 < 1e-24
    radius = jnp.sqrt(jnp.where(is_centre, 1.0, radius2))
    undistorted = radius
    for _ in range(UNDISTORTION_STEPS):
        scale, slope = _scale(camera, undistorted * undistorted)
        undistorted -= (undistorted * scale - radius) / (scale + 2.0 * undistorted * undistorted * slope)
    return point * jnp.where(is_centre, 1.0, undistorted / radius)


def _scale(camera: Camera, radius2: Float[Array, ""]) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """s(r²) = 1 + d1 r² + d2 r⁴ + … and its derivative by r², by Horner's rule."""
    scale, slope = jnp.ones_like(radius2), jnp.zeros_like(radius2)
    polynomial = jnp.zeros_like(radius2)
    for k in reversed(range(np.shape(camera.distortion)[-1])):
        slope = slope * radius2 + polynomial
        polynomial = polynomial * radius2 + jnp.asarray(camera.distortion)[k]
    return scale + polynomial * radius2, slope * radius2 + polynomial


def project(camera: Camera, point_c: Float[Array, "3"]) -> Pixel:
    """Pixel of a point in camera coordinates. A point in the camera's own plane (v_z = 0) gives a finite dummy pixel.

    Derivative exact for v_z ≠ 0. Only the direction of `point_c` matters; whether it lies in front is the caller's
    test.
    """
    return pixel_jacobian(camera, point_c)[0]


def pixel_jacobian(camera: Camera, point_c: Float[Array, "3"]) -> tuple[Pixel, Float[Array, "2 3"]]:
    """Pixel of a point in camera coordinates and its derivative by that point, ∂(u, v)/∂(x, y, z)."""
    x, y, z = point_c
    inverse_z = 1.0 / jnp.where(z == 0.0, 1.0, z)
    a, b = x * inverse_z, y * inverse_z
    u0, v0, au, av = jnp.asarray(camera.intrinsics_px)
    if np.shape(camera.distortion)[-1] == 0:
        pixel = jnp.stack([u0 + au * a, v0 + av * b])
        zero = jnp.zeros_like(a)
        return pixel, jnp.stack(
            [
                jnp.stack([au * inverse_z, zero, -au * a * inverse_z]),
                jnp.stack([zero, av * inverse_z, -av * b * inverse_z]),
            ]
        )
    scale, slope = _scale(camera, a * a + b * b)
    pixel = jnp.stack([u0 + au * a * scale, v0 + av * b * scale])
    # ∂(a s, b s)/∂(a, b) = s I + 2 s' [a b]ᵀ[a b]
    aa, ab, bb = scale + 2.0 * slope * a * a, 2.0 * slope * a * b, scale + 2.0 * slope * b * b
    return pixel, inverse_z * jnp.stack(
        [
            au * jnp.stack([aa, ab, -(aa * a + ab * b)]),
            av * jnp.stack([ab, bb, -(ab * a + bb * b)]),
        ]
    )


def back_project(camera: Camera, pixel: Pixel) -> Float[Array, "3"]:
    """Ray of a pixel in camera coordinates, (x, y, 1): the inverse of `project` up to scale. Derivative exact."""
    u0, v0, au, av = jnp.asarray(camera.intrinsics_px)
    point = undistort(camera, jnp.stack([(pixel[0] - u0) / au, (pixel[1] - v0) / av]))
    return jnp.concatenate([point, jnp.ones(1, point.dtype)])


def is_inside(camera: Camera, pixel: Float[Array, "... 2"], margin_px: float | Array = 0.0) -> Bool[Array, "..."]:
    """Whether a pixel lies in [0, width] × [0, height], at least `margin_px` from every border (bounds included)."""
    size = jnp.asarray(camera.image_size_px)
    return jnp.all((pixel >= margin_px) & (pixel <= size - margin_px), axis=-1)
