"""Planar rotorcraft, and the same with unmodelled effects of its rotors: Dimmig et al. 2023, section IV."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from math import pi
from types import MappingProxyType
from typing import Any

import casadi as ca

from diransac.errors import ModelError
from diransac.model.derivation import Symbols
from diransac.model.model import Model
from diransac.model.parameter import Parameter
from diransac.model.plant import Disturbance, Plant, check_possible


def planar_rotorcraft(arm_length: float = 0.177, gravity: float = 9.81) -> Model:
    """Model of two rotors in the vertical plane, with induced drag.

    ``m x'' = -T sin(theta) - C |T| x' cos(theta)``
    ``m (z'' + g) = T cos(theta) - C |T| z' sin(theta)``
    ``I theta'' = L M``

    Parameters
    ----------
    arm_length : float
        L, distance of each rotor from the centre of gravity, m (Table I).
    gravity : float
        g, m/s^2.

    Returns
    -------
    Model
        Coordinates x, z (world frame, m) and theta (rad). Inputs thrust T (N, along the body's z axis) and moment M
        (the paper's u_2, multiplied by L in eq. (4): N). Parameters mass m, inertia I, drag C (induced drag, s/m).

    References
    ----------
    Dimmig et al. 2023, eqs. (4) and (5), Table I.
    """

    def equations(q: Symbols, v: Symbols, a: Symbols, u: Symbols, p: Symbols) -> list[object]:
        drag = p.drag * ca.fabs(u.thrust)
        return [
            p.mass * a.x + u.thrust * ca.sin(q.theta) + drag * v.x * ca.cos(q.theta),
            p.mass * (a.z + gravity) - u.thrust * ca.cos(q.theta) + drag * v.z * ca.sin(q.theta),
            p.inertia * a.theta - arm_length * u.moment,
        ]

    return Model(
        name="planar-rotorcraft",
        description="two rotors in the vertical plane with induced drag (Dimmig et al. 2023, eq. (4))",
        coordinates={"x": "m", "z": "m", "theta": "rad"},
        inputs={"thrust": "N", "moment": "N"},
        parameters={
            "mass": Parameter("kg", positive=True),
            "inertia": Parameter("kg m^2", positive=True),
            "drag": Parameter("s/m", lower=0.0),
        },
        equations=equations,
    )


TABLE_I: Mapping[str, float] = MappingProxyType({"mass": 0.249, "inertia": 0.004, "drag": 0.025})
"""Mass (kg), inertia (kg m^2) and induced drag (s/m) of the paper's rotorcraft, Table I."""

BLADE_FLAPPING = 0.3
"""Typical flapping of such rotors, rad per unit of advance ratio: ``4 theta_t - 2 lambda`` by blade elements.

With ideal twist and C_T of Table I: inflow ``lambda = sqrt(2 C_T / pi) / pi = 0.062``; tip pitch
``theta_t = lambda + 16 C_T / (pi^3 sigma a) = 0.107`` with solidity sigma = 0.12 and lift slope a = 5.7.
"""

_EFFECTS = ("rotational", "gravitational")
PerRotor = float | tuple[float, float]


def extended_rotorcraft(
    aerodynamic_imbalance: PerRotor = 0.0,
    mass_imbalance: PerRotor = 0.0,
    convention: str = "physical",
    phase: str = "integrated",
    parameters: Mapping[str, float] = TABLE_I,
    *,
    mass_effects: Collection[str] = _EFFECTS,
    blade_flapping: PerRotor = 0.0,
    rotor_phase: PerRotor | None = 0.0,
    thrust_coefficient: float = 0.06,
    power_coefficient: float = 0.06,
    diameter: float = 0.127,
    arm_length: float = 0.177,
    rotor_height: float = 0.01,
    air_density: float = 1.225,
    gravity: float = 9.81,
) -> Plant:
    """Planar rotorcraft with rotor imbalance, eqs. (6) to (20), and blade flapping.

    Rotor i turns with ``n_i = sqrt(max(T_i, 0) / (C_T rho D^4))`` (eq. (11)) and has the phase ``phi_i``; its projected
    radius is ``r_i = D/2 cos(phi_i)`` (eq. (14)). The disturbances, summed over both rotors, are

    ``f_z     = gamma_i rho n_i^2 + dm_i g``                                      (eqs. (13) and (18), upwards)
    ``f_theta = 4 pi C_P/C_T gamma_i rho n_i^2 r_i + dm_i (2 pi n_i)^2 r_i L_z + dm_i g r_i``  (eqs. (16), (17), (19))

    Parameters
    ----------
    aerodynamic_imbalance : float or (float, float)
        gamma of both rotors or of each, m^4; 1.0e-6 to 1.8e-6 in Table II.
    mass_imbalance : float or (float, float)
        dm of both rotors or of each, kg; 6e-5 to 1.4e-4 in Table II.
    convention : {"physical", "printed"}
        ``"physical"``: forces and torques, divided by mass and inertia, and ``T_i = (u_1 -+ u_2) / 2``, which is
        consistent with the torque ``L u_2`` of eq. (4). ``"printed"``: added to the accelerations, and
        ``T_i = (u_1 -+ u_2 / L) / 2``, as eqs. (9), (10) and (20) are printed.
    phase : {"integrated", "instantaneous"}
        ``phi_i' = 2 pi n_i``, or ``phi_i = 2 pi n_i t`` as eq. (14) is printed.
    parameters : mapping of str to float
        Of the model.
    mass_effects : collection of str
        Enabled effects of dm: ``"rotational"`` (eq. (17)), ``"gravitational"`` (eqs. (18) and (19)).
    blade_flapping : float or (float, float)
        K, rad: a rotor that advances with ``mu = v_x / (pi n_i D)`` along the body's x axis tilts its thrust, which
        acts L_z above the centre of gravity, back by ``a_i = K mu / (1 - mu^2 / 2)``; always as forces and torques. 0:
        none, as in the paper. `BLADE_FLAPPING` is a typical value.
    rotor_phase : float or (float, float), optional
        phi_i at the start, rad, of integrated phases; None: drawn with the seed of a flight.
    thrust_coefficient, power_coefficient : float
        C_T, C_P, Table I.
    diameter, arm_length, rotor_height : float
        D, L and L_z, m, Table I.
    air_density : float
        rho, kg/m^3.
    gravity : float
        g, m/s^2.

    Returns
    -------
    Plant
        Simulations take 8 integration steps per turn of the rotors at twice the thrust of hover.

    Raises
    ------
    ModelError
        An unknown convention, phase, effect or parameter, a parameter outside its bounds, a number that is not finite,
        or one that no rotor has.

    References
    ----------
    Dimmig et al. 2023, eqs. (6) to (20), Tables I and II. Blade flapping: Hoffmann, Huang, Waslander, Tomlin,
    "Quadrotor helicopter flight dynamics and control: theory and experiment", AIAA GNC 2007 (tilt of the thrust and its
    moment); Pounds, Mahony, Corke, "Modelling and control of a large quadrotor robot", Control Engineering Practice
    18(7), 2010 (the angle, ``mu (4 theta_t - 2 lambda) / (1 - mu^2 / 2)`` for ideal twist).
    """
    _check_choice("convention", convention, ("physical", "printed"))
    _check_choice("phase", phase, ("integrated", "instantaneous"))
    for effect in mass_effects:
        _check_choice("mass_effects", effect, _EFFECTS)
    numbers = (thrust_coefficient, power_coefficient, diameter, arm_length, rotor_height, air_density, gravity)
    rotors = _Rotors(convention, phase, *numbers)
    model = planar_rotorcraft(arm_length, gravity)
    mass = {effect: mass_imbalance if effect in mass_effects else 0.0 for effect in _EFFECTS}
    constants = _per_rotor(aerodynamic=aerodynamic_imbalance, **mass)
    known = Plant(model, parameters)
    check_possible(model, known.parameters)
    disturbances = [rotors.imbalance(model, constants, rotor_phase, known.parameters["mass"])]
    flapping = _per_rotor(flapping=blade_flapping)
    if any(flapping.values()):
        disturbances.append(rotors.flapping(model, flapping))
    return Plant(model, parameters, tuple(disturbances))


@dataclass(frozen=True)
class _Rotors:
    """Both rotors, with the arguments of `extended_rotorcraft`."""

    convention: str
    phase: str
    thrust_coefficient: float
    power_coefficient: float
    diameter: float
    arm_length: float
    rotor_height: float
    air_density: float
    gravity: float

    def __post_init__(self) -> None:
        smallest = {"power_coefficient": 0.0, "rotor_height": -1e6, "gravity": 0.0}
        for name, value in list(vars(self).items())[2:]:
            low, high = smallest.get(name, 1e-6), 1e6  # SI units: more than any machine has
            if isinstance(value, Sequence) or not low <= value <= high:
                raise ModelError(f"extended rotorcraft: {name} is {value}; give one number from {low:g} to {high:g}")

    @property
    def thrust_factor(self) -> float:
        """T / n^2, N s^2: eq. (6)."""
        return self.thrust_coefficient * self.air_density * self.diameter**4

    def thrusts(self, u: Symbols) -> tuple[ca.SX, ca.SX]:
        """T_1 and T_2, N: eqs. (9) and (10)."""
        couple = u.moment if self.convention == "physical" else u.moment / self.arm_length
        return (u.thrust - couple) / 2, (u.thrust + couple) / 2

    def speeds(self, u: Symbols) -> list[ca.SX]:
        """n_1 and n_2, turns per second: eq. (11)."""
        return [ca.sqrt(ca.fmax(thrust, 0) / self.thrust_factor) for thrust in self.thrusts(u)]

    def imbalance(
        self, model: Model, constants: Mapping[str, float], start: PerRotor | None, mass: float
    ) -> Disturbance:
        """Aerodynamic and mass imbalance, eqs. (12) to (19); resolved up to twice the thrust of hover."""

        def effect(_q: Symbols, _v: Symbols, u: Symbols, _p: Symbols, d: Symbols) -> dict[str, Any]:
            both = [self._one_rotor(i, n, d) for i, n in enumerate(self.speeds(u), start=1)]
            return {"z": both[0][0] + both[1][0], "theta": both[0][1] + both[1][1]}

        def rates(_q: Symbols, _v: Symbols, u: Symbols, _p: Symbols, _d: Symbols) -> dict[str, Any]:
            return {f"phase_{i}": 2 * pi * n for i, n in enumerate(self.speeds(u), start=1)}

        physical, integrated = self.convention == "physical", self.phase == "integrated"
        phases = _per_rotor(phase=0.0 if start is None else start) if integrated else {}
        return Disturbance(
            model,
            "imbalance",
            forces=effect if physical else None,
            accelerations=None if physical else effect,
            constants=constants,
            states=dict.fromkeys(phases, "rad"),
            rates=rates if integrated else None,
            start=dict.fromkeys(phases, (0.0, 2 * pi)) if start is None else phases,
            highest_frequency=(mass * self.gravity / self.thrust_factor) ** 0.5,
        )

    def _one_rotor(self, i: int, n: ca.SX, d: Symbols) -> tuple[ca.SX, ca.SX]:
        """Upward force and torque of rotor i at n turns per second."""
        angle = d[f"phase_{i}"] if self.phase == "integrated" else 2 * pi * n * d.t
        radius = self.diameter / 2 * ca.cos(angle)
        excess = d[f"aerodynamic_{i}"] * self.air_density * n**2
        torque_of_thrust = 4 * pi * self.power_coefficient / self.thrust_coefficient * radius
        weight = d[f"gravitational_{i}"] * self.gravity
        whirling = d[f"rotational_{i}"] * (2 * pi * n) ** 2 * self.rotor_height
        return excess + weight, excess * torque_of_thrust + (whirling + weight) * radius

    def flapping(self, model: Model, constants: Mapping[str, float]) -> Disturbance:
        """Tilt of the thrust by blade flapping."""

        def forces(q: Symbols, v: Symbols, u: Symbols, _p: Symbols, d: Symbols) -> dict[str, Any]:
            along = v.x * ca.cos(q.theta) + v.z * ca.sin(q.theta)
            back, up, torque = ca.SX(0), ca.SX(0), ca.SX(0)
            for i, n in enumerate(self.speeds(u), start=1):
                thrust, tip_speed = self.thrust_factor * n**2, pi * self.diameter * n
                # Flapping is constant above an advance ratio of 0.5, where the rotor almost stands still.
                mu = ca.fmax(ca.fmin(along / ca.fmax(tip_speed, 1e-9), 0.5), -0.5)
                tilt = d[f"flapping_{i}"] * mu / (1 - mu**2 / 2)
                lost, arm = thrust * (ca.cos(tilt) - 1), self.arm_length * (1 if i == 2 else -1)
                back += thrust * ca.sin(tilt)
                up += lost
                torque += self.rotor_height * thrust * ca.sin(tilt) + arm * lost
            return {
                "x": -back * ca.cos(q.theta) - up * ca.sin(q.theta),
                "z": -back * ca.sin(q.theta) + up * ca.cos(q.theta),
                "theta": torque,
            }

        return Disturbance(model, "blade-flapping", forces=forces, constants=constants)


def _per_rotor(**values: PerRotor) -> dict[str, float]:
    """Values by ``name_1`` and ``name_2``."""
    pairs = {name: value if isinstance(value, tuple) else (value, value) for name, value in values.items()}
    return {f"{name}_{i}": float(value) for name, pair in pairs.items() for i, value in enumerate(pair, start=1)}


def _check_choice(name: str, value: str, known: Collection[str]) -> None:
    """Raise ModelError for an unknown word."""
    if value not in known:
        raise ModelError(f"extended rotorcraft: {name} is {value!r}; choose {' or '.join(known)}")
