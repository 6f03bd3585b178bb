"""A fleet of logs: a bent propeller and a changed mass are found, no row is lost with a worker, rows per second.

Run: ``python benchmarks/fleet.py [METHOD]`` (default: ols).  200 flights of 20 planar rotorcraft, 5 s at 100 Hz, are
simulated by the code of this file alone.  Vehicle 7 has a propeller with 12 % less thrust, which is not in the model;
vehicle 13 carries 8 % more mass from its sixth flight on.
"""

from __future__ import annotations

import os
import signal
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

import diransac as dr
from diransac.study import connected, fleet_status, identify_each, summarise_fleet

N_VEHICLES, N_FLIGHTS, SECONDS, STEP = 20, 10, 5.0, 0.01
BENT, CHANGED = 7, 13
ARM, GRAVITY = 0.177, 9.81
NOISE = {"x": 0.002, "z": 0.002, "theta": 0.002, "x_dot": 0.02, "z_dot": 0.02, "theta_dot": 0.02}
NOISE |= {"x_ddot": 0.1, "z_ddot": 0.1, "theta_ddot": 0.5}
PATTERN = r"(?P<vehicle>v\d+)/(?P<time>\d+)\.csv"


def write_flight(path: Path, mass: float, inertia: float, drag: float, loss: float, rng: np.random.Generator) -> None:
    """Write a flight along a random path under feedback; `loss` is the fraction of thrust that one rotor lacks."""
    frequency, phase = rng.uniform(0.3, 1.2, (2, 4)), rng.uniform(0.0, 2.0 * np.pi, (2, 4))

    def commands(t: float, s: np.ndarray) -> tuple[float, float]:
        x, z, angle, vx, vz, rate = s
        wave = 2.0 * np.pi * frequency * t + phase
        target, speed = 0.25 * np.sin(wave).sum(1), 0.25 * (2.0 * np.pi * frequency * np.cos(wave)).sum(1)
        ax = np.clip(4.0 * (target[0] - x) + 3.0 * (speed[0] - vx), -6.0, 6.0)
        az = np.clip(6.0 * (target[1] - z) + 4.0 * (speed[1] - vz), -5.0, 5.0)
        moment = (0.004 / ARM) * (120.0 * (np.arctan2(-ax, GRAVITY) - angle) - 18.0 * rate)
        return 0.249 * (GRAVITY + az) / max(0.5, np.cos(angle)), float(np.clip(moment, -0.8, 0.8))

    def rates(s: np.ndarray, u: tuple[float, float]) -> np.ndarray:
        right, left = (1.0 - loss) * (u[0] + u[1]) / 2.0, (u[0] - u[1]) / 2.0
        thrust, moment = right + left, right - left
        sin, cos, along = np.sin(s[2]), np.cos(s[2]), drag * thrust
        ax, az = -thrust * sin - along * s[3] * cos, thrust * cos - along * s[4] * sin
        return np.array([s[3], s[4], s[5], ax / mass, az / mass - GRAVITY, ARM * moment / inertia])

    s, rows = np.zeros(6), []
    for k in range(round(SECONDS / STEP) + 1):
        u = commands(k * STEP, s)
        rows.append([k * STEP, *s, *rates(s, u)[3:], *u])
        for _ in range(5):
            h = STEP / 5
            k1 = rates(s, u)
            k2 = rates(s + h / 2 * k1, u)
            k3 = rates(s + h / 2 * k2, u)
            s = s + h / 6 * (k1 + 2 * k2 + 2 * k3 + rates(s + h * k3, u))
    table = np.array(rows)
    table[:, 1:10] += rng.standard_normal((len(table), 9)) * list(NOISE.values())
    np.savetxt(path, table, delimiter=",", header=",".join(["t", *NOISE, "thrust", "moment"]), comments="")


def write_fleet(folder: Path) -> list[Path]:
    """Logs ``v07/03.csv`` of the fleet; vehicles vary by 1 to 3 %, flights of a vehicle by 0.3 % of its mass."""
    rng, files = np.random.default_rng(1), list[Path]()
    for vehicle in range(N_VEHICLES):
        mass, inertia, drag = np.array([0.249, 0.004, 0.025]) * (1.0 + [0.01, 0.01, 0.03] * rng.standard_normal(3))
        (folder / f"v{vehicle:02d}").mkdir()
        for flight in range(N_FLIGHTS):
            more = 1.08 if vehicle == CHANGED and flight >= N_FLIGHTS // 2 else 1.0
            now = mass * more * (1.0 + 0.003 * rng.standard_normal())
            files.append(folder / f"v{vehicle:02d}" / f"{flight:02d}.csv")
            write_flight(files[-1], now, inertia, drag, 0.12 if vehicle == BENT else 0.0, rng)
    return files


def main() -> None:
    """Print what is found, and the rates."""
    method = sys.argv[1] if len(sys.argv) > 1 else "ols"
    model, options = dr.models.planar_rotorcraft(), {"vehicle": PATTERN, "batch_size": 1}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        files = write_fleet(folder)
        for jobs in (1, 2):
            identify_each(model, files[:4], method, store=folder / f"warm{jobs}.db", jobs=jobs, **options)
            begin = time.perf_counter()
            identify_each(model, files, method, store=folder / f"{jobs}.db", jobs=jobs, **options)
            rate = len(files) / (time.perf_counter() - begin)
            print(f"{jobs} processes, their start included: {rate:.1f} rows/s")
        print(summarise_fleet(folder / "2.db"))
        on_cluster(model, files, method, folder, options)


def noting(moments: list[tuple[int, float]], victims: list[int]) -> Callable[[int, int], None]:
    """Progress callback that notes times, and kills a victim after a quarter of the rows."""

    def note(done: int, asked: int) -> None:
        moments.append((done, time.perf_counter()))
        if done > asked // 4 and victims:
            os.kill(victims.pop(), signal.SIGKILL)

    return note


def on_cluster(model: dr.Model, files: list[Path], method: str, folder: Path, options: dict[str, object]) -> None:
    """Print rates on one and two Dask workers, and what is there after one of two is killed."""
    from distributed import Client, LocalCluster

    for n, kill in ((1, False), (2, False), (2, True)):
        store, moments = folder / f"dask{n}{kill}.db", list[tuple[int, float]]()
        with LocalCluster(n_workers=n, threads_per_worker=1, dashboard_address=None) as cluster:
            with Client(cluster, set_as_default=False) as client:
                victims = [*client.run(os.getpid).values()][: int(kill)]

            with connected(cluster.scheduler_address) as (executor, tasks):
                identify_each(
                    model,
                    files,
                    method,
                    store=store,
                    executor=executor,
                    tasks=tasks,
                    progress=noting(moments, victims),
                    **options,
                )
        (first, begin), (last, end) = next(x for x in moments if x[0]), moments[-1]
        told = ", one killed" if kill else ""
        print(f"Dask, {n} workers{told}: {(last - first) / (end - begin):.1f} rows/s; {fleet_status(store)}")
        if kill:
            same = summarise_fleet(store).findings == summarise_fleet(folder / "2.db").findings
            print(f"findings as on processes: {'yes' if same else 'NO'}")


if __name__ == "__main__":
    main()
