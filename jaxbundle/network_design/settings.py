"""Settings of the search for a design."""

import dataclasses


@dataclasses.dataclass(frozen=True)
class DesignSettings:
    """How configurations are searched for.

    - `softness`: of the conditions of rays, by round of the search, each above 0: at 0.3 a target a
      third of half the format outside still has a quarter of its visibility, and so a gradient; at
      0.03 the edge is sharp to a tenth. More rounds cost iterations; fewer leave targets outside.
    - `smallest_change`: of the logarithm of the aim, that ends a round; 1e-4 is 0.01 % of σ, which
      no plan is realised to.
    - `initial_roll`: σ of the random roll of cameras at the start, radians. Zero is often a saddle
      point, since the aim of a symmetrical network is even in the roll; any value beside it serves.
    - `edge_sharpness`: edges of obstacles, for projection centres, are rounded to this part of
      their half size (20: a twentieth), since a box has no gradient at its edges. Larger: sharper,
      and a station may get stuck at an edge; smaller: it keeps farther away than needed.
    - `candidates`: positions tried for a further photograph, from 1, and
    - `refined`: the number of the best that are refined, up to `candidates`. Both cost time in
      proportion, and more find a better place.
    - `candidate_softness`: of the conditions when candidates are compared: soft enough that
      positions from which targets are nearly visible count.
    - `max_exchanges`: of photographs in a selection, until it is as good as any exchange of two
      makes it; usually a few.
    """

    softness: tuple[float, ...] = (0.3, 0.1, 0.03)
    smallest_change: float = 1e-4
    initial_roll: float = 0.1
    edge_sharpness: float = 20.0
    candidates: int = 48
    refined: int = 2
    candidate_softness: float = 0.1
    max_exchanges: int = 50


DEFAULTS = DesignSettings()
