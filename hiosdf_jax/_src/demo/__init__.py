"""A simulated apartment with exact distances, and a robot that explores it."""
