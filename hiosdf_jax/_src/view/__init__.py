"""Maps as pictures, drawn without a display."""
