"""Figures draw what the tables say, with units, and files appear whole or not at all."""

import copy
import dataclasses
import os
import sys
import warnings

import equinox as eqx
import jax
import jax.numpy as jnp
import matplotlib
import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.quiver import Quiver

from jaxbundle import plotting
from jaxbundle.adjustment.result import Adjustment
from jaxbundle.cameras import default_parameters, get_model, project
from jaxbundle.errors import InputError, NotSolvedError
from jaxbundle.geometry import matrix_from_quaternion
from jaxbundle.plotting import files, quality
from jaxbundle.plotting.distortion import distortion_at
from jaxbundle.plotting.ellipses import (
    Ellipses,
    error_ellipses,
    median_neighbour,
    principal_sections,
)
from jaxbundle.plotting.style import extent, round_number
from jaxbundle.plotting.views import camera_pyramids

matplotlib.use("Agg")


@pytest.fixture
def axes():
    def make(projection=None):
        figure = Figure(figsize=(6, 5))
        FigureCanvasAgg(figure)
        return figure.add_subplot(projection=projection)

    return make


def texts(ax) -> str:
    """Everything written on the axes that is not an annotation."""
    parts = [ax.get_title(loc="left"), ax.get_xlabel(), ax.get_ylabel()]
    legend = ax.get_legend()
    return "\n".join(parts + [t.get_text() for t in (legend.get_texts() if legend else ())])


def offsets(ax, name):
    found = next(c for c in ax.collections if c.get_label() == name)
    return np.asarray(found.get_offsets())


# --- distortion -----------------------------------------------------------------------------

LENSES = {
    "brown": {"c": 20, "x0": 0.3, "y0": -0.2, "K1": -2e-4, "K2": 3e-7, "K3": 1e-10, "P1": 4e-5,
              "P2": -2e-5, "b1": 3e-4, "b2": 1e-4},
    "bingo": {"c": 130, "x0": 0.4, "y0": -0.3, "p25": 0.5, "p26": 0.3, "format_factor": 1.0},
    "opencv": {"fx": 900, "fy": 905, "cx": 640, "cy": 480, "k1": -0.2, "k2": 0.05, "p1": 1e-3,
               "p2": -5e-4},
    "kannala-brandt": {"fx": 400, "fy": 401, "cx": 640, "cy": 480, "k1": -0.02, "k2": 3e-3},
    "snavely": {"f": 900, "k1": -0.1, "k2": 0.02},
}  # fmt: skip


def lens(name):
    model = get_model(name)
    values = default_parameters(model) | {k: float(v) for k, v in LENSES[name].items()}
    return model, [values[p] for p in model.parameters]


def test_distortion_of_brown_in_closed_form():
    model, p = lens("brown")
    v = dict(zip(model.parameters, p))
    r = np.linspace(0, 10, 21)
    (radial, decentring), slopes = distortion_at(model, p, r)
    expected = -(v["K1"] * r**3 + v["K2"] * r**5 + v["K3"] * r**7 + v["b1"] * r / 2)
    np.testing.assert_allclose(radial, expected, rtol=1e-9, atol=1e-13)
    np.testing.assert_allclose(decentring, np.hypot(v["P1"], v["P2"]) * r**2, rtol=1e-9, atol=1e-13)
    by = dict(zip(model.parameters, np.moveaxis(slopes, 2, 0)))
    np.testing.assert_allclose(by["K2"][0], -(r**5), rtol=1e-12)
    for name in ("c", "x0", "y0"):
        np.testing.assert_allclose(by[name], 0, atol=1e-12)


