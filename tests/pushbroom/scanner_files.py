"""A scanner file with its tables, for the tests of reading and of the commands."""

import numpy as np
from pushbroom_scenes import LINES, PERIOD, PIXELS, orbit, quaternions

from jaxbundle.io.text.csv_tables import write_csv

TEXT = f"""
[scanner]
name = "test"
lines = {LINES}
pixels = {PIXELS}
epoch = "2016-06-22T04:00:12.25"

[times]
period = {PERIOD!r}

[position]
table = "positions.csv"

[attitude]
table = "attitude.csv"

[optics]
model = "brown"
c = 700.0
x0 = 0.02
K1 = 2e-6
P1 = 1e-6
pitch = 0.05
row = 0.3

[mounting]
pitch = {float(np.degrees(0.01))!r}
roll = {float(np.degrees(-0.02))!r}
yaw = {float(np.degrees(0.3))!r}
"""


def write_scanner(folder, text=TEXT, positions=None, rows=None):
    """The satellite of `pushbroom_scenes` as files; returns the path of the TOML file."""
    t = np.arange(-6.0, 11.0)
    P, V = positions if positions is not None else orbit(t)
    write_csv(
        folder / "positions.csv", ("t", "X", "Y", "Z", "VX", "VY", "VZ"),
        np.column_stack([t, P, V]).tolist(),
    )  # fmt: skip
    t = np.arange(-1, 5.5, 0.1)
    q = quaternions(t) if rows is None else rows
    names = ("t", "q0", "q1", "q2", "q3")
    write_csv(folder / "attitude.csv", names, np.column_stack([t, q]).tolist())
    path = folder / "scanner.toml"
    path.write_text(text)
    return path
