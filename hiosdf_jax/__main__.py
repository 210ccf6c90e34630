"""`python -m hiosdf_jax`: the `hiosdf` command."""

import sys

from hiosdf_jax._src.command.cli import main

if __name__ == "__main__":
    sys.exit(main())
