"""Colours for positions on a body, for errors and for signed values.

Colours are interpolated in the colour space OKLab, in which equal distances look like equal differences.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Float64

from jaxsmw.evaluation.metrics import THRESHOLDS
from jaxsmw.geometry.mesh import Mesh
from jaxsmw.report.standing import visible

ERROR_LIMIT = max(THRESHOLDS)
"""The error at which the colour scale ends, as a fraction of the square root of the target's area.

All figures and pages use this scale by default, so their colours are comparable.
"""

# Björn Ottosson, "A perceptual color space for image processing", 2020. The first matrix converts OKLab to
# the cube roots of cone responses. The second matrix converts cone responses to linear sRGB.
_LAB_TO_ROOTS = np.array(
    [
        [1, 0.3963377774, 0.2158037573],
        [1, -0.1055613458, -0.0638541728],
        [1, -0.0894841775, -1.2914855480],
    ]
)
_CONES_TO_RGB = np.array(
    [
        [4.0767416621, -3.3077115913, 0.2309699292],
        [-1.2684380046, 2.6097574011, -0.3413193965],
        [-0.0041960863, -0.7034186147, 1.7076147010],
    ]
)

# The colours of errors in OKLab, from paper white for no error to dark plum for large errors. Lightness
# decreases monotonically, so the order is visible to colour-blind readers and in black-and-white prints.
_ERROR_SCALE = np.array(
    [
        [0.95, 0.00, 0.015],
        [0.88, 0.02, 0.110],
        [0.74, 0.11, 0.120],
        [0.56, 0.20, 0.060],
        [0.32, 0.11, -0.050],
    ]
)

# The colours of signed values in OKLab, from blue for the most negative value to red for the most positive
# value. Both ends have the same lightness, so neither sign stands out. The key False gives the scale for
# light backgrounds, in which the colour for zero is paper white. The key True gives the scale for dark
# backgrounds, in which the colour for zero is dark.
_SIGNED_SCALE = {
    False: np.array(
        [
            [0.44, -0.03, -0.16],
            [0.68, -0.05, -0.11],
            [0.96, 0.00, 0.005],
            [0.68, 0.12, 0.07],
            [0.44, 0.16, 0.08],
        ]
    ),
    True: np.array(
        [
            [0.82, -0.06, -0.09],
            [0.58, -0.05, -0.13],
            [0.23, 0.00, -0.01],
            [0.58, 0.16, 0.07],
            [0.82, 0.09, 0.06],
        ]
    ),
}

PLAIN = np.array([0.76, 0.77, 0.79])
"""The grey of plain surfaces and of vertices with an unknown error, as an sRGB colour (3,) in [0, 1]."""


def linear_to_srgb(linear: Float64[np.ndarray, "*shape 3"]) -> Float64[np.ndarray, "*shape 3"]:
    """Convert linear RGB (…, 3), clipped to [0, 1], to sRGB (…, 3) in [0, 1] (IEC 61966-2-1)."""
    linear = np.clip(linear, 0, 1)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


def srgb_to_linear(srgb: Float64[np.ndarray, "*shape 3"]) -> Float64[np.ndarray, "*shape 3"]:
    """Convert sRGB colours (…, 3) in [0, 1] to linear RGB (…, 3), which can be averaged."""
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def position_colors(mesh: Mesh) -> Float64[np.ndarray, "n 3"]:
    """Return an sRGB colour (n, 3) for every vertex of an upright mesh, which shows its position on the body.

    The colours vary smoothly. The right side of the body is green, and the left side is red. The hue changes
    from yellow to blue along the height or the length of the body, whichever is larger. Along the shorter of
    the two axes, only the lightness changes. Each limb of people and animals therefore has its own hue, and
    swapped limbs are obvious.

    Along each axis, the colour depends on the vertex's relative position in the bounding box and on its
    relative rank among all vertices. Without the rank, the trunk of a slender body would be uniformly grey.
    """
    used = visible(mesh)
    low, high = used.min(axis=0), used.max(axis=0)
    # Coordinates are rounded to this grid. Without the grid, the ranks of vertices on a flat mesh would
    # depend on rounding errors, and the colours would be noisy.
    grid = 1e-6 * np.max(high - low)
    coordinates = np.empty_like(mesh.vertices)
    for axis in range(3):
        values = np.round(mesh.vertices[:, axis] / grid)
        ordered = np.sort(visible(mesh, values))
        below = sum(np.searchsorted(ordered, values, side) for side in ("left", "right"))
        position = (mesh.vertices[:, axis] - low[axis]) / max(high[axis] - low[axis], grid)
        coordinates[:, axis] = np.clip(position, 0, 1) + below / (2 * len(used)) - 1
    lateral, up, forward = coordinates.T
    longer, shorter = (up, forward) if high[1] - low[1] >= high[2] - low[2] else (forward, up)
    return _oklab_to_srgb(
        np.stack([0.71 + 0.09 * shorter, 0.02 + 0.16 * lateral, 0.03 - 0.16 * longer], axis=1)
    )


def error_colors(errors: Float[np.ndarray, " m"], limit: float = ERROR_LIMIT) -> Float64[np.ndarray, "m 3"]:
    """Return the sRGB colours (m, 3) of non-negative errors (m,) on a scale from 0 to `limit`.

    Errors above `limit` have the last colour. Unknown errors (NaN) have the colour `PLAIN`.
    """
    is_known = ~np.isnan(errors)
    colors = _on_scale(np.where(is_known, errors, 0), 0.0, limit, _ERROR_SCALE)
    return np.where(is_known[:, None], colors, PLAIN)


def signed_colors(
    values: Float[np.ndarray, " m"], limit: float, *, on_dark: bool = False
) -> Float64[np.ndarray, "m 3"]:
    """Return the sRGB colours (m, 3) of values (m,) on a scale from `-limit` (blue) to `limit` (red).

    Values outside of the scale are clipped. The colour for zero is dark on a dark background, else white.
    """
    return _on_scale(values, -limit, limit, _SIGNED_SCALE[on_dark])


def _on_scale(values: np.ndarray, low: float, high: float, scale: np.ndarray) -> np.ndarray:
    """Interpolate a colour scale from `low` (the first colour) to `high` (the last colour)."""
    stops = np.linspace(low, high, len(scale))
    return _oklab_to_srgb(np.stack([np.interp(values, stops, channel) for channel in scale.T], axis=1))


def _oklab_to_srgb(lab: np.ndarray) -> np.ndarray:
    return linear_to_srgb((lab @ _LAB_TO_ROOTS.T) ** 3 @ _CONES_TO_RGB.T)
