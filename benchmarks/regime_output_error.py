"""Output error over short segments: every segment's first state is free, residuals have a Cauchy loss.

Simulations are the plant's own equations without its fault, all segments and all perturbed parameters as lanes at once.
Nothing happens when this file is run.

References
----------
Jategaonkar 2015, "Flight Vehicle System Identification", chapter 4; Bock 1987 (multiple shooting) for the segments.
"""

from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
from regime_baselines import bridged, motion
from regime_flights import Recording, Regime, rk4
from regime_machines import Array, Machine

CAUCHY = 2.385
"""Tuning constant of the loss: 95 % efficient on Gaussian noise."""
STEP = 1e-5
"""Of a parameter or state relative to its size, for derivatives."""
ITERATIONS = 30
FAR = 1e6
"""Residual of a simulation that diverges."""


def output_error(regime: Regime, recording: Recording) -> dict[str, float]:
    """Parameters by Levenberg and Marquardt from the machine's base; the plain Cauchy loss decides on each step."""
    segments = _Segments.of(regime, recording)
    names = list(regime.machine.model.parameters)
    base = np.array([regime.machine.base[name] for name in names])
    low = np.where([regime.machine.model.parameters[name].lower >= 0.0 for name in names], 1e-3, -np.inf)
    z, first, damping = np.ones(len(base)), segments.first, 1e-3
    for _ in range(ITERATIONS):
        residual, jacobian = segments.linearized(z, first, base)
        scale = 1.4826 * np.nanmedian(np.abs(residual), axis=(0, 2))[None, :, None] + 1e-12
        cost = _cost(residual / scale)
        for _ in range(8):
            dz, d_first = _step(residual / scale, jacobian / scale, len(base), damping)
            new_z, new_first = np.maximum(z + dz, low), first + segments.size[:, None] * d_first
            if _cost(segments.residual(new_z, new_first, base) / scale) <= cost:
                break
            damping = max(10.0 * damping, 1e-8)
        else:
            break
        moved, z, first, damping = np.abs(new_z - z).max(), new_z, new_first, damping / 10.0
        if moved < 1e-6:
            break
    return dict(zip(names, (z * base).tolist(), strict=True))


def _cost(residual: Array) -> float:
    return float(np.nansum(np.log1p((residual / CAUCHY) ** 2)))


def _step(residual: Array, jacobian: Array, n_p: int, damping: float) -> tuple[Array, Array]:
    """Steps of the parameters (n_p,) and of the first states (n_x, S): weighted least squares by Schur's complement.

    Parameters
    ----------
    residual : (K, m, S)   rows of a segment, signals, segments; NaN where there is no measurement
    jacobian : (n_p + n_x, K, m, S)
    """
    weight = np.where(np.isnan(residual), 0.0, 1.0 / np.sqrt(1.0 + (np.nan_to_num(residual) / CAUCHY) ** 2))
    n_segments = residual.shape[-1]
    A = (weight * jacobian).reshape(len(jacobian), -1, n_segments).transpose(2, 1, 0)
    r = (weight * np.nan_to_num(residual)).reshape(-1, n_segments).T[:, :, None]
    H, g = A.transpose(0, 2, 1) @ A, (A.transpose(0, 2, 1) @ r)[:, :, 0]
    own = H[:, n_p:, n_p:]
    diagonal = np.einsum("sii->si", own)
    inverse = np.linalg.pinv(own + (damping * diagonal + 1e-12)[:, :, None] * np.eye(own.shape[1]), hermitian=True)
    cross = H[:, :n_p, n_p:] @ inverse
    shared = (H[:, :n_p, :n_p] - cross @ H[:, n_p:, :n_p]).sum(axis=0)
    shared += damping * np.diag(np.diag(shared)) + 1e-12 * np.trace(shared) * np.eye(n_p)
    dz = -np.linalg.solve(shared, (g[:, :n_p] - np.einsum("sij,sj->si", cross, g[:, n_p:])).sum(axis=0))
    d_first = -np.einsum("sij,sj->is", inverse, g[:, n_p:] + H[:, n_p:, :n_p] @ dz)
    return dz, d_first


