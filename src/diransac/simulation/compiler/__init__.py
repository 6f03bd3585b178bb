"""Compiler of expression graphs to machine code for eight lanes at a time.

| file | contents |
|---|---|
| `graph.py` | graph of a CasADi SX function: each value once, products fused into sums, invariants marked |
| `vectors.py` | arithmetic on eight float64 lanes, over llvmlite's IR builder |
| `elementary.py` | sin, atan2, exp, pow and the like of such vectors |
| `operations.py` | vector form of every operation, and the emission of graphs, once or over rows |
| `machine_code.py` | LLVM module to callable machine code; threads |
| `code_cache.py` | machine code on disk |
| `functions.py` | `Map` and `Scan`: SX functions over arrays |
| `time_loop.py` | the time loop of a simulation, and the sources of its inputs |
| `stage_function.py` | dynamics of a stage as one function, which every stage calls |
| `sensitivities.py` | derivatives of the state in the time loop: columns in memory, stepped in loops |
| `outputs.py` | outputs of the time loop: scores, sums, series |
| `lanes.py` | arrays of many rollouts, arranged for the time loop |
| `block_tridiagonal.py`, `block_elimination.py` | block-tridiagonal systems, and their elimination, emitted |
| `order_statistics.py`, `bisection.py` | order statistics of many rows, and their search, emitted |

LLVM is loaded when something is first compiled.
"""

from diransac.simulation.compiler.block_tridiagonal import BlockSolution, solve_blocks
from diransac.simulation.compiler.functions import Map, Scan, compile_map, compile_scan
from diransac.simulation.compiler.machine_code import Target
from diransac.simulation.compiler.order_statistics import order_statistics, padded_rows

__all__ = [
    "BlockSolution",
    "Map",
    "Scan",
    "Target",
    "compile_map",
    "compile_scan",
    "order_statistics",
    "padded_rows",
    "solve_blocks",
]
