"""Readers of recorded streams, one layout per module."""
