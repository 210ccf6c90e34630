"""How a loop runs on the device: a GPU wants few, large steps, and no wait for the host."""

from __future__ import annotations

import jax

_ROUNDS_PER_STEP = 8  # on a GPU, so that it starts fewer kernels


def rounds_per_step(on_gpu: int | None = None) -> int:
    """Returns how many rounds of a loop make a step, for `unroll=` of `jax.lax.fori_loop`.

    Args:
        on_gpu: The number on a GPU, `_ROUNDS_PER_STEP` by default. With all rounds, there is no
            loop.

    Returns:
        That number on a GPU. On a CPU 1, which compiles faster and runs as fast.
    """
    return 1 if jax.default_backend() == "cpu" else on_gpu or _ROUNDS_PER_STEP
