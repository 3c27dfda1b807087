"""Pages in a browser of 390 × 844 pixels, and as printed on A4."""

import base64
import re

import pytest
from browser import CHROMIUM, Browser

from jaxbundle.explorer.camera import CameraView
from jaxbundle.explorer.network import NetworkView
from jaxbundle.explorer.server import page_file
from jaxbundle.network.tables import Camera
from jaxbundle.report.page import InputFile, Origin, compose

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="chromium is missing")

PHONE = {"width": 390, "height": 844, "deviceScaleFactor": 1, "mobile": True}
ORIGIN = Origin((InputFile("a_long_folder_name_of_a_survey/project_of_2026.toml", 1, "0" * 64),))
OUTSIDE = """[...document.querySelectorAll('button, input, select, a, canvas, h1, h2, p')]
    .filter(one => !one.closest('.scroll, .wide'))
    .map(one => one.getBoundingClientRect())
    .filter(box => box.width > 0 && (box.left < 0 || box.right > innerWidth)).length"""


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    with Browser(tmp_path_factory.mktemp("browser")) as one:
        yield one


@pytest.fixture(scope="module")
def pages(convergent4, tmp_path_factory):
    folder = tmp_path_factory.mktemp("pages")
    values = {"fx": 1223.827160493827, "fy": 1223.0, "cx": 959.5, "cy": 539.5, "k1": -0.01}
    camera = Camera("cam", "opencv", values, image_size=(1920, 1080))
    content = {
        "report": "".join(compose(convergent4, ORIGIN)),
        "network": page_file(NetworkView(convergent4, ORIGIN), {}, live=False).content.decode(),
        "camera": page_file(CameraView(camera, origin=ORIGIN), {}, live=False).content.decode(),
    }
    for name, text in content.items():
        (folder / f"{name}.html").write_text(text, encoding="utf-8")
    return folder


@pytest.mark.parametrize("name", ["report", "network", "camera"])
def test_on_a_phone_nothing_has_to_be_moved_sideways(browser, pages, name):
    browser.call("Emulation.setDeviceMetricsOverride", **PHONE)
    browser.open((pages / f"{name}.html").as_uri())
    assert browser.value("document.documentElement.scrollWidth") <= PHONE["width"]
    assert browser.value("innerWidth") == PHONE["width"]
    assert browser.value(OUTSIDE) == 0
    if name == "camera":  # every control has its room
        smallest = "Math.min(...[...document.querySelectorAll('.controls input')]" \
            ".map(one => one.getBoundingClientRect().width))"  # fmt: skip
        assert browser.value(smallest) > 60
    browser.call("Emulation.clearDeviceMetricsOverride")


def test_a_printed_page_is_not_half_empty(browser, pages):
    """The report of the small example needed eight sheets, five of them less than half full."""
    browser.open((pages / "report.html").as_uri())
    browser.until("document.readyState === 'complete'")
    printed = browser.call("Page.printToPDF", preferCSSPageSize=True)
    content = base64.b64decode(printed["data"])
    assert len(re.findall(rb"/Type\s*/Page\b", content)) <= 7


def test_a_slider_gives_a_short_number(browser, pages):
    """In a copy the controls are dead; their handlers are those of a live page."""
    browser.open((pages / "camera.html").as_uri())
    browser.value("""(() => { const slider = document.querySelector('[data-slides=fx]');
        slider.value = Number(slider.min) + 0.123456789 * (slider.max - slider.min);
        slider.dispatchEvent(new Event("input")); })()""")
    shown = browser.value("document.querySelector('[data-key=fx]').value")
    assert len(shown) <= 8 and 1000 < float(shown) < 1500
