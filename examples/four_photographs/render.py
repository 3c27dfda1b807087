"""Renders the four photographs of this folder: a hilly ground with a roof above it.

    python examples/four_photographs/render.py [FOLDER]
"""

import sys
from pathlib import Path

import cv2
import numpy as np

import jaxbundle
from jaxbundle.geometry import matrix_from_omega_phi_kappa
from jaxbundle.planning import (
    HeightField,
    Rectangle,
    Scene,
    Sensor,
    Texture,
    render,
    stations_looking_at,
)

SIZE, F = (320, 240), 320.0
CAMERA = jaxbundle.Camera(
    "cam", "opencv", {"fx": F, "fy": F, "cx": 159.5, "cy": 119.5, "k1": -0.05}, image_size=SIZE
)
CENTRES = np.array([[-1.2, -0.8, 10], [1.2, -0.8, 10], [1.2, 0.8, 10], [-1.2, 0.8, 10]])
HEADER = "id,camera,X0,Y0,Z0,omega,phi,kappa,sX0,sY0,sZ0,somega,sphi,skappa"


def hills(X, Y):
    """The true height of the ground, metres."""
    return 0.6 * np.sin(X / 2) * np.cos(Y / 3)


def scene() -> Scene:
    """Hills, and a roof at Z = 2."""
    ground = HeightField(hills, (-15, -15, 15, 15))
    roof = Rectangle((-1.2, -1.2, 2.0), (2.0, 0, 0), (0, 2.0, 0))
    return Scene((ground, roof), (Texture(0.015, seed=1, side=512),))


def main(folder: Path) -> None:
    jaxbundle.enable_x64()
    stations = stations_looking_at(CENTRES, CENTRES * [0.3, 0.3, 0])
    rows, shown = [], scene()
    (folder / "photos").mkdir(parents=True, exist_ok=True)
    for k, (X0, angles) in enumerate(zip(stations.position, stations.angles)):
        M = np.asarray(matrix_from_omega_phi_kappa(angles))
        shot = render(shown, CAMERA, X0, M, Sensor(noise=1.5, seed=k, gain=1 - 0.05 * k))
        name = f"photo_{k + 1}.jpg"
        cv2.imwrite(str(folder / "photos" / name), shot.grey, [cv2.IMWRITE_JPEG_QUALITY, 95])
        values = ",".join(map(repr, [*X0.tolist(), *angles.tolist()]))
        rows.append(f"{name},cam,{values}" + ",0" * 6)
    (folder / "images.csv").write_text("\n".join([HEADER, *rows]) + "\n")
    p = "\n".join(f"{name} = {value}" for name, value in CAMERA.parameters.items())
    (folder / "project.toml").write_text(
        '[project]\nname = "four photographs"\nimage_unit = "px"\nimages = "images.csv"\n\n'
        f'[[camera]]\nid = "cam"\nmodel = "opencv"\nimage_size = {list(SIZE)}\nfree = []\n{p}\n'
    )


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent)
