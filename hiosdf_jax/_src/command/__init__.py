"""The `hiosdf` command."""
