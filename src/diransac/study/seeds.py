"""Seeds that depend on what they are for, and on nothing else."""

from __future__ import annotations

import hashlib
import json

__all__ = ["derived_seed"]

_BYTES = 8


def derived_seed(*what: str | int) -> int:
    """A number of 63 bits that depends on all of ``what``, in order, and is the same on every machine.

    Trials that run alone, in another order, in another batch or elsewhere so draw the same.
    """
    digest = hashlib.blake2b(json.dumps(what).encode(), digest_size=_BYTES).digest()
    return int.from_bytes(digest, "big") >> 1
