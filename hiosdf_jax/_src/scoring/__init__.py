"""Scores of a map against exact distances."""
