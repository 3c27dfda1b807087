"""Mistakes in an input, said as what they are: units, conventions of image coordinates, control
that fits nothing, names with blanks."""

import dataclasses

import numpy as np
import pytest

import jaxbundle
from jaxbundle import Camera, grid_of_targets, ring_of_stations, simulate
from jaxbundle.adjustment.mirrored_control import (
    name_mirrored,
    name_other_side,
    name_view_from_below,
)
from jaxbundle.errors import InputError, NotSolvedError
from jaxbundle.io.networks.control import read_control, with_control
from jaxbundle.network.unit_mistakes import (
    name_degrees,
    name_sigma_unit,
    name_unit_of_positions,
)
from jaxbundle.orientation.image_conventions import (
    explains_better,
    name_image_convention,
    name_image_extent,
)
from jaxbundle.orientation.network import without_placeholders

TARGETS = grid_of_targets(5, 5, 0.5, relief=0.2, seed=1)
RING = ring_of_stations(4, 3.0, 2.5, roll_every=2)
MM = Camera("cam", "brown", {"c": 24.0}, image_size=(6000, 4000), pixel_size=(0.006, 0.006))
PX = Camera("cam", "opencv", {"fx": 4000.0, "fy": 4000.0, "cx": 2999.5, "cy": 1999.5},
            image_size=(6000, 4000))  # fmt: skip
UP = Camera("cam", "snavely", {"f": 4000.0}, image_size=(6000, 4000))


def network(camera=MM, **options):
    noise = 0.3 * (1 if camera in (PX, UP) else 0.006)
    return simulate(RING, TARGETS, camera, noise=noise, seed=3, disturb=0.005, **options)


def with_xy(given, change):
    rays = given.observations
    return given.replace(observations=dataclasses.replace(rays, xy=change(rays.xy)))


def without_start_values(given):
    images, points = given.images, given.points
    nothing = np.full_like(images.position, np.nan)
    tie = points.has_role("tie")[:, None]
    return given.replace(
        images=dataclasses.replace(images, position=nothing, angles=nothing),
        points=dataclasses.replace(points, position=np.where(tie, np.nan, points.position)),
    )


# --- control --------------------------------------------------------------------------------


def table(folder, X):
    path = folder / "control.csv"
    rows = (f"{k},{','.join(map(repr, x))},0.02,0.02,0.02" for k, x in X.items())
    path.write_text("\n".join(["id,X,Y,Z,sX,sY,sZ", *rows]))
    return path


DEGREES = {
    "1": (11.5731, 48.1402, 519.2), "5": (11.5752, 48.1404, 520.1),
    "21": (11.5730, 48.1416, 518.4), "25": (11.5755, 48.1417, 519.9),
}  # fmt: skip


def test_control_in_degrees_is_said_and_not_adjusted(tmp_path):
    """100 iterations, then 40 unknowns that are hardly separated."""
    with pytest.raises(InputError, match=r"control.csv: X and Y of the 4 known points look like "
                       r"longitude and latitude in degrees .*11.573.*projection"):  # fmt: skip
        with_control(network(), read_control(table(tmp_path, DEGREES)))
    points = network(control=(0, 4, 20, 24)).points
    position = points.position.copy()
    position[[0, 4, 20, 24]] = list(DEGREES.values())
    given = network(control=(0, 4, 20, 24))
    with pytest.raises(InputError, match="longitude and latitude"):
        jaxbundle.adjust(given.replace(points=dataclasses.replace(points, position=position)))


@pytest.mark.parametrize("X", [
    TARGETS + [120.0, 35.0, 100.0],  # an object of 1 m in a local system
    TARGETS * [1, 1, 0] + [12.0, 48.0, 0.0],  # flat
    TARGETS * 200 + [4.5e6, 5.3e6, 500.0],  # a projection
    TARGETS * 1e5 * [1, 1, 0.01],  # metres about 0
    TARGETS * [0.01, 0.01, 1.0] + [500.0, 50.0, 0.0],  # a pole; no longitude is 500
])  # fmt: skip
def test_metric_coordinates_are_not_taken_for_degrees(X):
    points = network(control=range(25)).points
    assert name_degrees(dataclasses.replace(points, position=X)) == ""


def test_degrees_are_named_beside_a_point_without_coordinates():
    """A check point that is only measured in images has none."""
    points = network(control=(0, 4, 20, 24), check=(12,)).points
    position = points.position.copy()
    position[[0, 4, 20, 24]], position[12] = list(DEGREES.values()), np.nan
    said = name_degrees(dataclasses.replace(points, position=position))
    assert said.startswith("X and Y of the 4 known points look like longitude and latitude")


