"""What a cloud contradicts in the map: new things, hidden space, vanished surfaces, bad clouds."""