@pytest.mark.parametrize("name,half", [("opencv", 500.0), ("snavely", 500.0)])
def test_radial_distortion_of_pixel_models(name, half):
    model, p = lens(name)
    v = dict(zip(model.parameters, p)) | ({"p1": 0.0, "p2": 0.0} if name == "opencv" else {})
    f = v["f"] = v["fy"] = v.get("fx", v.get("f"))
    v = {k: v[k] for k in model.parameters}
    ideal = np.linspace(0, half, 11)
    rho = ideal / f
    measured = ideal * (1 + v["k1"] * rho**2 + v["k2"] * rho**4)
    (radial, decentring), _ = distortion_at(model, list(v.values()), measured)
    np.testing.assert_allclose(radial, measured - ideal, atol=1e-9)
    np.testing.assert_allclose(decentring, 0, atol=1e-9)


@pytest.mark.parametrize("name", ["brown", "bingo", "kannala-brandt"])
def test_derivatives_of_the_profile(name):
    model, p = lens(name)
    radius = np.array([0.3, 0.7, 1.0]) * (9.0 if model.unit == "mm" else 450.0)
    values, slopes = distortion_at(model, p, radius)
    assert np.isfinite(values).all() and np.abs(values[0]).min() > 1e-6
    for i, name in enumerate(model.parameters):
        if name in model.never_free:
            continue
        # a step that moves the profile by a hundred-millionth of the radius
        slope = np.abs(slopes[:, :, i]).max()
        step = min(1e-8 * radius[-1] / max(slope, 1e-300), 1e-3 * max(abs(p[i]), 1.0))
        change = np.eye(len(p))[i] * step
        up, down = (distortion_at(model, np.add(p, s * change), radius)[0] for s in (1, -1))
        numerical = (up - down) / (2 * step)
        noise = 1e-13 * radius[-1] / step
        tolerance = 1e-5 * np.abs(numerical).max() + noise
        assert np.abs(slopes[:, :, i] - numerical).max() < tolerance, name


def test_sigma_of_the_profile(convergent4):
    found = plotting.distortion_profile(convergent4, "cam")
    names, C = convergent4.camera_covariance("cam")
    r = found.radius
    powers = {"K1": r**3, "K2": r**5, "K3": r**7, "b1": r / 2}
    a = np.stack([powers.get(name, 0 * r) for name in names], 1)
    np.testing.assert_allclose(found.radial_sigma, np.sqrt(np.einsum("ri,ij,rj->r", a, C, a)),
                               rtol=1e-7, atol=1e-15)  # fmt: skip
    p = convergent4.camera_parameters("cam")
    direction = np.array([p["P1"], p["P2"]]) / np.hypot(p["P1"], p["P2"])
    P = [names.index("P1"), names.index("P2")]
    sigma = np.sqrt(direction @ C[np.ix_(P, P)] @ direction)
    np.testing.assert_allclose(found.decentring_sigma, sigma * r**2, rtol=1e-7, atol=1e-15)
    problem = convergent4.problem
    away = problem.image_coordinates()[problem.camera == 0] - [p["x0"], p["y0"]]
    assert r[-1] == pytest.approx(np.hypot(*away.T).max())


def test_the_distortion_curve_goes_to_the_corner_of_the_image(convergent4, axes):
    """Where the size of the image is known; a line marks the farthest measurement."""
    network = convergent4.problem.network
    size = dict(image_size=(3000, 2000), pixel_size=(0.01, 0.01))
    camera = dataclasses.replace(network.cameras[0], **size)
    problem = dataclasses.replace(convergent4.problem, network=network.replace(cameras=(camera,)))
    sized = Adjustment(problem.network, problem, convergent4.minimum)
    ax = sized.plot_distortion("cam", axes())
    p = sized.camera_parameters("cam")
    expected = np.hypot(15 + abs(p["x0"]), 10 + abs(p["y0"]))
    last = [line.get_xdata()[-1] for line in ax.lines if line.get_label().startswith("symm")]
    assert last == [pytest.approx(expected)] and ax.get_xlim()[1] == pytest.approx(expected)
    mark = next(line for line in ax.lines if line.get_label() == "farthest measurement")
    measured = plotting.distortion_profile(sized, "cam").radius[-1]
    assert mark.get_xdata()[0] == pytest.approx(measured)


