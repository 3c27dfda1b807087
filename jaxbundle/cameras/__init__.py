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

from jaxbundle.cameras.catalogue import FAMILIES as FAMILIES
from jaxbundle.cameras.catalogue import MODEL_NAMES as MODEL_NAMES
from jaxbundle.cameras.catalogue import get_model as get_model
from jaxbundle.cameras.catalogue import is_known as is_known
from jaxbundle.cameras.catalogue import is_own as is_own
from jaxbundle.cameras.catalogue import key_of as key_of
from jaxbundle.cameras.compare import Comparison as Comparison
from jaxbundle.cameras.compare import compare_cameras as compare_cameras
from jaxbundle.cameras.compare import difference_rings as difference_rings
from jaxbundle.cameras.convert import Conversion as Conversion
from jaxbundle.cameras.convert import convert_camera as convert_camera
from jaxbundle.cameras.inverse import implicit_inverse as implicit_inverse
from jaxbundle.cameras.model import CameraModel as CameraModel
from jaxbundle.cameras.model import image_ray as image_ray
from jaxbundle.cameras.model import project as project
from jaxbundle.cameras.model import residual as residual
from jaxbundle.cameras.own import check_own as check_own
from jaxbundle.cameras.parameters import check_parameters as check_parameters
from jaxbundle.cameras.parameters import default_parameters as default_parameters
from jaxbundle.cameras.validity import turning_radius as turning_radius
from jaxbundle.cameras.validity import validity_message as validity_message
