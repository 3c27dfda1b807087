"""The settings of planning: how observations are laid out, and how the reduced system is solved."""

import dataclasses


@dataclasses.dataclass(frozen=True)
class PlanningSettings:
    """Sizes at which a plan changes its form. Results do not depend on them, apart from the order
    of sums; time, memory and compilation do. `python benchmarks/constants.py` measures them.

    **Observations** of a part are computed in chunks that touch the same kept rows:

    - `chunk_lengths`: allowed lengths, the longest that fits is used.
    - `max_padding`: a length fits if it pads the part by at most this fraction.
    - `small_part`: parts with fewer observations have chunks of length one.

    **Pairs** of incidences are summed in chunks of one block of the reduced matrix:

    - `pair_chunk_lengths`: lengths in turn, the last one padded.
    - `few_pairs`: lists of fewer pairs have chunks of one length, `few_pairs_chunk_length`.

    **Programs** are shared by problems of similar sizes:

    - `masked_below`: with fewer eliminated rows some may be held by the same program, as in data
      snooping; with more, whether all are free is compiled in.
    - `exact_sizes_from`: problems with more observations are compiled for their exact sizes, the
      others for sizes rounded up (`indices.round_up`).

    **The reduced system** is solved in the way with the fewest operations (`reduction.py`):

    - `always_dense_below`: systems of fewer unknowns are solved densely.
    - `required_gain`: another way than the dense one must save this factor of operations.
    - `max_factor_elements`: larger factors are not formed (2 GB of double precision).
    - `max_pairs`: systems with more pairs of incidences are solved iteratively; the list of pairs
      takes 8 bytes for each, and planning sorts it.
    - `conjugate_gradient_steps`, `conjugate_gradient_work`: passes over all observations, and cost
      per observation and pass in operations of a factorisation.
    - `min_super_block`: least unknowns of a super-block of a banded system.
    """

    # BAL 16, pairs in chunks of 64 and 8, or of 32: 15 to 17 ms; of 256, 32 and 4: 14. The second
    # to last is at most 100 long, where transposing on the fly pays (`elimination.sum_pairs`).
    pair_chunk_lengths: tuple[int, ...] = (256, 64, 12)
    # A program for each length is compiled: one length takes a third of the time.
    few_pairs: int = 50_000
    few_pairs_chunk_length: int = 8
    # BAL 16: sums by image in one long `segment_sum` took 66 ms an iteration, in chunks 45. Half of
    # the lengths take the same time, double up to a tenth more; half or double of the padding the
    # same.
    chunk_lengths: tuple[int, ...] = (256, 64, 16)
    max_padding: float = 0.1
    # Below, the program without chunks compiles in a tenth of the time, which saves more than
    # chunks do.
    small_part: int = 2000
    # Compiling takes seconds; the mask of 22 106 points costs nothing that can be measured (BAL 16:
    # 100 ms an evaluation with and without, alternating).
    masked_below: int = 100_000
    # Rounding pads by up to an eighth: less than the compilation that it saves a small problem; of
    # a large one an eighth of every iteration.
    exact_sizes_from: int = 200_000
    # n³/3 operations of 1000 unknowns take 0.02 s on a core, less than compiling another way.
    always_dense_below: int = 1000
    # One large factorisation runs faster than many small blocks, so that a small saving of
    # operations is a loss. Milliseconds an iteration dense, banded, by conjugate gradients: street
    # of 200 images 109, 64, 71; arc of 60 images 40, 80, 58.
    required_gain: float = 3.0
    max_factor_elements: float = 2e9 / 8
    max_pairs: float = 3e8
    # Some tens of steps reach a hundredth of the right-hand side. Half or double of either moves
    # the change from one way to the other, where their times differ little.
    conjugate_gradient_steps: int = 40
    conjugate_gradient_work: float = 600.0
    # With fewer unknowns the overhead of the loop over super-blocks dominates.
    min_super_block: int = 32


PLANNING = PlanningSettings()
