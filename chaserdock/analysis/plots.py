# SPDX-License-Identifier: Apache-2.0
"""Style of the figures, and their export to files or inline SVG.

The colours are distinguishable for colour-blind readers (Okabe and Ito, 2008) on white and on dark
backgrounds. Text stays text. In an inline SVG the colours are CSS variables, so that a figure
follows the theme of the page.
"""

from __future__ import annotations

import base64
import io
import re
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any, Literal

import matplotlib
from chaserdock_protocol.output_files import replaced
from matplotlib import get_data_path
from matplotlib.axes import Axes
from matplotlib.figure import Figure

INK, FAINT, GRID = "#1b1e23", "#5c6370", "#d9dce1"
GOOD = "#1b7f4b"
SERIES = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#7a6a00", "#6b4fa0")
AXES_XYZ = (INK, "#858d99", "#9c6b4e")
"""Colours of x, y and z: none of a chaser."""
LIMIT = "#b3261e"

STYLE: dict[str, Any] = {
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],
    "font.size": 9.0,
    "axes.titlesize": 9.5,
    "axes.titlelocation": "left",
    "axes.edgecolor": FAINT,
    "axes.labelcolor": INK,
    "axes.titlecolor": INK,
    "axes.linewidth": 0.7,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": GRID,
    "grid.linewidth": 0.6,
    "text.color": INK,
    "xtick.color": FAINT,
    "ytick.color": FAINT,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "lines.linewidth": 1.1,
    "legend.frameon": False,
    "legend.fontsize": 8.5,
    "figure.constrained_layout.use": True,
    "svg.fonttype": "none",
    "pdf.fonttype": 42,  # TrueType, so that text can be edited; the default is Type 3
    "ps.fonttype": 42,
    "savefig.dpi": 150,
    "path.simplify_threshold": 0.3,
}

_VARIABLES = {
    INK: "ink",
    FAINT: "faint",
    GRID: "grid",
    LIMIT: "limit",
    GOOD: "good",
    AXES_XYZ[1]: "axis-y",
    AXES_XYZ[2]: "axis-z",
    **{c: f"series-{k}" for k, c in enumerate(SERIES)},
}


MAX_POINTS = 20_000
"""Longer series are decimated. Figures of all values would have gigabytes for ten hours."""


