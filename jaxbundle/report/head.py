"""The head of a report: input, method, termination, σ0.

σ0 has no unit: it is the factor between the a priori and the a posteriori standard deviations. The
precision of an image coordinate is σ0 times its a priori σ, in the unit of the image.
"""

import textwrap
from collections import Counter
from collections.abc import Iterable
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from jaxbundle.leastsquares.iterations.stopping import LIMIT, NOT_FINITE, SINGULAR, STUCK
from jaxbundle.leastsquares.quality.global_test import describe_test
from jaxbundle.network.blunders import Removed, removed_rays
from jaxbundle.network.columns import count, list_some
from jaxbundle.network.datum_words import open_directions_in_words
from jaxbundle.network.tables import ESTIMATED, ROLES, STATED, UNIT
from jaxbundle.report import correlated
from jaxbundle.report.layout import (
    WIDTH,
    clean,
    cut_lines,
    facts,
    fixed,
    heading,
    paragraph,
    significant,
    table,
)
from jaxbundle.report.lens_advice import FEWER_PARAMETERS
from jaxbundle.report.rig_scale import scale_of_rigs
from jaxbundle.types import not_none

if TYPE_CHECKING:
    from jaxbundle.adjustment.problem import NetworkProblem
    from jaxbundle.adjustment.result import Adjustment
    from jaxbundle.report.verdict import Verdict

METHODS = {
    "levenberg-marquardt": "least squares by Levenberg–Marquardt steps, points eliminated (Schur)",
    "gauss-newton": "least squares by Gauss–Newton steps, points eliminated (Schur)",
}
REDUCTIONS = {
    "dense": "dense Cholesky factor",
    "banded": "Cholesky factor of blocks along a band",
    "iterative": "conjugate gradients",
}
# How the σ of image coordinates are called by their origin.
KINDS = {
    STATED: "σ a priori",
    UNIT: "unit of weight",
    ESTIMATED: "σ estimated",
}
DOMAINS = {
    "corrected": "corrected: the measurement freed of distortion against the ideal image",
    "measured": "measured: the distorted image of the point against the raw measurement",
}
NO_RESULT = "The adjustment did not converge. It has no result, and none is shown."
ADVICE = {
    LIMIT: "Allow more iterations (--max-iterations), or give better start values.",
    SINGULAR: "Measure what determines them, give them a prior σ, or hold them.",
    STUCK: "Give better start values, and look for gross errors in observations and point names.",
    NOT_FINITE: "Give better start values: some points are behind their cameras or in their "
    "plane, or outside the range of the distortion.",
}

LARGER_SIGMA = (
    "For cameras, images and points, the larger of the classical standard deviation and that under "
    "correlated errors is shown: see Correlated errors for both."
)
# What determines the unknowns of each table.
ADVICE_FOR = {
    "camera": FEWER_PARAMETERS,
    "image": "An image needs three or more well spread points whose coordinates are determined.",
    "point": "A point needs rays from two directions or more.",
}


def title(adjustment: "Adjustment", date: str | None) -> list[str]:
    """Name of the program, its version, the date, and the network."""
    from jaxbundle import __version__

    program = f"jaxbundle {__version__}: bundle adjustment"
    right = clean(date or "")
    first_line = f"{program}{right:>{max(WIDTH - len(program), len(right) + 2)}}".rstrip()
    return [first_line, "=" * WIDTH, *paragraph(clean(adjustment.network.name) or "network")]


def settings(adjustment: "Adjustment", verdict: "Verdict | None" = None) -> list[str]:
    """What to know first; method, datum, domain of the residuals, units."""
    rows = first_facts(adjustment, verdict)
    if adjustment.converged:
        rows.append(("RMS residual", image_residuals_in_words(adjustment)))
    return ["", *facts([*rows, *setting_facts(adjustment)])]


