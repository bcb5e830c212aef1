"""Ranges on a WebSocket that Foxglove opens: a topic a pair, with the schema that exported recordings have, too."""

from __future__ import annotations

import json
from types import TracebackType
from typing import Any, Final, Self

from uwblink.errors import PortError
from uwblink.exporters.schemas import RANGE, SCHEMAS, stamped
from uwblink.streaming.addresses import host_and_port
from uwblink.streaming.gate import Gate, hidden_address
from uwblink.streaming.ranges import StreamedRange

NEWS_KEPT: Final = 1024
"""Messages that wait for a viewer; the oldest are dropped for one that is slower."""


class FoxgloveServer:
    """Serves ranges to as many viewers as come. A context manager: leaving it ends the server.

    Viewers are programs, Foxglove's own pages, and pages of the computer that serves; other web sites are refused.

    Needs the extra `uwbcal[foxglove]`. Sending never waits for a viewer.
    """

    def __init__(self, address: str = "8765") -> None:
        """Serve at "HOST:PORT", or at a port of this computer alone; 0 takes a free one.

        Raises `ArgumentError`, and `PortError` where it cannot be served or the extra is not installed.
        """
        host, port = host_and_port(address, "foxglove")
        try:
            import foxglove
        except ImportError as error:
            raise PortError(
                "serving Foxglove needs foxglove-sdk; pip install 'uwbcal[foxglove]'", parameter="foxglove"
            ) from error
        self._context, behind = foxglove.Context(), hidden_address()
        try:
            self._server = foxglove.start_server(
                name="uwblink", host=behind, port=0, context=self._context, message_backlog_size=NEWS_KEPT
            )
        except (RuntimeError, OSError, ValueError) as error:
            raise PortError(f"foxglove {address}: cannot be served ({str(error).splitlines()[0]})") from error
        try:
            self._gate = Gate(host, port, (behind, self._server.port))
        except OSError as error:
            self._server.stop()
            raise PortError(f"foxglove {address}: cannot be served there ({error.strerror or error})") from error
        layout = json.dumps(SCHEMAS[RANGE]).encode()
        self._schema = foxglove.Schema(name=RANGE, encoding="jsonschema", data=layout)
        self._channels: dict[tuple[int, int], foxglove.Channel] = {}
        self.url = f"ws://{f'[{host}]' if ':' in host else host}:{self._gate.server_address[1]}"

    def __enter__(self) -> Self:
        """Return the server."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        """End the server."""
        self._gate.close()
        self._server.stop()

    def send(self, found: StreamedRange) -> None:
        """Give a range to the viewers that want its topic, `/ranges/INITIATOR_TARGET`."""
        row = found.to_dict()
        data = json.dumps(stamped(row.pop("time_ns"), row)).encode()
        self._channel(found.initiator, found.target).log(data, log_time=max(found.time_ns, 0))

    def _channel(self, initiator: int, target: int) -> Any:
        if (initiator, target) not in self._channels:
            import foxglove

            self._channels[initiator, target] = foxglove.Channel(
                f"/ranges/{initiator}_{target}", message_encoding="json", schema=self._schema, context=self._context
            )
        return self._channels[initiator, target]
