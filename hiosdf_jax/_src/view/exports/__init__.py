"""Files of maps for other programs, one module per format."""
