"""How a loop runs on the device.

A GPU wants few, large steps, and no wait for the host. A CPU wants kernels that its cores share.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

_MOST_PER_STEP = 10  # on a GPU, so that it starts fewer kernels

# Sharing a kernel among cores costs some microseconds. A kernel of fewer numbers is faster on one.
_LEAST_TO_SHARE = 50_000


def rounds_per_step(rounds: int) -> int:
    """Returns how many rounds of a loop make a step, for `unroll=` of `jax.lax.fori_loop`.

    Args:
        rounds: The rounds of the loop. If a step has them all, there is no loop.

    Returns:
        On a CPU 1, which compiles faster and runs as fast. On a GPU the largest number up to
        `_MOST_PER_STEP` that divides the rounds: XLA compiles rounds that are left over once more.
        If it would be less than half of the most, it is the most.
    """
    if jax.default_backend() == "cpu":
        return 1
    divisor = max(k for k in range(1, _MOST_PER_STEP + 1) if rounds % k == 0)
    return divisor if 2 * divisor >= min(_MOST_PER_STEP, rounds) else _MOST_PER_STEP


def on_all_cores(counter: jax.Array, size: int) -> jax.Array:
    """Has a CPU run the large kernels of a loop on all of its cores.

    XLA compiles a loop without a sort, a scatter or a matrix product to one function, which runs on
    one core. So this sorts two numbers.

    Args:
        counter: The loop's counter, () int32. The loop's body must use the result instead.
        size: How many numbers a kernel computes. Small ones are left on one core.

    Returns:
        The same number.
    """
    if jax.default_backend() != "cpu" or size < _LEAST_TO_SHARE:
        return counter
    return jax.lax.sort(jnp.stack([counter, counter + 1]))[0]
