"""Digests of results whose model is built where they are computed, for processes that import this module."""

import hashlib
import json

import numpy as np

import diransac as dr
from diransac.identification.methods import METHODS

TIME = 0.05 * np.arange(100)


def built() -> dr.Model:
    """A model of one coordinate with terms that CasADi may order one way or another."""
    return dr.Model(
        "sledge",
        {"s": "m"},
        {"force": "N"},
        {"mass": dr.Parameter("kg", positive=True), "drag": dr.Parameter("kg/m"), "bias": dr.Parameter("N")},
        lambda q, v, a, u, p: [p.mass * a.s + p.drag * v.s * abs(v.s) + p.bias - u.force],
    )


def log() -> dr.Log:
    """A recorded motion with noise and outliers."""
    rng = np.random.default_rng(4)
    v, a = np.sin(1.3 * TIME) + np.sin(3.1 * TIME), 1.3 * np.cos(1.3 * TIME) + 3.1 * np.cos(3.1 * TIME)
    s = -np.cos(1.3 * TIME) / 1.3 - np.cos(3.1 * TIME) / 3.1
    force = 2.0 * a + 0.7 * v * np.abs(v) + 0.3
    columns = {"s": s, "s_dot": v, "s_ddot": a + 0.05 * rng.standard_normal(len(TIME)), "force": force}
    columns["s_dot"] = columns["s_dot"] + np.where(rng.random(len(TIME)) < 0.05, 3.0, 0.0)
    return dr.Log.from_arrays(TIME, columns, source="log")


def digest(name: str, model: dr.Model | None = None) -> str:
    """Digest of all that a result holds, of a method and a model; None: one that is built here."""
    few = dr.Settings(max_iterations=20, sample_size=20) if name in ("diransac", "i-diransac") else None
    result = dr.identify(built() if model is None else model, log(), name, settings=few, seed=3)
    return hashlib.sha256(json.dumps(result.to_dict(), sort_keys=True).encode()).hexdigest()


def digests(model: dr.Model | None = None) -> dict[str, str]:
    """Digest of every method."""
    return {name: digest(name, model) for name in METHODS}