def test_ids_of_a_plan_stay_inside_and_apart(convergent4):
    figure = Figure(figsize=(7.5, 6.5), layout="constrained")
    FigureCanvasAgg(figure)
    ax = convergent4.plot_plan(figure.add_subplot())
    figure.draw_without_rendering()
    frame = ax.get_window_extent()
    boxes = [text.get_window_extent() for text in ax.texts]
    assert len(boxes) >= 12
    for k, box in enumerate(boxes):
        inside = frame.x0 <= box.x0 and box.x1 <= frame.x1
        assert inside and frame.y0 <= box.y0 and box.y1 <= frame.y1, ax.texts[k]
        assert not any(box.overlaps(other) for other in boxes[:k]), ax.texts[k]


def test_names_of_figures_have_one_suffix():
    names = files.FigureNames(())
    assert [names("residuals", id) for id in ("photo_01.jpg", "photo_01.TIF", "12.5", ".png")] == [
        "residuals_photo_01", "residuals_photo_01_2", "residuals_12.5", "residuals_png",
    ]  # fmt: skip


def test_contours_are_smooth_and_true():
    """A spline of the logarithm of a few places, against the function itself."""
    u, v = np.linspace(0, 479, 21), np.linspace(0, 359, 17)
    sigma = lambda u, v: 0.01 + 0.6 * (np.hypot(u - 240, v[:, None] - 180) / 300) ** 6
    x, y, fine = quality._smooth(u, v, sigma(u, v))
    np.testing.assert_allclose(fine, sigma(x, y), rtol=0.03)
    assert fine.shape == (129, 161)
    holes = np.where(u > 400, np.nan, sigma(u, v))
    assert quality._smooth(u, v, holes)[2] is holes


def test_distortion_curve(convergent4, axes):
    ax = convergent4.plot_distortion("cam", axes())
    found = plotting.distortion_profile(convergent4, "cam")
    radial = next(line for line in ax.lines if line.get_label().startswith("symmetric radial"))
    np.testing.assert_allclose(radial.get_ydata(), 1e3 * found.radial)
    band = ax.collections[0].get_paths()[0].get_extents()
    assert band.ymin == pytest.approx(1e3 * (found.radial - found.radial_sigma).min())
    assert "[mm]" in ax.get_xlabel() and "[µm]" in ax.get_ylabel()
    assert "decentring" in texts(ax) and "±σ (a posteriori)" in texts(ax)


# --- residuals ------------------------------------------------------------------------------


def test_residual_vectors_are_those_of_the_table(convergent4, axes):
    image = "DSC_041"
    ax = convergent4.plot_residuals(image, axes())
    arrows = next(c for c in ax.collections if isinstance(c, Quiver))
    table = convergent4.residuals
    rows = (table["kind"] == "image") & (table["image"] == image)
    v = table["v"][rows].reshape(-1, 2)
    given = convergent4.network.observations
    chosen = given.image == convergent4.network.images.id.index(image)
    order = np.argsort(given.point[chosen])
    drawn = np.argsort([int(t.get_text()) for t in ax.texts])
    np.testing.assert_allclose(np.asarray(arrows.get_offsets())[drawn], given.xy[chosen][order])
    np.testing.assert_allclose(np.stack([arrows.U, arrows.V], 1)[drawn], v[order])
    factor = float(ax.get_title(loc="left").split("× ")[1].split(",")[0])
    assert arrows.scale == pytest.approx(1 / factor)
    assert ax.get_xlabel() == "x [mm]" and ax.get_ylabel() == "y [mm]"
    assert ax.get_aspect() == 1 and not ax.yaxis_inverted()
    assert any("µm" in a.text.get_text() for a in ax.artists), "a scale bar with its unit"


