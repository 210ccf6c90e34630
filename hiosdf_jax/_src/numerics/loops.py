"""How a loop runs on the device: a GPU wants few, large steps, and no wait for the host."""

from __future__ import annotations

import jax

_UNROLL = 8  # rounds per step on a GPU, so that it starts fewer kernels


def unroll(rounds: int | None = None) -> int:
    """Returns how many rounds of a loop make a step, for `unroll=` of `jax.lax.fori_loop`.

    Args:
        rounds: The number on a GPU, `_UNROLL` by default. With all rounds, there is no loop.

    Returns:
        That number; 1 on a CPU, which compiles faster and runs as fast.
    """
    return 1 if jax.default_backend() == "cpu" else rounds or _UNROLL
