"""The HTTP side: page, health, figures, the model that is served and its replacement; and the WebSockets."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractAsyncContextManager
from pathlib import Path
from typing import Annotated, Any

from fastapi import Body, FastAPI, Request, Response, WebSocket
from fastapi.responses import FileResponse, JSONResponse, PlainTextResponse
from fastapi.staticfiles import StaticFiles

from pipelines import report
from pipelines.report.results import as_json
from pipelines.serve.connection import Connection
from pipelines.serve.guard import Guard
from pipelines.serve.hub import Hub
from pipelines.serve.wire import encode
from terrain import __version__
from terrain.errors import TerrainError

LARGEST_BODY = 262_144  #: Bytes of a request's body: a table of target slips, or the name of a model

PAGE = Path(__file__).parent / "page"
FOLDERS = {"/page": PAGE, "/assets": Path(report.__file__).parent / "assets"}
"""Files of the page, and the plots that it shares with reports."""

OPEN = frozenset(
    (
        *("/", "/health", "/ready"),
        *(f"{place}/{file.name}" for place, folder in FOLDERS.items() for file in folder.iterdir()),
    )
)
"""Paths that need no token: they tell nothing of robots."""

ModelUri = Annotated[
    str,
    Body(embed=True, min_length=1, max_length=1000, description="models:/NAME@champion or a model folder"),
]


def make_app(hub: Hub, lifespan: Callable[[FastAPI], AbstractAsyncContextManager[None]]) -> Guard:
    """Return the application behind its guard.

    Parameters
    ----------
    hub : of the sessions
    lifespan : what begins before the first request, and ends after the last
    """
    app = FastAPI(
        title="Terrain service",
        version=__version__,
        description="Terrain and target slip of robots, live. Robots connect to the WebSocket /robots.",
        docs_url=None,  # it loads scripts of other hosts
        redoc_url=None,
        lifespan=lifespan,
        max_body_size=LARGEST_BODY,
    )

    @app.exception_handler(TerrainError)
    async def refused(request: Request, error: TerrainError) -> JSONResponse:
        return JSONResponse({"detail": str(error)}, 409)

    for place, folder in FOLDERS.items():
        app.mount(place, StaticFiles(directory=folder))

    @app.get("/", include_in_schema=False)
    async def page() -> FileResponse:
        return FileResponse(PAGE / "index.html")

    @app.websocket("/robots")
    async def robots(socket: WebSocket) -> None:
        await Connection(socket, hub).serve()

    @app.get("/health")
    async def health() -> dict[str, str]:
        """Say that the process runs."""
        return {"status": "ok", "version": __version__}

    @app.get("/ready")
    async def ready(response: Response) -> dict[str, Any]:
        """Say whether robots can be served (503 where they cannot), and what is not as it should be."""
        if hub.closing:
            response.status_code = 503
        return {"ready": not hub.closing, "sessions": len(hub.sessions), "trouble": hub.trouble}

    @app.get("/metrics", response_class=PlainTextResponse)
    async def metrics() -> PlainTextResponse:
        """Return the figures of the service in Prometheus' text form."""
        return PlainTextResponse(hub.metrics.text(), media_type="text/plain; version=0.0.4; charset=utf-8")

    @app.get("/model")
    async def model() -> dict[str, Any]:
        """Return the card of the model that is served: how it was trained, on what, and how well it did."""
        served = hub.served
        return {
            "served": served.content(),
            "card": {} if served.model is None else as_json(served.model.info),
        }

    @app.get("/state")
    async def state(session: str = "") -> Response:
        """Return what the page shows of a robot, of the first one where it is not connected."""
        return Response(encode(hub.content(session)), media_type="application/json")

    @app.get("/sessions")
    async def sessions() -> list[dict[str, Any]]:
        """Return the robots that are connected."""
        return [opened.content() for opened in hub.sessions.values()]

    @app.put("/model")
    async def replace_model(uri: ModelUri) -> dict[str, Any]:
        """Serve another model: all robots at once, or none; no sample is lost."""
        return (await hub.replace_model(uri)).content()

    @app.put("/table")
    async def replace_table(text: Annotated[str, Body(media_type="application/yaml")]) -> dict[str, Any]:
        """Serve another table of target slips, given as its YAML: all robots at once, or none."""
        return (await hub.replace_table(text)).content()

    return Guard(app, hub, OPEN)
