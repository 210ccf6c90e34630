"""The coarse global grid (paper, section IV-B), the stages that keep it, and lookups."""
