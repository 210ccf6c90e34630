"""The coarse global grid (paper, section IV-B), one stage per module."""
