"""Maps that move: re-expressed in another frame, added to another map, corrected after a loop."""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hiosdf_jax._src.config import Config
from hiosdf_jax._src.grid.evidence import empty_grid, whole_window, write_window
from hiosdf_jax._src.mapping.derived import recompute_derived
from hiosdf_jax._src.mapping.joining.adding import Moved, sum_evidence
from hiosdf_jax._src.mapping.joining.rebinning import coincides, count_lost, passes_at, rebin
from hiosdf_jax._src.network.rigid_motion import move_network
from hiosdf_jax._src.network.training import least_epochs, train
from hiosdf_jax._src.numerics.intake import as_array, check_pose, is_traced
from hiosdf_jax._src.numerics.modes import cond, plain, varying_like
from hiosdf_jax._src.numerics.rigid import is_rigid, nearest_rotation
from hiosdf_jax._src.samples.from_grid import sample_grid
from hiosdf_jax._src.state.checks import check_map
from hiosdf_jax._src.state.flags import Flag
from hiosdf_jax._src.state.pytrees import Grid, MapState, Network

# What the arrays of a map depend on. Maps in which these differ do not add up.
_SHARED = ("voxel_size", "range_noise", "hidden_width", "hidden_layers", "frequency")

# After a merge the network learns what the other map knew, in this many trainings of
# `Config.warmup_epochs` on samples of the whole grid. Each keeps half of the old average.
_TRAININGS = 10
_AVERAGE = 0.5

# Outside jit a warning says if a larger share of the surface falls outside of the box.
_MOST_LOST = 0.01


def transform(state: MapState, pose: Any, bounds: Any = None) -> MapState:
    """Expresses a map in another frame.

    The network is the same in its new frame, and answers as before up to rounding. The grid is
    re-binned: patches move exactly and those that meet in a voxel add up; observed space shrinks
    by up to a voxel. By whole voxels and turns of 90 degrees, the grid is only re-indexed. What
    falls outside of the new box is lost: surfaces there raise `Flag.POINTS_OUTSIDE`, and outside
    jit a warning if they are more than 1 % of all.

    Args:
        state: The map.
        pose: (4, 4) T_new_old, rigid: it maps points of the old frame to the new one.
        bounds: The new map's box, ((x0, y0, z0), (x1, y1, z1)) m, new frame, concrete numbers; by
            default the numbers stay those of the old box.

    Returns:
        The map in the new frame. It shares no memory with the old one. Inside jit, a pose that is
        not rigid counts as the identity and raises `Flag.BAD_POSE`.

    Raises:
        ValueError: `state` is not a map, or `bounds` is not a box. Outside jit also: the pose is
            not finite or not rigid.

    Example:
        >>> moved = hio.transform(state, pose)
        >>> hio.sdf(moved, points @ pose[:3, :3].T + pose[:3, 3])  # about hio.sdf(state, points)
    """
    check_map(state, batched="jax.vmap(hio.transform)(maps, poses)")
    config = _in_bounds(state.config, bounds)
    matrix = _checked_pose("pose", pose)
    return _joined(config, ((state, matrix),))


def merge(a: MapState, b: MapState, pose_a_b: Any) -> MapState:
    """Adds a map to another one, without the clouds of either.

    Hits, passes and the moments of patches add up, as if one map had met the rays of both. Only
    what lies in the box of `a` is added: `grow` it first. Surfaces outside are lost, as in
    `transform`. The network of `a`, or of `b` if `a` has no updates, is trained on the merged grid.

    Args:
        a: The map whose frame, box and configuration the result has.
        b: The other map. Its configuration may differ in all but voxel_size, range_noise,
            hidden_width, hidden_layers and frequency.
        pose_a_b: (4, 4), rigid: it maps points of the frame of `b` to that of `a`.

    Returns:
        The merged map. It shares no memory with the others. A map without updates adds nothing:
        the result answers as the other one. Inside jit, a pose that is not rigid adds nothing and
        raises `Flag.BAD_POSE`.

    Raises:
        ValueError: An argument is not a map, or the configurations do not fit. Outside jit also:
            the pose is not finite or not rigid.

    Example:
        >>> both = hio.merge(hio.grow(a, bounds), b, pose_a_b)
    """
    batched = "jax.vmap(hio.merge)(maps_a, maps_b, poses)"
    check_map(a, name="a", batched=batched)
    check_map(b, name="b", batched=batched)
    _check_fits("a", a, "b", b)
    matrix = _checked_pose("pose_a_b", pose_a_b)
    return _joined(a.config, ((a, None), (b, matrix)))


