"""The pytrees of a map: what `update` carries from cloud to cloud, and what a planner holds."""

from __future__ import annotations

import enum
from typing import Any, NamedTuple

import flax.struct
import jax

from hiosdf_jax._src.config import Config


class Flag(enum.IntFlag):
    """What has gone wrong since the map was made; bits of `Report.flags`, never cleared."""

    BAD_POSE = 1
    """A pose was not finite or not rigid: that update changed nothing else."""
    EMPTY_CLOUD = 2
    """A cloud had no finite row: that update changed nothing else."""
    POINTS_OUTSIDE = 4
    """Points in range fell outside the bounds: they cleared their rays but left no surface."""
    TRAINING_FAILED = 8
    """A training step gave a value that is not finite: the network was kept as it was."""


class Report(flax.struct.PyTreeNode):
    """Scalars of the last update; `flags` gathers those of all updates.

    Attributes:
        points_used: Points that were fused into the grid, int32.
        points_outside: Points in range whose end lies outside the bounds, int32.
        points_out_of_range: Finite points nearer than min_range or farther than max_range, int32.
        points_invalid: Rows with a NaN or inf, padding included, int32.
        sdf_loss: Mean |f - s| over the samples in the last epoch, m, float32 (paper, eq. 4).
        eikonal_loss: Mean | |grad f| - 1 | in the last epoch, float32 (paper, eq. 5).
        flags: Bits of `Flag`, uint32, sticky.
    """

    points_used: jax.Array
    points_outside: jax.Array
    points_out_of_range: jax.Array
    points_invalid: jax.Array
    sdf_loss: jax.Array
    eikonal_loss: jax.Array
    flags: jax.Array


class Surface(flax.struct.PyTreeNode):
    """What queries read of the grid: its surface patches, and distances derived from them.

    Lengths are in voxels where no unit is given; offsets are from the voxel's centre.

    Attributes:
        mean: Weighted mean of the hits, (X, Y, Z, 3) float16.
        axes: Principal axes of the hits, longest first, each as long as the standard deviation
            along it; the last is the normal, pointing to the sensor's side,
            (X, Y, Z, 3, 3) float16.
        nearest: Offset in whole voxels to the voxel of the nearest feature, (X, Y, Z, 3) int8;
            -128 where there is none within the horizon.
        sdf: Signed distance of the voxel's centre to that feature, m, (X, Y, Z) float16.
        doubt: Distance of the voxel's centre to the nearest voxel in which any ray has ended and
            that is not all but certainly free: surfaces that were carved or met once are among
            them, m, (X, Y, Z) float16.
        frontier: Distance of the voxel's centre to the nearest voxel that no ray has reached, in
            127ths of the frontier's horizon; of such voxels, minus the distance to the nearest one
            that was reached, (X, Y, Z) int8.
    """

    mean: jax.Array
    axes: jax.Array
    nearest: jax.Array
    sdf: jax.Array
    doubt: jax.Array
    frontier: jax.Array


class Grid(flax.struct.PyTreeNode):
    """The coarse global grid: what each voxel remembers of the rays that met it.

    Attributes:
        hits: Rays that ended in the voxel (fading), (X, Y, Z) float16.
        passes: Rays that went through it well before their end (fading), (X, Y, Z) float16.
        behind: Rays that ended a little before it (fading), (X, Y, Z) float16.
        weight: Root of the sum of the weights of the hits (fading), (X, Y, Z) float16.
        surface: The patches that the hits make, and what is derived from all this.
    """

    hits: jax.Array
    passes: jax.Array
    behind: jax.Array
    weight: jax.Array
    surface: Surface


class Network(flax.struct.PyTreeNode):
    """The SIREN and its optimiser.

    Attributes:
        params: The weights that are trained.
        served: The weights that queries use, a running average of `params`.
        optimizer: The state of AdamW.
        origin_world: Point that is the network's zero, (3,) m; `grow` does not move it.
    """

    params: Any
    served: Any
    optimizer: Any
    origin_world: jax.Array


class MapState(flax.struct.PyTreeNode):
    """Everything that an update needs and changes; made by `init`, changed by `update`.

    Attributes:
        config: The configuration; static, not a leaf.
        grid: The coarse global grid.
        network: The SIREN and its optimiser.
        optimism: How many of its own error scales the map errs to the free side, see
            `uncertainty`, () float32.
        key: Source of all randomness, a typed key.
        updates: Updates that changed the map so far, int32.
        report: Scalars of the last update.
    """

    config: Config = flax.struct.field(pytree_node=False)
    grid: Grid
    network: Network
    optimism: jax.Array
    key: jax.Array
    updates: jax.Array
    report: Report


class Field(flax.struct.PyTreeNode):
    """What a planner holds while the map goes on; made by `snapshot`.

    Attributes:
        config: The map's configuration; static, not a leaf.
        params: The network's weights that queries use.
        origin_world: Point that is the network's zero, (3,) m.
        surface: The grid's patches and distances.
        optimism: As in `MapState`, () float32.
        updates: Updates that the map had seen, int32.
        stamp: When the snapshot was taken, s on the caller's clock, () float32.
    """

    config: Config = flax.struct.field(pytree_node=False)
    params: Any
    origin_world: jax.Array
    surface: Surface
    optimism: jax.Array
    updates: jax.Array
    stamp: jax.Array


class Baked(flax.struct.PyTreeNode):
    """Samples of a field on a lattice, for inner loops; made by `bake`.

    Attributes:
        corner_world: Position of sample (0, 0, 0), (3,) m.
        resolution: Spacing of the samples, () m.
        sdf: Signed distances, m, (X, Y, Z) float32.
        frontier: Distances to unseen space, m, (X, Y, Z) float32.
        lower: Lower bounds of the distance, m, (X, Y, Z) float32.
        updates: Updates that the map had seen, int32.
        stamp: As in `Field`.
    """

    corner_world: jax.Array
    resolution: jax.Array
    sdf: jax.Array
    frontier: jax.Array
    lower: jax.Array
    updates: jax.Array
    stamp: jax.Array


class Query(NamedTuple):
    """What the map says of points.

    Attributes:
        sdf: Signed distance under the chosen policy for unseen space, (...) float32, m.
        grad: Its gradient by the point, (..., 3) float32.
        observed: Whether the voxel that contains the point has been seen, (...) bool.
        frontier: Distance to the nearest voxel that has not been seen, (...) float32, m; not
            positive in such voxels.
        lower: A lower bound of the true distance, (...) float32, m; see `uncertainty`.
    """

    sdf: jax.Array
    grad: jax.Array
    observed: jax.Array
    frontier: jax.Array
    lower: jax.Array
