"""Rendered photographs agree with the truth: every pixel's point, nothing through a hill, and the
position of the texture to far below a pixel."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

import jaxbundle
from jaxbundle.cameras import get_model
from jaxbundle.errors import InputError
from jaxbundle.measure.transfer import View, image_point
from jaxbundle.orientation.pose import CameraPose
from jaxbundle.planning.rendering import Scene, Sensor, render, visible
from jaxbundle.planning.shapes import HeightField, Rectangle
from jaxbundle.planning.texture import Texture

SIZE, F = (160, 120), 150.0
CAMERA = jaxbundle.Camera(
    "cam", "opencv", {"fx": F, "fy": F, "cx": 79.5, "cy": 59.5, "k1": -0.08}, image_size=SIZE
)
TEXTURE = Texture(0.03, seed=3, side=512)
DOWN = np.eye(3)


def ridge(X, Y):
    """Low hills and a ridge along Y with slopes of 5."""
    return 0.4 * np.sin(X / 2) * np.cos(Y / 3) + 3 * np.exp(-(((X - 1) / 0.5) ** 2))


def tilted(angle):
    """Looking from the side: a rotation about Y."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]])


@pytest.fixture(scope="module")
def hills():
    scene = Scene((HeightField(ridge, (-12, -12, 12, 12)),), (TEXTURE,))
    position = np.array([8.0, 0, 8.0])
    return scene, position, tilted(0.75), render(scene, CAMERA, position, tilted(0.75))


