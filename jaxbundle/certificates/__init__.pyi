# Written by `make stubs` from the names in __init__.py.
# ruff: noqa: I001
from jaxbundle.adjustment.budget_inputs import HeldInput as HeldInput
from jaxbundle.adjustment.uncertainty_budget import UncertaintyBudget as UncertaintyBudget
from jaxbundle.adjustment.uncertainty_budget import uncertainty_budget as uncertainty_budget
from jaxbundle.certificates.acceptance import Acceptance as Acceptance
from jaxbundle.certificates.acceptance import accept as accept
from jaxbundle.certificates.details import CertificateDetails as CertificateDetails
from jaxbundle.certificates.details import read_details as read_details
from jaxbundle.certificates.document import Certificate as Certificate
from jaxbundle.certificates.document import certificate as certificate
from jaxbundle.certificates.lengths import CalibratedLengths as CalibratedLengths
from jaxbundle.certificates.lengths import LengthTest as LengthTest
from jaxbundle.certificates.lengths import PermissibleError as PermissibleError
from jaxbundle.certificates.lengths import join_length_tests as join_length_tests
from jaxbundle.certificates.lengths import length_errors as length_errors
from jaxbundle.certificates.lengths import read_lengths as read_lengths
from jaxbundle.certificates.lengths import read_mpe as read_mpe
from jaxbundle.certificates.positional import PositionalAccuracy as PositionalAccuracy
from jaxbundle.certificates.positional import positional_accuracy as positional_accuracy

__all__ = [
    "Acceptance",
    "CalibratedLengths",
    "Certificate",
    "CertificateDetails",
    "HeldInput",
    "LengthTest",
    "PermissibleError",
    "PositionalAccuracy",
    "UncertaintyBudget",
    "accept",
    "certificate",
    "join_length_tests",
    "length_errors",
    "positional_accuracy",
    "read_details",
    "read_lengths",
    "read_mpe",
    "uncertainty_budget",
]
