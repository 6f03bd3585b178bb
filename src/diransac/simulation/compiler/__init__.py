"""A small compiler: expression graph -> typed instructions -> LLVM -> machine code on eight lanes at a time.

| file | what it holds |
|---|---|
| `graph.py` | the graph of a CasADi SX function: each value once, products fused into sums, invariants marked |
| `vectors.py` | arithmetic on eight float64 lanes, over llvmlite's IR builder |
| `angles.py`, `exponentials.py` | sin, atan2, exp, pow and the like, of such vectors |
| `operations.py` | the vector form of every operation, in one table; emits a graph by it |
| `machine_code.py` | LLVM module -> callable machine code; threads |
| `map_loop.py`, `row_map.py` | one function over many rows |
| `time_loop.py` | the time loop of a simulation; `diransac.simulation` is its face |
| `scan.py` | any other recurrence over rows, by the same loop |
| `inputs.py`, `kept.py` | variants of the loop: where inputs come from; what is kept of rollouts |
| `lanes.py` | arrays of many rollouts, checked and arranged for the loop |

LLVM is loaded when something is first compiled.
"""

from diransac.simulation.compiler.machine_code import Target
from diransac.simulation.compiler.row_map import Map, compile_map
from diransac.simulation.compiler.scan import Scan, compile_scan

__all__ = ["Map", "Scan", "Target", "compile_map", "compile_scan"]
