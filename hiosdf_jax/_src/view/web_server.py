"""Starts and ends a server of viser, for this machine alone by default."""

from __future__ import annotations

import contextlib
import io
import socket
from typing import TYPE_CHECKING

from hiosdf_jax._src.numerics.intake import check_whole

if TYPE_CHECKING:
    import viser

LOOPBACK = "127.0.0.1"
PORT = 8080


def serve(host: str = LOOPBACK, port: int = PORT) -> viser.ViserServer:
    """Starts a server of viser that prints nothing and opens no tunnel to the outside.

    Args:
        host: Address to serve at.
        port: Port to serve at; the next free one is taken.

    Returns:
        The server.

    Raises:
        ValueError: The port is none, or the address is not one of this machine.
        ModuleNotFoundError: viser is not installed.
    """
    check_whole("port", port, 0)
    if port > 65535:
        raise ValueError(f"port is {port}, expected at most 65535")
    _check_address(host)
    try:
        import viser
    except ModuleNotFoundError as error:
        if error.name != "viser":
            raise
        message = "the view needs viser: in a clone, pip install '.[view]'"
        raise ModuleNotFoundError(message, name="viser") from error
    with contextlib.redirect_stdout(io.StringIO()):
        server = viser.ViserServer(host=host, port=port, label="hiosdf_jax", verbose=False)
    # Any client may ask viser to publish the view through a server of its authors.
    server.request_share_url = lambda verbose=True: None
    server.gui.configure_theme(show_share_button=False, show_logo=False)
    return server


def stop(server: viser.ViserServer) -> None:
    """Ends a server without a word."""
    with contextlib.redirect_stdout(io.StringIO()):
        server.stop()


def _check_address(host: str) -> None:
    """Raises a ValueError if nothing can be served at an address; viser would try without end."""
    try:
        found = socket.getaddrinfo(host or None, 0, type=socket.SOCK_STREAM)
        for family, kind, *_, address in found:
            with socket.socket(family, kind) as each:
                each.bind(address)
    except OSError as error:
        message = f"host is {host!r}, expected an address of this machine: {error.strerror}"
        raise ValueError(message) from error