def decimation(number: int) -> int:
    """Return the factor by which a series of ``number`` values is decimated."""
    return max(1, -(-number // MAX_POINTS))


def decimated(number: int) -> slice:
    """Return the slice that selects the drawn values out of ``number``."""
    return slice(None, None, decimation(number))


class MissingData(Exception):
    """A figure cannot be drawn; the text names what the log lacks."""


def styled(salt: str = "chaserdock") -> AbstractContextManager[None]:
    """Apply the style within a context; ``salt`` makes the ids of SVG elements reproducible."""
    settings: Any = STYLE | {"svg.hashsalt": salt}
    return matplotlib.rc_context(settings)


def colour(number: int) -> str:
    """Return the colour of chaser ``number`` in every figure."""
    return SERIES[number % len(SERIES)]


def dashes(number: int) -> Any:
    """Return a line style for chaser or pair ``number``; overlapping lines stay visible."""
    return ("-", (0, (5, 2)), (0, (2, 1.5)), (0, (7, 2, 1.5, 2)))[number % 4]


def new_figure(
    rows: int, columns: int = 1, height: float = 2.3, **options: Any
) -> tuple[Figure, list[Axes]]:
    """Create a figure of the page's width; return it and its axes row by row. ``height`` of one row
    in inches.
    """
    figure = Figure(figsize=(9.6, 0.35 + height * rows))
    axes: Any = figure.subplots(rows, columns, squeeze=False, **options)
    return figure, list(axes.ravel())


def limit_line(
    axes: Axes, value: float, label: str, at: Literal["left", "right"] = "right"
) -> None:
    """Draw a dashed limit across the axes, labelled at one end."""
    axes.axhline(value, color=LIMIT, linestyle=(0, (5, 3)), linewidth=0.9)
    axes.annotate(
        label,
        (1.0 if at == "right" else 0.0, value),
        xycoords=("axes fraction", "data"),
        xytext=(-2 if at == "right" else 2, 2),
        textcoords="offset points",
        ha=at,
        color=LIMIT,
        fontsize=8,
    )


def legend_above(axes: Axes, columns: int = 8, **entries: Any) -> None:
    """Place the legend in one row above the right end of the axes. ``entries``: handles and labels
    in place of those of the curves.
    """
    axes.legend(
        **entries,
        loc="lower right",
        bbox_to_anchor=(1.0, 1.0),
        ncols=columns,
        borderaxespad=0.1,
        handlelength=1.4,
    )


def save(figure: Figure, path: Path) -> None:
    """Write a figure in the format of the path's suffix; equal figures give equal SVG files. PDF
    and SVG contain the characters that they use as TrueType.
    """
    is_svg = path.suffix == ".svg"
    with styled(path.stem), replaced(path) as new:
        figure.savefig(new, facecolor="white", metadata={"Date": None} if is_svg else None)
        if is_svg:
            text = new.read_text(encoding="utf-8")
            style = f"<style>{font_face(text)}</style>"
            new.write_text(text.replace("</metadata>", f"</metadata>{style}", 1), encoding="utf-8")


def font_face(text: str) -> str:
    """Return the CSS rule that embeds the characters of a text in the font of the figures."""
    from fontTools.subset import Options, Subsetter
    from fontTools.ttLib import TTFont

    options = Options(hinting=False, layout_features=[], notdef_outline=True)
    options.drop_tables += ["FFTM"]  # the date of the subset
    font = TTFont(get_data_path() + "/fonts/ttf/DejaVuSans.ttf", recalcTimestamp=False)
    subset = Subsetter(options)
    subset.populate(text="".join(sorted(set(text))))
    subset.subset(font)
    data = io.BytesIO()
    font.save(data)
    url = "data:font/ttf;base64," + base64.b64encode(data.getvalue()).decode()
    return f"@font-face{{font-family:'DejaVu Sans';src:url({url})}}"


def _rounded(attribute: re.Match[str]) -> str:
    """Return an attribute of SVG with coordinates to 0.01 points: two thirds of the length."""
    return re.sub(r"(\d\.\d\d)\d+", r"\1", attribute[0])


def css_colour(hexadecimal: str) -> str:
    """Return the page's CSS variable of a colour of the figures, or the colour itself."""
    variable = _VARIABLES.get(hexadecimal)
    return hexadecimal if variable is None else f"--{variable}"


def to_inline_svg(figure: Figure, name: str, title: str) -> str:
    """Return an ``svg`` element for a page: ids unique to ``name``, colours as CSS variables, no
    external references.
    """
    out = io.StringIO()
    with styled(name):
        figure.savefig(out, format="svg", transparent=True, metadata={"Date": None})
    text = out.getvalue()
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>", "", text, count=1, flags=re.DOTALL)
    text = re.sub(r'\sxmlns(:\w+)?="[^"]*"', "", text, count=2)
    text = re.sub(r'(<svg[^>]*?) width="[^"]*"', r"\1", text, count=1)
    text = re.sub(r'(<svg[^>]*?) height="[^"]*"', r"\1", text, count=1)
    # All figures of a page share one namespace of ids. SVG needs no xlink prefix.
    text = re.sub(r'\bid="', f'id="{name}-', text)
    text = text.replace("url(#", f"url(#{name}-").replace('xlink:href="#', f'href="#{name}-')
    text = re.sub(r'\s(d|x|y|transform)="[^"]*"', _rounded, text)
    for hexadecimal, variable in _VARIABLES.items():
        text = text.replace(hexadecimal, f"var(--{variable})")
    text = re.sub(
        r"font(-family)?: ([^;\"]*)'DejaVu Sans'[^;\"]*", r"font\1: \2var(--figure-font)", text
    )
    return text.replace("<svg ", f'<svg role="img" aria-label="{title}" ', 1)
