# SPDX-License-Identifier: Apache-2.0
"""Reflectance of surfaces in mesh files: one grey each, linear in light.

Images are sRGB as in the glTF specification (3.9.2), factors are linear. A texture becomes its
mean.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from chaserdock_models.arrays import Array
from chaserdock_models.meshes import Material

from .mesh_sources import MeshFileError

_LUMINANCE = (0.2126, 0.7152, 0.0722)
"""Share of red, green and blue in luminance (ITU-R BT.709)."""
_DIELECTRIC = 0.04
"""Reflectance of a dielectric at normal incidence (glTF 2.0, appendix B)."""


def grey_of(rgb: Array) -> float:
    """Return the mean luminance of linear colours (n, 3), 0 to 1."""
    mean = float((np.asarray(rgb, dtype=float) @ _LUMINANCE).mean())
    if not np.isfinite(mean):
        raise MeshFileError("has a colour that is not a number")
    return round(float(np.clip(mean, 0.0, 1.0)), 4)


def linear_of(encoded: Array) -> Array:
    """Return linear values of sRGB values, both 0 to 1 (IEC 61966-2-1)."""
    return np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)


def channel_means(image: Any, is_srgb: bool) -> Array:
    """Return the means of red, green and blue (3,), linear, of an image of Pillow.

    Raises MeshFileError for a damaged image.
    """
    levels = np.linspace(0.0, 1.0, 256)
    try:
        if image.mode.startswith(("I", "F")):  # 16 bits of grey
            image = image.point(lambda v: v / 257.0).convert("L")
        counts = np.reshape(image.convert("RGB").histogram(), (3, 256))
    except Exception as error:  # Pillow raises whatever its decoders stumble over
        raise MeshFileError(f"has a texture that cannot be read: {str(error)[:80]}") from None
    return counts @ (linear_of(levels) if is_srgb else levels) / counts.sum(axis=1)


def metallic_roughness(label: str, grey: float, metallic: float, roughness: float) -> Material:
    """Return the material of metallic-roughness shading.

    A metal reflects mostly in its highlight, whose exponent is 2 / r^4 - 2 at the roughness r.
    """
    metallic, roughness = float(np.clip(metallic, 0, 1)), float(np.clip(roughness, 0.1, 1.0))
    shininess = float(np.clip(2.0 / roughness**4 - 2.0, 1.0, 200.0))
    diffuse = grey * (1.0 - 0.5 * metallic)
    specular = _DIELECTRIC * (1.0 - metallic) + 0.8 * grey * metallic
    return Material(label, round(diffuse, 4), round(specular, 4), round(shininess, 2))


def phong(label: str, diffuse: float, specular: float, exponent: float) -> Material:
    """Return a material of Phong's shading."""
    shininess = exponent if np.isfinite(exponent) and exponent else 20.0
    return Material(label, diffuse, specular, float(np.clip(shininess, 1.0, 1000.0)))
