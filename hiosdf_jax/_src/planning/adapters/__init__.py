"""Thin adapters to other packages, one per module."""
