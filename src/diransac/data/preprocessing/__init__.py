"""Preparation of a log in explicit steps: functions from a `Log` to a new `Log`.

Each step adds one mapping to ``Log.history`` and, where it changes samples, a sentence to ``Log.notes``.

| file | contents |
|---|---|
| `steps.py` | names, factors, rates, delays |
| `differentiation.py` | velocities and accelerations, and rows filtered against their noise |
| `spikes.py` | `despike`, by running medians |
| `continuity.py` | angles without wraps, quaternions without changes of sign |
| `degrees.py` | columns of joints in degrees that do not say so |
| `wraps.py` | periods of counters that wrap |
"""

from diransac.data.preprocessing.continuity import continuous, continuous_quaternions, unwrap
from diransac.data.preprocessing.degrees import in_degrees
from diransac.data.preprocessing.differentiation import acting_inputs, differentiate, filter_rows
from diransac.data.preprocessing.spikes import despike, hampel
from diransac.data.preprocessing.steps import (
    in_stated_units,
    in_units,
    keep_while,
    leave_out,
    prepared,
    rename,
    resample,
    scale,
    shift,
    unit_factors,
)
from diransac.data.preprocessing.wraps import wrap_period

__all__ = [
    "acting_inputs",
    "continuous",
    "continuous_quaternions",
    "despike",
    "differentiate",
    "filter_rows",
    "hampel",
    "in_degrees",
    "in_stated_units",
    "in_units",
    "keep_while",
    "leave_out",
    "prepared",
    "rename",
    "resample",
    "scale",
    "shift",
    "unit_factors",
    "unwrap",
    "wrap_period",
]
