# SPDX-License-Identifier: Apache-2.0
"""Perception of the target: ``python benchmarks/perception.py [--only PART ...]``.

``markers``: accuracy, range and speed by markers, and the renderers; ``track``: printed sheets
in independent images; ``mesh``: the renderer of
meshes; ``shape``: by shape in single images; ``flight``: by shape in missions.
"""

from common import main
from parts import markers, mesh_renderer, shape_flights, shape_views, sheet_tracking

GROUPS = (
    markers.GROUP,
    sheet_tracking.GROUP,
    mesh_renderer.GROUP,
    shape_views.GROUP,
    shape_flights.GROUP,
)

if __name__ == "__main__":
    main(__doc__, GROUPS)