def correct(submaps: Sequence[MapState], poses: Any, bounds: Any = None) -> MapState:
    """Makes one map of submaps at corrected poses, for instance after a loop closure.

    Keep the submaps as they were mapped, and call this again with each new correction: what is lost
    when a grid is re-binned is then lost once.

    Args:
        submaps: One map or more, each in a frame of its own. The first one gives the configuration,
            which may differ from the others as for `merge`.
        poses: (K, 4, 4) T_world_submap, rigid, one for each submap.
        bounds: The result's box, ((x0, y0, z0), (x1, y1, z1)) m, world frame, concrete numbers; by
            default the numbers are those of the first submap's box.

    Returns:
        The map of all submaps in the world frame. It shares no memory with them. Inside jit, a
        submap whose pose is not rigid is left out and raises `Flag.BAD_POSE`.

    Raises:
        ValueError: There is no submap, one is not a map, the configurations do not fit, there are
            not as many poses as submaps, or `bounds` is not a box. Outside jit also: a pose is not
            finite or not rigid.

    Example:
        >>> state = hio.correct(submaps, poses_after_the_loop, bounds)
    """
    is_list = isinstance(submaps, list | tuple)
    if not (is_list and submaps):
        found = "empty" if is_list else type(submaps).__name__
        raise ValueError(f"submaps is {found}, expected a list of maps, at least 1")
    for i, submap in enumerate(submaps):
        check_map(submap, name=f"submaps[{i}]")
        _check_fits("submaps[0]", submaps[0], f"submaps[{i}]", submap)
    matrices = as_array("poses", poses)
    if matrices.shape != (len(submaps), 4, 4):
        raise ValueError(f"poses has shape {matrices.shape}, expected ({len(submaps)}, 4, 4)")
    if not is_traced(matrices):
        checked = [check_pose(pose, f"poses[{i}]") for i, pose in enumerate(np.asarray(matrices))]
        matrices = jax.device_put(np.stack(checked))
    config = _in_bounds(submaps[0].config, bounds)
    return _joined(config, tuple(zip(submaps, matrices, strict=True)))


def _joined(config: Config, parts: tuple[tuple[MapState, jax.Array | None], ...]) -> MapState:
    """Calls `_join`, outside jit compiled; there it warns of what is lost."""
    if is_traced(*jax.tree.leaves(parts)):
        return _join(config, parts)[0]
    result, lost = _join_jit(config, parts)
    share = float(jax.device_get(lost))
    if share > _MOST_LOST:
        warnings.warn(
            f"{100 * share:.2g} % of the surface patches fall outside of the box and are "
            f"lost: pass larger bounds than {config.bounds}, or grow the map first",
            stacklevel=3,
        )
    return result