def test_control_that_fits_no_similarity_is_named_with_its_residuals(tmp_path):
    rng = np.random.default_rng(1)
    ids = ("1", "3", "5", "12", "21", "25")
    wrong = {id: tuple(rng.uniform(0, 80, 3).tolist()) for id in ids}
    with pytest.raises(InputError, match=r"fits no similarity .* its 6 points .* off \(median\), "
                       r"most of all '\d+' by \d.*check names and units"):  # fmt: skip
        with_control(network(), read_control(table(tmp_path, wrong)))
    A = np.array([[0, -7.0, 0], [7, 0, 0], [0, 0, 7]])
    right = {id: tuple((A @ TARGETS[int(id) - 1] + [900, 800, 70]).tolist()) for id in ids}
    right["12"] = (910.0, 805.0, 72.0)  # one of them wrong: that is not the similarity's fault
    moved = with_control(network(), read_control(table(tmp_path, right)))
    assert any("a similarity by 6 points was applied" in line for line in moved.notes)


# --- conventions of image coordinates -------------------------------------------------------

HALF = np.array([18.0, 12.0])
CENTRE = np.array([2999.5, 1999.5])
MISREAD = [
    (MM, lambda xy: xy * [1, -1], "y is counted in the other direction"),
    (MM, lambda xy: -xy, "turned by 180°"),
    (MM, lambda xy: xy[:, ::-1], "x and y are exchanged"),
    (MM, lambda xy: xy + HALF, "from a corner of the image: expected"),
    (MM, lambda xy: xy * [1, -1] + HALF, "a corner of the image and y is counted in the other"),
    (PX, lambda uv: uv * [1, -1] + [0, 3999], "v is counted in the other direction"),
    (PX, lambda uv: uv - CENTRE, "from the image centre: expected"),
    (UP, lambda xy: xy * [1, -1], "y is counted in the other direction: expected are pixels from"),
    (UP, lambda xy: xy * [1, -1] + CENTRE, "a corner of the image and y is counted in the other"),
]


@pytest.mark.parametrize("camera, misread, said", MISREAD)
def test_another_convention_of_image_coordinates_is_named(camera, misread, said):
    given = network(camera)
    assert name_image_convention(given) == ""
    found = name_image_convention(with_xy(given, misread))
    assert said in found and "change them in the input" in found


def test_a_flipped_axis_is_the_first_line_of_a_report_without_result():
    try:
        result = jaxbundle.adjust(with_xy(network(), MISREAD[0][1]))
        said = result.report().split("Counts")[0]
    except NotSolvedError as error:
        said = str(error)
    assert "y is counted in the other direction" in " ".join(said.split())


@pytest.mark.parametrize("camera, misread, said", [
    (MM, lambda xy: xy + HALF, "are they counted from a corner of the image?"),
    (PX, lambda uv: uv - CENTRE, "are they counted from the image centre?"),
    (UP, lambda xy: xy * [1, -1] + CENTRE, "from a corner of the image? Expected are pixels from"),
    (PX, lambda uv: (uv - CENTRE) * [0.006, -0.006], "are they in mm?"),
])  # fmt: skip
def test_coordinates_where_no_image_is_name_their_origin_or_unit(camera, misread, said):
    given = network(camera)
    assert name_image_extent(given) == ""
    assert said in name_image_extent(with_xy(given, misread))


# --- σ --------------------------------------------------------------------------------------


@pytest.mark.parametrize("camera, sigma, said", [
    (MM, 0.3, "0.3 mm, looks like one in pixels; it is expected in mm: 0.0018 (times 0.006)"),
    (MM, 1.8, "1.8 mm, looks like one in µm; it is expected in mm: 0.0018 (times 0.001)"),
    pytest.param(PX, 0.0018, "looks like one in mm; it is expected in px",
                 marks=pytest.mark.further),
])  # fmt: skip
def test_a_sigma_in_another_unit_is_said_with_the_factor(camera, sigma, said):
    given = network(camera)
    rays = given.observations
    wrong = dataclasses.replace(rays, sigma=np.full_like(rays.sigma, sigma))
    result = jaxbundle.adjust(given.replace(observations=wrong))
    assert result.converged
    head = " ".join(result.report().split("Counts")[0].split())
    assert "Attention σ0 is" in head and said in head
    assert any(said in line for line in result.warnings)


def test_a_sigma_that_is_only_poor_is_in_no_other_unit():
    given = network()
    assert name_sigma_unit(given, 5.0) == name_sigma_unit(given, 0.3) == ""
    assert name_sigma_unit(given, 40.0) == ""
    rays = given.observations
    weights = dataclasses.replace(rays, sigma=np.ones_like(rays.sigma), sigma_origin="unit")
    assert name_sigma_unit(given.replace(observations=weights), 0.0015) == ""


# --- start values that say nothing ----------------------------------------------------------