def test_image_frame_is_drawn_where_it_is_known(convergent4, axes):
    network = convergent4.problem.network
    camera = dataclasses.replace(
        network.cameras[0], image_size=(4000, 3000), pixel_size=(0.004, 0.004)
    )
    changed = renamed(convergent4, network.replace(cameras=(camera,)))
    frame = changed.plot_residuals("DSC_041", axes()).patches[0]
    np.testing.assert_allclose(frame.get_bbox().bounds, (-8, -6, 16, 12))
    assert not convergent4.plot_residuals("DSC_041", axes()).patches


def test_an_unknown_image_is_named(convergent4, axes):
    with pytest.raises(KeyError, match="DSC_037"):
        convergent4.plot_residuals("99", axes())
    with pytest.raises(KeyError, match="cam"):
        convergent4.plot_distortion("99", axes())


def test_histogram(convergent4, axes):
    ax = convergent4.plot_histogram(axes())
    bars = ax.patches
    assert sum(bar.get_height() for bar in bars) == 80
    low, high = bars[7].get_x(), bars[7].get_x() + bars[7].get_width()
    tau = convergent4.residuals["tau"]
    assert bars[7].get_height() == ((tau >= low) & (tau < high)).sum()
    t, n = ax.lines[0].get_data()
    area = ((n[1:] + n[:-1]) / 2 * np.diff(t)).sum()
    assert area == pytest.approx(80 * bars[0].get_width(), rel=1e-3)
    assert "τ = w/σ0" in ax.get_xlabel() and "[number]" in ax.get_ylabel()


# --- the network ----------------------------------------------------------------------------


def test_plan(convergent4, axes):
    ax = convergent4.plot_plan(axes())
    points, images = convergent4.points, convergent4.images
    expected = np.stack([points["X"], points["Y"]], 1)
    np.testing.assert_allclose(offsets(ax, "tie points"), expected)
    np.testing.assert_allclose(offsets(ax, "cameras"), np.stack([images["X0"], images["Y0"]], 1))
    assert ax.get_xlabel() == "X [model]" and ax.get_ylabel() == "Y [model]"
    assert ax.get_aspect() == 1
    (low_x, high_x), (low_y, high_y) = ax.get_xlim(), ax.get_ylim()
    assert ((low_x < expected[:, 0]) & (expected[:, 0] < high_x)).all()
    assert ((low_y < expected[:, 1]) & (expected[:, 1] < high_y)).all()
    factor = float(texts(ax).split("× ")[1].replace(" ", ""))
    ellipses = next(
        c for c in ax.collections
        if isinstance(c, LineCollection) and str(c.get_label()).startswith("error")
    )  # fmt: skip
    # the rectangle around an ellipse is σX by σY
    size = [np.ptp(s, axis=0) / 2 for s in ellipses.get_segments()]
    sigma = np.stack([points["sX"], points["sY"]], 1)
    np.testing.assert_allclose(size, factor * sigma, rtol=5e-3)


@pytest.mark.parametrize("number", [2, 401, 799])
def test_the_median_distance_of_neighbours(number):
    """Of a line with steps of 2, every place twice."""
    places = np.repeat(2.0 * np.arange(number), 2)[:, None] * [1.0, 0.0, 0.0]
    assert median_neighbour(places) == 2
    assert median_neighbour(places[:2]) == np.inf


def test_error_ellipses_lean_as_the_covariance(convergent4):
    all_of_them = Ellipses(np.arange(len(convergent4.points["id"])), 0, 1.0)
    polygons = error_ellipses(convergent4, all_of_them)[:, :-1]
    away = polygons - polygons.mean(1, keepdims=True)
    moment = np.einsum("pni,pnj->pij", away, away) / away.shape[1]
    expected = convergent4.point_covariance[:, :2, :2]
    np.testing.assert_allclose(2 * moment, expected, rtol=1e-6, atol=1e-14)