@plain
def _join(
    config: Config, parts: tuple[tuple[MapState, jax.Array | None], ...]
) -> tuple[MapState, jax.Array]:
    """Joins maps in one box.

    Args:
        config: The configuration of the result.
        parts: Maps and their poses T_world_map; None leaves a map of this very box as it is.

    Returns:
        The map, and the share of the surface patches that fall outside of the box, ().
    """
    states, eye = [state for state, _ in parts], jnp.eye(4, dtype=jnp.float32)
    good = [jnp.asarray(True) if pose is None else is_rigid(pose) for _, pose in parts]
    # A map that is only moved is kept in any case; of several, those that can be placed.
    used = [jnp.asarray(True)]
    if len(parts) > 1:
        used = [ok & (state.updates > 0) for ok, state in zip(good, states, strict=True)]

    windows, moved, networks = [], [], []
    lost = patches = jnp.int32(0)
    for (state, pose), ok, use in zip(parts, good, used, strict=True):
        exact = None if pose is None else _exact(jnp.where(ok, pose, eye))
        known = state.grid.evidence
        if exact is None:
            window = whole_window(known)
            networks.append(state.network)
        else:
            window = rebin(state.config, known, config, exact)
            networks.append(move_network(state.network, exact))
            own_lost, own = count_lost(state.config, known, config, exact)
            lost, patches = lost + jnp.where(use, own_lost, 0), patches + jnp.where(use, own, 0)
        window = jax.tree.map(lambda x, use=use: jnp.where(use, x, jnp.zeros_like(x)), window)
        windows.append(window)
        moved.append(None if exact is None else _moved(state, config, exact, use))
    empty = empty_grid(config)
    total = sum_evidence(config, windows, moved)
    grid = empty.replace(evidence=write_window(empty.evidence, total))
    grid = recompute_derived(config, grid)

    # The network of the first map that has learned anything.
    first = jnp.argmax(jnp.stack(used))
    network = jax.tree.map(lambda *leaves: jnp.stack(leaves)[first], *networks)
    known = jnp.stack([state.optimism for state in states])
    mapped = jnp.stack(used)
    worst = jnp.max(jnp.where(mapped, known, -jnp.inf))
    optimism = jnp.where(jnp.any(mapped), worst, states[0].optimism)
    key, trained = states[0].key, jnp.asarray(True)
    if len(parts) > 1:
        key, network, trained = cond(
            jnp.sum(mapped) > 1, lambda *x: _learn(config, *x), _skip, grid, network, key
        )
    flags = jnp.where(jnp.all(jnp.stack(good)), 0, Flag.BAD_POSE)
    flags |= jnp.where(lost > 0, Flag.POINTS_OUTSIDE, 0)
    flags = (flags | jnp.where(trained, 0, Flag.TRAINING_FAILED)).astype(jnp.uint32)
    report = states[0].report
    for state in states[1:]:
        report = report.replace(flags=report.flags | state.report.flags)
    report = report.replace(flags=report.flags | flags, update_flags=flags)
    updates = sum(jnp.where(use, state.updates, 0) for use, state in zip(used, states, strict=True))
    result = MapState(
        config=config,
        grid=grid,
        network=network,
        optimism=optimism,
        key=key,
        updates=jnp.asarray(updates, jnp.int32),
        report=report,
    )
    # Copied, so that each map can be donated.
    return jax.tree.map(jnp.copy, result), lost / jnp.maximum(patches, 1)


def _moved(state: MapState, config: Config, pose: jax.Array, used: jax.Array) -> Moved:
    """Describes where a map at a pose T_new_old lies in the voxels of a joined grid."""

    def look_up(offset: jax.Array) -> jax.Array:
        passes = passes_at(state.config, state.grid.evidence, config, pose, offset)
        return jnp.where(used, passes, 0)

    return Moved(coincides(config, pose) | ~used, look_up)


_join_jit = jax.jit(_join, static_argnums=0)


def _learn(
    config: Config, grid: Grid, network: Network, key: jax.Array
) -> tuple[jax.Array, Network, jax.Array]:
    """Trains the network on samples of a whole grid; returns whether training was finite, too."""
    extra = jnp.asarray(config.warmup_epochs - least_epochs(config), jnp.int32)

    def once(
        _: jax.Array, carry: tuple[jax.Array, Network, jax.Array]
    ) -> tuple[jax.Array, Network, jax.Array]:
        key, network, finite = carry
        key, grid_key, order_key = jax.random.split(key, 3)
        samples = sample_grid(config, grid, grid_key)
        network, _losses, trained = train(
            config, network, samples, extra, jnp.float32(_AVERAGE), order_key
        )
        return key, network, finite & trained

    start = varying_like((key, network, jnp.asarray(True)), grid, network)
    return jax.lax.fori_loop(0, _TRAININGS, once, start)


def _skip(_: Grid, network: Network, key: jax.Array) -> tuple[jax.Array, Network, jax.Array]:
    return key, network, jnp.asarray(True)


def _exact(pose: jax.Array) -> jax.Array:
    return pose.at[:3, :3].set(nearest_rotation(pose[:3, :3]))


def _check_fits(name: str, state: MapState, other_name: str, other: MapState) -> None:
    for field in _SHARED:
        here, there = getattr(state.config, field), getattr(other.config, field)
        if here != there:
            raise ValueError(
                f"{other_name} has Config.{field} {there!r}, expected that of {name}, {here!r}"
            )


def _checked_pose(name: str, pose: Any) -> jax.Array:
    """Checks the shape of a pose, and its values unless it is traced."""
    array = as_array(name, pose)
    if array.shape != (4, 4):
        raise ValueError(f"{name} has shape {array.shape}, expected (4, 4)")
    if is_traced(array):
        return jnp.asarray(array)
    return jax.device_put(check_pose(array, "" if name == "pose" else name))


def _in_bounds(config: Config, bounds: Any) -> Config:
    if bounds is None:
        return config
    if is_traced(bounds):
        raise ValueError("bounds is traced, expected concrete numbers")
    return dataclasses.replace(config, bounds=bounds)
