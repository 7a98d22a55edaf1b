"""A page of the viewer without a browser: speaks its websocket protocol, moves a camera, counts what it is shown.

Otherwise a measurement with many pages would measure their browsers.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from types import TracebackType
from typing import Any

import msgspec
import viser
import zstandard
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

_HEADER = 8


@dataclass
class Page:
    """One connection, opened by entering it as a context."""

    url: str
    """`ws://host:port`."""
    width: int = 320
    height: int = 240
    origin: str | None = None
    """Of the page, as a browser would say it."""
    headers: dict[str, str] = field(default_factory=dict)
    """Others of the request that opens the connection."""
    pictures: list[tuple[float, int]] = field(default_factory=list)
    """When each picture came (monotonic seconds), and its bytes."""
    last_picture: bytes = b""
    last_depth: bytes | None = None
    controls: dict[str, dict[str, Any]] = field(default_factory=dict)
    """Controls by their identifier: type and properties."""
    notices: list[tuple[str, str]] = field(default_factory=list)
    """Titles and texts."""
    downloads: list[str] = field(default_factory=list)
    frusta: dict[str, bool] = field(default_factory=dict)
    """Whether each camera that is shown has its image."""
    kinds: set[str] = field(default_factory=set)
    """Of all messages that came."""
    is_closed: bool = False
    storage: dict[str, str] = field(default_factory=dict)
    """What the browser keeps from page to page."""

    def __enter__(self) -> Page:
        self._socket = connect(
            self.url,
            subprotocols=[f"viser-v{viser.__version__}"],  # type: ignore[list-item]
            origin=self.origin,  # type: ignore[arg-type]
            additional_headers=self.headers,
            max_size=None,
            compression=None,
        )
        self._changed = threading.Condition()
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._socket.close()
        self._reader.join(5)

    def look_from(self, angle: float, distance: float = 4.0, height: float = 1.5, **changes: Any) -> None:
        """Send a camera on a circle around the origin that looks at it; `changes` replace parts of the message."""
        place = (distance * math.cos(angle), distance * math.sin(angle), height)
        camera = {"wxyz": _looking_at_origin(place), "position": place, "look_at": (0.0, 0.0, 0.0)}
        lens = {"fov": 0.8, "near": 0.01, "far": 1000.0, "up_direction": (0.0, 0.0, 1.0)}
        size = {"image_height": self.height, "image_width": self.width}
        self.send("ViewerCameraMessage", **{**camera, **lens, **size, **changes})

    def click(self, x: float, y: float) -> None:
        """Click a point of the picture, given in parts of its width and height."""
        ray = {"ray_origin": (0.0, 0.0, 0.0), "ray_direction": (0.0, 0.0, 1.0)}
        self.send("ScenePointerMessage", event_type="click", **ray, screen_pos=((x, y),), modifier=None)

    def control(self, label: str) -> str:
        """Identifier of the control with a label; the newest if there are several."""
        labels = {str(props.get("label")): key for key, props in self.controls.items()}
        if label not in labels:
            raise KeyError(f"{label}; there are {sorted(labels)}")
        return labels[label]

    def props(self, label: str) -> dict[str, Any]:
        """Properties of a control, among them its value; they follow what the page is told."""
        return self.controls[self.control(label)]

    def set(self, label: str, value: Any = True) -> None:
        """Change a control, or press a button."""
        self.send("GuiUpdateMessage", uuid=self.control(label), updates={"value": value})

    def set_all(self, values: dict[str, Any]) -> None:
        """Change several, given by their labels."""
        for label, value in values.items():
            self.set(label, value)

    def send(self, kind: str, **content: Any) -> None:
        self._socket.send(msgspec.msgpack.encode({"type": kind, **content}))

    def send_raw(self, data: bytes | str) -> None:
        self._socket.send(data)

    def wait_until(self, holds: Callable[[], bool], timeout_s: float = 120.0) -> None:
        """Wait for something to become true; if it does not, TimeoutError."""
        with self._changed:
            if not self._changed.wait_for(holds, timeout_s):
                shown = f"{len(self.pictures)} pictures, notices {self.notices}, closed {self.is_closed}"
                raise TimeoutError(shown)

    def wait_for_notice(self, text: str) -> None:
        self.wait_until(lambda: any(text in said for _, said in self.notices))

    def wait_for_text(self, *texts: str) -> None:
        self.wait_until(lambda: all(text in self.texts for text in texts))

    @property
    def texts(self) -> str:
        """All HTML that the page shows."""
        return "\n".join(str(props.get("content", "")) for props in list(self.controls.values()))

    def _read(self) -> None:
        decompressor = zstandard.ZstdDecompressor()
        try:
            for data in self._socket:
                assert isinstance(data, bytes)
                size = int.from_bytes(data[_HEADER : 2 * _HEADER], "little")
                packed = data[2 * _HEADER : 2 * _HEADER + size]
                content = msgspec.msgpack.decode(decompressor.decompress(packed))
                with self._changed:
                    for message in content["messages"]:
                        self._take(message)
                    self._changed.notify_all()
        except ConnectionClosed:
            pass
        with self._changed:
            self.is_closed = True
            self._changed.notify_all()

    def _take(self, message: dict[str, Any]) -> None:
        kind = message["type"]
        self.kinds.add(kind)
        if kind == "BackgroundImageMessage" and message["rgb_data"] is not None:
            self.last_picture, self.last_depth = message["rgb_data"], message["depth_data"]
            self.pictures.append((time.monotonic(), len(message["rgb_data"])))
        elif kind == "GuiUpdateMessage":
            self.controls.setdefault(message["uuid"], {}).update(message["updates"])
        elif kind == "GuiRemoveMessage":
            self.controls.pop(message["uuid"], None)
        elif kind.startswith("Gui") and "uuid" in message and "props" in message:
            value = {"value": message["value"]} if "value" in message else {}
            self.controls[message["uuid"]] = {"type": kind, **message["props"], **value}
        elif kind == "NotificationShowMessage":
            self.notices.append((message["props"]["title"], message["props"]["body"]))
        elif kind in ("CameraFrustumMessage", "SceneNodeUpdateMessage"):
            self._take_node(message)
        elif kind == "FileTransferStartDownload":
            self.downloads.append(message["filename"])
        elif kind == "LocalStorageSetItemMessage":
            self.storage[message["key"]] = message["value"]
        elif kind == "LocalStorageGetItemRequestMessage":
            answer = {"value": self.storage.get(message["key"]), "request_uuid": message["request_uuid"]}
            self.send("LocalStorageGetItemResponseMessage", error=None, **answer)

    def _take_node(self, message: dict[str, Any]) -> None:
        if message["type"] == "CameraFrustumMessage":
            self.frusta[message["name"]] = message["props"]["_image_data"] is not None
        elif message["updates"].get("_image_data") is not None:
            self.frusta[message["name"]] = True


def _looking_at_origin(place: tuple[float, float, float]) -> tuple[float, float, float, float]:
    """Quaternion of OpenCV axes at a place, looking at the origin with +z up."""
    import numpy as np
    from viser.transforms import SO3

    forward = -np.array(place) / np.linalg.norm(place)
    right = np.cross(forward, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward], axis=1)
    w, x, y, z = SO3.from_matrix(rotation).wxyz.tolist()
    return w, x, y, z
