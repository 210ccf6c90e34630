"""Clearances and costs for controllers."""
