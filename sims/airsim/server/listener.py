"""Where clients connect, and how many may."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import Callable

from runtime.logs import NodeLogger
from sims.airsim.server.connection import Connection
from sims.airsim.server.incidents import Incidents
from sims.airsim.server.methods import Flavour, Table


class Listener:
    """Lets clients in.

    Clients may connect as soon as it is made; they are served from `serve` on.

    Args:
        host: Address to listen on.
        port: Port to listen on; 0 for any that is free.
        most: Connections that may be open at once.
        log: Where refusals are logged.
        on_change: Called whenever a client has come or left, with whether any is there.

    Attributes:
        port: The port.

    Raises:
        ValueError: The port is not free.
    """

    def __init__(
        self,
        host: str,
        port: int,
        most: int,
        log: NodeLogger,
        on_change: Callable[[bool], None] = lambda _: None,
    ) -> None:
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        try:
            self._socket = socket.create_server((host, port), family=family)
        except OSError as error:
            raise ValueError(
                f"port: expected one that is free on {host}, found {port}: {error}"
            ) from None
        self._socket.setblocking(False)
        self.port: int = self._socket.getsockname()[1]
        self._most = most
        self._on_change = on_change
        self._incidents = Incidents(log)
        self._connections: set[Connection] = set()

    def serve(self, table: Table, flavour: Flavour) -> None:
        """Serve those who have connected, and those who will."""
        self._table, self._flavour = table, flavour
        asyncio.get_running_loop().add_reader(self._socket, self._accept)

    def close(self) -> None:
        """Close all connections, and log what was counted."""
        self._on_change = lambda _: None
        asyncio.get_running_loop().remove_reader(self._socket)
        self._socket.close()
        for connection in tuple(self._connections):
            connection.close()
        self._incidents.log_counts()

    def _accept(self) -> None:
        try:
            client, (host, port, *_) = self._socket.accept()
        except OSError:  # it is gone again
            return
        address = f"{host}:{port}"
        if len(self._connections) >= self._most:
            idlest = max(self._connections, key=Connection.spare_for)
            if idlest.spare_for() < 0.0:
                self._incidents.refused(address, f"expected at most {self._most} connections")
                client.close()
                return
            idlest.close("it was idle, and another client came")
        self._incidents.count("connections")
        connection = Connection(
            client, address, self._table, self._flavour, self._incidents, self._left
        )
        self._connections.add(connection)
        self._on_change(bool(self._connections))

    def _left(self, connection: Connection) -> None:
        self._connections.discard(connection)
        self._on_change(bool(self._connections))
