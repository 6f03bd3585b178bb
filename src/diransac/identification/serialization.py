"""JSON forms of frozen dataclasses: declared by their annotations, written and checked by pydantic.

Fields that hold arrays name their form in their annotation (`Numbers`, `Mask`, `Series`, ...).  Pydantic is imported
when something is first written or read.
"""

from __future__ import annotations

import base64
import dataclasses
from collections.abc import Callable, Mapping
from functools import cache
from typing import Annotated, Any, TypeVar

import numpy as np

from diransac.arrays import BoolArray, FloatArray, IntArray

T = TypeVar("T")


@dataclasses.dataclass(frozen=True)
class Form:
    """Annotation of a field: how its value is written to JSON and read back."""

    encode: Callable[[Any], Any]
    decode: Callable[[Any], Any]

    def __get_pydantic_core_schema__(self, _source: object, _handler: object) -> Any:
        from pydantic_core import core_schema

        written = core_schema.plain_serializer_function_ser_schema(self.encode)
        return core_schema.no_info_plain_validator_function(self._checked, serialization=written)

    def _checked(self, value: object) -> Any:
        try:
            return self.decode(value)
        except (TypeError, AttributeError, LookupError, ArithmeticError) as error:
            raise ValueError(f"{type(error).__name__}: {error}") from error

    @classmethod
    def by_name(cls, encode: Callable[[Any], Any], decode: Callable[[Any], Any]) -> Form:
        """The form of a mapping from names to values that have these forms."""
        return cls(
            lambda values: {str(name): encode(x) for name, x in values.items()},
            lambda data: {str(name): decode(x) for name, x in data.items()},
        )


def _encode_number(x: float) -> float | str:
    """A number; as text where JSON has none: infinity and NaN."""
    return float(x) if np.isfinite(x) else str(float(x))


def _decode_number(x: object) -> float:
    if isinstance(x, bool) or not isinstance(x, int | float | str):
        raise ValueError(f"{x!r} is no number")
    return float(x)


def _encode_numbers(values: FloatArray) -> Any:
    if np.isfinite(values).all():
        return values.tolist()
    return [_encode_numbers(x) for x in values] if values.ndim > 1 else [_encode_number(x) for x in values]


def _decode_numbers(data: object) -> FloatArray:
    if not isinstance(data, list):
        raise ValueError(f"{data!r:.40} is no list of numbers")
    return np.array(data, np.float64)


def _decode_whole_numbers(data: object) -> IntArray:
    if not isinstance(data, list) or not all(type(x) is int for x in data):
        raise ValueError(f"{data!r:.40} is no list of whole numbers")
    return np.array(data, np.int64)


def _encode_mask(mask: BoolArray) -> dict[str, Any]:
    return {"rows": len(mask), "bits": base64.b64encode(np.packbits(mask).tobytes()).decode()}


def _decode_mask(data: Any) -> BoolArray:
    n_rows = int(data["rows"])
    packed = np.frombuffer(base64.b64decode(data["bits"], validate=True), dtype=np.uint8)
    if len(packed) != (n_rows + 7) // 8:
        raise ValueError(f"a mask of {n_rows} rows has {len(packed)} bytes")
    return np.unpackbits(packed, count=n_rows).astype(bool)


Number = Annotated[float, Form(_encode_number, _decode_number)]
"""A number that may be infinite or NaN."""
Numbers = Annotated[FloatArray, Form(_encode_numbers, _decode_numbers)]
"""An array of numbers of any shape, as nested lists."""
WholeNumbers = Annotated[IntArray, Form(lambda values: values.tolist(), _decode_whole_numbers)]
"""An array ``(n,)`` of whole numbers."""
Mask = Annotated[BoolArray, Form(_encode_mask, _decode_mask)]
"""An array ``(N,)`` of Booleans, packed."""
Values = Annotated[Mapping[str, float], Form.by_name(_encode_number, _decode_number)]
"""Numbers by name."""
NumberPairs = Mapping[str, tuple[Number, Number]]
"""Pairs of numbers by name."""
Series = Annotated[Mapping[str, FloatArray], Form.by_name(_encode_numbers, _decode_numbers)]
"""Arrays by name."""
Masks = Annotated[Mapping[str, BoolArray], Form.by_name(_encode_mask, _decode_mask)]
"""Masks by name."""


def dump(value: Any, kind: Any = None) -> Any:
    """A value as JSON can hold it; `load` reads a dataclass back.

    Parameters
    ----------
    value : object
    kind : type, optional
        Its annotation; by default its class.
    """
    form: Any = type(value) if kind is None else kind
    return _adapter(form).dump_python(value, mode="json")


def load(kind: type[T], data: Mapping[str, Any]) -> T:
    """Dataclass from a mapping that `dump` returned; keys that are not fields are ignored.

    Parameters
    ----------
    kind : type
        Class of the dataclass.
    data : mapping of str to object

    Returns
    -------
    dataclass of that class

    Raises
    ------
    KeyError
        A key is missing.
    ValueError
        The value of a key is of another type; the message names the key.
    """
    from pydantic import ValidationError

    own = {f.name: data[f.name] for f in dataclasses.fields(kind)}  # type: ignore[arg-type]
    adapter: Any = _adapter(kind)  # type: ignore[arg-type]  # a class is hashable
    try:
        found: T = adapter.validate_python(own)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        place = ".".join(str(x) for x in first["loc"])
        raise ValueError(f"{place}: {first['msg']}") from error
    return found


@cache
def _adapter(kind: Any) -> Any:
    from pydantic import TypeAdapter

    return TypeAdapter(kind)
