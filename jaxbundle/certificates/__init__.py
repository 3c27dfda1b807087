"""Certificates and acceptance: what a laboratory, an authority or a CI asks of a result.

accepted = jaxbundle.accept(result, ["sigma(c) < 2 um", "sigma0 < 1.2"])
jaxbundle.certificate(result, details="details.toml").save("certificate.html")
"""

from jaxbundle.lazy import import_on_use

_HOME = {
    "jaxbundle.adjustment.budget_inputs": ("HeldInput",),
    "jaxbundle.adjustment.uncertainty_budget": (
        "UncertaintyBudget",
        "uncertainty_budget",
    ),
    "jaxbundle.certificates.acceptance": ("Acceptance", "accept"),
    "jaxbundle.certificates.document": ("Certificate", "certificate"),
    "jaxbundle.certificates.details": ("CertificateDetails", "read_details"),
    "jaxbundle.certificates.lengths": (
        "CalibratedLengths",
        "LengthTest",
        "PermissibleError",
        "join_length_tests",
        "length_errors",
        "read_lengths",
        "read_mpe",
    ),
    "jaxbundle.certificates.positional": ("PositionalAccuracy", "positional_accuracy"),
}
__getattr__, __dir__, __all__ = import_on_use(globals(), _HOME)
