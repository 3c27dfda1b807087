"""Pages and reports as their reader sees them: ticks, digits, what is drawn, on a phone, on
paper, and what they were computed from."""

import re
from importlib.resources import files

import numpy as np
import pytest
import scipy.stats
from numpy.testing import assert_allclose, assert_array_equal
from page_reader import Page, column, data_of, decode

from jaxbundle.batches.page import compose_batch
from jaxbundle.errors import InputError, NotSolvedError
from jaxbundle.explorer.camera import CameraView
from jaxbundle.explorer.network import NetworkView
from jaxbundle.explorer.server import page_file
from jaxbundle.network.tables import Camera
from jaxbundle.plotting import views
from jaxbundle.plotting.ellipses import (
    PERSPECTIVE,
    PLAN,
    PROBABILITY,
    EllipseSettings,
    choose_ellipses,
    thin_out,
)
from jaxbundle.plotting.style import extent
from jaxbundle.plotting.ticks import label_coordinates, label_ticks, offset_in_words
from jaxbundle.report.layout import coordinate_decimals, digits_of, estimate
from jaxbundle.report.page import Addition, InputFile, Origin, compose, compose_failure, scene
from jaxbundle.report.page.charts import Curve, draw_curves
from jaxbundle.report.page.markup import grid
from jaxbundle.system import clock

ORIGIN = Origin((InputFile("valley/project.toml", 1, "0" * 64),), {}, "2024-05-02 10:30")
HOSTILE = "</style><script>alert('1')</script>\\\n\";} * { display: none"


# --- ticks ----------------------------------------------------------------------------------


def ticks_of(drawing: str):
    """Positions and texts of the ticks of x and of y, and the labels of the axes."""
    texts = re.findall(r'<text(?: class="tick")? x="([\d.]+)" y="([\d.]+)"(.*?)>(.*?)</text>',
                       drawing)  # fmt: skip
    x = [(float(at), name) for at, y, _, name in texts if float(y) == 271]
    y = [(float(at), name) for left, at, _, name in texts if float(left) == 64]
    labels = [name for at, y, _, name in texts if (at, name) not in x and float(y) != 271
              and float(at) != 64]  # fmt: skip
    return x, y, labels


def offset_of(label: str) -> float:
    found = re.search(r"\(([+−][\d .]+)\)", label)
    return 0.0 if found is None else float(found[1].replace(" ", "").replace("−", "-"))


@pytest.mark.parametrize("low, high", [
    (4_769_900.0, 4_770_600.0), (364_000.0, 364_900.0), (-5_000_000.3, -5_000_000.1),
    (0.0, 1.0), (2e-7, 9e-7), (47_653.2, 47_653.3), (-3.0, 12.0), (1e7, 5e7),
])  # fmt: skip
def test_ticks_are_short_differ_and_say_where_they_are(low, high):
    x = np.linspace(low, high, 5)
    across, up, (x_label, _) = ticks_of(draw_curves([Curve("a", x, x)], "X [m]", "Y [m]"))
    names = [name for _, name in across]
    assert len(names) >= 2 and len(set(names)) == len(names)
    assert max(map(len, names)) <= 7
    values = np.array(names, float) + offset_of(x_label)
    # from the numbers that are read to the places in the drawing, as the curve itself
    slope = (625 - 70) / (high - low)
    assert_allclose([at for at, _ in across], 70 + slope * (values - low), atol=0.2)
    assert len({name for _, name in up}) == len(up) >= 2


@pytest.mark.parametrize("low, high", [(47_640.0, 47_660.0), (12_600.0, 25_000.0), (1e-6, 20.0)])
def test_ticks_of_a_logarithmic_axis_differ(low, high):
    x, y = np.arange(4.0), np.linspace(np.log10(low), np.log10(high), 4)
    _, up, labels = ticks_of(draw_curves([Curve("a", x, y)], "step", "v", "y"))
    names = [name for _, name in up]
    assert len(set(names)) == len(names) >= 2 and max(map(len, names)) <= 7
    offset = max(map(offset_of, labels), key=abs)
    places = np.log10(np.array(names, float) + offset)
    assert_allclose(np.polyfit(places, [at for at, _ in up], 1)[0] * np.ptp(y), -240 / 1.1,
                    rtol=2e-2)  # fmt: skip


def test_a_value_that_does_not_change_has_ticks_too():
    x = np.arange(3.0)
    _, up, _ = ticks_of(draw_curves([Curve("a", x, 24.0718 + 1e-14 * x)], "step", "v"))
    assert len({name for _, name in up}) == len(up)


