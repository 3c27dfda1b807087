"""Cameras: interior orientation and distortion, as pure functions of one image point.

Batch them with `jax.vmap`. A model is a `CameraModel`: a user's own, or one found by name:

| name | formula | unit, axes |
|---|---|---|
| `brown` | correction at the measured point (Brown 1971) | mm, y up |
| `brown-projected` | distortion at the projected point (AICON) | mm, y up |
| `usgs` | correction of the USGS calibration report | mm, y up |
| `bingo` | radial correction of the BINGO program | mm, y up |
| `opencv` | distortion at the projected point, 4 to 12 coefficients | px, v down |
| `snavely` | Bundler and BAL | px, y up |
| `division` | radial distortion as a division (Fitzgibbon 2001) | px, v down |
| `kannala-brandt` | fisheye, polynomial in the angle | px, v down |
| `kannala-brandt-tangential`, `thin-prism-fisheye`, `rad-tan-thin-prism-fisheye` | with more | px |
| `fov` | fisheye of one coefficient (Devernay and Faugeras 2001) | px, v down |
| `eucm`, `double-sphere`, `mei` | unified cameras: spheres and a plane | px, v down |
| `scaramuzza` | rays as a polynomial of the image radius | px, v down |
| `stereographic`, `equidistant`, `equisolid`, `orthographic` | ideal fisheyes | px, v down |
| `equirectangular` | panorama of a sphere | px, v down |
| `radial-spline-N-FOV` | fisheye, radial distortion a spline | px, v down |
| `spline-NXxNY-FOV` | grid of B-splines over stereographic coordinates (mrcal) | px, v down |
"""

from jaxbundle.cameras.catalogue import FAMILIES, MODEL_NAMES, get_model, is_known, is_own, key_of
from jaxbundle.cameras.compare import Comparison, compare_cameras, difference_rings
from jaxbundle.cameras.convert import Conversion, convert_camera
from jaxbundle.cameras.distortion_table import distortion_table
from jaxbundle.cameras.field_of_view import (
    FieldOfView,
    equivalent_35mm,
    field_of_view,
    field_of_view_of_rays,
)
from jaxbundle.cameras.inverse import implicit_inverse
from jaxbundle.cameras.model import CameraModel, image_ray, project, residual
from jaxbundle.cameras.own import check_own
from jaxbundle.cameras.parameters import check_parameters, default_parameters
from jaxbundle.cameras.pixel_frame import in_pixels
from jaxbundle.cameras.validity import turning_radius, validity_message

__all__ = [
    "CameraModel",
    "Comparison",
    "Conversion",
    "FAMILIES",
    "FieldOfView",
    "MODEL_NAMES",
    "check_own",
    "check_parameters",
    "compare_cameras",
    "convert_camera",
    "default_parameters",
    "difference_rings",
    "distortion_table",
    "equivalent_35mm",
    "field_of_view",
    "field_of_view_of_rays",
    "get_model",
    "image_ray",
    "implicit_inverse",
    "in_pixels",
    "is_known",
    "is_own",
    "key_of",
    "project",
    "residual",
    "turning_radius",
    "validity_message",
]
