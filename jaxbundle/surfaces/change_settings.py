"""How changes between surfaces are found."""

import dataclasses


@dataclasses.dataclass(frozen=True)
class ChangeSettings:
    """How changes are found."""

    reach: int = 15
    """Cells up to which errors are correlated at most. Twice the windows of dense matching (15
    pixels) divided by two pixels a cell."""
    least_cells: int = 9
    """Cells of the smallest region of significant ones that is listed: 3 × 3."""
    most_regions: int = 50
    """Regions that are listed, the largest volumes first."""
    reweightings: int = 4
    """Rounds in which shared errors are estimated again from cells that have not changed. With a
    tenth of the area raised by five σ the scatter, 1 in truth, is 1.22 without; 1.12, 1.06, 1.04,
    and after four rounds 1.03."""
    enlarge_sigma: bool = True
    """Whether the given σ of cells are multiplied by their scatter, if that is above 1."""
    tile_numbers: int = 1 << 25
    """Numbers of a tile in memory, 8 bytes each: 256 MB. A cell has about sixteen, and four for
    each error that cells share. Smaller tiles read more cells twice, at their edges."""
    sampled_tiles: int = 16
    """Tiles of which ρ and the scatter of the cells are estimated, evenly spread: of a million
    cells each, of which some ten thousand are independent even with the longest ρ."""


DEFAULTS = ChangeSettings()
