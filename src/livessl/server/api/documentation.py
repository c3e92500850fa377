"""The page `/docs`: the OpenAPI description in Swagger UI, whose files come from an installed package."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path
from typing import Final

from fastapi import FastAPI, HTTPException
from fastapi.responses import FileResponse

PAGE: Final = Path(__file__).parent / "docs"
"""Our own part of the page: HTML and the script that starts the viewer."""

MISSING: Final = "docs: the viewer is not installed; run pip install 'livessl[api-docs]' or read /api/v1/openapi.json"

_OURS: Final = frozenset({"start.js"})
_THEIRS: Final = frozenset({"swagger-ui.css", "swagger-ui-bundle.js"})


def add_documentation(app: FastAPI) -> None:
    """Serve `/docs`; it answers 404 with the cure if the package with the viewer is not installed."""
    viewer = viewer_files()

    @app.get("/docs", include_in_schema=False)
    def get_page() -> FileResponse:
        if viewer is None:
            raise HTTPException(404, MISSING)
        return FileResponse(PAGE / "index.html")

    @app.get("/docs/{name}", include_in_schema=False)
    def get_file(name: str) -> FileResponse:
        if name in _OURS:
            return FileResponse(PAGE / name)
        if viewer is None or name not in _THEIRS:
            raise HTTPException(404, f"docs: no file {name!r}")
        return FileResponse(viewer / name)


def viewer_files() -> Path | None:
    """Folder of Swagger UI in the package `fastapi-offline`; None if that is not installed."""
    found = find_spec("fastapi_offline")
    return None if found is None or found.origin is None else Path(found.origin).parent / "static"
