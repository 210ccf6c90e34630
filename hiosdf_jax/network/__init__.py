"""The global SDF network (paper, sections IV-A and IV-D).

sine: a fast sine.  siren: the network.  training: its loss and its fit to samples.
"""
