"""A figure as a file that is the same, byte for byte, whenever the figure is; written whole or not at all."""

from __future__ import annotations

import io
from pathlib import Path
from typing import TYPE_CHECKING

from diransac.atomic import write_with
from diransac.errors import SettingsError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["checked_ending", "svg", "write"]

_DOTS_PER_INCH = 200
_METADATA = {".png": {"Software": None}, ".svg": {"Date": None}, ".pdf": {"CreationDate": None}}
# An SVG names its parts by a hash, whose salt cannot be given in another way; it holds for one call alone.
_SALT = {"svg.hashsalt": "diransac"}


def checked_ending(path: Path) -> str:
    """What kind of file it is to be.  Raises SettingsError: none that is known."""
    ending = path.suffix.lower()
    if ending not in _METADATA:
        raise SettingsError(f'cannot write "{path}": its ending is not known; use one of {", ".join(_METADATA)}')
    return ending


def write(figure: Figure, path: Path) -> None:
    """Write the figure as its file's ending says.

    Raises SettingsError: the ending is not known, or the file cannot be written.
    """
    from matplotlib import rc_context

    ending = checked_ending(path)

    def save(temporary: Path) -> None:
        with rc_context(_SALT):
            figure.savefig(temporary, format=ending[1:], dpi=_DOTS_PER_INCH, metadata=_METADATA[ending])

    try:
        write_with(path, save)
    except OSError as error:
        raise SettingsError(f'cannot write "{path}": {error.strerror or error}') from error


def svg(figure: Figure) -> str:
    """The figure as an ``<svg>`` element, its texts left as text, to be put into a page."""
    from matplotlib import rc_context

    memory = io.StringIO()
    with rc_context({**_SALT, "svg.fonttype": "none"}):
        figure.savefig(memory, format="svg", metadata={"Date": None, "Creator": None, "Format": None, "Type": None})
    text = memory.getvalue()
    return text[text.index("<svg") :]
