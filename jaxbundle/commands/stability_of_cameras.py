"""`stability`: calibrations of one camera at several epochs, from files too."""

from collections.abc import Sequence
from pathlib import Path

from jaxbundle.batches.population import number_or_days
from jaxbundle.calibration.stability import Stability
from jaxbundle.calibration.stability import stability as test_stability
from jaxbundle.commands.cameras import CameraSource, open_calibration
from jaxbundle.errors import InputError


def stability(
    calibrations: Sequence[CameraSource], *, at: Sequence[float | str] | None = None
) -> Stability:
    """Test whether calibrations of one camera differ significantly.

    **Arguments:** `calibrations`: two or more `Calibration`s, cameras with the covariance of their
    free parameters, or JSON results of `calibrate` or `adjust`, FILE or FILE#ID; `at`: a number
    or a date for each epoch, such as its temperature, for slopes.

    **Raises:** `InputError` if they are not of one camera, or have no covariance.
    """
    opened = []
    for source in calibrations:
        camera, covariance = open_calibration(source)
        if covariance is None:
            name = source if isinstance(source, str | Path) else f"camera {camera.id!r}"
            raise InputError(
                f"{name}: has no covariance; give the result.json of calibrate or adjust"
            )
        opened.append((camera, covariance))
    numbers = [number_or_days(str(word), "--at") for word in at or ()]
    return test_stability(opened, numbers or None)
