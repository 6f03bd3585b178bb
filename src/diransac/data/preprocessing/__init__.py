"""Preparation of a log, one explicit step after another: every function takes a `Log` and gives a new one.

Each step adds one mapping to ``Log.history`` and, where it did something to the samples, a sentence to ``Log.notes``.
"""

from diransac.data.preprocessing.differentiation import acting_inputs, differentiate, filter_rows
from diransac.data.preprocessing.steps import despike, rename, resample, scale, shift, spikes, unwrap

__all__ = [
    "acting_inputs",
    "despike",
    "differentiate",
    "filter_rows",
    "rename",
    "resample",
    "scale",
    "shift",
    "spikes",
    "unwrap",
]