def first_facts(
    adjustment: "Adjustment", verdict: "Verdict | None" = None
) -> list[tuple[str, str]]:
    """The verdict with its reasons, likely causes of a bad fit, and how much was left out."""
    rows = []
    if adjustment.converged:
        _, words, findings = verdict or adjustment.verdict
        rows = [("Verdict", words), *((f.about, f.words) for f in findings if f.lowers)]
        facts_said = {about for about, _ in rows}
        rows += [row for row in correlated.first_facts(adjustment) if row[0] not in facts_said]
    rows += [("Attention", clean(text)) for text in adjustment.findings]
    left_out = left_out_in_words(adjustment)
    facts_said = [f"{left_out}: see Notes, and left_out in the JSON"] if left_out else []
    if removals := adjustment.removed:
        rays = len(removed_rays(removals))
        others = count_removed(removals) - rays
        numbers = ((rays, "image point"), (others, "other observation"))
        words = ", ".join(count(n, noun) for n, noun in numbers if n)
        if excluded := int(adjustment.problem.excluded.sum()):
            words += f" and with them {count(excluded, 'object point')}"
        facts_said.append(f'{words} by data snooping: see Data snooping, and "removed" in the JSON')
    return [*rows, ("Left out", "; ".join(facts_said))] if facts_said else rows


def count_removed(removals: Iterable[Removed]) -> int:
    """The number of observations that were removed, inseparable ones among them."""
    return sum(len(item.rows) for item in removals)


def left_out_in_words(adjustment: "Adjustment") -> str:
    """The numbers of things left out, by kind."""
    number: dict[str, int] = {}
    for note in adjustment.problem.network.left_out:
        number[note.thing] = number.get(note.thing, 0) + len(note.names)
    return ", ".join(count(n, thing) for thing, n in number.items())


def setting_facts(adjustment: "Adjustment") -> list[tuple[str, str]]:
    """The settings by name, in words."""
    network = adjustment.network
    return [
        ("Method", METHODS.get(adjustment.method) or adjustment.method),
        ("Reduced system", reduced_system(adjustment)),
        ("Datum", datum(adjustment)),
        ("Residuals", f"v = computed − observed, {DOMAINS[network.residuals]}"),
        (
            "Units",
            f"object {clean(network.object_unit)}, image {adjustment.image_unit}, "
            f"angles {network.angle_unit}",
        ),
    ]


def reduced_system(adjustment: "Adjustment") -> str:
    """The size of the reduced system of images and cameras, and its solver."""
    plan = adjustment.problem.plan
    how = REDUCTIONS[adjustment.reduction]
    if adjustment.reduction == "banded":
        how += f" of {not_none(plan.band).width} unknowns"
    return f"{adjustment.problem.reduced_size} unknowns, {how}"


def datum(adjustment: "Adjustment") -> str:
    """The datum of the coordinates, and the freedoms left open by the observations."""
    problem, network = adjustment.problem, adjustment.problem.network
    defect = adjustment.counts.datum
    if not defect:
        counted = [
            (int(network.points.has_role("control").sum()), "control point", ""),
            (int(network.points.has_role("fixed").sum()), "fixed point", ""),
            (
                len(problem.data.measured.get("exterior", ())),
                "image",
                " with a prior exterior orientation",
            ),
            (int((problem.table("image").free == 0).any(1).sum()), "image", " held"),
            (len(network.distances), "distance", ""),
        ]
        parts = [count(*part) for part in counted if part[0]]
        return f"{network.datum}; defect 0: given by {', '.join(parts)}"
    open_ones = f"defect {defect}: the observations leave open {open_datum(adjustment)}"
    weight = np.asarray(not_none(problem.plan.datum).weight["point"])[: len(network.points)] > 0
    ids = network.points.id
    if network.datum == "minimal":
        held_coordinates = [f"{'XYZ'[i]} of {clean(ids[p])}" for p, i in zip(*np.nonzero(weight))]
        how = f"these coordinates keep their start values: {', '.join(held_coordinates)}"
    else:
        how = (
            f"inner constraints on {count(int(weight.any(1).sum()), 'datum point')}, whose start "
            "values fix it (smallest sum of their variances)"
        )
    scale = scale_of_rigs(adjustment)
    return (
        f"{network.datum}; {open_ones}; {how}. {scale}{'. ' if scale else ''}Coordinates, exterior "
        "orientation and their σ refer to this datum; residuals, σ0 and cameras do not depend on "
        "it."
    )


