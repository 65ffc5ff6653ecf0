"""What an effect or a shape does to the tip, pose by pose: through the joints' angles, or to the tip itself."""

from __future__ import annotations

from typing import Protocol

from calib.arrays import Array


class Signature(Protocol):
    """C columns. `slope_rad` (c, m, n) moves joints, `slope_m` (c, m, 3) the tip in the base frame (None: not at all)."""

    @property
    def slope_rad(self) -> Array:
        """Per unit of each coefficient."""

    @property
    def slope_m(self) -> Array | None:
        """Per unit of each coefficient."""
