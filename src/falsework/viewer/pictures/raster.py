"""Compiled loops of the software renderer over triangles and pixels.

Whatever they find is written into arrays that they are given.
"""

from __future__ import annotations

import numpy as np

from falsework.utils.kernels import njit


@njit(cache=True, nogil=True)
def lay_over(image, veil):
    """Blend a picture with opacity into one without, in place."""
    for row in range(image.shape[0]):
        for column in range(image.shape[1]):
            share = veil[row, column, 3]
            if share > 0:
                for channel in range(4):
                    image[row, column, channel] = image[row, column, channel] * (1 - share) + veil[row, column, channel]


@njit(cache=True, nogil=True)
def average(image, samples, mean):
    """Write the mean over squares of pixels, without opacity, shape (height, width, 3), which begins at zero."""
    height, width = mean.shape[0], mean.shape[1]
    for row in range(height * samples):
        for column in range(width * samples):
            for channel in range(3):
                mean[row // samples, column // samples, channel] += image[row, column, channel]
    for row in range(height):
        for column in range(width):
            for channel in range(3):
                mean[row, column, channel] /= samples**2


@njit(cache=True, nogil=True)
def depth_buffer(triangles, facing, face, depth):
    """Write the index of the nearest triangle at each pixel, and its depth; where there is none, both stay.

    Args:
        triangles: pixels to the right and down, and depth, of their corners, shape (triangles, 3, 3).
        facing: those above zero are drawn, shape (triangles,).
        face, depth: shape (height, width).
    """
    height, width = face.shape
    for index in range(len(triangles)):
        if facing[index] <= 0:
            continue
        corners = triangles[index]
        x0, y0, z0 = corners[0, 0], corners[0, 1], corners[0, 2]
        x1, y1, z1 = corners[1, 0], corners[1, 1], corners[1, 2]
        x2, y2, z2 = corners[2, 0], corners[2, 1], corners[2, 2]
        area = (x1 - x0) * (y2 - y0) - (x2 - x0) * (y1 - y0)
        if area == 0:
            continue
        left, right = max(int(np.floor(min(x0, x1, x2))), 0), min(int(np.ceil(max(x0, x1, x2))), width - 1)
        top, bottom = max(int(np.floor(min(y0, y1, y2))), 0), min(int(np.ceil(max(y0, y1, y2))), height - 1)
        # Barycentric coordinates are linear in x: a value at x = 0 of each row, and a slope.
        a_slope, b_slope = (y1 - y2) / area, (y2 - y0) / area
        for row in range(top, bottom + 1):
            y = row + 0.5
            a_here = (x1 * (y2 - y) - x2 * (y1 - y)) / area
            b_here = (x2 * (y0 - y) - x0 * (y2 - y)) / area
            for column in range(left, right + 1):
                x = column + 0.5
                a = a_here + a_slope * x
                b = b_here + b_slope * x
                c = 1.0 - a - b
                if a >= -1e-9 and b >= -1e-9 and c >= -1e-9:
                    z = a * z0 + b * z1 + c * z2
                    if z > depth[row, column]:
                        depth[row, column] = z
                        face[row, column] = index


@njit(cache=True, nogil=True)
def shade(
    face, depth, normals, owner, colors, view, center, scale, ground, whole, floor,
    light_axes, middle, light_scale, shadow, reach, ink, image,
):  # fmt: skip
    """Write colours of pixels whose nearest triangle is known, light, shadow and edges: shape (height, width, 4)."""
    height, width = face.shape
    size = shadow.shape[0]
    light = light_axes[2]
    jump = 18.0 / scale
    lift = 0.004 * reach
    crease = np.cos(np.radians(30.0))
    for row in range(height):
        for column in range(width):
            index = face[row, column]
            across = (column + 0.5 - width / 2) / scale + center[0]
            upward = (height / 2 - row - 0.5) / scale + center[1]
            if index >= 0:
                deep = depth[row, column]
                nx, ny, nz = normals[index, 0], normals[index, 1], normals[index, 2]
            elif floor:
                # The floor is z = ground: how far towards the viewer each pixel's line meets it.
                deep = (ground - across * view[0, 2] - upward * view[1, 2]) / view[2, 2]
                nx, ny, nz = 0.0, 0.0, 1.0
            else:
                if whole:
                    for channel in range(4):
                        image[row, column, channel] = 1.0
                continue
            lit = 1.0
            if whole:
                # A little off the surface, so that it does not shade itself.
                px = across * view[0, 0] + upward * view[1, 0] + deep * view[2, 0] + nx * lift
                py = across * view[0, 1] + upward * view[1, 1] + deep * view[2, 1] + ny * lift
                pz = across * view[0, 2] + upward * view[1, 2] + deep * view[2, 2] + nz * lift
                x = light_axes[0, 0] * px + light_axes[0, 1] * py + light_axes[0, 2] * pz
                y = light_axes[1, 0] * px + light_axes[1, 1] * py + light_axes[1, 2] * pz
                x = (x - middle[0]) * light_scale + size / 2
                y = (y - middle[1]) * light_scale + size / 2
                z = light[0] * px + light[1] * py + light[2] * pz + 0.75 * lift
                reached = 0
                for i in range(-1, 2):
                    for j in range(-1, 2):
                        u = min(max(int(x + 1.8 * i), 0), size - 1)
                        v = min(max(int(y + 1.8 * j), 0), size - 1)
                        if z > shadow[v, u]:
                            reached += 1
                lit = reached / 9.0
            if index < 0:
                for channel in range(4):
                    image[row, column, channel] = 1.0 - 0.20 * (1.0 - lit)
                continue
            facing = max(nx * light[0] + ny * light[1] + nz * light[2], 0.0)
            strength = 0.40 + 0.17 * (0.5 + 0.5 * nz) + 0.49 * facing * lit
            solid = owner[index]
            for channel in range(3):
                image[row, column, channel] = min(colors[solid, channel] * strength, 1.0) * colors[solid, 3]
            image[row, column, 3] = colors[solid, 3]
    # Lines where one solid ends or has a sharp edge.
    for row in range(height - 1):
        for column in range(width - 1):
            here = face[row, column]
            for k in range(2):
                there = face[row + 1, column] if k == 0 else face[row, column + 1]
                if here == there:
                    continue
                if here >= 0 and there >= 0 and owner[here] == owner[there]:
                    step = abs(depth[row, column] - (depth[row + 1, column] if k == 0 else depth[row, column + 1]))
                    bend = 0.0
                    for axis in range(3):
                        bend += normals[here, axis] * normals[there, axis]
                    if bend >= crease and step <= jump:
                        continue
                strength = 1.0
                if here >= 0:
                    strength = colors[owner[here], 3]
                else:
                    strength = colors[owner[there], 3]
                for channel in range(3):
                    image[row, column, channel] = 0.35 * image[row, column, channel] + 0.65 * ink[channel] * strength
                if not whole:
                    image[row, column, 3] = 0.35 * image[row, column, 3] + 0.65 * strength
                break
