# SPDX-License-Identifier: Apache-2.0
"""Curves of figures as plain data, for charts of the page that zoom (page/charts.js).

A figure is drawn once, by matplotlib; this reads its curves and bars back. The charts are drawn by
uPlot 1.6.32 (MIT, 52 kB), which is part of the page; Plotly has 4.5 MB and Bokeh 1 MB.
"""

from __future__ import annotations

import base64
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from chaserdock_models.arrays import Array
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection, QuadMesh
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import StepPatch
from matplotlib.ticker import FixedLocator

from .plots import css_colour

_MOST_POINTS = 3000
"""Largest number of points of a curve: three a pixel. Larger: the zoom shows more of a long flight,
larger page.
"""
TIME = "time / s"
"""Label of an axis of time."""


_SCALES = {"linear": 1, "log": 3, "symlog": 4}
"""uPlot's numbers of matplotlib's scales; its inverse hyperbolic sine stands for symlog."""


@dataclass
class ArrayPool:
    """Arrays for a page, each once: little-endian, base64."""

    arrays: list[str] = field(default_factory=list)
    _known: dict[bytes, int] = field(default_factory=dict)

    def add(self, values: Any, kind: str = "<f4") -> int:
        """Return the index in ``arrays`` of an array of this kind (NumPy's name), stored flat."""
        content = np.asarray(values, dtype=kind).tobytes()
        if content not in self._known:
            self._known[content] = len(self.arrays)
            self.arrays.append(base64.b64encode(content).decode())
        return self._known[content]


@dataclass
class ChartData:
    """Panels of figures, and their arrays."""

    pool: ArrayPool = field(default_factory=ArrayPool)
    figures: dict[str, list[dict[str, Any]]] = field(default_factory=dict)

    def add(self, name: str, figure: Figure) -> None:
        """Add the panels of a figure that has been laid out: those with a labelled x axis. A view
        of three dimensions has none.
        """
        flat = [axes for axes in figure.axes if axes.axison and axes.name == "rectilinear"]
        panels = [self._panel(axes, over) for axes in flat if (over := _x_label(axes))]
        panels = [panel for panel in panels if panel["curves"] or panel["bars"]]
        if panels:
            self.figures[name] = panels

    def _panel(self, axes: Axes, over: str) -> dict[str, Any]:
        box, curves, limits = axes.get_position(), list[dict[str, Any]](), list[dict[str, Any]]()
        named: dict[str, str] = {}
        for line in axes.get_lines():
            x, y = (_thinned(values) for values in line.get_data())
            colour = css_colour(to_hex(line.get_color()))
            if len(x) > 2:
                label = (
                    named.setdefault(colour, _label(line)) if _is_unnamed(line) else _label(line)
                )
                named.setdefault(colour, label)
                curves.append(
                    {
                        "label": label,
                        "colour": colour,
                        "dashed": line.get_linestyle() == "--",
                        "dots": line.get_linestyle() == "None",
                        "steps": line.get_drawstyle() == "steps-post",
                        "x": self.pool.add(x),
                        "y": self.pool.add(y),
                    }
                )
            elif len(y) in (1, 2) and y[0] == y[-1]:
                everywhere = line.get_transform() != axes.transData
                ends = None if everywhere else [float(x[0]), float(x[-1])]
                limits.append({"x": ends, "y": float(y[0]), "colour": colour})
        for patch in axes.patches:
            if isinstance(patch, StepPatch):
                values, edges, _ = patch.get_data()
                curves.append(
                    {
                        "label": str(patch.get_label()),
                        "colour": css_colour(to_hex(patch.get_edgecolor())),
                        "dashed": False,
                        "dots": False,
                        "steps": True,
                        "x": self.pool.add(_thinned(edges[:-1])),
                        "y": self.pool.add(_thinned(values)),
                    }
                )
        return {
            "label": ", ".join(text for text in _texts(axes) if text).replace("\n", " "),
            "box": [round(100.0 * v, 3) for v in (box.x0, 1.0 - box.y1, box.width, box.height)],
            "over": over,
            "time": over == TIME,
            "x": _span(axes.get_xlim(), axes.get_xscale()),
            "y": _span(axes.get_ylim(), axes.get_yscale()) | {"names": _named_ticks(axes)},
            "curves": curves,
            "limits": limits,
            "bars": self._bars(axes),
        }

    def _bars(self, axes: Axes) -> list[dict[str, Any]]:
        """Return rows of bars from the bars and the meshes of a panel, with their opacity."""
        rows = []
        for shape in axes.collections:
            if isinstance(shape, QuadMesh):
                edges = np.asarray(shape.get_coordinates())
                shades = shape.cmap(shape.norm(np.asarray(shape.get_array())))
                for k, shade in enumerate(shades):
                    x, low, high = edges[k, :, 0], edges[k, 0, 1], edges[k + 1, 0, 1]
                    drawn = np.flatnonzero(shade[:, 3])
                    rows.append((x[:-1][drawn], x[1:][drawn], low, high, shade[drawn]))
            elif type(shape) is PolyCollection:  # no band between curves
                corners = np.array([path.vertices for path in shape.get_paths()])
                begin, end = corners[:, :, 0].min(axis=1), corners[:, :, 0].max(axis=1)
                low, high = corners[0, :, 1].min(), corners[0, :, 1].max()
                shade = np.repeat(shape.get_facecolor()[:1], len(corners), axis=0)
                rows.append((begin, end, low, high, shade))
        return [
            {
                "from": self.pool.add(begin),
                "to": self.pool.add(end),
                "y": [float(low), float(high)],
                "colour": css_colour(to_hex(shade[0])),
                "opacity": self.pool.add(255.0 * shade[:, 3], "u1"),
            }
            for begin, end, low, high, shade in rows
            if len(begin)
        ]


def _thinned(values: Any) -> Array:
    step = -(-len(values) // _MOST_POINTS)
    return np.asarray(values, dtype=float)[:: max(step, 1)]


def _span(limits: tuple[float, float], scale: str) -> dict[str, Any]:
    """Return the ends of an axis in ascending order, uPlot's number of its scale, and -1 if it
    is inverted.
    """
    return {
        "ends": sorted(float(v) for v in limits),
        "scale": _SCALES[scale],
        "direction": 1 if limits[0] <= limits[1] else -1,
    }


def _named_ticks(axes: Axes) -> list[tuple[float, str]]:
    """Return place and text of the ticks of a y axis that have names; none if they are numbers."""
    if not isinstance(axes.yaxis.get_major_locator(), FixedLocator):
        return []
    labels = axes.get_yticklabels()
    return [(float(y), t.get_text()) for y, t in zip(axes.get_yticks(), labels, strict=True)]


def _x_label(axes: Axes) -> str:
    """Return the label of the x axis: that of the axes, or of others that share their x axis."""
    siblings = (axes, *axes.get_shared_x_axes().get_siblings(axes))
    return next((label for other in siblings if (label := other.get_xlabel())), "")


def _texts(axes: Axes) -> tuple[str, str]:
    return axes.get_ylabel(), axes.get_title("left")


def _is_unnamed(line: Line2D) -> bool:
    return str(line.get_label()).startswith("_")


def _label(line: Line2D) -> str:
    return "value" if _is_unnamed(line) else str(line.get_label())
