"""The paper's network and its training in plain, eager PyTorch, the baseline of our training.

Autograd computes the gradient by the points, and then differentiates through it for the weights
(arXiv 2310.09463, sections IV-A and IV-D).
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch  # pyright: ignore[reportMissingImports]


class Siren(torch.nn.Module):
    """Layers of sin(omega_0 (W x + b)), and a linear output."""

    def __init__(self, layers: list[tuple[np.ndarray, np.ndarray]], frequency: float) -> None:
        """Copies weights.

        Args:
            layers: Kernel (in, out) and bias (out,) of each layer, from input to output.
            frequency: omega_0.
        """
        super().__init__()
        self.frequency = frequency
        self.layers = torch.nn.ModuleList()
        for kernel, bias in layers:
            linear = torch.nn.Linear(*kernel.shape)
            with torch.no_grad():
                linear.weight.copy_(torch.tensor(kernel.T))
                linear.bias.copy_(torch.tensor(bias))
            self.layers.append(linear)

    def forward(self, points: Any) -> Any:
        """Maps (N, 3) points to (N,) values."""
        x = points
        for layer in self.layers[:-1]:
            x = torch.sin(self.frequency * layer(x))
        return self.layers[-1](x)[:, 0]


def value_and_gradient(model: Siren, points: Any, *, of_weights: bool = False) -> tuple[Any, Any]:
    """Computes values (N,) and gradients (N, 3) at points (N, 3).

    With `of_weights` both are differentiable by the weights.
    """
    points = points.detach().requires_grad_()
    value = model(points)
    (gradient,) = torch.autograd.grad(value.sum(), points, create_graph=of_weights)
    return value, gradient


def loss(model: Siren, points: Any, sdf: Any, weight: Any, weights: tuple[float, float]) -> Any:
    """Computes the weighted sum of mean |f - s| and mean | |grad f| - 1 | (equations 4 and 5).

    Args:
        model: The network.
        points: (N, 3) m, relative to the network's origin.
        sdf: (N,) m.
        weight: (N,) 0 or 1; samples of weight 0 are padding.
        weights: Weights of the two parts of the loss.

    Returns:
        The loss, ().
    """
    value, gradient = value_and_gradient(model, points, of_weights=True)
    count = weight.sum().clamp(min=1)
    fit = ((value - sdf).abs() * weight).sum() / count
    eikonal = ((gradient.norm(dim=-1) - 1).abs() * weight).sum() / count
    return weights[0] * fit + weights[1] * eikonal


def optimizer(model: Siren, learning_rate: float, weight_decay: float) -> Any:
    """Makes the optimizer, AdamW."""
    return torch.optim.AdamW(model.parameters(), lr=learning_rate, weight_decay=weight_decay)


def train(model: Siren, steps: Any, epochs: int, samples: Any, weights: tuple[float, float]) -> Any:
    """Trains for some epochs, each one step on all samples.

    Args:
        model: The network, changed in place.
        steps: Its optimizer.
        epochs: Number of epochs.
        samples: (points, sdf, weight), as `loss` takes them.
        weights: Weights of the two parts of the loss.

    Returns:
        The last loss, ().
    """
    last = None
    for _ in range(epochs):
        steps.zero_grad()
        points, sdf, weight = samples
        last = loss(model, points, sdf, weight, weights)
        last.backward()
        steps.step()
    return last
