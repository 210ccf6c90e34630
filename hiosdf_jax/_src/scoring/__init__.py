"""Scores of a map against exact distances, or against returns that it was not given."""