def test_sections_of_error_ellipsoids_lie_on_them_in_planes_of_two_axes(convergent4):
    number = len(convergent4.points["id"])
    sections = principal_sections(convergent4, Ellipses(np.arange(number), 0, 3.0))
    away = sections.reshape(3, number, -1, 3) - convergent4.point_values[:, None]
    covariance = convergent4.point_covariance
    distance = np.einsum("spci,pij,spcj->spc", away, np.linalg.inv(covariance), away)
    np.testing.assert_allclose(distance, 9.0, rtol=1e-6)
    for p, (_, axes) in enumerate(zip(*np.linalg.eigh(covariance))):
        along = np.abs(away[:, p] @ axes).max(1)
        absent = along < 1e-9 * along.max(0)
        np.testing.assert_array_equal(absent, np.eye(3, dtype=bool)[::-1])


def test_pyramids_are_the_corners_of_the_images(convergent4):
    size = 0.1
    pyramids = camera_pyramids(convergent4, size)
    edges = np.linalg.norm(pyramids[:, 1:] - pyramids[:, :1], axis=2)
    np.testing.assert_allclose(edges.mean(1), size)
    model = get_model("brown")
    p = tuple(convergent4.camera_parameters("cam").values())
    M = jax.vmap(matrix_from_quaternion)(convergent4.values["image"].rotation)
    rays = np.einsum("iab,icb->ica", M, pyramids[:, 1:] - pyramids[:, :1])
    image_of = jax.jit(jax.vmap(jax.vmap(lambda ray: jnp.stack(project(model, p, *ray)))))
    xy = np.asarray(image_of(rays))
    measured = convergent4.problem.image_coordinates()
    for corners in xy:
        np.testing.assert_allclose(corners.min(0), measured.min(0), atol=1e-9)
        np.testing.assert_allclose(corners.max(0), measured.max(0), atol=1e-9)


def test_perspective(convergent4, axes):
    ax = convergent4.plot_perspective(axes("3d"))
    drawn = next(c for c in ax.collections if c.get_label() == "tie points")
    expected = [convergent4.points[axis] for axis in "XYZ"]
    np.testing.assert_allclose(np.array(drawn._offsets3d), expected)
    assert [ax.get_xlabel(), ax.get_ylabel(), ax.get_zlabel()] == [f"{a} [model]" for a in "XYZ"]
    lengths = np.ptp([ax.get_xlim(), ax.get_ylim(), ax.get_zlim()], axis=1)
    np.testing.assert_allclose(ax._box_aspect / lengths, (ax._box_aspect / lengths)[0])
    with pytest.raises(ValueError, match="3D"):
        convergent4.plot_perspective(axes())


def test_far_points_do_not_shrink_the_view():
    xyz = np.random.default_rng(0).normal(size=(200, 3))
    xyz[0] = 1e6, 0, 0
    centre, size = extent(xyz)
    assert size < 10 and np.abs(centre).max() < 2
    assert extent(np.array([[1.0, 2.0, 3.0]]))[0].tolist() == [1, 2, 3]
    assert [round_number(x) for x in (0.3, 1.0, 7.0, 49.9, 2e-5)] == [0.2, 1, 5, 20, 2e-5]


# --- cameras --------------------------------------------------------------------------------


@pytest.mark.parametrize("camera", [None, "cam"])
def test_correlations(convergent4, axes, camera):
    ax = convergent4.plot_correlations(camera, axes())
    entry = convergent4.cameras["cam"]
    np.testing.assert_allclose(ax.images[0].get_array(), 100 * entry["correlations"])
    assert [t.get_text() for t in ax.get_xticklabels()] == entry["free"]
    assert "%" in texts(ax)


# --- files ----------------------------------------------------------------------------------


def renamed(adjustment, network, **changes):
    problem = dataclasses.replace(adjustment.problem, network=network)
    return Adjustment(network, problem, adjustment.minimum, **changes)


