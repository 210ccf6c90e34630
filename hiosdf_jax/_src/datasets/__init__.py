"""Readers of recorded streams, one format per module; CONTRIBUTING.md says how to add one."""
