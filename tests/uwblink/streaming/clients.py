"""Receivers of a stream, from plain sockets, which share no code with the senders."""

import base64
import json
import os
import socket
import struct


class FoxgloveClient:
    """A viewer that implements WebSocket (RFC 6455) and the protocol of Foxglove literally."""

    def __init__(self, url, name=None, origin=None):
        """Connect as a page of an `origin` that uses a `name` for the server."""
        host, port = url.removeprefix("ws://").rsplit(":", 1)
        self.socket = socket.create_connection((host.strip("[]"), int(port)), timeout=20)
        key = base64.b64encode(os.urandom(16)).decode()
        lines = [
            "GET / HTTP/1.1",
            f"Host: {name or host}",
            *([f"Origin: {origin}"] if origin else []),
            "Upgrade: websocket",
            "Connection: Upgrade",
            f"Sec-WebSocket-Key: {key}",
            "Sec-WebSocket-Version: 13",
            "Sec-WebSocket-Protocol: foxglove.sdk.v1",
        ]
        self.socket.sendall("\r\n".join([*lines, "", ""]).encode())
        self.data = b""
        while b"\r\n\r\n" not in self.data:
            self.data += self.socket.recv(65536)
        head, self.data = self.data.split(b"\r\n\r\n", 1)
        self.status = int(head.split()[1])

    def _take(self, count):
        while len(self.data) < count:
            more = self.socket.recv(65536)
            assert more, "the server hung up"
            self.data += more
        taken, self.data = self.data[:count], self.data[count:]
        return taken

    def receive(self):
        """Return opcode and payload of the next frame; servers do not mask."""
        first, length = self._take(2)
        if length == 126:
            (length,) = struct.unpack(">H", self._take(2))
        elif length == 127:
            (length,) = struct.unpack(">Q", self._take(8))
        return first & 0x0F, self._take(length)

    def text(self):
        opcode, payload = self.receive()
        assert opcode == 1
        return json.loads(payload)

    def message(self):
        """Return subscription, time and content of the next message data."""
        opcode, payload = self.receive()
        assert opcode == 2
        kind, subscription, time_ns = struct.unpack_from("<BIQ", payload)
        assert kind == 1
        return subscription, time_ns, json.loads(payload[13:])

    def send(self, document):
        data = json.dumps(document).encode()
        assert len(data) < 126
        self.socket.sendall(bytes([0x81, 0x80 | len(data)]) + b"\0\0\0\0" + data)

    def close(self):
        self.socket.close()
