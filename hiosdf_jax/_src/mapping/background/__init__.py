"""Mapping beside a controller, in a thread or in a process of its own."""
