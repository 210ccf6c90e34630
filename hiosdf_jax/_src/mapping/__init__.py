"""Updates: one cloud is fused into the map, stage by stage."""