def test_save_figures(convergent4, tmp_path, monkeypatch):
    """Each is drawn once, inside its margins, and reported."""
    import cv2
    from matplotlib import pyplot
    from matplotlib.figure import Figure

    drawn, told = [], []
    draw = Figure.draw
    monkeypatch.setattr(Figure, "draw", lambda self, at: (drawn.append(self), draw(self, at)))
    before = pyplot.get_fignums()
    written = plotting.save_figures(
        convergent4, tmp_path / "new" / "folder", progress=lambda *state: told.append(state)
    )
    assert told == [("drawing", k, 9) for k in range(10)]
    assert len({*map(id, drawn)}) == 9 and len(drawn) == 10  # the plan measures its labels
    for path in written:
        edge = np.array(cv2.imread(str(path)))
        edge[5:-5, 5:-5] = 255
        assert (edge == 255).all(), path.name
    assert pyplot.get_fignums() == before
    names = ["plan", "perspective", "histogram"]
    names += [f"residuals_{image}" for image in convergent4.images["id"]]
    names += ["distortion_cam", "correlations_cam"]
    assert [path.name for path in written] == [f"{name}.png" for name in names]
    assert sorted(written) == sorted((tmp_path / "new" / "folder").glob("*.png"))
    for path in written:
        content = path.read_bytes()
        assert content.startswith(b"\x89PNG") and b"IEND" in content[-12:]


@pytest.mark.further
def test_files_have_safe_names_of_their_own(convergent4, tmp_path, monkeypatch):
    network = convergent4.problem.network
    images = dataclasses.replace(network.images, id=("../a/b", "A?B", "$x_1$\n", "図"))
    camera = dataclasses.replace(network.cameras[0], id="a$\\frac$")
    monkeypatch.setattr(files, "network_perspective", lambda adjustment, ax: None)
    changed = renamed(convergent4, network.replace(images=images, cameras=(camera,)))
    written = plotting.save_figures(changed, tmp_path)
    assert {path.parent for path in written} == {tmp_path}
    assert {path.name for path in written[3:7]} == {
        "residuals_a_b.png", "residuals_A_B_2.png", "residuals_x_1.png", "residuals_unnamed.png"
    }  # fmt: skip
    assert written[-1].name == "correlations_a_frac.png"
    assert len({path.name.casefold() for path in written}) == len(written)


def test_nothing_half_written(convergent4, tmp_path, monkeypatch):
    def fail(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", fail)
    with pytest.raises(InputError, match="plan.png: cannot be written"):
        plotting.save_figures(convergent4, tmp_path)
    assert not list(tmp_path.iterdir())


def test_a_folder_that_cannot_be_made(convergent4, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="cannot be made"):
        plotting.save_figures(convergent4, tmp_path / "file" / "folder")


def test_nothing_to_draw_where_nothing_was_solved(convergent4, tmp_path, axes):
    minimum = eqx.tree_at(lambda m: m.termination, convergent4.minimum, jnp.asarray(0))
    changed = Adjustment(convergent4.network, convergent4.problem, minimum)
    with pytest.raises(NotSolvedError):
        plotting.save_figures(changed, tmp_path)
    with pytest.raises(NotSolvedError):
        changed.plot_plan(axes())
    assert not list(tmp_path.iterdir())


def test_without_matplotlib(convergent4, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(ImportError, match=r"pip install 'jaxbundle\[plots\]'"):
        plotting.save_figures(convergent4, tmp_path)
    with pytest.raises(ImportError, match=r"jaxbundle\[plots\]"):
        convergent4.plot_histogram()


def test_a_figure_of_its_own(convergent4):
    from matplotlib import pyplot

    ax = convergent4.plot_histogram()
    assert pyplot.fignum_exists(ax.figure.number)
    pyplot.close(ax.figure)


@pytest.mark.parametrize("name", ["项目", "مشروع", "😀"])
def test_names_in_any_script_are_drawn_without_a_warning(convergent4, name):
    """The font may lack them: boxes in the figure, and nothing on the terminal, also from
    drawings that measure their text first."""
    named = copy.copy(convergent4)
    named.network = convergent4.network.replace(name=name)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert files.png((6, 5), None, named.plot_plan).startswith(b"\x89PNG")
