"""Figures: colours, panels in inches, heading with legend, and files that are reproducible byte for byte."""

from __future__ import annotations

import io
import math
import sys
import warnings
from collections.abc import Iterator, Sequence
from contextlib import chdir, contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any

from diransac.atomic import write_bytes
from diransac.errors import SettingsError
from diransac.plain_text import printable

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Range = tuple[float, float]
"""Smallest and largest value that an axis shows."""

# Colours and dashes are those of the report: a method looks the same there.
PAPER, INK, MUTED, RULE, SOFT = "#ffffff", "#1c2126", "#5a646e", "#d8dde2", "#f4f6f8"
REFERENCE = "#a3adb6"
COLOURS = ("#0072b2", "#00875f", "#a63a79", "#946a00", "#2e9bd6", "#4b4bb5")
# Solid, and on and off from a start, in line widths.
DASHES: tuple[Any, ...] = (
    *("-", (0.0, (5.3, 1.8)), (0.0, (1.8, 1.8)), (0.0, (5.3, 1.8, 1.2, 1.8)), (0.0, (8.2, 2.4)), (0.0, (3.5, 0.9))),
)


def extent(visible: Range) -> float:
    """Length of the range of an axis."""
    return visible[1] - visible[0]


# Panels --------------------------------------------------------------------------------------------------------------

WIDTH = 9.0
"""Width of every figure, inches."""

# Free height between panels, inches.
_GAP = 0.06

LINE = 0.155
"""Height of a line of a caption, inches."""


def empty_figure(height: float) -> Figure:
    """Figure without panels.

    Matplotlib, which is imported here first, would take settings from ``matplotlibrc`` in the working directory.
    """
    beside = Path("matplotlibrc").exists() and "matplotlib" not in sys.modules
    with chdir(Path(__file__).parent) if beside else nullcontext():
        from matplotlib.figure import Figure

    return Figure(figsize=(WIDTH, height), facecolor=PAPER)


