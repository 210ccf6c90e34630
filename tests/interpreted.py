"""Kernels of functions of points, interpreted on a CPU."""

from hiosdf_jax._src.numerics import devices, point_kernel


def clear():
    """Forgets the kernels that were made, which depend on what tests change."""
    point_kernel._with_kernel.cache_clear()
    point_kernel._with_sum.cache_clear()


def interpret_point_kernels(monkeypatch):
    """Runs the kernels on the CPU, for any number of points."""
    monkeypatch.setattr(devices, "has_kernels", lambda: True)
    monkeypatch.setattr(point_kernel, "INTERPRET", True)
    monkeypatch.setattr(point_kernel, "_LEAST_POINTS", 1)
    clear()