def open_datum(adjustment: "Adjustment") -> str:
    """What the observations leave open of position, orientation and scale; empty: nothing."""
    network, defect = adjustment.problem.network, adjustment.counts.datum
    if defect in (0, 7):
        return "position, orientation and scale" if defect else ""
    # The directions are told about these points, which a rotation about them leaves.
    is_known = network.points.has_role("control", "fixed")
    about = (network.points.position[is_known] - adjustment.problem.origin).sum(0)
    gauge = np.asarray(not_none(adjustment.problem.plan.datum).gauge)
    words = open_directions_in_words(gauge, about / max(is_known.sum(), 1))
    return "position and orientation" if defect == 6 and "scale" not in words else words


def counts(adjustment: "Adjustment") -> list[str]:
    """Counts of observations and unknowns, and the redundancy."""
    return [*heading("Counts"), *table(("", "", ""), count_rows(adjustment), "lrl")[1:]]


def count_rows(adjustment: "Adjustment") -> list[tuple[str, str, str]]:
    """Label, count, and its parts."""
    network, n = adjustment.problem.network, adjustment.counts
    is_included = ~adjustment.problem.excluded
    roles = [(role, int((network.points.has_role(role) & is_included).sum())) for role in ROLES]
    kinds = [
        ("coordinates of control points", n.control),
        ("exterior orientation", n.exterior),
        ("interior orientation", n.interior),
        ("distances", n.distances),
        *_count_further(adjustment.problem).items(),
    ]
    free = lambda table: int(adjustment.problem.table(table).free.sum())
    groups = [
        ("exterior orientation", free("image")),
        ("interior orientation", sum(free(t.name) for t in adjustment.problem.cameras)),
        ("object coordinates", free("point")),
    ]
    number_used = int(adjustment.problem.used.sum())
    points = count_points(adjustment)
    excluded = len(network.points) - points
    rows = [
        ("Cameras", len(network.cameras), ""),
        ("Images", len(network.images), ""),
        ("Points", points, _list(roles) + (f"; {excluded} more excluded" if excluded else "")),
        ("Image points", number_used, ""),
        ("Observations", n.observations, "image coordinates"),
        ("Pseudo-observations", n.pseudo_observations, _list(kinds)),
        ("Datum conditions", n.datum, ""),
        ("Unknowns", n.unknowns, _list(groups)),
        ("Redundancy", n.redundancy, "observations + pseudo-observations + conditions − unknowns"),
    ]
    # What the columns of names and numbers, two blanks behind each, leave of a line.
    width = WIDTH - 4 - sum(max(len(str(row[k])) for row in rows) for k in (0, 1))
    lines = []
    for name, n, detail in rows:
        first_part, *other_parts = textwrap.wrap(detail, width) or [""]
        lines += [(name, str(n), first_part), *(("", "", part) for part in other_parts)]
    return lines


def _count_further(problem: "NetworkProblem") -> Counter[str]:
    """The residuals with weight of further kinds."""
    number_of_kind: Counter[str] = Counter()
    for name in problem.further_sets:
        number_of_kind[problem.observations_of(name).kind.name] += int(
            (problem.weights(name) > 0).sum()
        )
    return number_of_kind


def count_points(adjustment: "Adjustment") -> int:
    """The number of points without those that data snooping excluded: these have no coordinates."""
    return int((~adjustment.problem.excluded).sum())


def _list(groups: Iterable[tuple[str, int]]) -> str:
    """Names with their non-zero counts."""
    return ", ".join(f"{name} {n}" for name, n in groups if n)


def convergence(adjustment: "Adjustment") -> list[str]:
    """One row per evaluation; a rejected step would have increased vᵀPv."""
    vtpv, damping, is_accepted = evaluations(adjustment)
    steps_tried = len(vtpv)
    rows = [
        (
            "start" if i == 0 else str(i),
            f"{vtpv[i]:.5e}" if np.isfinite(vtpv[i]) else "not finite",
            "–" if i == 0 else f"{damping[i]:.1e}" if damping[i] else "0",
            "" if i == 0 else "accepted" if is_accepted[i] else "rejected",
        )
        for i in range(steps_tried)
    ]
    # A page of lines: the beginning and the end tell how it went.
    if len(rows) > 45:
        rows = [*rows[:20], ("…", "", "", ""), *rows[-20:]]
    lines = [
        *heading("Convergence"),
        *table(("iteration", "vᵀPv", "λ (damping)", "step"), rows, "rrrl"),
        "",
        *paragraph(
            f"Ended after {count(adjustment.iterations, 'iteration')}, {adjustment.termination}."
        ),
    ]
    if is_last_of_several(adjustment):
        lines += paragraph(
            "This is the last of several adjustments, each started from the result of the previous "
            "one, after observations or parameters were removed or σ estimated (see below)."
        )
    return lines


