"""The network of a map as a file that any framework reads."""

from __future__ import annotations

import os

import numpy as np

from hiosdf_jax._src.network.forward import layers_of
from hiosdf_jax._src.output_files import replacing
from hiosdf_jax._src.state.pytrees import Field


def write_safetensors(path: str | os.PathLike[str], field: Field) -> None:
    """Writes the weights of the SIREN that queries use, as safetensors.

    `kernel.K` (inputs, outputs) and `bias.K` (outputs,) are the layers, from K = 0; `frequency` is
    omega_0, and `origin_world` (3,) m is what is subtracted from a point before. All are float32.
    The distance is W_n x + b_n, m, where every x before is sin(omega_0 (W x + b)).

    Args:
        path: The file.
        field: A snapshot of a map. Its grid is not in the file: only with `Config.paper` is the
            network alone the answer of the map.

    Raises:
        OSError: The file cannot be written.
        ModuleNotFoundError: safetensors is not installed.
    """
    try:
        from safetensors.numpy import save
    except ModuleNotFoundError as error:
        if error.name != "safetensors":
            raise
        message = "weights need safetensors: in a clone, pip install '.[export]'"
        raise ModuleNotFoundError(message, name="safetensors") from error
    arrays = {
        "frequency": np.float32(field.config.frequency).reshape(1),
        "origin_world": np.asarray(field.origin_world),
    }
    for number, (kernel, bias) in enumerate(layers_of(field.params)):
        arrays |= {f"kernel.{number}": np.asarray(kernel), f"bias.{number}": np.asarray(bias)}
    written = save({name: np.ascontiguousarray(each) for name, each in arrays.items()})
    with replacing(path) as file:
        file.write(written)