def test_columns_of_zeros_are_no_start_values():
    given = network()
    assert without_placeholders(given) is given
    images, points = given.images, given.points
    zeros = given.replace(
        images=dataclasses.replace(images, position=np.zeros((4, 3)), angles=np.zeros((4, 3))),
        points=dataclasses.replace(points, position=np.zeros((25, 3))),
    )
    found = without_placeholders(zeros)
    assert np.isnan(found.images.position).all() and np.isnan(found.points.position).all()
    words = " ".join(found.warnings)
    assert "all 25 tie points have one" in words and "all 4 images have one" in words
    panorama = given.replace(images=dataclasses.replace(images, position=np.zeros((4, 3))))
    assert without_placeholders(panorama) is panorama


# --- names ----------------------------------------------------------------------------------


def test_names_that_blanks_split_are_said(tmp_path):
    path = tmp_path / "control.txt"
    path.write_text("P 1 10.0 20.0 3.0\nP 2 11.0 20.0 3.0\n")
    with pytest.raises(InputError, match="control.txt, line 1: .* is 'P 1' one name. .* by commas"):
        read_control(path)
    path.write_text("id X Y Z\nP1 10.0 20.0 3.0\nP 2 11.0 20.0 3.0\n")
    with pytest.raises(InputError, match="control.txt, line 3: .* is 'P 2' one name. .* by commas"):
        read_control(path)


# --- control of a mirrored system -----------------------------------------------------------

CONTROL = {"control": (0, 4, 20, 24), "control_sigma": 0.002, "datum": "control"}
FREE = dataclasses.replace(MM, free=("c",))


def with_control_at(given, change):
    points, held = given.points, given.points.has_role("control")
    position = points.position.copy()
    position[held] = change(position[held])
    return given.replace(points=dataclasses.replace(points, position=position))


@pytest.mark.parametrize("start", [True, pytest.param(False, marks=pytest.mark.further)])
@pytest.mark.parametrize("change", [
    pytest.param(lambda X: X * [1, -1, 1], marks=pytest.mark.further), lambda X: X[:, [1, 0, 2]]
], ids=["Y in the other direction", "X and Y exchanged"])  # fmt: skip
def test_control_of_a_left_handed_system_is_named(change, start):
    """The nearly plane object has a mirror image that nearly fits its control: no point is blamed
    for it, and the right system has a σ0 of 1."""
    given = network(FREE, **CONTROL)
    mirrored = with_control_at(given, change)
    said = said_of(mirrored if start else without_start_values(mirrored))
    assert "the control points fit the mirror image of the network (σ0 1.0" in said
    assert "exchange X and Y of the control" in said and "contradict each other" not in said


def said_of(given) -> str:
    """What is said first of a network without a good result."""
    try:
        result = jaxbundle.adjust(given)
    except NotSolvedError as error:
        return str(error)
    (said,) = result.findings
    assert said[:60] in " ".join(result.report()[:1500].split())
    assert not result.converged or result.verdict.state == "not met"
    return said


@pytest.mark.further
@pytest.mark.parametrize("unit", [1.0, 100.0])
def test_a_mirrored_control_is_named_whatever_the_unit_of_weight(unit):
    """σ that nobody stated only scale σ0: the residuals, in principal distances, are the same."""
    given = network(dataclasses.replace(PX, free=("fx", "cx", "cy")), **CONTROL)
    sigma = np.full_like(given.observations.sigma, unit)
    free = dataclasses.replace(given.observations, sigma=sigma, sigma_origin="unit")
    points = dataclasses.replace(given.points, sigma=given.points.sigma * unit)
    given = given.replace(observations=free, points=points)
    said = said_of(with_control_at(given, lambda X: X[:, [1, 0, 2]]))
    assert "the control points fit the mirror image of the network" in said


def test_the_rule_of_conventions_is_one():
    """A fifth of the misfit: of image coordinates by start values, of control by σ0."""
    assert explains_better(0.9, 5.0) and not explains_better(1.1, 5.0)
    given = network(FREE, **CONTROL)
    for mirrored, sigma0, named in ((0.9, 5.0, True), (1.1, 5.0, False), (1.0, None, True),
                                    (6.0, None, False)):  # fmt: skip
        said = name_mirrored(without_start_values(given), sigma0, lambda _, s=mirrored: s, 5.0)
        assert bool(said) == named


def test_other_findings_make_another_result(convergent4):
    changed = convergent4.with_changes(findings=("a cause",), sigma_factors={"image": 2.0})
    assert (convergent4.findings, convergent4.sigma_factors) == ((), {})
    assert changed.findings == ("a cause",) and changed.sigma_origin == "estimated"
    assert changed.verdict is not convergent4.verdict and changed.sigma0 == convergent4.sigma0