def is_last_of_several(adjustment: "Adjustment") -> bool:
    """Whether others came before, without removals or with other weights."""
    return bool(adjustment.removed or adjustment.eliminated or adjustment.sigma_factors)


def evaluations(adjustment: "Adjustment") -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """vᵀPv, damping, and whether the step was accepted, of the start and every step tried."""
    steps_tried, history = int(adjustment.minimum.iterations), adjustment.minimum.history
    columns = (history.cost, history.damping, history.accepted)
    cost, damping, is_accepted = (np.asarray(column)[:steps_tried] for column in columns)
    return 2 * cost, damping, is_accepted


def image_sigmas(adjustment: "Adjustment") -> np.ndarray:
    """The distinct a priori σ of the image coordinates, ascending."""
    weight = adjustment.problem.image_weights
    # Weights are 1/σ: σ that were equal in the file differ in the last digits on the way back.
    return np.unique(np.round(1 / weight[weight > 0], 12))


def image_precision(adjustment: "Adjustment") -> str:
    """σ0 times the a priori σ of image coordinates, in their unit, in µm and in pixels."""
    sigma, unit = image_sigmas(adjustment), adjustment.image_unit
    if not len(sigma) or not np.isfinite(adjustment.sigma0):
        return "–"
    # The smallest and the largest stand for all; a few may be far from the others.
    ends, median = sigma[[0, -1]], ""
    if len(sigma) > 2:
        weight = adjustment.problem.image_weights
        middle = adjustment.sigma0 / np.median(weight[weight > 0])
        median = f", median {significant(middle, 3)} {unit}"
    a_priori = f"{KINDS[adjustment.sigma_origin]} {span(ends, 4)} {unit}"
    return f"{_in_units(adjustment, adjustment.sigma0 * ends)}{median}  (σ0 × {a_priori})"


def image_residuals_in_words(adjustment: "Adjustment") -> str:
    """The RMS of the residuals of image coordinates."""
    rms = adjustment.image_rms
    if not np.isfinite(rms):
        return "–"
    return f"{_in_units(adjustment, np.array([rms]), 3)} of an image coordinate"


def _in_units(adjustment: "Adjustment", lengths: Float[np.ndarray, " n"], digits: int = 5) -> str:
    """Lengths in images, from the smallest to the largest, in their unit; readers know the
    precision of a camera in µm and in pixels."""
    unit = adjustment.image_unit
    parts = [f"{span(lengths, digits)} {unit}"]
    if unit == "mm":
        parts.insert(0, f"{span(1e3 * lengths, digits)} µm")
        pitch = {camera.pixel_size for camera in adjustment.problem.network.cameras}
        if len(pitch) == 1 and None not in pitch:
            size = abs(not_none(next(iter(pitch)))[0])
            parts.append(f"{span(lengths / size, 3)} px")
    return " = ".join(parts)


def unit_of_weight(adjustment: "Adjustment") -> str:
    """The σ of image coordinates with their unit, as a unit of weight."""
    ends = dict.fromkeys(f"{sigma:.4g}" for sigma in image_sigmas(adjustment)[[0, -1]])
    return f"{' to '.join(ends)} {adjustment.image_unit}"


def span(values: Iterable[float], digits: int = 5) -> str:
    """From the smallest to the largest; one number if they are equal to these digits."""
    return " to ".join(dict.fromkeys(significant(value, digits) for value in values))


def chi_squared(adjustment: "Adjustment", level: float = 0.05) -> str:
    """The global test in words."""
    test = adjustment.global_test(level)
    is_failed = test["passed"] is False and test["vtpv"] > test["high"]
    shared = correlated.has_shared_errors(adjustment)
    words = describe_test(test, unit_of_weight(adjustment), level, shared)
    return f"{words}, see Warnings" if is_failed and adjustment.doubts else words


