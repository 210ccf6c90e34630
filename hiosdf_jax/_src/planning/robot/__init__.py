"""Robots as spheres."""