def test_flipped_images_without_start_values_are_named():
    given = with_xy(network(FREE, **CONTROL), lambda xy: xy * [1, -1])
    said = said_of(without_start_values(given))
    assert "y (or x) of the image coordinates (expected: mm" in said


ALL_CONTROL = {"control": range(25), "control_sigma": 0.002, "datum": "control"}


def start_of_images(given):
    return dict(zip(given.images.id, given.images.position))


def test_control_in_mm_beside_images_in_m_is_named_although_all_fits():
    """Without tie points nothing contradicts it: the images move to where they see it."""
    given = network(**ALL_CONTROL)
    found = start_of_images(given)
    assert name_unit_of_positions(given, found) == name_unit_of_positions(given, {}) == ""
    said = name_unit_of_positions(given, {id: 999.7 * X for id, X in found.items()})
    assert "are 999.7 times their start values: is the control in mm" in said
    assert name_unit_of_positions(given, {id: 600 * X for id, X in found.items()}) == ""


def test_images_that_went_to_the_other_side_of_the_control_are_named():
    """Of an object that is nearly a plane the mirror image fits about as well."""
    given = network(FREE, **ALL_CONTROL)
    found = start_of_images(given)
    assert name_other_side(given, found) == ""
    below = {id: X * [1, 1, -1] for id, X in found.items()}
    said = name_other_side(given, below)
    assert "4 images of 4 moved" in said and "exchange X and Y of the control" in said
    nothing = {id: np.zeros(3) for id in found}  # start values that say nothing
    images = dataclasses.replace(given.images, position=np.zeros((4, 3)))
    assert name_other_side(given.replace(images=images), below) == ""
    assert name_other_side(given, nothing) == ""


def test_poor_start_values_are_not_taken_for_a_mirror_image():
    """The mirrored images fit better than a solution that went astray, but as given they fit as
    well from computed start values."""
    given, sigma0 = network(FREE, **CONTROL), iter((3.0, 2.9))
    assert name_mirrored(given, 1700.0, lambda network: next(sigma0), 5.0) == ""
    assert next(sigma0, None) is None


@pytest.mark.parametrize("corner", [(1, 1), (1, -1), (-1, 1), (-1, -1)])
def test_coordinates_from_a_corner_are_named_without_the_size_of_the_image(corner):
    camera = dataclasses.replace(MM, image_size=None, pixel_size=None)
    given = network().replace(cameras=(camera,))
    assert name_image_extent(given) == ""
    said = name_image_extent(with_xy(given, lambda xy: xy + corner * HALF))
    assert "counted from a corner?" in said


def test_control_in_mm_beside_start_values_in_m_is_named_where_nothing_is_solved():
    result = jaxbundle.adjust(with_control_at(network(FREE, **CONTROL), lambda X: 1000 * X))
    assert "is one of them in mm, the other in m?" in " ".join(result.findings)


def test_a_sigma_in_metres_for_mm_is_named():
    given = network(MM)
    sigma = np.full_like(given.observations.sigma, 2e-6)
    given = given.replace(observations=dataclasses.replace(given.observations, sigma=sigma))
    assert "2e-06 mm, looks like one in m" in name_sigma_unit(given, 900.0)
    unknown = given.replace(observations=dataclasses.replace(
        given.observations, sigma_origin="unit"
    ))  # fmt: skip
    assert name_sigma_unit(unknown, 900.0) == ""  # Nobody stated them.


# --- numbers beyond what can be computed with -------------------------------------------------


@pytest.mark.parametrize("change, said", [
    (lambda x: np.where(np.arange(x.size).reshape(x.shape) == 2, 1e300, x), "got 1e+300"),
    (lambda x: 1e150 * x, "expected X within"), (lambda x: x + 1e17, "subtract a common offset"),
    (lambda x: x + 1e20, "subtract a common offset"),
])  # fmt: skip
def test_numbers_that_cannot_be_computed_with_end_in_one_line(command, tmp_path, change, said):
    given = network(MM)
    images = dataclasses.replace(given.images, position=change(given.images.position))
    points = given.points
    if said != "got 1e+300":
        points = dataclasses.replace(points, position=change(points.position))
    path = jaxbundle.write_project(given.replace(images=images, points=points), tmp_path / "given")
    told = command("adjust", path, "--out", tmp_path / "out")
    assert told.status == 2 and said in told.err and not (tmp_path / "out").exists()
    assert len(told.err.strip().splitlines()) == 1


@pytest.mark.parametrize("omega, said", [(0.1, ""), (np.pi - 0.2, "4 photographs of 4 look up")])
def test_photographs_that_look_up_at_control_are_named(omega, said):
    images = np.zeros((4, 6))
    images[:, 3] = omega
    words = name_view_from_below(images)
    assert said in words and bool(words) == bool(said)
