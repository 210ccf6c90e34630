"""Kernels of functions of points, interpreted on a CPU or lowered for a GPU without one."""

import warnings

import jax
import pytest

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


def lowered(function, *arguments, platform="cuda"):
    """The program for a GPU, made without one."""
    if not hasattr(jax.sharding, "AbstractDevice"):
        pytest.skip("this jax needs a GPU to make programs for one")
    device = jax.sharding.AbstractDevice(
        device_kind="NVIDIA H100 80GB HBM3", num_cores=132, platform="gpu"
    )
    mesh = jax.sharding.AbstractMesh((1,), ("x",), abstract_device=device)
    with jax.sharding.use_abstract_mesh(mesh), warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        traced = jax.jit(function).trace(*arguments)
        return traced.lower(lowering_platforms=(platform,)).as_text()
