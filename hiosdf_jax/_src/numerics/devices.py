"""Which of our kernels a device can run."""

from __future__ import annotations

from typing import Any

import jax

_HOPPER = "9.0"  # CUDA's compute capability
_TRIED_BEFORE = (0, 13)  # jax changes its interface for GPU kernels from version to version


def has_kernels() -> bool:
    """Returns whether the default backend is one Hopper GPU, and jax a version that was tried.

    XLA cannot divide one of our kernels among several devices.
    """
    if jax.__version_info__ >= _TRIED_BEFORE:
        return False
    devices = jax.devices()
    capability = getattr(devices[0], "compute_capability", None)
    return len(devices) == 1 and jax.default_backend() == "gpu" and capability == _HOPPER


def choose(by_kernel: Any, by_xla: Any, interpret: Any, *arguments: Any) -> Any:
    """Calls one of two functions.

    Args:
        by_kernel: For a Hopper GPU, or where a kernel is interpreted.
        by_xla: For other devices. The device is known when the program is compiled.
        interpret: How to interpret the kernel on a CPU, or None.
        *arguments: Arguments of both functions.

    Returns:
        The result.
    """
    if interpret is not None:
        return by_kernel(*arguments)
    return jax.lax.platform_dependent(*arguments, cuda=by_kernel, default=by_xla)
