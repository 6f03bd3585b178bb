"""A controller that follows a tracker: the gains of a rotorcraft are rescheduled after it has dropped its payload.

A planar rotorcraft flies a star under TVLQR, designed for its mass with the payload. In the middle it drops the
payload, a third of its mass. Motion capture of the pose and a gyroscope, with noise and outliers, feed `dr.Tracker`
every 0.1 s. When it reports a change, feed-forward and gains are computed anew for the parameters that it has found.
The same flight without the tracker, and with a controller that is told the truth, stand beside it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

import diransac as dr

MODEL = dr.models.planar_rotorcraft()
LOADED = {"mass": 0.375, "inertia": 0.0045, "drag": 0.025}
EMPTY = {**LOADED, "mass": 0.25, "inertia": 0.004}
DROP, STEP = 6.0, 0.1
NOISE = {"x": 2e-3, "z": 2e-3, "theta": 3e-3, "theta_dot": 0.02}
OUTLIERS, SIZE = 0.05, 1.0

Parameters = Mapping[str, float]
Schedule = Callable[[dr.Log], Parameters | None]
"""Takes what was flown in the last step, and returns the parameters of another controller, or None to keep it."""


def controller_for(parameters: Parameters, plan: dr.Trajectory) -> dr.Controller:
    """Feed-forward and gains along a plan that was made for the loaded machine.

    The same motion needs a thrust in proportion to the mass, and a moment in proportion to the inertia.
    """
    ratios = [parameters["mass"] / LOADED["mass"], parameters["inertia"] / LOADED["inertia"]]
    return dr.tvlqr(dr.Plant(MODEL, parameters), replace(plan, inputs=plan.inputs * ratios))


def flown(plan: dr.Trajectory, schedule: Schedule) -> dr.Log:
    """Log of the flight; after each step, the schedule may change the controller."""
    controller, x = controller_for(LOADED, plan), plan.states[0]
    every, parts = round(STEP / plan.dt), []
    for first in range(0, len(plan) - 1, every):
        time = plan.time[first : first + every + 1]
        plant = dr.Plant(MODEL, LOADED if time[0] < DROP else EMPTY)
        part = dr.fly_batch([plant], [controller.at(time)], x[None])[0]
        x = np.array([part[name][-1] for name in MODEL.state])
        parts.append(part)
        found = schedule(part[: len(part) - 1] if len(part) > 2 else part)
        controller = controller if found is None else controller_for(found, plan)
    columns = {name: np.concatenate([part[name][:-1] for part in parts]) for name in parts[0].names}
    return dr.Log.from_arrays(np.concatenate([part.time[:-1] for part in parts]), columns)


def never(_part: dr.Log) -> None:
    """The controller of the loaded machine, to the end."""


def told(part: dr.Log) -> Parameters | None:
    """The truth, when it changes."""
    return EMPTY if part.time[0] < DROP <= part.time[-1] + STEP else None


class Tracked:
    """Parameters of a tracker, when it reports a change, and at every step for a second after it."""

    def __init__(self, seed: int) -> None:
        self._tracker = dr.Tracker(MODEL, step=STEP, start=LOADED)
        self._rng, self._until = np.random.default_rng(seed), -np.inf

    def __call__(self, part: dr.Log) -> Parameters | None:
        """Feed the tracker with what sensors see of a step."""
        now = self._tracker.update(self._seen(part))
        if now is None:
            return None
        for change in now.changes:
            print(
                f"  t = {now.time:.2f} s: {change.parameter} {change.before:.4f} -> {change.after:.4f} since "
                f"{change.time:.2f} s"
            )
            self._until = now.time + 1.0
        return now.parameters if now.time <= self._until else None

    def _seen(self, part: dr.Log) -> dict[str, np.ndarray]:
        """Pose and rate with noise and outliers, and the inputs."""
        columns = {"t": part.time, **{name: part[name] for name in MODEL.inputs}}
        for name, noise in NOISE.items():
            hit = self._rng.random(len(part)) < OUTLIERS
            errors = self._rng.normal(0.0, noise, len(part)) + hit * self._rng.uniform(-SIZE, SIZE, len(part))
            columns[name] = part[name] + errors
        return columns


def main() -> None:
    """Fly three times, and print the tracking errors after the drop."""
    plan = dr.star(dr.Plant(MODEL, LOADED))
    print(f"A star of {plan.time[-1]:.1f} s; at {DROP:g} s the mass drops to {EMPTY['mass'] / LOADED['mass']:.0%}.")
    print(f"{'controller':12}{'x':>9}{'z':>9}{'theta':>9}   RMS error after the drop (m, m, rad)")
    schedules: dict[str, Schedule] = {"unchanged": never, "tracked": Tracked(seed=0), "told": told}
    for name, schedule in schedules.items():
        log = flown(plan, schedule)
        error = dr.tracking_error(plan, log.between(DROP, log.time[-1]))
        print(f"{name:12}" + "".join(f"{error[state]:9.3f}" for state in ("x", "z", "theta")))


if __name__ == "__main__":
    main()
