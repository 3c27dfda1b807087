"""One real or realistic camera for every model, with all its parameters different from zero."""

from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxbundle import cameras


@dataclass(frozen=True, eq=False)
class Case:
    """A camera: model, parameters by name, and the image as (centre, half width, half height)."""

    name: str
    values: dict[str, float]
    centre: tuple[float, float]
    half: tuple[float, float]
    dtype: type = jnp.float64

    @property
    def model(self):
        return cameras.get_model(self.name)

    @property
    def p(self):
        return tuple(self.dtype(self.values[name]) for name in self.model.parameters)

    @property
    def half_diagonal(self):
        return float(np.hypot(*self.half))

    def grid(self, n=9):
        """Image coordinates [n² + 2, 2]: over the whole image, its centre, the principal point."""
        x = np.linspace(-1, 1, n) * self.half[0] + self.centre[0]
        y = np.linspace(-1, 1, n) * self.half[1] + self.centre[1]
        points = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
        principal_point = project(self, [[0.0, 0.0, -1.0]])[0]
        return jnp.asarray(np.vstack([points, self.centre, principal_point]))


FISHEYE = dict(fx=380.0, fy=381.0, cx=642.0, cy=478.0)
WIDE = (639.5, 479.5), (640, 480)

CASES = [
    Case(
        "brown",
        dict(c=7.457, x0=3.616, y0=-2.608, K1=4.57e-3, K2=-4.26e-5, K3=-2.16e-6, P1=-6.6e-5,
             P2=-3e-5, b1=-1.6e-3, b2=2.8e-4, r0=1.5),
        (3.6266, -2.7188), (3.6266, 2.7188),
    ),
    Case(
        "brown-projected",
        dict(c=28.785, x0=0.0173, y0=0.0567, K1=-1.096e-4, K2=1.4957e-7, K3=-2e-11, P1=5.8e-6,
             P2=-8.6e-6, b1=-7e-5, b2=-3.1e-5, r0=13.488),
        (0, 0), (18, 12),
    ),
    Case(
        "usgs",
        dict(c=153.068, x0=-0.003, y0=0.009, K0=-4.894e-5, K1=4.278e-9, K2=-2.968e-14, K3=1e-19,
             K4=-1e-24, P1=-7.9e-8, P2=-9.158e-8, P3=1e-6, P4=-1e-11),
        (0, 0), (110, 110),
    ),
    Case(
        "bingo",
        dict(c=125.4565, x0=-0.3684, y0=-0.1726, p25=33.8081, p26=-5.0203, format_factor=1.1),
        (0.5, -0.5), (96, 54),
    ),
    Case(
        "opencv",
        dict(fx=535.9, fy=536.2, cx=342.3, cy=235.6, k1=-0.2663, k2=-0.0386, p1=0.0018, p2=-0.0003,
             k3=0.2386, k4=0.01, k5=-0.02, k6=0.03, s1=1e-3, s2=-2e-3, s3=-1e-3, s4=5e-4),
        (319.5, 239.5), (320, 240),
    ),
    Case(
        "kannala-brandt",
        dict(fx=380.0, fy=381.0, cx=642.0, cy=478.0, k1=0.1, k2=0.05, k3=-0.03, k4=0.006),
        (639.5, 479.5), (640, 480),
    ),
    Case("snavely", dict(f=500.0, k1=-0.12, k2=0.03), (0, 0), (320, 240)),
    Case("division", dict(FISHEYE, k=-0.2), *WIDE),
    Case(
        "kannala-brandt-tangential",
        dict(FISHEYE, k1=0.05, k2=-0.02, k3=0.004, k4=-3e-4, p1=1e-3, p2=-2e-3), *WIDE,
    ),
    Case(
        "thin-prism-fisheye",
        dict(FISHEYE, k1=0.05, k2=-0.02, p1=1e-3, p2=-2e-3, k3=0.004, k4=-3e-4, sx1=1e-3,
             sy1=-1e-3), *WIDE,
    ),
    Case(
        "rad-tan-thin-prism-fisheye",
        dict(FISHEYE, k0=0.05, k1=-0.02, k2=0.004, k3=-3e-4, k4=1e-5, k5=-1e-6, p0=-2e-3, p1=1e-3,
             s0=1e-3, s1=-2e-4, s2=-1e-3, s3=1e-4), *WIDE,
    ),
    Case("fov", dict(FISHEYE, omega=0.9), *WIDE),
    Case("eucm", dict(FISHEYE, alpha=0.6, beta=1.1), *WIDE),
    Case("double-sphere", dict(FISHEYE, xi=-0.18, alpha=0.59), *WIDE),
    Case(
        "mei",
        dict(fx=800.0, fy=802.0, cx=642.0, cy=478.0, xi=1.2, k1=-0.05, k2=0.01, p1=1e-3, p2=-5e-4),
        *WIDE,
    ),
    Case(
        "scaramuzza",
        dict(a0=380.0, cx=642.0, cy=478.0, a2=-5e-4, a3=3e-7, a4=-4e-10, c=1.002, d=3e-4, e=-2e-4),
        *WIDE,
    ),
    Case("equidistant", FISHEYE, *WIDE),
    Case("stereographic", FISHEYE, *WIDE),
    Case("equisolid", FISHEYE, (639.5, 479.5), (560, 420)),
    Case("orthographic", FISHEYE, (639.5, 479.5), (290, 220)),
    Case("equirectangular", dict(fx=1280 / (2 * np.pi), fy=640 / np.pi, cx=640.5, cy=320.5),
         (639.5, 319.5), (600, 300)),
    Case(
        "radial-spline-4-300",
        dict(FISHEYE, s1=0.02, s2=0.015, s3=-0.01, s4=-0.06), *WIDE,
    ),
    Case(
        "spline-6x5-160",
        dict(fx=400.0, fy=401.0, cx=642.0, cy=478.0, **{
            f"d{k}_{i}_{j}": 0.01 * np.sin(3 * i + 2 * j + (k == "y") + 0.5)
            for i in range(5) for j in range(6) for k in "xy"
        }),
        (639.5, 479.5), (450, 250),
    ),
]


each_case = pytest.mark.parametrize("case", CASES, ids=[case.name for case in CASES])


def project(case, rays):
    """Image coordinates [n, 2] of rays [n, 3]."""
    return _project(case.model, case.p, jnp.asarray(rays))


def image_rays(case, xy):
    """Rays [n, 3] of image coordinates [n, 2]."""
    return _image_rays(case.model, case.p, jnp.asarray(xy))


@partial(jax.jit, static_argnums=0)
def _project(model, p, rays):
    return jnp.stack(jax.vmap(lambda ray: cameras.project(model, p, *ray))(rays), 1)


@partial(jax.jit, static_argnums=0)
def _image_rays(model, p, xy):
    return jnp.stack(jax.vmap(lambda xy: cameras.image_ray(model, p, *xy))(xy), 1)