@dataclass(frozen=True)
class _Segments:
    """Measured signals of segments, and how they are simulated.

    Parameters
    ----------
    machine : the plant
    held : whether inputs are held between samples
    measured : (K, m, S), NaN where nothing is measured
    index : of each measured signal among ``[q, v, a]``
    inputs : (K + 1, n_u, S)
    first : (n_x, S) rough first states
    size : (n_x,) of each state
    """

    machine: Machine
    held: bool
    measured: Array
    index: list[int]
    inputs: Array
    first: Array
    size: Array

    @classmethod
    def of(cls, regime: Regime, recording: Recording) -> "_Segments":
        """Segments of half a second or 50 rows, whichever is longer, without those that lack inputs."""
        machine, model, columns = regime.machine, regime.machine.model, recording.columns
        length = max(50, round(0.5 / machine.dt))
        begins = np.arange(0, len(recording.time) - length, length)
        inputs = np.stack([columns[name] for name in model.inputs])
        begins = np.array([k for k in begins if np.isfinite(inputs[:, k : k + length + 1]).all()])
        rows = begins + np.arange(length + 1)[:, None]
        signals = [*model.coordinates, *model.velocities, *model.accelerations]
        names = [name for name in signals if name in columns]
        measured = np.stack([columns[name] for name in names])
        q, v, _ = motion(machine, bridged(columns, 0)[0], rough=True)
        states = np.concatenate([q, v])
        return cls(
            machine, regime.held, measured[:, rows[:-1]].transpose(1, 0, 2), [signals.index(name) for name in names],
            inputs[:, rows].transpose(1, 0, 2), states[:, begins], np.std(states, axis=1) + 1e-3,
        )  # fmt: skip

    def residual(self, z: Array, first: Array, base: Array) -> Array:
        """Simulated less measured signals (K, m, S)."""
        return self._simulated((z * base)[:, None], first) - self.measured

    def linearized(self, z: Array, first: Array, base: Array) -> tuple[Array, Array]:
        """Residuals, and their derivatives (n_p + n_x, K, m, S) by z and by the first states in their sizes."""
        n_p, n_x, n_segments = len(z), len(first), first.shape[1]
        moved_z = np.repeat(z[:, None], 1 + n_p + n_x, axis=1)
        moved_z[:, 1 : n_p + 1] += STEP * np.eye(n_p)
        states = np.repeat(first[:, None, :], 1 + n_p + n_x, axis=1)
        states[:, n_p + 1 :] += STEP * np.diag(self.size)[:, :, None]
        parameters = np.repeat(moved_z * base[:, None], n_segments, axis=1)
        found = self._simulated(parameters, states.reshape(n_x, -1))
        found = found.reshape(*found.shape[:2], 1 + n_p + n_x, n_segments).transpose(2, 0, 1, 3)
        return found[0] - self.measured, np.nan_to_num((found[1:] - found[0]) / STEP)

    def _simulated(self, values: Array, x: Array) -> Array:
        """Measured signals (K, m, lanes); lanes are segments, repeated."""
        machine, copies = self.machine, x.shape[1] // self.first.shape[1]
        p = SimpleNamespace(**dict(zip(machine.model.parameters, values, strict=True)))
        n_q, none = machine.model.n_q, np.zeros((machine.model.n_v, 1))
        kinematics, modelled = machine.kinematics or (lambda q, v: v), machine.modelled or machine.accelerations
        steps = (machine.substeps + 1) // 2
        h, found = machine.dt / steps, []

        def accelerations(x: Array, u: Array) -> Array:
            return modelled(x[:n_q], x[n_q:], u, p, none)

        with np.errstate(all="ignore"):
            for k in range(len(self.measured)):
                u, after = (np.tile(self.inputs[i], copies) for i in (k, k + 1))
                slope = 0.0 if self.held else (after - u) / machine.dt
                found.append(np.concatenate([x, accelerations(x, u)])[self.index])

                def rate(t: float, x: Array, u: Array, slope: Array | float = slope) -> Array:
                    return np.concatenate([kinematics(x[:n_q], x[n_q:]), accelerations(x, u + t * slope)])

                for i in range(steps):
                    x = rk4(rate, i * h, x, u, h)
        return np.clip(np.nan_to_num(np.stack(found), nan=FAR), -FAR, FAR)
