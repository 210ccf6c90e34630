"""Pictures of maps, drawn without a display."""
