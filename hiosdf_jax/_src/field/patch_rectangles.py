"""The surface patches of a grid as rectangles."""

from __future__ import annotations

from typing import NamedTuple

import jax
import numpy as np

from hiosdf_jax._src.grid.patches import EXTENT_DEVIATIONS
from hiosdf_jax._src.state.pytrees import NO_FEATURE, Side, Surface

FILLING_VOXELS = 0.2
"""A thicker patch, standard deviation in voxels, fills its voxel and has no plane."""

# A rectangle is at least this wide to each side, voxels, also if its hits lie on a line.
_LEAST_HALF_EDGE = 5e-3


class Patches(NamedTuple):
    """Surface patches, in voxels from the corner of the grid.

    Attributes:
        voxel: Indices, (M, 3) int.
        center: Mean of the hits, (M, 3).
        axes: Half edges of the rectangle and half thickness, descending, (M, 3, 3).
        in_free_space: There is free space around it or on both of its sides, as around a thin leg,
            (M,) bool.
    """

    voxel: np.ndarray
    center: np.ndarray
    axes: np.ndarray
    in_free_space: np.ndarray

    @property
    def normal(self) -> np.ndarray:
        """Unit vectors toward the sensor's side, (M, 3)."""
        across = np.cross(self.axes[:, 0], self.axes[:, 1])
        return across / np.maximum(np.linalg.norm(across, axis=-1, keepdims=True), 1e-12)

    @property
    def deviations(self) -> np.ndarray:
        """Principal axes of the hits, as long as their standard deviations, (M, 3, 3)."""
        return self.axes / EXTENT_DEVIATIONS

    @property
    def area(self) -> np.ndarray:
        """Products of the half edges, a quarter of the areas, (M,)."""
        return np.prod(np.linalg.norm(self.axes[:, :2], axis=-1), axis=-1)

    @property
    def moment(self) -> np.ndarray:
        """Covariances of the hits, (M, 3, 3)."""
        deviations = self.deviations
        return np.einsum("mki,mkj->mij", deviations, deviations)

    @property
    def thickness(self) -> np.ndarray:
        """Standard deviation of the hits along the normal, (M,)."""
        return np.linalg.norm(self.axes[:, 2], axis=-1) / EXTENT_DEVIATIONS

    def part(self, kept: np.ndarray) -> Patches:
        """Returns the patches of a mask, (M,) bool."""
        return Patches(*(values[kept] for values in self))


class Triangles(NamedTuple):
    """Triangles with common vertices, in voxels from the corner of the grid.

    Attributes:
        vertex: (V, 3).
        normal: Unit vectors toward the sensor's side, (V, 3).
        spread: Standard deviation of the hits along the normal, (V,) voxels.
        face: Rows of vertices, counterclockwise around the normal, (F, 3).
    """

    vertex: np.ndarray
    normal: np.ndarray
    spread: np.ndarray
    face: np.ndarray


def find_patches(surface: Surface) -> Patches:
    """Finds the patches that queries use."""
    nearest, mean, axes = (
        np.asarray(array) for array in (surface.derived.nearest, surface.mean, surface.axes)
    )
    known = np.argwhere(nearest[..., 0] != NO_FEATURE)
    used = np.zeros(nearest.shape[:3], bool)
    used[tuple((known + nearest[tuple(known.T)]).T)] = True
    voxel = np.argwhere(used)
    center = voxel + 0.5 + mean[used].astype(float)
    side = np.asarray(surface.derived.side)[used]
    in_free_space = (side == Side.FREE) | (side == Side.SHEET)
    return Patches(voxel, center, EXTENT_DEVIATIONS * axes[used].astype(float), in_free_space)


def with_patches(surface: Surface, patches: Patches, nearest: np.ndarray) -> Surface:
    """Puts patches into the surface in which they were found, on its device.

    Args:
        surface: The surface.
        patches: At most one in each voxel.
        nearest: Offsets to the voxels of the nearest patches, as in `Derived`, (X, Y, Z, 3) int8.

    Returns:
        The surface with these patches.
    """
    mean, axes, nearest = np.array(surface.mean), np.array(surface.axes), np.array(nearest)
    row = tuple(patches.voxel.T)
    mean[row] = patches.center - patches.voxel - 0.5
    axes[row] = patches.deviations
    # A patch inside a thin wall may lie across, and nearer to the centers of voxels than the wall's
    # sides: a voxel with a patch of its own then knows that one.
    fills = np.zeros(nearest.shape[:3], bool)
    fills[row] = patches.thickness >= FILLING_VOXELS
    own = patches.voxel[~fills[row]]
    own = own[nearest[tuple(own.T)][:, 0] != NO_FEATURE]
    own = own[fills[tuple((own + nearest[tuple(own.T)]).T)]]
    nearest[tuple(own.T)] = 0
    arrays = surface.mean, surface.axes, surface.derived.nearest
    places = [getattr(array, "sharding", None) for array in arrays]
    mean, axes, nearest = jax.device_put([mean, axes, nearest], places)
    derived = surface.derived.replace(nearest=nearest)
    return surface.replace(mean=mean, axes=axes, derived=derived)


def as_rectangles(patches: Patches) -> Triangles:
    """Draws patches as rectangles inside their voxels, two triangles each."""
    first, second = patches.axes[:, 0], patches.axes[:, 1]
    # The corners of a patch that turned with the noise lie outside of its voxel, where no hit was.
    room = 0.5 - np.abs(patches.center - np.floor(patches.center) - 0.5)
    reach = np.abs(first) + np.abs(second)
    scale = np.minimum(1, np.min(room / np.maximum(reach, 1e-12), axis=-1, keepdims=True))
    first, second = _widened(scale * first), _widened(scale * second)
    corner = [a * first + b * second for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    normal = patches.normal
    vertex = (patches.center + np.stack(corner)).swapaxes(0, 1).reshape(-1, 3)
    start = 4 * np.arange(len(normal))[:, None]
    face = np.concatenate([start + np.array(half) for half in ((0, 1, 2), (0, 2, 3))])
    return Triangles(vertex, np.repeat(normal, 4, axis=0), np.repeat(patches.thickness, 4), face)


def _widened(half_edge: np.ndarray) -> np.ndarray:
    """Scales vectors (M, 3) to at least the least half edge."""
    size = np.linalg.norm(half_edge, axis=-1, keepdims=True)
    return half_edge * np.maximum(1, _LEAST_HALF_EDGE / np.maximum(size, 1e-12))
