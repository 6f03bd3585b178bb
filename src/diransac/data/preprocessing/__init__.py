"""Preparation of a log, one explicit step after another: every function takes a `Log` and gives a new one.

Each step adds one mapping to ``Log.history`` and, where it did something to the samples, a sentence to ``Log.notes``.
"""

from diransac.data.preprocessing.differentiation import acting_inputs, differentiate, filter_rows
from diransac.data.preprocessing.steps import (
    despike,
    hampel,
    rename,
    resample,
    running_deviation,
    scale,
    shift,
    unwrap,
)

__all__ = [
    "acting_inputs",
    "despike",
    "differentiate",
    "filter_rows",
    "hampel",
    "rename",
    "resample",
    "running_deviation",
    "scale",
    "shift",
    "unwrap",
]
