"""Flights of a plant: planned, controlled, simulated, and recorded with noise and faults.

In come a `Plant` or `Result` and the places to pass; out come a `Trajectory`, a `Controller` and a `Log`.  Begin with
`closed_loop.py`: `fly` is what the others serve.

| file | contents |
|---|---|
| `planning/` | trajectories: optimal, named, random, designed for identification |
| `trajectory.py` | `Trajectory`, the reference of a flight |
| `tvlqr.py`, `riccati.py` | `Controller` by time-varying LQR; its compiled Riccati sweep |
| `closed_loop.py` | `fly`, `fly_batch`, `tracking_error` |
| `noise.py`, `corruption.py` | `Noise`; `corrupt`, a log with noise and faults and the mask of these |
"""