def test_points_lie_on_the_surface_in_the_middle_of_their_pixels(hills):
    _, position, M, photo = hills
    seen = photo.surface == 0
    X = photo.point[seen]
    assert seen.mean() > 0.5
    np.testing.assert_allclose(X[:, 2], ridge(X[:, 0], X[:, 1]), atol=1e-6)
    model = get_model("opencv")
    p = [CAMERA.parameters.get(name, 0.0) for name in model.parameters]
    view = View(model, jnp.array(p), CameraPose(jnp.array(position), jnp.array(M)))
    v, u = np.nonzero(seen)
    for k in range(0, len(X), len(X) // 10):
        np.testing.assert_allclose(image_point(view, jnp.array(X[k])), [u[k], v[k]], atol=1e-6)


def test_nothing_is_seen_through_the_ridge(hills):
    scene, position, _, photo = hills
    X = photo.point[photo.surface == 0]
    for t in np.linspace(0.02, 0.98, 60):
        between = position + t * (X - position)
        assert (between[:, 2] > ridge(between[:, 0], between[:, 1]) - 1e-6).all()
    behind = np.array([[-0.5, 0, ridge(-0.5, 0)], [4.0, 0, ridge(4.0, 0)]])
    assert visible(scene, behind, position).tolist() == [False, True]
    assert visible(scene, X[::97], position).all()


def test_a_plane_hides_what_is_behind_it():
    roof = Rectangle((-1, -1, 2), (2, 0, 0), (0, 2, 0))
    ground = Rectangle((-20, -20, 0), (40, 0, 0), (0, 40, 0))
    photo = render(Scene((ground, roof), (TEXTURE,)), CAMERA, [0, 0, 10.0], DOWN)
    X = photo.point
    np.testing.assert_allclose(X[..., 2], np.where(photo.surface == 1, 2, 0), atol=1e-9)
    assert (np.abs(X[photo.surface == 1][:, :2]) <= 1).all()
    side = np.sqrt((photo.surface == 1).sum())
    assert 2 * F / 8 - 1 < side < 2 * F / 8 + 1


@pytest.mark.parametrize("texel", [0.02, 0.11])
def test_a_camera_moved_by_part_of_a_pixel_moves_the_image_by_it(texel):
    """Least squares for the shift, along the gradient: texture finer and coarser than a pixel."""
    plane = Rectangle((-20, -20, 0), (40, 0, 0), (0, 40, 0))
    scene = Scene((plane,), (Texture(texel, seed=5, side=512),))
    straight = jaxbundle.Camera(
        "cam", "opencv", {"fx": F, "fy": F, "cx": 79.5, "cy": 59.5}, image_size=SIZE
    )
    moved = np.array([0.3, -0.2])
    shots = [
        render(scene, straight, [s * moved[0] / 2 * 10 / F, -s * moved[1] / 2 * 10 / F, 10], DOWN,
               Sensor(fine=4)).grey.astype(float)
        for s in (-1, 1)
    ]  # fmt: skip
    # Parseval: the phase of the lower frequencies of both spectra is that of the shift.
    window = np.outer(np.hanning(SIZE[1]), np.hanning(SIZE[0]))
    a, b = (np.fft.fft2((g - g.mean()) * window) for g in shots)
    fy, fx = np.fft.fftfreq(SIZE[1])[:, None], np.fft.fftfreq(SIZE[0])[None]
    low = (np.hypot(fx, fy) < 0.15) & (np.hypot(fx, fy) > 0.02)
    cross = b * a.conj()
    A = 2 * np.pi * np.stack(np.broadcast_arrays(fx, fy), -1)[low]
    weight = np.abs(cross[low])
    N, n = A.T @ (weight[:, None] * A), A.T @ (weight * np.angle(cross[low]))
    np.testing.assert_allclose(np.linalg.solve(N, n), moved, atol=0.01)


def test_noise_and_exposure_are_those_of_the_sensor():
    scene = Scene((Rectangle((-20, -20, 0), (40, 0, 0), (0, 40, 0)),), (TEXTURE,))
    shot = lambda sensor: render(scene, CAMERA, [0, 0, 10.0], DOWN, sensor).grey.astype(float)
    plain = shot(Sensor(gain=0.8, offset=10))
    noise = shot(Sensor(gain=0.8, offset=10, noise=3, seed=1)) - plain
    assert 2.9 < noise.std() < 3.1
    slope, level = np.polyfit(shot(Sensor(gain=0.8)).ravel(), plain.ravel(), 1)
    assert abs(slope - 1) < 0.002 and abs(level - 10) < 0.3


def test_texture_repeats_where_it_is_to_and_is_blank_where_it_is_to():
    s, t = np.random.default_rng(0).uniform(-5, 5, (2, 400))
    width = np.full(400, 0.05)
    repeated = Texture(0.03, side=64, period=1.5)
    np.testing.assert_allclose(repeated(s + 3.0, t - 1.5, width), repeated(s, t, width), atol=1e-5)
    assert np.corrcoef(TEXTURE(s, t, width), TEXTURE(s + 512 * 0.03, t, width))[0, 1] < 0.6
    blank = Texture(0.03, side=64, blank=lambda s, t: s > 0)(s, t, width)
    assert (blank[s > 0] == 0.5).all() and blank[s < 0].std() > 0.1


def test_pixels_that_no_ray_reaches_have_the_background():
    """With K1 < 0 the image of all rays ends at the largest r(1 + K1·r²), r² = −1/(3·K1)."""
    k1 = -0.9
    barrel = dataclasses.replace(CAMERA, parameters=CAMERA.parameters | {"k1": k1})
    ground = Rectangle((-90, -90, 0), (180, 0, 0), (0, 180, 0))
    photo = render(
        Scene((ground,), (TEXTURE,)), barrel, [0, 0, 10.0], DOWN, Sensor(background=7)
    )
    v, u = np.indices(photo.surface.shape)
    radius = np.hypot(u - 79.5, v - 59.5)
    end = F * 2 / 3 / np.sqrt(-3 * k1)
    assert (photo.surface[radius < end - 1.5] == 0).all()
    outside = radius > end
    assert (photo.surface[outside] == -1).all() and (photo.grey[outside] == 7).all()
    assert np.isnan(photo.point[outside]).all()


def test_a_camera_without_a_size_is_refused():
    scene = Scene((Rectangle((0, 0, 0), (1, 0, 0), (0, 1, 0)),), (TEXTURE,))
    with pytest.raises(InputError, match="image_size"):
        render(scene, jaxbundle.Camera("cam", "opencv", {"fx": 1.0, "fy": 1.0}), [0, 0, 1], DOWN)
