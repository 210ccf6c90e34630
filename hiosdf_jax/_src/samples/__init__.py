"""Training samples from the grid and from the newest cloud (paper, sections IV-B and IV-C)."""
