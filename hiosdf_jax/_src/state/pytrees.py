"""The map that `update` carries, and the fields that planners hold."""

from __future__ import annotations

import enum
from typing import Any, Literal, NamedTuple, Self

import flax.serialization
import flax.struct
import jax
import jax.numpy as jnp
import optax

from hiosdf_jax._src.config import Config
from hiosdf_jax._src.numerics.arrays import scalar
from hiosdf_jax._src.numerics.describing import Described
from hiosdf_jax._src.numerics.exporting import export_optimizer, exportable

NO_FEATURE = -128
"""`Derived.nearest` of a voxel without a surface patch within the distance horizon."""

FRONTIER_STEPS = 127
"""`Derived.frontier_steps` counts steps; the frontier horizon is this many steps long."""


Unknown = Literal["network", "obstacle"]
"""Policies for unseen space: the map's prediction there, or solid."""

Bound = Literal["sdf", "lower"]
"""What a planner keeps clear of: the estimated distance, or its calibrated lower bound."""


def frontier_step_m(config: Config) -> float:
    """Returns the length of a step of `Derived.frontier_steps`, m."""
    return config.frontier_horizon / FRONTIER_STEPS


@exportable()
class Report(Described):
    """Summary of the last update; `flags` collects those of all updates.

    Updates that changed nothing else leave all numbers as they were, but for the flags and
    `refused_in_row`.

    Attributes:
        points_used: Returns that were fused into the grid, int32.
        points_outside: Returns in range that lie outside the bounds, int32. Stray returns and
            those on the robot count neither here nor in `points_used`.
        points_out_of_range: Returns nearer than min_range or farther than max_range, int32.
        points_invalid: Rows with a NaN or inf, int32. Outside jit the rows count that `update` has
            added to reach `Config.max_points`, too.
        sdf_loss: Mean |f - s| over the samples in the last epoch, m, float32 (paper, eq. 4).
        eikonal_loss: Mean | |grad f| - 1 | in the last epoch, float32 (paper, eq. 5).
        points_moving: Returns in space that had been free: on things that move or are new, int32.
        refused_in_row: Clouds since the last one that was fused which contradicted the map, int32.
        update_flags: Bits of `Flag` of the last update alone, uint32.
        flags: Bits of `Flag` of all updates so far, uint32.
    """

    points_used: jax.Array
    points_outside: jax.Array
    points_out_of_range: jax.Array
    points_invalid: jax.Array
    sdf_loss: jax.Array
    eikonal_loss: jax.Array
    points_moving: jax.Array
    refused_in_row: jax.Array
    update_flags: jax.Array
    flags: jax.Array


@exportable()
class Evidence(Described):
    """What each voxel remembers of the rays that met it.

    Offsets are from the voxel's center, in voxels.

    Attributes:
        hits: Rays that ended in the voxel (fading), (X, Y, Z) float16.
        passes: Rays that went through it well before their end (fading), (X, Y, Z) float16;
            negative in a voxel that something new hides now, which counts as unobserved.
        behind: Rays that ended a little before it (fading), (X, Y, Z) float16.
        root_weight: Square root of the summed weights of the hits (fading), (X, Y, Z) float16; the
            weights of far returns are too small for float16.
        mean: Weighted mean of the hits, (X, Y, Z, 3) float16.
        axes: Principal axes of the hits, longest first, each as long as the standard deviation
            along it, right-handed, (X, Y, Z, 3, 3) float16. The last one is the normal, on the
            sensor's side.
        change: Recent changes, (X, Y, Z) int8. k > 0: a surface appeared in free space and counts
            as new for k more scans that see it. -64 <= k < 0: rays have crossed the patch since its
            last hit; see `change.vanishing`. k < -64: it vanished, and counts as recent for -64 - k
            more scans that pass there.
    """

    hits: jax.Array
    passes: jax.Array
    behind: jax.Array
    root_weight: jax.Array
    mean: jax.Array
    axes: jax.Array
    change: jax.Array


