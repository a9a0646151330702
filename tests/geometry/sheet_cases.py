"""Sheets whose measures are known, straight from formulas."""

import numpy as np

from hipsta_bids.types import Sheet


def sheet_of(points):
    return Sheet(points=points, valid=np.ones(points.shape[:2], dtype=bool))


def grid(nx=41, ny=21, nz=9):
    return np.meshgrid(
        np.linspace(0, 1, nx), np.linspace(0, 1, ny), np.linspace(0, 1, nz), indexing="ij"
    )


def plates(thickness=1.7):
    """Two parallel plates of 12 x 8 mm."""
    x, y, z = grid()
    return sheet_of(np.stack([12 * x, 8 * y, thickness * z], axis=-1))


def tube(radius=4.0, thickness=2.0, turn=np.pi):
    """Part of a pipe, interior side within."""
    x, y, z = grid()
    r = radius + thickness * (z - 0.5)
    return sheet_of(np.stack([r * np.cos(turn * x), r * np.sin(turn * x), 10 * y], axis=-1))


def shell(radius=10.0, thickness=2.0, tall=0.3):
    """Part of a sphere, interior side within; away from the poles."""
    x, y, z = grid()
    r = radius + thickness * (z - 0.5)
    polar, azimuth = np.pi * (0.5 + tall * (y - 0.5)), 1.2 * x
    return sheet_of(
        np.stack(
            [
                r * np.sin(polar) * np.cos(azimuth),
                r * np.sin(polar) * np.sin(azimuth),
                r * np.cos(polar),
            ],
            axis=-1,
        )
    )


def quadric(first, second, extent=2.0):
    """Height (first x^2 + second y^2) / 2 over a square; the interior side is above."""
    x, y, z = grid(nx=41, ny=41)
    x, y = extent * (x - 0.5), extent * (y - 0.5)
    height = (first * x**2 + second * y**2) / 2 - 1.5 * (z - 0.5)
    return sheet_of(np.stack([x, y, height], axis=-1))


def saddle(inner=4.0, ring=9.0, thickness=1.0, turn=2.0):
    """The inner side of a torus round its middle: curled both ways, interior side in the tube."""
    x, y, z = grid()
    r, angle = inner + thickness * (z - 0.5), np.pi + turn * (x - 0.5)
    around = 0.6 * y
    far = ring + r * np.cos(angle)
    return sheet_of(
        np.stack([far * np.cos(around), far * np.sin(around), r * np.sin(angle)], axis=-1)
    )