def test_map_coordinates_of_figures_are_short():
    from matplotlib.figure import Figure

    ax = Figure(figsize=(6, 5)).add_subplot()
    ax.set_xlim(364_000, 364_900)
    ax.set_ylim(4_769_900, 4_770_600)
    for axis in "xy":
        label_coordinates(ax, axis, "m")
    ax.figure.draw_without_rendering()
    assert ax.get_xlabel() == "X [m]"
    offset = offset_of(ax.get_ylabel())
    low, high = ax.get_ylim()
    seen = [tick for tick in ax.yaxis.get_major_ticks() if low <= tick.get_loc() <= high]
    names = [tick.label1.get_text() for tick in seen]
    assert len(names) > 3 and max(map(len, names)) <= 5
    assert_allclose(np.array(names, float) + offset, [tick.get_loc() for tick in seen])


def test_an_offset_is_a_round_number():
    offset, names = label_ticks([4_769_950.0, 4_770_000.0, 4_770_050.0])
    assert offset == 4_769_900 and names == ["50", "100", "150"]
    assert offset_in_words(offset) == " (+4 769 900)" and offset_in_words(0) == ""


# --- digits ---------------------------------------------------------------------------------


@pytest.mark.parametrize("value, sigma", [
    (18.528014315, 0.0453018675), (2759.480123456, 0.0123), (-3.4412e-8, 2.29e-8),
    (4_770_123.456789012, 0.0123), (0.00123456789, 0.5), (154.006, None), (3072.123456789, None),
])  # fmt: skip
def test_a_value_has_the_digits_of_its_sigma(value, sigma):
    text, _ = estimate(value, sigma)
    if sigma is None:
        assert digits_of(value) in range(4, 7)
        assert abs(float(text) / value - 1) < 1e-5 and len(text.replace(".", "")) <= 6
        return
    digits = digits_of(value, sigma)
    rounded = float(f"{value:.{digits - 1}e}")
    assert abs(rounded - value) <= max(0.005 * sigma, 0.5 * abs(value))
    if abs(value) > sigma:
        assert abs(float(text) - value) <= 0.005 * sigma
        # one digit less would lose more than a two-hundredth of σ
        assert 10.0 ** (np.floor(np.log10(abs(value))) - digits + 2) > 0.005 * sigma


def test_no_number_of_the_page_has_more_digits_than_its_sigma(convergent4):
    text = "".join(compose(convergent4))
    cameras = data_of(text, "data-cameras")
    value, sigma, digits = (
        decode(packed, cameras["length"])
        for packed in (*(cameras["columns"][n] for n in ("value", "sigma")),
                       cameras["columns"]["value"]["digits"])
    )  # fmt: skip
    shown = np.array([float(f"{v:.{n - 1}e}") for v, n in zip(value, digits)])
    known = sigma > 0
    assert known.sum() == 10 and (digits <= 7).all()
    big = known & (np.abs(value) > sigma)
    assert (np.abs(shown - value)[big] <= 0.005 * sigma[big]).all()
    assert (digits[~known] == 6).all()
    for table, names in (("points", "XYZ"), ("images", ("X0", "Y0", "Z0"))):
        columns = data_of(text, f"data-{table}")["columns"]
        for name in names:
            s = column(text, table, f"s{name}")
            unit = 10.0 ** -columns[name]["places"]
            # σ is at least nine, and not hundreds of, units of the last place
            assert (s > 9 * unit).mean() >= 0.8 and np.quantile(s, 0.1) < 100 * unit
    v = column(text, "observations", "v")
    unit = 10.0 ** -data_of(text, "data-observations")["columns"]["measured"]["places"]
    assert unit < np.sqrt((v**2).mean())


def test_map_coordinates_have_eleven_digits_at_most():
    """σ of 8 mm to 3 cm, coordinates of millions of metres: to 0.1 or 1 mm."""
    sigma = np.random.default_rng(0).uniform(0.008, 0.03, 100)
    assert coordinate_decimals(sigma) in (3, 4)


def test_a_blunder_is_detectable_from_the_same_size_in_text_and_page(convergent4):
    text, found = "".join(compose(convergent4)), convergent4.residuals
    page = column(text, "observations", "mdb")
    assert_allclose(page, found["mdb"], rtol=1e-6)
    assert_allclose(found["mdb"], 4.13 * found["sigma"] / np.sqrt(found["r"]), rtol=1e-9)
    report = convergent4.report()
    rows = re.findall(r"^image +(\S+) +(\S+) +([xy]) .*?(\S+) +\S+$", report, re.MULTILINE)
    assert len(rows) >= 8
    for image, point, axis, mdb in rows:
        (row,) = np.flatnonzero((found["image"] == image) & (found["point"] == point)
                                & (found["axis"] == axis))  # fmt: skip
        assert float(mdb) == pytest.approx(page[row], rel=0.01)


# --- ellipsoids -----------------------------------------------------------------------------