class Side(enum.IntEnum):
    """What decides the sign of distances around a voxel."""

    BEHIND = -1
    """Rays end before the voxel: it is negative."""
    UNKNOWN = 0
    """No ray and no patch nearby shows its side."""
    FREE = 1
    """Rays go through the voxel."""
    PLANE = 2
    """The plane of its nearest patch, which lies right beside the voxel's center."""
    SHEET = 3
    """The same, but the patch has free space on both sides."""


@exportable()
class Derived(Described):
    """Distances of each voxel, derived from the evidence around it.

    Attributes:
        nearest: Offset in whole voxels to the voxel of the nearest surface patch,
            (X, Y, Z, 3) int8; NO_FEATURE where there is none within the horizon.
        sdf: Signed distance of the voxel's center to that patch, m, (X, Y, Z) float16.
        side: What decides the sign around the voxel, (X, Y, Z) int8: `Side`.
        doubt: Distance of the voxel's center to the nearest voxel in which any ray has ended and
            that is not almost certainly free, m, (X, Y, Z) float16. Carved surfaces and surfaces
            that were hit once count.
        frontier_steps: Distance of the voxel's center to the nearest voxel that is not observed,
            in steps of 1 / 127 of the frontier horizon; in unobserved voxels, minus the distance to
            the nearest observed one, (X, Y, Z) int8.
    """

    nearest: jax.Array
    sdf: jax.Array
    side: jax.Array
    doubt: jax.Array
    frontier_steps: jax.Array


@exportable()
class Grid(Described):
    """The coarse global grid.

    Attributes:
        evidence: What the rays left in it.
        derived: What follows from the evidence.
    """

    evidence: Evidence
    derived: Derived


@exportable()
class Surface(Described):
    """What queries read of the grid.

    Attributes:
        mean: As in `Evidence`.
        axes: As in `Evidence`.
        derived: The voxels' distances.
    """

    mean: jax.Array
    axes: jax.Array
    derived: Derived


@exportable()
class Network(Described):
    """The SIREN and its optimizer.

    Attributes:
        params: The weights that are trained.
        average: Running average of `params` over updates; queries use these weights.
        optimizer: The state of AdamW.
        origin_world: The network's origin, (3,) m; `grow` does not move it.
    """

    params: Any
    average: Any
    optimizer: Any
    origin_world: jax.Array


class _FloatLeaves(Described):
    """A pytree whose float leaves can be taken apart from the others, for `jax.grad`."""

    def differentiable(self) -> Self:
        """Returns the same tree with only its float leaves; None stands for the others.

        `jax.grad` takes gradients by it, and optax optimizes it, as it is.

        Example:
            >>> floats = field.differentiable()
            >>> loss = lambda floats: hio.sdf(field.combine(floats), points).sum()
            >>> gradient = jax.grad(loss)(floats)
        """
        return jax.tree.map(lambda x: x if jnp.issubdtype(x.dtype, jnp.floating) else None, self)

    def combine(self, floats: Self) -> Self:
        """Returns this tree with the float leaves of another, from `differentiable`."""
        return jax.tree.map(lambda own, new: own if new is None else new, self, floats)


def _config(fields: dict[str, Any]) -> Config:
    return Config(**fields)


@exportable(config=_config)
class MapState(_FloatLeaves):
    """A map: everything that `update` needs and changes.

    Attributes:
        config: The configuration; static, not a leaf.
        grid: The coarse global grid.
        network: The SIREN and its optimizer.
        optimism: How far the map errs to the free side, in units of its own error scale,
            () float32. See `hiosdf_jax.query`, `lower`.
        key: Source of all randomness, a typed key.
        updates: Number of updates that changed the map, int32.
        report: Summary of the last update.
    """

    config: Config = flax.struct.field(pytree_node=False)
    grid: Grid
    network: Network
    optimism: jax.Array
    key: jax.Array
    updates: jax.Array
    report: Report


