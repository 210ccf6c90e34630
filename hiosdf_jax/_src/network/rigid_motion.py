"""The same network in another frame: its first layer absorbs a rigid motion of its input."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from hiosdf_jax._src.state.pytrees import Network

_FIRST = "Dense_0"


def move_network(network: Network, pose: jax.Array) -> Network:
    """Expresses a network in another frame.

    The first layer computes (x - origin) K + b. With x = R^T (y - t) that is
    (y - (R origin + t)) (R K) + b, so the distances are the same up to rounding. AdamW's mean of
    the gradients turns like K. Only the diagonal of its mean squares is known: they turn as those
    of gradients whose components are independent.

    Args:
        network: The network.
        pose: (4, 4) T_new_old, its rotation exact to rounding.

    Returns:
        The network in the new frame.
    """
    rotation = pose[:3, :3]
    adam, *rest = network.optimizer
    adam = adam._replace(mu=_turn(rotation, adam.mu), nu=_turn(rotation**2, adam.nu))
    origin = jnp.sum(rotation * network.origin_world, axis=1) + pose[:3, 3]
    return network.replace(
        params=_turn(rotation, network.params),
        average=_turn(rotation, network.average),
        optimizer=(adam, *rest),
        origin_world=origin,
    )


def _turn(matrix: jax.Array, params: Any) -> Any:
    """Multiplies the first layer's kernel (3, width) by a matrix from the left."""
    layers = params["params"]
    kernel = jnp.sum(matrix[:, :, None] * layers[_FIRST]["kernel"][None], axis=1)
    return params | {"params": layers | {_FIRST: layers[_FIRST] | {"kernel": kernel}}}
