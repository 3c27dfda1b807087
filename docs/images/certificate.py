"""The picture of docs/certificate.md: the first two pages of the certificate of an example.

    python docs/images/certificate.py

Needs chromium, and pdftoppm of poppler.
"""

import subprocess
import sys
import tempfile
from pathlib import Path

from PIL import Image

HERE = Path(__file__).parent
FRAME, GREY = 4, (200, 206, 211)


def main() -> None:
    with tempfile.TemporaryDirectory() as name:
        folder, board = Path(name), HERE.parents[1] / "examples" / "board"
        page, paper = folder / "page.html", folder / "page.pdf"
        options = ["--board", "9x6", "--square", "0.03", "--accept", "sigma(fx) < 1 px"]
        command = [sys.executable, "-m", "jaxbundle", "calibrate", board, *options]
        run([*command, "--certificate", page, "--json", folder / "r.json", "--quiet"])
        run(["chromium", "--headless", "--no-sandbox", "--no-pdf-header-footer",
             f"--print-to-pdf={paper}", page])  # fmt: skip
        run(["pdftoppm", "-r", "64", "-l", "2", "-png", paper, folder / "page"])
        pages = [Image.open(file).convert("RGB") for file in sorted(folder.glob("page-*.png"))]
    w, h = pages[0].size
    both = Image.new("RGB", (2 * w + 3 * FRAME, h + 2 * FRAME), GREY)
    for k, one in enumerate(pages):
        both.paste(one, (FRAME + k * (w + FRAME), FRAME))
    both.quantize(160).save(HERE / "certificate.png", optimize=True)


def run(command: list) -> None:
    subprocess.run([str(word) for word in command], check=True, capture_output=True)


if __name__ == "__main__":
    main()
