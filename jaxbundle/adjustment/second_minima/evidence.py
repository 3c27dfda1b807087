r"""Two minima of one adjustment: when the observations cannot choose between them.

Of two solutions that are no special case of one another (Cox, 1961) with vᵀPv of Ω₁ ≤ Ω₂ the
observations choose by the ratio of their likelihoods; with normal errors

    E = −2·ln(L₂/L₁) = (Ω₂ − Ω₁)/s²,            s² = max(1, σ0²)         with stated σ
    E = r·ln(Ω₂/Ω₁)                             r: redundancy            with σ as units of weight

(the second: for an unknown variance the likelihood is its maximum, ∝ Ω^(−r/2)). Residuals below
their stated σ are chance: s² is not below 1. The first one is chosen wrongly with a probability of
at most α if it is only accepted with (Wald, 1945, equation 3.16)

    L₁/L₂ ≥ (1 − α)/α,        E ≥ T = 2·ln((1 − α)/α)                     α = 0.1 %: T = 13.8

Below this both remain: they are ambiguous. As probabilities, neither preferred before, the second
one has 1/(1 + exp(E/2)). This assumes that vᵀPv is curved alike at both (the determinants of the
normal equations of a solution and of its mirror image differ little).
"""

import dataclasses
import math

from jaxbundle.leastsquares.quality.distributions import normal_quantile
from jaxbundle.network.columns import list_some

TURNED = "planar object turned over"
OTHER_POSE = "another pose of the image"
REVERSED = "depth reversed"
MIRRORED = "mirrored behind the cameras"
OTHER_PLANE = "two orientations of a plane"


@dataclasses.dataclass(frozen=True)
class SecondMinimum:
    """Another minimum of an adjustment.

    `ambiguity`: which one (one of the constants above); `images`: ids of those that differ; `vtpv`:
    of the result, `other_vtpv`: of the other minimum; `evidence`: E of the module, for the result;
    `ambiguous`: E is below the threshold; `taken`: the iterations ended in the other one first, and
    the result was found from it; `turn` (radians), `shift` (object unit): the largest differences
    of rotations and projection centres.
    """

    ambiguity: str
    images: tuple[str, ...]
    vtpv: float
    other_vtpv: float
    evidence: float
    ambiguous: bool
    taken: bool
    turn: float
    shift: float

    @property
    def difference(self) -> float:
        """vᵀPv of the other minimum less that of the result."""
        return self.other_vtpv - self.vtpv

    @property
    def probability(self) -> float:
        """That the other minimum is the true one, if one of them is and neither was preferred."""
        return 1 / (1 + math.exp(min(max(self.evidence, 0.0) / 2, 700.0)))

    def in_words(self, unit: str) -> str:
        """A sentence; `unit` of object coordinates."""
        subject = f"{self.ambiguity} ({list_some(self.images, 5, str)})"
        both_fits = f"vᵀPv {self.vtpv:.6g}, of the other {self.other_vtpv:.6g}"
        difference = (
            f"rotations differ by up to {math.degrees(self.turn):.3g}°, projection centres by "
            f"{self.shift:.3g} {unit}"
        )
        if self.ambiguous:
            begin = "the iterations ended in the other one, " if self.taken else ""
            return (
                f"{subject}: {begin}both fit, {both_fits} (the other with a probability of "
                f"{100 * self.probability:.2g} %); {difference}"
            )
        return (
            f"{subject}: the iterations ended in the other one; the better one is taken, "
            f"{both_fits}; {difference}"
        )


@dataclasses.dataclass(frozen=True)
class SecondMinimumSettings:
    """Where second minima are looked for, and when they count.

    - `error_probability`: α of the module; that of the tests of the verdict. Larger: fewer are
      ambiguous, and more of those that are not reported are the true ones.
    - `min_turning_share`: of the effect of perspective that remains in the second minimum of a
      plane. With the cost A·(τ² − θ²)²/4 + B·(τ − θ)² of its tilt τ, true θ, (foreshortening, even
      in τ, and perspective, odd) the second minimum is between −θ and −θ/2, where it vanishes:
      at least (3/4)² of the effect 4·B·θ² at −θ remains.
    - `min_reversed_share`: the same of a network whose points are free, and absorb more; also for
      the other plane of two images. In networks of 2 to 5 images, flat or not, at distances of 5 to
      500 times the size of the object, 0.0005 (two images) to 0.4 remained, and at least 0.05 of
      three images and more. Larger: second minima of two images are missed; smaller: networks that
      have none are adjusted again for nothing.
    - `few_points`: images of no more points are tried whatever their perspective. Four points keep
      four coordinates beside shift, scale and roll, and the tilt may absorb nearly all of them: of
      5000 random images one had E = 2 with an effect of 1000, and four points. Larger: more images
      are resected for nothing.
    - `safety`: by which both shares are divided, for what these orders of the effect leave out; and
      by which the threshold is multiplied for resections, in which points and cameras are held.
    - `max_misfit`: an image whose residuals exceed this many σ (RMS) is also resected in closed
      form, whatever its perspective: a wrong pose, not a wrong σ (`likely_causes`, `max_sigma0`).
    - `evaluations_before_rejection`: from an analytic start value, which is right to the square of
      the effect of perspective, a second minimum that counts is nearly reached in three. What is
      then still above `early_limit` times the limit is rejected. Smaller: slowly converging ones
      are missed.
    - `early_limit`: an order of magnitude, since vᵀPv still falls.
    - `max_images`: of images alone, this many of the least evidence are adjusted again, and this
      many of the worst resected in closed form.
    - `max_runs`: a second minimum of two images may lie in the valley of their bas-relief, along
      which iterations are slow: they are continued up to this many times, each time up to the limit
      of iterations.
    - `max_rounds`: how often a better minimum may take the place of the result.
    """

    error_probability: float = 0.001
    early_limit: float = 10.0
    min_turning_share: float = 9 / 16
    min_reversed_share: float = 0.01
    few_points: int = 5
    safety: float = 4.0
    max_misfit: float = 5.0
    evaluations_before_rejection: int = 6
    max_images: int = 8
    max_runs: int = 5
    max_rounds: int = 3

    @property
    def threshold(self) -> float:
        """T of the module."""
        return 2 * math.log((1 - self.error_probability) / self.error_probability)

    @property
    def limit(self) -> float:
        """An effect d² = Σ(δ/σ)² above which noise hardly brings E below the threshold T.

        E = d² + 2·d·x, x standard normal. With z, which x exceeds with the error probability, E is
        below T with that probability if d² − 2·d·z = T: d = z + √(z² + T)."""
        z = normal_quantile(1 - self.error_probability)
        return (z + math.sqrt(z * z + self.threshold)) ** 2


SECOND_MINIMUM = SecondMinimumSettings()


def evidence(
    vtpv: float, other_vtpv: float, redundancy: int, stated: bool, rounding: float
) -> float:
    """E of the module; `rounding`: the vᵀPv that rounding leaves of exact data."""
    if redundancy <= 0 or abs(other_vtpv - vtpv) <= rounding:
        return 0.0
    if stated:
        return (other_vtpv - vtpv) / max(1.0, vtpv / redundancy)
    return redundancy * math.log((other_vtpv + rounding) / (vtpv + rounding))
