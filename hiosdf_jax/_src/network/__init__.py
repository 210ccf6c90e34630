"""The SIREN and its training (paper, sections IV-A and IV-D)."""
