# SPDX-License-Identifier: Apache-2.0
"""Curves of figures over time as plain data, for charts of the page that zoom (page/charts.js).

A figure is drawn once, by matplotlib; this reads its curves back. The charts are drawn by uPlot
1.6.32 (MIT, 52 kB), which is part of the page; Plotly has 4.5 MB and Bokeh 1 MB.
"""

from __future__ import annotations

import base64
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from chaserdock_models.arrays import Array
from matplotlib.axes import Axes
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import StepPatch

from .plots import css_colour

_MOST_POINTS = 3000
"""Largest number of points of a curve: three a pixel. Larger: the zoom shows more of a long flight,
larger page.
"""
TIME = "time / s"
"""Label of an axis of time."""


@dataclass
class ChartData:
    """Panels of figures, and their arrays, each once: little-endian float32, base64."""

    arrays: list[str] = field(default_factory=list)
    figures: dict[str, list[dict[str, Any]]] = field(default_factory=dict)
    _known: dict[bytes, int] = field(default_factory=dict)

    def add(self, name: str, figure: Figure) -> None:
        """Add the panels over time of a figure that has been laid out, if it has any curve."""
        panels = [self._panel(axes) for axes in figure.axes if _is_over_time(axes)]
        panels = [panel for panel in panels if panel["curves"]]
        if panels:
            self.figures[name] = panels

    def _array(self, values: Array) -> int:
        content = np.asarray(values, dtype="<f4").tobytes()
        if content not in self._known:
            self._known[content] = len(self.arrays)
            self.arrays.append(base64.b64encode(content).decode())
        return self._known[content]

    def _panel(self, axes: Axes) -> dict[str, Any]:
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
                        "x": self._array(x),
                        "y": self._array(y),
                    }
                )
            elif len(y) == 2 and y[0] == y[1]:
                limits.append({"y": float(y[0]), "colour": colour})
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
                        "x": self._array(_thinned(edges[:-1])),
                        "y": self._array(_thinned(values)),
                    }
                )
        low, high = axes.get_ylim()
        begin, end = axes.get_xlim()
        return {
            "label": ", ".join(text for text in _texts(axes) if text).replace("\n", " "),
            "box": [round(100.0 * v, 3) for v in (box.x0, 1.0 - box.y1, box.width, box.height)],
            "x": [begin, end],
            "y": [low, high],
            "log": axes.get_yscale() == "log",
            "curves": curves,
            "limits": limits,
        }


def _thinned(values: Any) -> Array:
    step = -(-len(values) // _MOST_POINTS)
    return np.asarray(values, dtype=float)[:: max(step, 1)]


def _is_over_time(axes: Axes) -> bool:
    """Return whether the axes, or others that share their x axis, are labelled as time."""
    siblings = axes.get_shared_x_axes().get_siblings(axes)
    return axes.axison and any(other.get_xlabel() == TIME for other in siblings)


def _texts(axes: Axes) -> tuple[str, str]:
    return axes.get_ylabel(), axes.get_title("left")


def _is_unnamed(line: Line2D) -> bool:
    return str(line.get_label()).startswith("_")


def _label(line: Line2D) -> str:
    return "value" if _is_unnamed(line) else str(line.get_label())