def variance_factor(adjustment: "Adjustment") -> list[str]:
    """σ0, what it means in the image, and the global test."""
    text = (
        "All standard deviations below are a posteriori, σ0 × those from the a priori weights, "
        "unless called a priori."
    )
    if adjustment.error_model is not None:
        text += f" {LARGER_SIGMA}"
    if adjustment.sigma_factors:
        text += (
            "  The a priori σ of the groups of observations are the estimated ones:  "
            "see Variance components."
        )
    return [*heading("Variance factor"), *facts(variance_facts(adjustment)), "", *paragraph(text)]


def variance_facts(adjustment: "Adjustment") -> list[tuple[str, str]]:
    """vᵀPv, redundancy, σ0, the precision of an image coordinate, the global test."""
    return [
        ("vᵀPv", significant(adjustment.vtpv, 6)),
        ("Redundancy", str(adjustment.redundancy)),
        ("σ0", f"{significant(adjustment.sigma0, 6)}  √(vᵀPv/redundancy), dimensionless"),
        ("Image coordinate", image_precision(adjustment)),
        ("χ² test", chi_squared(adjustment)),
    ]


def messages(adjustment: "Adjustment") -> list[str]:
    """Warnings: suspicious data; and notes, such as of what was left out."""
    lines_of_messages = []
    for title, texts in (("Warnings", warnings(adjustment)), ("Notes", adjustment.notes)):
        lines = [line for text in texts for line in paragraph(f"- {clean(text)}", 0, 2)]
        lines_of_messages += [*heading(title), *cut_lines(lines, 60, "…")] if lines else []
    return lines_of_messages


def warnings(adjustment: "Adjustment") -> tuple[str, ...]:
    """The warnings, without the causes that `failure_facts` gives."""
    causes_told = () if adjustment.converged else adjustment.findings
    return tuple(text for text in adjustment.warnings if text not in causes_told)


def why_not_solved(adjustment: "Adjustment") -> list[str]:
    """The reason why there is no result, undetermined unknowns, remedy."""
    return [*heading("Not solved"), *paragraph(NO_RESULT), "", *facts(failure_facts(adjustment))]


def failure_facts(adjustment: "Adjustment") -> list[tuple[str, str]]:
    """The reason why there is no result, its likely causes, undetermined unknowns, remedy, by
    name."""
    names, causes = adjustment.undetermined, adjustment.findings
    reason = SINGULAR if names else int(adjustment.minimum.termination)
    steps_tried = int(adjustment.minimum.iterations)
    steps_taken = int(np.asarray(adjustment.minimum.history.accepted)[1:steps_tried].sum())
    rows = [
        ("Why", adjustment.termination),
        *(("", clean(cause)) for cause in causes),
        ("Iterations", f"{adjustment.iterations}, of which {steps_taken} were steps taken"),
    ]
    if names:
        rows.append(("Not determined", list_some(names, 40, clean)))
    elif adjustment.weakness.unknowns:
        rows.append(("Hardly determined", list_some(adjustment.weakness.unknowns, 40, clean)))
    # A cause says what to do itself; the general advice may contradict it.
    advice = [] if causes and not names else [ADVICE.get(reason, ADVICE[STUCK])]
    if reason == LIMIT and steps_taken < steps_tried / 2:
        advice.append("Most steps were rejected: hold parameters that the images hardly determine.")
    advice += [text for kind, text in ADVICE_FOR.items() if any(f" of {kind} " in n for n in names)]
    rows += [("What to do" if i == 0 else "", text) for i, text in enumerate(advice)]
    return rows


def result_in_words(adjustment: "Adjustment") -> str:
    """Converged or not, in one line."""
    if adjustment.converged:
        several = ", the last of several adjustments" if is_last_of_several(adjustment) else ""
        return f"converged after {count(adjustment.iterations, 'iteration')}{several}"
    return f"NOT converged: {adjustment.termination}"


def redundancy_in_words(adjustment: "Adjustment") -> str:
    """The sum that gives the redundancy."""
    n = adjustment.counts
    return (
        f"{n.redundancy} = {n.observations} observations + {n.pseudo_observations} "
        f"pseudo-observations + {n.datum} datum conditions − {n.unknowns} unknowns"
    )


def sigma0_in_words(adjustment: "Adjustment") -> str:
    """σ0 to five digits, a dash without redundancy."""
    s0 = adjustment.sigma0
    return fixed(s0, 5) if 0.1 <= s0 < 1e3 else significant(s0, 5)
