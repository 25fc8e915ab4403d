"""Windows and feature arrays, for whole logs and sample by sample."""

from pathlib import Path

import terrain
from terrain.kernel_caches import discard_stale

discard_stale(Path(__file__).parent, Path(terrain.__file__).parent)
