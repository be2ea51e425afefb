"""Anti-aliased polygons in an image of bytes: each pixel is painted according to its covered share.

Each edge of an outline adds, to the cells that it crosses in a row, the area to its right; the running sum
along the row is the coverage, exact up to rounding. (This is the method of the rasterisers of FreeType and
font-rs.) No library is needed: painting is compiled by Numba, like stepping.
"""

from __future__ import annotations

import math
import struct
import zlib
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lag_envs.stepping.cache import jit

#: Coverage below this counts as 0, and above 1 minus this as 1.
EDGE = 1.0 / 512.0


def fill(
    image: NDArray[np.uint8], points: Any, ends: Any, frames: Any, poses: Any, colours: Any, room: Any
) -> None:
    """Paint polygons over an image, later ones over earlier ones.

    Parameters
    ----------
    image : ndarray of uint8, shape (height, width, 3)
        The image to paint on.
    points : ndarray, shape (n, 2)
        Corners of all polygons, one after the other.
    ends : ndarray of int, shape (polygons,)
        The end of each polygon's corners.
    frames : ndarray of int, shape (polygons,)
        The frame of each polygon's corners.
    poses : ndarray, shape (frames, 6)
        For each frame (a, b, c, d, e, f), with which x = a·x' + b·y' + e and y = c·x' + d·y' + f in pixels.
    colours : ndarray, shape (polygons, 4)
        Red, green, blue from 0 to 255, and opacity from 0 to 1.
    room : ndarray, shape (height, width + 2)
        Zeros; they are zeros again afterwards.
    """
    _fill(image, points, ends, frames, poses, colours, room)


@jit
def _fill(image: Any, points: Any, ends: Any, frames: Any, poses: Any, colours: Any, room: Any) -> None:
    height, width = image.shape[0], image.shape[1]
    begin = 0
    for polygon in range(len(ends)):
        end = ends[polygon]
        frame = frames[polygon]
        a, b, c = poses[frame, 0], poses[frame, 1], poses[frame, 2]
        d, e, f = poses[frame, 3], poses[frame, 4], poses[frame, 5]
        # The rows and columns that the polygon touches.
        left, right, top, bottom = math.inf, -math.inf, math.inf, -math.inf
        for i in range(begin, end):
            x = a * points[i, 0] + b * points[i, 1] + e
            y = c * points[i, 0] + d * points[i, 1] + f
            left, right, top, bottom = min(left, x), max(right, x), min(top, y), max(bottom, y)
        if not (left < width and right > 0.0 and top < height and bottom > 0.0):
            begin = end
            continue
        first, last = int(max(0.0, math.floor(left))), int(min(float(width), math.ceil(right)))
        upper, lower = int(max(0.0, math.floor(top))), int(min(float(height), math.ceil(bottom)))
        low, high = float(first), float(last)
        for i in range(begin, end):
            j = i + 1 if i + 1 < end else begin
            x0 = a * points[i, 0] + b * points[i, 1] + e
            y0 = c * points[i, 0] + d * points[i, 1] + f
            x1 = a * points[j, 0] + b * points[j, 1] + e
            y1 = c * points[j, 0] + d * points[j, 1] + f
            way = 1.0
            if y0 > y1:
                x0, y0, x1, y1, way = x1, y1, x0, y0, -1.0
            if y1 <= upper or y0 >= lower or y0 == y1:
                continue
            slope = (x1 - x0) / (y1 - y0)
            for row in range(max(upper, math.floor(max(y0, 0.0))), lower):
                if row >= y1:
                    break
                from_y, to_y = max(y0, float(row)), min(y1, row + 1.0)
                share = way * (to_y - from_y)
                xa = min(max(x0 + slope * (from_y - y0), low), high)
                xb = min(max(x0 + slope * (to_y - y0), low), high)
                if xa > xb:
                    xa, xb = xb, xa
                start, stop = math.floor(xa), math.ceil(xb)
                if stop <= start + 1:
                    inside = 0.5 * (xa + xb) - start
                    room[row, start] += share * (1.0 - inside)
                    room[row, start + 1] += share * inside
                    continue
                per = 1.0 / (xb - xa)
                over = 0.0
                for column in range(start, stop):
                    # The part of this strip of the edge to the left of the cell's right end, integrated.
                    p, q = max(xa, float(column)), min(xb, column + 1.0)
                    covered = per * ((q - p) * (column + 1.0 - 0.5 * (p + q)) + (p - xa))
                    room[row, column] += share * (covered - over)
                    over = covered
                room[row, stop] += share * (1.0 - over)
        opaque = colours[polygon, 3]
        red, green, blue = colours[polygon, 0], colours[polygon, 1], colours[polygon, 2]
        whole = np.uint8(red), np.uint8(green), np.uint8(blue)
        for row in range(upper, lower):
            total, cover = 0.0, 0.0
            column = first
            while column < last:
                change = room[row, column]
                if change != 0.0:
                    room[row, column] = 0.0
                    total += change
                    cover = min(abs(total), 1.0)
                    cover = 0.0 if cover < EDGE else opaque if cover > 1.0 - EDGE else opaque * cover
                # Coverage stays the same up to the next cell that an edge crosses.
                start, column = column, column + 1
                while column < last and room[row, column] == 0.0:
                    column += 1
                if cover == 1.0:
                    for i in range(start, column):
                        image[row, i, 0], image[row, i, 1], image[row, i, 2] = whole
                elif cover > 0.0:
                    rest = 1.0 - cover
                    for i in range(start, column):
                        image[row, i, 0] = np.uint8(rest * image[row, i, 0] + cover * red + 0.5)
                        image[row, i, 1] = np.uint8(rest * image[row, i, 1] + cover * green + 0.5)
                        image[row, i, 2] = np.uint8(rest * image[row, i, 2] + cover * blue + 0.5)
            room[row, last] = 0.0
            room[row, last + 1] = 0.0
        begin = end


def png(image: NDArray[np.uint8]) -> bytes:
    """Return an image (height, width, 3) as the bytes of a PNG file."""
    height, width = image.shape[:2]
    # Each row is stored as its difference from the one above, which is mostly zero.
    rows = np.empty((height, 1 + 3 * width), np.uint8)
    flat = np.ascontiguousarray(image).reshape(height, -1)
    rows[:, 0], rows[0, 1:], rows[1:, 1:] = 2, flat[0], flat[1:] - flat[:-1]
    head = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    parts = ((b"IHDR", head), (b"IDAT", zlib.compress(rows.tobytes(), 9)), (b"IEND", b""))
    chunks = [
        struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))
        for name, data in parts
    ]
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunks)