def test_of_many_points_the_largest_and_a_spread_sample_are_drawn():
    rng = np.random.default_rng(0)
    xyz, large = rng.uniform(0, [700, 500, 20], (6000, 3)), rng.lognormal(size=6000)
    rows = thin_out(xyz, large, 700, PLAN)
    assert len(set(rows.tolist())) == len(rows) <= PLAN.largest + PLAN.sampled
    assert set(np.argsort(-large)[: PLAN.largest]) <= set(rows.tolist())
    quarter = (xyz[rows, 0] > 350) + 2 * (xyz[rows, 1] > 250)
    assert np.bincount(quarter, minlength=4).min() > 0.2 * len(rows)
    few = rows[:40]
    assert_array_equal(thin_out(xyz[few], large[few], 700, PLAN), np.arange(40))
    # all at one place, or along a line, where as many have room beside each other
    assert len(thin_out(0 * xyz, large, 700, PLAN)) == PLAN.largest + 1
    beside = 1 / (2.5 * PLAN.smallest)
    assert PLAN.largest + 0.9 * beside < len(thin_out(xyz * [1, 0, 0], large, 700, PLAN))
    # the object is a tenth of the network: its ellipses have no room beside each other
    assert len(thin_out(xyz, large, 7000, PLAN)) < PLAN.largest + 0.02 * beside**2


def test_ellipsoids_too_wide_to_be_drawn_are_marked_and_said(convergent4, monkeypatch):
    """One point hardly determined: its ellipsoid would cover the others."""
    covariance = np.array(convergent4.point_covariance)
    covariance[3] *= 100.0**2
    monkeypatch.setitem(vars(convergent4), "point_covariance", covariance)
    _, size = extent(np.concatenate([convergent4.point_values, convergent4.image_values[:, :3]]))
    found = choose_ellipses(convergent4, size, PERSPECTIVE)
    half_axis = np.sqrt(np.linalg.eigvalsh(covariance)[:, -1])
    assert found.wide.tolist() == [3] and 3 not in found.rows and len(found.rows) == 9
    assert (found.factor * half_axis[found.rows] <= PERSPECTIVE.longest * size).all()
    assert found.selection == "of 9 of 10 points (too wide to be drawn: 1)"
    ax = convergent4.plot_perspective()
    assert "too wide" in ax.get_title(loc="left")
    (rings,) = [c for c in ax.collections if "too wide" in str(c.get_label())]
    assert len(rings.get_offsets()) == 1
    from matplotlib import pyplot

    pyplot.close(ax.figure)


def test_the_probability_of_an_ellipsoid_is_that_of_chi_squared():
    for dimensions, words in PROBABILITY.items():
        assert words == f"{100 * scipy.stats.chi2.cdf(1, dimensions):.0f} %"


def test_a_page_says_which_ellipsoids_it_draws(convergent4, monkeypatch):
    drawing = data_of("".join(compose(convergent4)), "network-data")
    assert drawing["ellipsoids"]["points"] == list(range(10))
    words = drawing["drawn"]
    assert "1σ" in words and "20 %" in words and " of " not in words
    few = EllipseSettings(largest=2, sampled=4)
    monkeypatch.setattr(views, "PLAN", few)
    monkeypatch.setattr(scene, "SCENE", few)
    drawing = data_of("".join(compose(convergent4)), "network-data")
    rows = drawing["ellipsoids"]["points"]
    assert 2 < len(rows) <= 6
    assert f"of {len(rows)} of 10 points: the 2 largest and {len(rows) - 2} others" in (
        drawing["drawn"]
    )
    ax = convergent4.plot_plan()
    assert f"{len(rows)} of 10 points" in ax.get_title(loc="left")
    from matplotlib import pyplot

    pyplot.close(ax.figure)


@pytest.mark.further
def test_the_explorer_draws_the_expected_ellipsoids_and_says_so(convergent4):
    view = NetworkView(convergent4)
    text = page_file(view, {}, live=True).content.decode()
    assert "stay those of the adjustment" not in text
    assert "ellipsoids of the drawing are then the expected ones" in text
    pose = [float(convergent4.images[name][1]) for name in
            ("X0", "Y0", "Z0", "omega", "phi", "kappa")]  # fmt: skip
    pose[2] += 0.1
    answer = view.answer({"moves": {convergent4.images["id"][1]: pose}, "aim": False})
    drawn, after = answer["ellipsoids"]["points"], np.array(answer["sigma"]["after"]["points"])
    assert drawn["rows"] == list(range(10))
    variance = np.reshape(drawn["elements"], (-1, 6))[:, [0, 3, 5]]
    assert_allclose(np.sqrt(variance), after, rtol=1e-9)


# --- on a phone -----------------------------------------------------------------------------


def styles() -> str:
    return "".join(
        files("jaxbundle").joinpath(path).read_text(encoding="utf-8")
        for path in ("report/page/page.css", "explorer/page/explore.css")
    )


