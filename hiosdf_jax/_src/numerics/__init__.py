"""Gradients of batches, vectors as components, and rigid poses."""
