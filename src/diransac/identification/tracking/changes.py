"""Changes of the parameters while a machine runs."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from diransac.arrays import FloatArray

if TYPE_CHECKING:
    from diransac.identification.tracking.estimates import Change
    from diransac.identification.tracking.setup import Setup
    from diransac.identification.tracking.window import Linearization, Window

__all__ = ["Changes"]


class Changes:
    """Tests of steps and drifts of the parameters."""

    def __init__(self, setup: Setup, step: float, false_alarms_per_hour: float, drift: Mapping[str, float]) -> None:
        self.setup = setup

    def before_step(self, window: Window) -> None:
        """Let parameters drift."""

    def after_step(self, window: Window, found: Linearization) -> None:
        """Test for steps."""

    def covariance(self, window: Window) -> FloatArray:
        """Covariance of the parameters at the end of the window."""
        assert window.last is not None
        return window.last.solved.var_p

    def taken(self) -> tuple[Change, ...]:
        """Changes since the last call."""
        return ()
