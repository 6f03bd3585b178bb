"""Logs of the regimes, by a simulation that is not the package's, in fewer steps than the tables'.

They change motions by less than a tenth of the noise, which `test_regimes` checks.
"""

from dataclasses import replace
from functools import cache

import regime_flights as flights


def recorded(regime: flights.Regime, seed: int) -> flights.Recording:
    """One log of a regime."""
    coarse = replace(regime.machine, substeps=max(1, regime.machine.substeps // 4))
    return flights.recordings(replace(regime, machine=coarse), [seed])[0]


@cache
def of_table(name: str, seed: int) -> flights.Recording:
    """One log of a regime of the table; what many tests ask for is simulated once."""
    return recorded(flights.REGIMES[name], seed)
