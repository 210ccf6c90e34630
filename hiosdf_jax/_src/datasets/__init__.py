"""Readers of recorded streams, one format per module."""
