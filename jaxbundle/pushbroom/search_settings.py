"""Settings of ground → image: pieces, footprint, search, Newton's method."""

import dataclasses


@dataclasses.dataclass(frozen=True)
class SearchSettings:
    """How an image is prepared for `project_points`, and how points are found in it.

    Measured on a satellite that oscillates by 1e-4 to 2e-2 radians; "not critical" is what half
    and double do not change there.

    Pieces of the trajectory (`pieces`):

    - `piece_tolerance`: error of the polynomials, in lines and pixels. Half makes 1.1 to 1.4 times
      as many pieces, double 0.7 to 1 times.
    - `min_piece`: shortest piece, as a fraction of a line; a trajectory that needs shorter ones is
      refused. Not critical.
    - `equal_times`: rows of two tables closer than this fraction of a line count as one. Not
      critical.
    - `max_shared_pieces`: images with at most so many pieces are filled up to a common number, so
      that they share compiled programs. More than `search_times` would make the times of the search
      uneven.
    - `times_at_once`: batch of times at which poses are computed: one shape to compile.

    Footprint (`footprint`; lattice, speed, margin and error are not critical: images either advance
    steadily or turn back):

    - `with_footprint`: without one every point is searched for, which takes ten times as long and a
      third of the compilation: for a few hundred points of an image that keeps changing.
    - `footprint_heights`: lowest and highest height of points, metres, if the camera is more than
      twice as high: the Earth from the Dead Sea to Mount Everest.
    - `footprint_lattice`: times, pixels and heights of the lattice for cubic polynomials.
    - `min_relative_speed`: the slowest movement of the detector line over the ground, relative to
      the fastest: the margin to an image that turns back between the tested times.
    - `slope_margin`: the factor by which slopes beyond those of the lattice are tested.
    - `max_start_error`: error of the polynomials, in lines and pixels, from which Newton's method
      still converges.

    Search of the whole image (`passages`):

    - `search_times`: largest number of search steps; `fine_search_times`: without a footprint, when
      the camera may turn back.

    Newton's method (`newton`):

    - `steps_per_round`: steps with one matrix of derivatives; at least 2, as the decrease from one
      to the next tells whether a point has settled. More: steps that most points do not need.
    - `max_rounds`: rounds after which a point is given up. More: points without a position take
      longer; fewer: starts many pieces away are lost.
    - `position_tolerance`: error of settled positions, in lines and pixels: that of the pieces, as
      a better root of their polynomials is no better position.
    - `sight_tolerance`: largest movement, in lines, of a position since its corrections were
      computed: they change by less than 1e-4 of it.
    - `max_distance`: a position so many lines outside the image is given up. Larger: diverging
      points take longer; smaller: a start outside is not led back.
    - `piece_overlap`: a root at most so many lines beyond the end of its piece stays with it: many
      times the position tolerance, so that such a root settles in one of both pieces, and so little
      that the polynomials hold there.

    Points at once, on a processor and on an accelerator (`system.devices.batch_size`):

    - `points_at_once`: of Newton's method, 0.1 MB and 15 MB a step: the former stay in the cache.
    - `searched_at_once`: points that are searched for outside the footprint; `gathered_at_once`:
      points gathered for another round. Larger: batches are filled up with points that need
      neither; smaller: more batches.
    """

    piece_tolerance: float = 1e-7
    min_piece: float = 1e-3
    equal_times: float = 1e-6
    max_shared_pieces: int = 128
    times_at_once: int = 1024
    with_footprint: bool = True
    footprint_heights: tuple[float, float] = (-1000.0, 10_000.0)
    footprint_lattice: tuple[int, int, int] = (17, 9, 4)
    min_relative_speed: float = 0.1
    slope_margin: float = 1.2
    max_start_error: float = 50.0
    search_times: int = 128
    fine_search_times: int = 512
    steps_per_round: int = 2
    max_rounds: int = 8
    position_tolerance: float = 1e-7
    sight_tolerance: float = 1e-3
    max_distance: float = 1000.0
    piece_overlap: float = 1e-5
    points_at_once: tuple[int, int] = (2048, 1 << 18)
    searched_at_once: tuple[int, int] = (256, 1 << 14)
    gathered_at_once: tuple[int, int] = (64, 1 << 15)


DEFAULTS = SearchSettings()