def flight_panels(
    states: Sequence[str],
    inputs: Sequence[str],
    box: tuple[Range, Range] | None,
    entries: Sequence[LegendEntry],
    title: str | None,
) -> tuple[Figure, dict[str, Axes], Axes | None]:
    """Figure with a heading, a panel per signal, and one for the path: beside the states, or above them if it is wide.

    Parameters
    ----------
    box : ranges of the path in x and z; None for no path
    entries, title : as in `headed_figure`
    """
    row_height, times = 1.12, 0.24  # inches: a row of panels, and the times below the last one
    path_width, path_height = 3.75, 2.3  # inches: beside the states, and above them
    columns = _halves(states)
    n_rows, n_input_rows = max(map(len, columns)), -(-len(inputs) // 2)
    wide = box is not None and extent(box[0]) > 2.2 * extent(box[1])
    above = path_height + times if wide else 0.0
    figure, header = headed_figure(entries, title, above + (n_rows + n_input_rows) * row_height + 2.0 * times + _GAP)
    top, below = header + above, header + above + n_rows * row_height + times

    path = None
    if box is not None:
        size = (WIDTH, path_height) if wide else (path_width, min(n_rows, 3) * row_height)
        path = panel(figure, 0.0, header, *size)
    left = path_width if box is not None and not wide else 0.0
    width = (WIDTH - left) / 2.0
    panels = {}
    for column, names in enumerate(columns):
        for row, name in enumerate(names):
            place = (left + column * width, top + row * row_height, width, row_height)
            panels[name] = panel(figure, *place, last=row == len(names) - 1)
    for i, name in enumerate(inputs):
        alone = i == len(inputs) - 1 and i % 2 == 0
        place = (i % 2 * WIDTH / 2.0, below + i // 2 * row_height, WIDTH if alone else WIDTH / 2.0, row_height)
        panels[name] = panel(figure, *place, last=i >= len(inputs) - 2)
    return figure, panels, path


def _halves(states: Sequence[str]) -> tuple[Sequence[str], Sequence[str]]:
    """Coordinates and velocities by name; the first and second half if names do not distinguish them."""
    velocities = [name for name in states if name.endswith("_dot")]
    if not velocities or len(velocities) == len(states):
        half = -(-len(states) // 2)
        return states[:half], states[half:]
    return [name for name in states if name not in velocities], velocities


def axes_at(figure: Figure, left: float, top: float, width: float, height: float) -> Axes:
    """Axes without a frame in a rectangle, inches from the figure's top left."""
    full = figure.get_figheight()
    place = (left / WIDTH, 1.0 - (top + height) / full, width / WIDTH, height / full)
    axes = figure.add_axes(place, facecolor=SOFT)
    for spine in axes.spines.values():
        spine.set_visible(False)
    axes.tick_params(length=0, labelsize=7.5, labelcolor=MUTED, pad=3)
    axes.grid(color=RULE, linewidth=0.7)
    axes.set_axisbelow(True)
    return axes


def panel(figure: Figure, left: float, top: float, width: float, height: float, *, last: bool = True) -> Axes:
    """Panel in a rectangle, inches from the figure's top left; only the last of a column has time labels."""
    from matplotlib.ticker import MaxNLocator

    values, name, edge = 0.46, 0.25, 0.17  # inches: values on the left, name above, and the right margin
    inner_width, inner_height = width - values - edge, height - name - _GAP
    axes = axes_at(figure, left + values, top + name, inner_width, inner_height)
    axes.tick_params(labelbottom=last)
    axes.yaxis.set_major_locator(MaxNLocator(max(4, round(1.7 * inner_height)), steps=(1, 2, 5, 10)))
    axes.xaxis.set_major_locator(MaxNLocator(max(4, round(2.2 * inner_width)), steps=(1, 2, 5, 10)))
    return axes


def write_at(figure: Figure, x: float, top: float, text: str, **look: Any) -> None:
    """Write a text at a place, inches from the figure's top left."""
    at: dict[str, Any] = {"fontsize": 7.5, "color": MUTED, "va": "top"}
    figure.text(x / WIDTH, 1.0 - top / figure.get_figheight(), text, **(at | look))


def write_caption(figure: Figure, top: float, lines: Sequence[str]) -> None:
    """Write the lines of a caption below this height, inches from the figure's top."""
    for k, line in enumerate(lines):
        write_at(figure, 0.1, top + k * LINE, line)


def round_step(least: float) -> float:
    """Smallest of 1, 2 and 5 times a power of ten that is at least this."""
    decade = 10.0 ** math.floor(math.log10(least))
    return next(step * decade for step in (1.0, 2.0, 5.0, 10.0) if step * decade >= least)


def name_panel(axes: Axes, name: str, detail: str) -> None:
    """Write a panel's name, and in a muted colour its unit."""
    axes.set_title(name, loc="left", fontsize=8.5, color=INK, pad=4)
    axes.set_title(detail, loc="right", fontsize=7.5, color=MUTED, pad=4)


def inches(axes: Axes) -> tuple[float, float]:
    """Width and height of a panel, inches."""
    return axes.bbox.width / axes.figure.dpi, axes.bbox.height / axes.figure.dpi


# Heading -------------------------------------------------------------------------------------------------------------

# Inches: margin around title and legend.
_MARGIN = 0.16

LegendEntry = tuple[str, dict[str, Any]]
"""Label, and style of its line."""


def _columns(entries: Sequence[LegendEntry]) -> int:
    """Number of entries per line of the legend."""
    # Inches: width of a letter in the legend, and of a sample line with its margins.
    widths = [0.65 + 0.075 * len(label) for label, _ in entries]
    return len(entries) if sum(widths) < WIDTH - 0.2 else max(1, int((WIDTH - 0.2) / max(widths)))


def headed_figure(entries: Sequence[LegendEntry], title: str | None, height: float) -> tuple[Figure, float]:
    """Figure with a title, a legend and a free height below them, inches; and the height above that."""
    lines = -(-len(entries) // _columns(entries))
    header = _MARGIN + 0.19 * lines + _title_height(title)
    figure = empty_figure(header + height)
    draw_heading(figure, entries, title)
    return figure, header


def _title_height(title: str | None) -> float:
    """Height of the title, inches."""
    return 0.27 * len(title.splitlines()) if title else 0.0


def draw_heading(figure: Figure, entries: Sequence[LegendEntry], title: str | None) -> None:
    """Draw title and legend at the top of a figure, as `headed_figure` does."""
    from matplotlib.lines import Line2D

    inch = 1.0 / figure.get_figheight()
    top = 1.0 - _MARGIN / 2.0 * inch
    if title:
        figure.text(0.08 / WIDTH, top, title, fontsize=11.5, fontweight="bold", color=INK, va="top")
        top -= _title_height(title) * inch
    n_columns = _columns(entries)
    in_lines = [entry for column in range(n_columns) for entry in entries[column::n_columns]]
    figure.legend(
        handles=[Line2D([], [], label=label, **style) for label, style in in_lines],
        loc="upper left",
        bbox_to_anchor=(0.06 / WIDTH, top),
        ncols=n_columns,
        frameon=False,
        fontsize=8.5,
        labelcolor=INK,
        borderaxespad=0.0,
        borderpad=0.2,
        handlelength=2.6,
        columnspacing=1.8,
    )


# Files ---------------------------------------------------------------------------------------------------------------

_METADATA = {".png": {"Software": None}, ".svg": {"Date": None}, ".pdf": {"CreationDate": None}}


def check_ending(path: str | Path | None) -> str:
    """Lower-case ending of a figure's file, if there is to be one.  Raises SettingsError: it is unknown."""
    ending = "" if path is None else Path(path).suffix.lower()
    if path is not None and ending not in _METADATA:
        raise SettingsError(f'cannot write "{path}": its ending is not known; use one of {", ".join(_METADATA)}')
    return ending


@contextmanager
def _literal_texts(figure: Figure, **settings: Any) -> Iterator[None]:
    """Context in which a figure is saved: names are no formulas, have no control characters, and may lack a glyph."""
    from matplotlib import rc_context
    from matplotlib.text import Text

    for text in figure.findobj(Text):
        text.set_parse_math(False)
        text.set_text(printable(text.get_text()))
    # The ids of an SVG are hashes with a random salt; a fixed one gives the same file each time.
    with rc_context({"svg.hashsalt": "diransac", "text.parse_math": False, **settings}), warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Glyph .* missing from font", category=UserWarning)
        yield


def write(figure: Figure, path: str | Path | None) -> Figure:
    """The figure itself, written in the format of the file's ending, completely or not at all; None writes none.

    Raises SettingsError: the ending is unknown, or the file cannot be written.
    """
    if path is None:
        return figure
    ending, memory = check_ending(path), io.BytesIO()  # a full disk is an error of zlib to Matplotlib
    with _literal_texts(figure):
        figure.savefig(memory, format=ending[1:], dpi=200, metadata=_METADATA[ending])
    try:
        write_bytes(path, memory.getvalue())
    except OSError as error:
        raise SettingsError(f'cannot write "{path}": {error.strerror or error}') from error
    return figure


def svg(figure: Figure) -> str:
    """Figure as an ``<svg>`` element with selectable text, for embedding in a page."""
    memory = io.StringIO()
    with _literal_texts(figure, **{"svg.fonttype": "none"}):
        figure.savefig(memory, format="svg", metadata={"Date": None, "Creator": None, "Format": None, "Type": None})
    text = memory.getvalue()
    return text[text.index("<svg") :]
