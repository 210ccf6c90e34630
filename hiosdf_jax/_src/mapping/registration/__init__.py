"""Poses that the map itself corrects."""
