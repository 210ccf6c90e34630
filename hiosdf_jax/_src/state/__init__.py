"""The pytrees: the map that `update` carries, and the fields that planners hold."""
