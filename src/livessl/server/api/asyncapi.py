"""The AsyncAPI description of the WebSockets, generated from the models of their messages and parameters."""

from __future__ import annotations

from typing import Any, Final

from fastapi import APIRouter, Request, Response
from pydantic import BaseModel
from pydantic.json_schema import models_json_schema

from livessl import __version__
from livessl.schema.messages import MESSAGES
from livessl.server.api.auth import PROTOCOL, TOKEN_PROTOCOL, Access
from livessl.server.api.encode import JsonObject
from livessl.server.api.hosts import public_host
from livessl.server.api.live import LISTEN, LIVE, MAP
from livessl.server.api.queries import ListenParameters, LiveParameters, MapParameters
from livessl.server.api.routes import as_json
from livessl.server.clips.listeners import HEADER as SOUND_HEADER
from livessl.server.maps import HEADER
from livessl.site.models import Site

ASYNCAPI: Final = "/api/v1/asyncapi.json"

_PICTURE: Final = f"""\
Power map of one view, as a binary message: a header of {HEADER.size} bytes, little-endian, and then one byte for each
grid point, row by row, the first row at the lowest coordinate. The header holds: 4 bytes `LMAP`; uint8 version, 1;
uint8 view (0 floor, 1 side, 2 front); uint16 length of the header; int64 time of the window's middle in nanoseconds
since 1970, UTC; float32 its age in seconds when sent; 2 float32, the powers that 0 and 255 stand for; 4 float32, the
lowest and highest coordinate of the rows and then of the columns, in metres; 2 uint16, the numbers of rows and columns.
"""

_TOKEN: Final = {
    "type": "http",
    "scheme": "bearer",
    "description": "Send `Authorization: Bearer TOKEN`, or from a browser offer the WebSocket protocols "
    f"`{PROTOCOL}` and `{TOKEN_PROTOCOL}TOKEN`.",
}


def asyncapi_route(site: Site, access: Access) -> APIRouter:
    """`GET /api/v1/asyncapi.json`."""
    router = APIRouter()

    @router.get(ASYNCAPI, include_in_schema=False)
    def get_asyncapi(request: Request) -> Response:
        protocol = "wss" if request.url.scheme == "https" else "ws"
        host, root = public_host(request.headers), request.scope["root_path"]
        return as_json(describe(site.site, host, protocol, root, tokens=access.wanted))

    return router


def describe(site: str, host: str, protocol: str, root_path: str = "", *, tokens: bool) -> JsonObject:
    """The AsyncAPI 3.0 document of a server.

    Parameters
    ----------
    site : str
        Name of the site, in the title.
    host : str
        Host and port that the WebSockets are reached at.
    protocol : str
        `ws` or `wss`.
    root_path : str
        Path that the proxy puts before every address; empty without one.
    tokens : bool
        Whether clients need a token.
    """
    _, schemas = models_json_schema(
        [(model, "serialization") for model in MESSAGES], ref_template="#/components/schemas/{model}"
    )
    server: JsonObject = {"host": host, "protocol": protocol, "description": f"The server of site {site}."}
    if root_path:
        server["pathname"] = root_path
    components: JsonObject = {
        "schemas": schemas["$defs"],
        "messages": {
            **{model.__name__: _message(model) for model in MESSAGES},
            "Picture": _picture(),
            "Sound": _sound(),
        },
    }
    if tokens:
        server["security"] = [{"$ref": "#/components/securitySchemes/token"}]
        components["securitySchemes"] = {"token": _TOKEN}
    live = [model.__name__ for model in MESSAGES]
    return {
        "asyncapi": "3.0.0",
        "info": {
            "title": "livessl",
            "version": __version__,
            "description": "Live messages, power maps and sound over WebSockets. A wrong query is answered by closing "
            "the connection with code 1008 and a reason. The REST API is described in `/api/v1/openapi.json`.",
        },
        "defaultContentType": "application/json",
        "servers": {"site": server},
        "channels": {
            "live": _channel(LIVE, "Events, updates, tracks and states as they are published.", LiveParameters, live),
            "map": _channel(MAP, "Power maps of each new window.", MapParameters, ["Picture"]),
            "listen": _channel(
                LISTEN, "Sound of one microphone, for operators, if the site permits it.", ListenParameters, ["Sound"]
            ),
        },
        "operations": {
            "sendLive": _operation(
                "live", "Sends `hello` first, and then every message that the filters select.", live
            ),
            "sendMap": _operation(
                "map", "Sends the newest window's pictures at once, then each new one's.", ["Picture"]
            ),
            "sendListen": _operation("listen", "Sends each frame that the array's node sends.", ["Sound"]),
        },
        "components": components,
    }


def _channel(address: str, description: str, parameters: type[BaseModel], messages: list[str]) -> JsonObject:
    query = parameters.model_json_schema()
    return {
        "address": address,
        "description": description,
        "messages": {name: {"$ref": f"#/components/messages/{name}"} for name in messages},
        "bindings": {"ws": {"method": "GET", "query": query, "bindingVersion": "0.1.0"}},
    }


def _operation(channel: str, summary: str, messages: list[str]) -> JsonObject:
    return {
        "action": "send",
        "channel": {"$ref": f"#/channels/{channel}"},
        "summary": summary,
        "messages": [{"$ref": f"#/channels/{channel}/messages/{name}"} for name in messages],
    }


def _message(model: type[BaseModel]) -> dict[str, Any]:
    return {
        "name": model.model_fields["kind"].annotation.__args__[0],  # type: ignore[union-attr]
        "title": model.__name__,
        "summary": model.__doc__,
        "contentType": "application/json",
        "payload": {"$ref": f"#/components/schemas/{model.__name__}"},
    }


def _picture() -> dict[str, Any]:
    return {
        "name": "picture",
        "title": "Picture",
        "summary": "Power map of one view.",
        "description": _PICTURE,
        "contentType": "application/octet-stream",
        "payload": {"type": "string", "format": "binary"},
    }


def _sound() -> dict[str, Any]:
    return {
        "name": "sound",
        "title": "Sound",
        "summary": "A frame of one microphone's sound.",
        "description": f"A header of {SOUND_HEADER.size} bytes, little-endian: int64, time of the first sample in "
        "nanoseconds since the epoch; float64, sampling rate in hertz; uint32, messages left out before this one "
        "because the client was slow. Then the samples as int16, little-endian. Nodes send sound only around sound.",
        "contentType": "application/octet-stream",
        "payload": {"type": "string", "format": "binary"},
    }
