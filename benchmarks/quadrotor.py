"""A quadrotor from its motor commands, IMU and late motion capture: the default method beside what else one would do.

Run it as ``python benchmarks/quadrotor.py [--seeds 0:3] [--duration 20]``: errors in percent, and seconds of processor
time.  ``--coverage 100`` instead counts how often the 95 % intervals of each parameter hold the truth, over flights of
6 s with timely motion capture.  Reported figures are of seeds from 0 on; whoever develops a method uses seeds from 1000
on.
"""

import argparse
import sys
import time
from statistics import median

import numpy as np
import quadrotor_flights as flights
from quadrotor_baselines import least_squares_of, output_error_of
from quadrotor_flights import Flight

import diransac as dr

SHORT = 6.0


def main() -> None:
    """Print the table of errors, or that of coverage."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", default="0:3", metavar="A:B", help="from A to B - 1")
    parser.add_argument("--duration", type=float, default=20.0, help="of a flight, s")
    parser.add_argument("--coverage", type=int, default=0, metavar="N", help="flights whose intervals are counted")
    chosen = parser.parse_args()
    first, last = map(int, chosen.seeds.split(":"))
    if chosen.coverage:
        count_coverage(range(first, first + chosen.coverage))
    else:
        compare(range(first, last), chosen.duration)


def model() -> dr.Model:
    """The built-in model of this airframe."""
    rotors = [(float(x), float(y), int(s)) for (x, y), s in zip(flights.PLACES, flights.DIRECTIONS, strict=True)]
    return dr.models.quadrotor(rotors, motor_lag=True, imu=True)


def identified(flight: Flight) -> dr.Result:
    """Result of the default method, the mass known."""
    return dr.identify(model(), flight.log, differentiate=True, fixed={"mass": flight.truth["mass"]})


def compare(seeds: range, duration: float) -> None:
    """Errors of every method on the same flights."""
    methods = {
        "lo-diransac": lambda f: dict(identified(f).parameters),
        "filtered OLS": least_squares_of,
        "output error": output_error_of,
    }
    errors: dict[str, dict[str, list[float]]] = {name: {} for name in methods}
    seconds: dict[str, list[float]] = {name: [] for name in methods}
    for seed in seeds:
        flight = flights.fly(seed, duration)
        for name, method in methods.items():
            begin = time.process_time()
            found = method(flight)
            seconds[name].append(time.process_time() - begin)
            for parameter, value in flight.truth.items():
                if parameter in found and parameter != "mass":
                    error = _error(parameter, found[parameter], value)
                    errors[name].setdefault(parameter, []).append(error)
            print(f"seed {seed}: {name} {seconds[name][-1]:.0f} s", file=sys.stderr)
    print(f"{len(seeds)} flights of {duration:g} s: median and worst error")
    print("\n| | " + " | ".join(methods) + " |\n|---|" + "--:|" * len(methods))
    for parameter in next(iter(errors.values())):
        unit = " % of the noise" if "bias" in parameter else " %"
        cells = [_cell(errors[name].get(parameter, []), unit) for name in methods]
        print(f"| {parameter} | {' | '.join(cells)} |")
    print("| processor time, s | " + " | ".join(f"{median(seconds[name]):.0f}" for name in methods) + " |")


def _error(parameter: str, found: float, true: float) -> float:
    """Error in percent of the parameter; of a bias, of the noise of its sensor."""
    if "bias" in parameter:
        return 100.0 * abs(found - true) / flights.NOISE[parameter.split("_")[0]]
    return 100.0 * abs(found / true - 1.0)


def _cell(errors: list[float], unit: str) -> str:
    return f"{median(errors):.2g}, {max(errors):.2g}{unit}" if errors else ""


def count_coverage(seeds: range) -> None:
    """Share of the flights whose 95 % interval of each parameter holds the truth; if interrupted, of those done."""
    inside: dict[str, list[bool]] = {}
    try:
        for seed in seeds:
            flight = flights.fly(seed, SHORT, late=0.0)
            result = identified(flight)
            intervals = {n: x for n, x in result.intervals(0.95).items() if n != "mass"}
            holds = {n: low <= flight.truth[n] <= high for n, (low, high) in intervals.items()}
            for parameter, held in holds.items():
                inside.setdefault(parameter, []).append(held)
            outside = ", ".join(n for n, held in holds.items() if not held) or "none"
            print(f"seed {seed}: {result.verdict}; outside: {outside}", file=sys.stderr, flush=True)
    except KeyboardInterrupt:
        print("ended early", file=sys.stderr)
    for parameter, held in inside.items():
        print(f"| {parameter} | {np.mean(held):.2f} |")
    n_flights = max(map(len, inside.values()), default=0)
    print(f"| all, {n_flights} flights | {np.mean([x for held in inside.values() for x in held]):.3f} |")


if __name__ == "__main__":
    main()
