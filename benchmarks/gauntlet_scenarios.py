"""Scenarios of the gauntlet: what is wrong with a recording, and what the model does not know of the plant.

A new scenario is one more row.  Nothing happens when this file is run.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from gauntlet_vehicles import VEHICLES

from diransac import Log, Noise, Plant, corrupt

MIDDLE = {"acceleration_std": 1.27, "rate_std": 0.5}
"""Gaussian noise of Table III, m/s^2 and rad/s: the middle of its range."""
LARGEST = {"acceleration_std": 2.5, "rate_std": 1.0}


@dataclass(frozen=True)
class Scenario:
    """One row of the gauntlet.

    Parameters
    ----------
    name : as the table shows it
    noise : what is wrong with the recording, or a function that spoils it: ``(log, seed) -> log``
    world : options of the vehicle's plant: what its model does not know
    """

    name: str
    noise: Noise | Callable[[Log, int], Log] = Noise()  # noqa: RUF009  frozen
    world: Mapping[str, Any] = field(default_factory=dict)

    def recorded(self, plant: Plant, log: Log, seed: int) -> Log:
        """What a recorder with these faults makes of a log."""
        return corrupt(log, self.noise, seed, signals=plant.model.signals) if self._is_noise else self.noise(log, seed)

    @property
    def bounded(self) -> bool:
        """Whether there is Gaussian noise, so that Cramer-Rao's bound is above zero."""
        return self._is_noise and set(MIDDLE) <= set(self.noise.changed)

    @property
    def _is_noise(self) -> bool:
        return isinstance(self.noise, Noise)


def _outliers(probability: float, magnitude: float, **more: Any) -> Noise:
    return Noise(outlier_probability=probability, outlier_magnitude=magnitude, **more)


def recordings(lever: str) -> list[Scenario]:
    """What any recording suffers from; bursts, frozen and missing runs of 10 samples cover 20 % of the log."""
    return [
        Scenario("clean"),
        Scenario("outliers .1 x 80", _outliers(0.1, 80.0)),
        Scenario("outliers .3 x 80", _outliers(0.3, 80.0)),
        Scenario("outliers .5 x 100", _outliers(0.5, 100.0)),
        Scenario("outliers .1 x 10", _outliers(0.1, 10.0)),
        Scenario("bursts", Noise(burst_probability=0.022, outlier_magnitude=30.0)),
        Scenario("frozen", Noise(freeze_probability=0.022, runs="together")),
        Scenario("missing", Noise(dropout_probability=0.022, runs="together")),
        Scenario("Gaussian (middle)", Noise(**MIDDLE)),
        Scenario("Gaussian (maximum)", Noise(**LARGEST)),
        Scenario("delay 20 ms", Noise(delay=0.02)),
        Scenario("leverage", Noise(leverage_probability=0.8, leverage_offset=80.0, leverage_signal=lever)),
    ]


def mismatches(some: Mapping[str, Any], most: Mapping[str, Any], name: str) -> list[Scenario]:
    """What the model does not know, alone, with much else, and with everything at the end of its range."""
    return [
        Scenario(name, world=most),
        Scenario("all at once", _outliers(0.2, 80.0, **MIDDLE), some),
        Scenario("everything at its maximum", _outliers(0.5, 100.0, **LARGEST), most),
    ]


def _imbalances(convention: str) -> list[Scenario]:
    return [
        Scenario(f"aerodynamic ({convention})", world={"aerodynamic_imbalance": 1.8e-6, "convention": convention}),
        Scenario(f"mass ({convention})", world={"mass_imbalance": 1.4e-4, "convention": convention}),
    ]


SCENARIOS = {
    "rotorcraft": [
        *recordings(VEHICLES["rotorcraft"].lever),
        Scenario("Gaussian (middle) but theta_ddot clean", Noise(**MIDDLE, angular_acceleration_std=0.0)),
        Scenario("Gaussian (maximum) but theta_ddot clean", Noise(**LARGEST, angular_acceleration_std=0.0)),
        *_imbalances("physical"),
        *_imbalances("printed"),
        *mismatches(
            {"aerodynamic_imbalance": 1.4e-6, "mass_imbalance": 1.0e-4},
            {"aerodynamic_imbalance": 1.8e-6, "mass_imbalance": 1.4e-4},
            "both imbalances",
        ),
    ],
    "servo-axis": [
        *recordings(VEHICLES["servo-axis"].lever),
        *mismatches({"cogging": 5.0}, {"cogging": 10.0}, "cogging"),
    ],
    "double-pendulum": [
        *recordings(VEHICLES["double-pendulum"].lever),
        *mismatches({"ripple": 0.01}, {"ripple": 0.02}, "ripple"),
    ],
    "pendulum": [
        *recordings(VEHICLES["pendulum"].lever),
        *mismatches({"ripple": 0.05}, {"ripple": 0.1}, "ripple"),
    ],
}
