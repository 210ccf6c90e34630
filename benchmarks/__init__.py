"""What is measured of the project; nothing here is installed."""
