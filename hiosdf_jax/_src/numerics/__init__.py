"""Checks of clouds and poses, gradients, vectors, shifts and chunks."""
