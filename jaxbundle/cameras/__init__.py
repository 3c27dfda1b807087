"""Cameras: interior orientation and distortion, as pure functions of one image point.

Batch them with `jax.vmap`. A model is a `CameraModel`: a user's own, or one found by name:

| name | formula | unit, axes |
|---|---|---|
| `brown` | correction at the measured point (Brown 1971) | mm, y up |
| `brown-projected` | distortion at the projected point (AICON) | mm, y up |
| `usgs` | correction of the USGS calibration report | mm, y up |
| `bingo` | radial correction of the BINGO program | mm, y up |
| `opencv` | distortion at the projected point, 4 to 12 coefficients | px, v down |
| `kannala-brandt` | fisheye, polynomial in the angle | px, v down |
| `snavely` | Bundler and BAL | px, y up |
"""

from .catalogue import MODEL_NAMES as MODEL_NAMES
from .catalogue import get_model as get_model
from .catalogue import is_own as is_own
from .catalogue import key_of as key_of
from .compare import Comparison as Comparison
from .compare import compare_cameras as compare_cameras
from .compare import difference_rings as difference_rings
from .convert import Conversion as Conversion
from .convert import convert_camera as convert_camera
from .inverse import implicit_inverse as implicit_inverse
from .model import CameraModel as CameraModel
from .model import image_ray as image_ray
from .model import project as project
from .model import residual as residual
from .own import check_own as check_own
from .parameters import check_parameters as check_parameters
from .parameters import default_parameters as default_parameters
from .validity import turning_radius as turning_radius
from .validity import validity_message as validity_message
