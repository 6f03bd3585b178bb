"""Identified models as files for other programs: C, Python, CasADi and YAML.

In comes a `PortableModel`, which `Result.export` makes; out comes a file.  Begin with `formats.py`.

| file | contents |
|---|---|
| `portable.py` | `PortableModel`: what is written of a model, and its description in words |
| `statements.py` | expression graph of a function as assignments in C or Python |
| `formats.py` | the text of each format, and the formats by the endings of files |
"""

from diransac.export.formats import FORMATS, format_of, write_model
from diransac.export.portable import PortableModel

__all__ = ["FORMATS", "PortableModel", "format_of", "write_model"]
