"""Pictures of maps, drawn without a display, and the live view in a browser."""
