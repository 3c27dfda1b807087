"""The picture of README and of the front page: docs/images/network.png.

    python docs/images/network.py

Six simulated photographs from one side of an object with relief, adjusted, with the error
ellipsoids of its points."""

import dataclasses
from pathlib import Path

import numpy as np

import jaxbundle

jaxbundle.enable_x64()
azimuth = np.linspace(-2.6, -0.5, 6)
centres = np.stack([3.4 * np.cos(azimuth), 3.4 * np.sin(azimuth), np.full(6, 2.4)], 1)
stations = jaxbundle.stations_looking_at(
    centres, (0.0, 0.0, 0.0), roll=np.pi / 2 * (np.arange(6) % 2)
)
targets = jaxbundle.grid_of_targets(5, 4, 1.0, relief=0.5)
camera = jaxbundle.Camera(
    "cam", "brown", {"c": 24.0}, free=("c", "x0", "y0", "K1", "K2", "P1", "P2")
)
network = jaxbundle.simulate(stations, targets, camera, noise=0.0005, seed=1)
result = jaxbundle.adjust(dataclasses.replace(network, name="six photographs"))
print(result)
axes = result.plot_perspective()
axes.view_init(elev=38, azim=-75)
axes.figure.savefig(Path(__file__).with_name("network.png"), dpi=110, bbox_inches="tight")
