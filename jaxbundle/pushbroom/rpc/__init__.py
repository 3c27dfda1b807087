"""Rational polynomial coefficients: from them to images, fitted, compensated, compared.

fit("scanner.toml", heights=(0.0, 3000.0)).write("image_RPC.TXT")    # the commands, on files
apply("image_RPC.TXT", "points.csv")
compensate("image_RPC.TXT", "control.csv", model="affine")

line, sample, status = project_points(rpc, longitude, latitude, height)    # arrays
"""

from jaxbundle.lazy import import_on_use

# By module; __init__.pyi has their types: `make stubs` writes it.
_HOME = {
    "jaxbundle.commands.rpc": (
        "ScannerRpc",
        "apply",
        "compensate",
        "fit",
    ),
    "jaxbundle.pushbroom.rpc.polynomials": (
        "Rpc",
        "RpcStatus",
        "domain",
        "locate",
        "locate_on",
        "locate_points",
        "locate_points_on",
        "project",
        "project_points",
    ),
}
__getattr__, __dir__, __all__ = import_on_use(globals(), _HOME)
