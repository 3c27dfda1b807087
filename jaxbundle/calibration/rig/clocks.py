"""The clock of a camera that is not synchronised, with σ, and whether the motion determines it."""

import dataclasses

import numpy as np
from jaxtyping import Float

from jaxbundle.display import print_in_one_screen
from jaxbundle.network.kinds.continuous_time import CLOCK_PARAMETERS, OFFSET, RATE, READ_OUT


@print_in_one_screen
@dataclasses.dataclass(frozen=True)
class Clock:
    """The clock of a camera relative to that of the reference camera: common time = t + offset +
    rate·(t − middle) + read-out·line, `line` in heights of the image from its middle.

    **Fields:** `offset`, `rate`, `read_out` (s, without unit, s) and their `sigma` [3], a
    posteriori, 0 for what was not estimated; `middle` of its photographs, by its own clock, s;
    `frame`: from a photograph to the next, s; `estimated`: names of the unknowns; `held`: by name
    of an unknown that the motion does not determine, why: it has its start value.
    """

    offset: float
    rate: float
    read_out: float
    sigma: Float[np.ndarray, "3"]
    middle: float
    frame: float
    estimated: tuple[str, ...] = ()
    held: dict[str, str] = dataclasses.field(default_factory=dict)

    @property
    def values(self) -> dict[str, tuple[float, float]]:
        """Value and σ by name of the unknown."""
        return dict(
            zip(CLOCK_PARAMETERS, zip((self.offset, self.rate, self.read_out), self.sigma.tolist()))
        )

    def in_words(self) -> list[str]:
        """Every unknown with its σ; of one that is not determined, why."""
        scale = {OFFSET: (1e3, "ms"), RATE: (1e6, "ppm"), READ_OUT: (1e3, "ms")}
        sentences = []
        for name in self.estimated:
            factor, unit = scale[name]
            value, sigma = self.values[name]
            sentences.append(f"{name} {factor * value:.4f} ± {factor * sigma:.2g} {unit}")
        return [*sentences, *(f"{name} {why}" for name, why in self.held.items())]

    def to_dict(self) -> dict:
        """Values, σ and what is not determined as plain dicts and numbers."""
        return {
            **{name: {"value": v, "sigma": s} for name, (v, s) in self.values.items()},
            "middle": self.middle,
            "frame": self.frame,
            "estimated": list(self.estimated),
            "not_determined": dict(self.held),
        }