def test_tables_scroll_inside_the_page():
    assert re.match(r'<div class="wide"><table', grid(("a", "b"), [("1", "2")]))
    rules = styles()
    assert re.search(r"\.wide \{[^}]*overflow-x: auto", rules)


def test_nothing_is_wider_than_a_phone():
    """390 pixels are 26 em; what is wider must be allowed to shrink."""
    plain = re.sub(r"@media print.*", "", styles(), flags=re.DOTALL)
    for name, width in re.findall(r"[\s;{(](min-width|width): (\d+)em", plain):
        assert float(width) <= 18, (name, width)
    assert "minmax(24em" not in plain


def test_every_page_fits_a_phone(convergent4):
    for text in ("".join(compose(convergent4)), camera_page()):
        assert '<meta name="viewport" content="width=device-width, initial-scale=1">' in text
        # no table outside a part that scrolls, but the narrow ones of names and facts
        for before, kind in re.findall(r'(<div class="wide">)?<table([^>]*)>', text):
            assert before or "facts" in kind


def camera_page() -> str:
    camera = Camera("cam", "opencv", {
        "fx": 1223.827160493827, "fy": 1223.0, "cx": 959.5, "cy": 539.5, "k1": -0.0123456789,
    }, image_size=(1920, 1080))  # fmt: skip
    return page_file(CameraView(camera), {}, live=True).content.decode()


def test_a_field_is_short_and_stands_for_the_exact_value():
    fields = [given for tag, given in Page(camera_page()).tags
              if tag == "input" and given.get("type") == "number"]  # fmt: skip
    by_key = {given["data-key"]: given for given in fields}
    assert by_key["fx"]["value"] == "1223.83"
    assert float(by_key["fx"]["data-exact"]) == 1223.827160493827
    assert by_key["cx"]["value"] == "959.5" and "data-exact" not in by_key["cx"]
    assert max(len(given["value"]) for given in fields) <= 12


# --- on paper -------------------------------------------------------------------------------


def test_paper_has_no_forced_breaks_and_whole_figures():
    printed = re.search(r"@media print \{(.*?)\n\}", styles(), re.DOTALL)[1]
    assert not re.search(r"break-(before|after): (page|always|left|right)", styles())
    assert 'class="breaks"' not in styles()
    for rule in (r"thead \{[^}]*table-header-group", r"figure svg \{[^}]*max-width: none",
                 r"nav, \.hint, \.tools, button \{[^}]*display: none",
                 r"h2, h3 \{[^}]*break-after: avoid", r"print-color-adjust: exact"):  # fmt: skip
        assert re.search(rule, printed), rule


# --- what it was computed from ---------------------------------------------------------------


def pages(convergent4, origin):
    error = NotSolvedError("too few images")
    row = {"key": "a", "status": "bad input", "error": "no such file"}
    yield "".join(compose(convergent4, origin))
    yield "".join(compose_failure(error, origin))
    yield "".join(compose_batch([row], origin))
    view = NetworkView(convergent4, origin)
    yield page_file(view, {}, live=True).content.decode()
    yield page_file(view, {}, live=False).content.decode()


def margins(text: str) -> str:
    """The strings of the margins of printed pages, their escapes resolved."""
    found = " ".join(re.findall(r'@(?:top|bottom)-left \{ content: "([^"]*)"', text))
    return re.sub(r"\\([0-9a-f]+) ", lambda code: chr(int(code[1], 16)), found)


def test_every_page_says_project_date_and_version_also_in_print(convergent4):
    from jaxbundle import __version__

    for text in pages(convergent4, ORIGIN):
        head = re.search(r"<header>.*?</header>", text, re.DOTALL)[0]
        title = Page(text).texts["title"][0]
        for place in (head, margins(text)):
            for words in (title, "valley/project.toml", "2024-05-02 10:30", __version__):
                assert words in place, (words, place)


def test_a_page_without_an_origin_has_the_date_of_today(convergent4, monkeypatch):
    monkeypatch.setenv(clock.VARIABLE, "1000000000")
    for text in pages(convergent4, Origin()):
        assert "2001-09-09 01:46 UTC" in margins(text)


def test_a_title_cannot_leave_the_style(convergent4):
    text = "".join(compose(convergent4, ORIGIN, also=Addition(name=HOSTILE)))
    assert text.count("</style>") == 1 and text.count("<style>") == 1
    assert "alert('1')" in margins(text)
    Page(text)


@pytest.mark.parametrize("given", ["yesterday", "1e99", "9" * 30])
def test_a_date_that_is_none_is_refused(given, monkeypatch):
    monkeypatch.setenv(clock.VARIABLE, given)
    with pytest.raises(InputError, match="SOURCE_DATE_EPOCH: expected seconds since 1970, got"):
        clock.now()
