"""The implementation: see `hiosdf_jax` and the modules beside this folder for public names."""