@exportable(config=_config)
class Field(_FloatLeaves):
    """The part of a map that queries read; made by `snapshot`.

    Attributes:
        config: The map's configuration; static, not a leaf.
        params: The network's average weights.
        origin_world: The network's origin, (3,) m.
        surface: The grid's patches and distances.
        optimism: As in `MapState`, () float32.
        updates: Number of updates of the map, int32.
        stamp: Time of the snapshot, s on the caller's clock, () float32.
    """

    config: Config = flax.struct.field(pytree_node=False)
    params: Any
    origin_world: jax.Array
    surface: Surface
    optimism: jax.Array
    updates: jax.Array
    stamp: jax.Array


@exportable(window=bool)
class Baked(_FloatLeaves):
    """A field sampled on a lattice, for inner loops; made by `bake`.

    Attributes:
        corner_world: Position of sample (0, 0, 0), (3,) m.
        resolution: Spacing of the samples, () m.
        sdf: Signed distances, m, (X, Y, Z) float32.
        frontier: Distances to unseen space, m, (X, Y, Z) float32.
        lower: Lower bounds of the distance, m, (X, Y, Z) float32.
        updates: Number of updates of the map, int32.
        stamp: As in `Field`.
        window: Whether it covers a part of the map; static, not a leaf. Outside of it no distance
            is more than what the window implies.
    """

    corner_world: jax.Array
    resolution: jax.Array
    sdf: jax.Array
    frontier: jax.Array
    lower: jax.Array
    updates: jax.Array
    stamp: jax.Array
    window: bool = flax.struct.field(pytree_node=False, default=False)


@exportable()
class Query(NamedTuple):
    """The answer of `query` at points.

    Attributes:
        sdf: Signed distance under the chosen policy for unseen space, (...) float32, m.
        grad: d(sdf)/d(point), (..., 3) float32.
        observed: Whether the point was seen and its side of the surface is certain, (...) bool.
            False where `frontier` is not positive, and at a few points where `sdf` is near 0
            although no surface is, mostly because rays contradict each other. Of a baked field,
            whether `frontier` is positive.
        frontier: Distance to the nearest voxel that was not seen, (...) float32, m; not positive in
            such voxels.
        lower: At most the true distance at about 99 % of the points on a sensor's rays, (...)
            float32, m. It is calibrated on each new cloud, not guaranteed. It is negative in unseen
            space. In observed space a surface that no ray has met may be nearer: the least of
            `lower` and `frontier` counts it.
        lower_grad: d(lower)/d(point), (..., 3) float32.
    """

    sdf: jax.Array
    grad: jax.Array
    observed: jax.Array
    frontier: jax.Array
    lower: jax.Array
    lower_grad: jax.Array


export_optimizer(optax.ScaleByAdamState, optax.EmptyState)


def _to_flax(state: MapState) -> dict[str, Any]:
    """Writes a map for `flax.serialization`, which cannot write typed keys."""
    data = {k: v for k, v in vars(state).items() if k != "config"}
    data["key"] = jax.random.key_data(state.key)
    return {name: flax.serialization.to_state_dict(value) for name, value in data.items()}


def _from_flax(state: MapState, data: dict[str, Any]) -> MapState:
    own = {k: v for k, v in vars(state).items() if k != "config"}
    own["key"] = jax.random.key_data(state.key)
    read = flax.serialization.from_state_dict(own, data)
    read["key"] = jax.random.wrap_key_data(read["key"], impl=jax.random.key_impl(state.key))
    return state.replace(**read)


flax.serialization.register_serialization_state(MapState, _to_flax, _from_flax, override=True)


def surface_of(grid: Grid) -> Surface:
    """Selects what queries read of a grid, without a copy."""
    return Surface(mean=grid.evidence.mean, axes=grid.evidence.axes, derived=grid.derived)


def field_of(state: MapState) -> Field:
    """Selects what queries read of a map, without a copy."""
    return Field(
        config=state.config,
        params=state.network.average,
        origin_world=state.network.origin_world,
        surface=surface_of(state.grid),
        optimism=state.optimism,
        updates=state.updates,
        stamp=scalar(0),
    )
