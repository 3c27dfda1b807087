"""What the functions of camera models take and return: unpacked scalars of ONE image point."""

from collections.abc import Callable, Sequence

from jaxbundle.types import Scalar as Scalar

Pair = tuple[Scalar, Scalar]
Triple = tuple[Scalar, Scalar, Scalar]
Parameters = Sequence[Scalar]
Formula = Callable[[Parameters, Scalar, Scalar], Pair]
OfRay = Callable[[Parameters, Scalar, Scalar, Scalar], Pair]
ToRay = Callable[[Parameters, Scalar, Scalar], Triple]
