"""Commands on cameras, for every camera model: an opencv camera is converted to it, looked at and
compared; photographs are calibrated with it, and the network that this leaves is adjusted again."""

from documents import Process

from jaxbundle.cameras.catalogue import MODELS as BUILT_IN

MODELS = (*BUILT_IN, "radial-spline-6-54", "spline-8x6-80")
"""From corner to corner the base camera has 52°, and so a radial spline must have more."""

FREE = {"mei": "fx,fy,cx,cy,k1,k2", "radial-spline-6-54": "fx,fy,cx,cy,s1,s2,s3"}
"""Where the photographs, of a lens of 42°, do not determine all that is free by default: xi is
singular beside fx, fy, k1 and k2; the outer values of a spline are beyond all points."""

COMMANDS = """
jaxbundle convert base.toml MODEL.toml --model MODEL --pixel-size 0.01,0.01
jaxbundle camera MODEL.toml
jaxbundle compare base.toml MODEL.toml
jaxbundle calibrate views --board 9x6 --square 0.03 --model MODEL FREE --pixel-size 0.01 --no-plots --out calibrated
jaxbundle adjust calibrated/network --no-plots --out adjusted
jaxbundle compare calibrated/result.json adjusted/result.json
""".strip().splitlines()  # noqa: E501

SAME_RESULT = """
import json
first, again = (json.load(open(f"{folder}/result.json")) for folder in ("calibrated", "adjusted"))
assert abs(again["sigma0"] / first["sigma0"] - 1) < 1e-6, (first["sigma0"], again["sigma0"])
for name, one in first["cameras"]["cam"]["parameters"].items():
    other = again["cameras"]["cam"]["parameters"][name]
    if one["free"]:
        # Both have stopped where no unknown would move by more than 1e-3 of its σ.
        assert abs(other["value"] - one["value"]) < 2e-3 * one["sigma"], (name, one, other)
        assert abs(other["sigma"] / one["sigma"] - 1) < 1e-3, (name, one, other)
"""


def processes_of_model(name: str) -> list[Process]:
    """The commands on a model, and what must be equal."""
    free = f"--free {FREE[name]}" if name in FREE else ""
    commands = [line.replace("MODEL", name).replace("FREE", free) for line in COMMANDS]
    return [*(Process(name, k, line) for k, line in enumerate(commands, 1)),
            Process(name, len(commands) + 1, SAME_RESULT, python=True)]  # fmt: skip
