"""The networks of the adjustment's tests serve here too."""

import sys
from pathlib import Path

sys.path.append(str(Path(__file__).parent.parent / "adjustment"))
