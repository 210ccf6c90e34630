"""Readers of recorded streams, one format per module; docs/architecture.md says how to add one."""
