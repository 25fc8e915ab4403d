"""The HTTP side: page, health, figures, the model that is served and its replacement; and the WebSockets."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from contextlib import AbstractAsyncContextManager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any

from fastapi import Body, FastAPI, HTTPException, Response, WebSocket
from fastapi.responses import FileResponse, PlainTextResponse
from fastapi.staticfiles import StaticFiles

from pipelines import report
from pipelines.learn.model_file import TerrainModel
from pipelines.report.json_file import as_json
from pipelines.serve.connection import Connection
from pipelines.serve.guard import Guard
from pipelines.serve.hub import Hub
from pipelines.serve.wire import encode
from terrain import __version__
from terrain.control.slip_table import SlipTable, load_slip_table
from terrain.errors import ConfigError, TerrainError

LARGEST_BODY = 262_144
"""Bytes of a request's body: a table of target slips, or the name of a model."""

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


def make_app(
    hub: Hub,
    token: str,
    load: Callable[[str], TerrainModel],
    lifespan: Callable[[FastAPI], AbstractAsyncContextManager[None]],
    *,
    loopback: bool,
) -> Guard:
    """Return the application behind its guard.

    Parameters
    ----------
    hub : of the sessions
    token : that is required; empty for none
    load : returns a model by its URI; raises ``ModelError``
    lifespan : what begins before the first request, and ends after the last
    loopback : whether only this machine is listened to
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
    guard = Guard(app, token, OPEN, hub.metrics, loopback=loopback)

    for place, folder in FOLDERS.items():
        app.mount(place, StaticFiles(directory=folder))

    @app.get("/", include_in_schema=False)
    async def page() -> FileResponse:
        return FileResponse(PAGE / "index.html")

    @app.websocket("/robots")
    async def robots(socket: WebSocket) -> None:
        await Connection(socket, hub, guard).serve()

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

    async def replaced(
        read: Callable[[str], Any], text: str, changed: Callable[[Any], Any]
    ) -> dict[str, Any]:
        try:
            found = await asyncio.to_thread(read, text)
            async with hub.changing:
                return hub.swap(*changed(found)).content()
        except TerrainError as error:
            raise HTTPException(409, str(error)) from None

    @app.put("/model")
    async def replace_model(uri: ModelUri) -> dict[str, Any]:
        """Serve another model: all robots at once, or none; no sample is lost."""
        return await replaced(load, uri, lambda model: (model, uri, hub.served.table))

    @app.put("/table")
    async def replace_table(text: Annotated[str, Body(media_type="application/yaml")]) -> dict[str, Any]:
        """Serve another table of target slips, given as its YAML: all robots at once, or none."""
        return await replaced(_table_of, text, lambda table: (hub.served.model, hub.served.model_name, table))

    return guard


def _table_of(text: str) -> SlipTable:
    """Return the table of a YAML text; ``ConfigError`` where it is none."""
    with TemporaryDirectory() as folder:
        file = Path(folder) / "table.yaml"
        file.write_text(text, encoding="utf-8")
        try:
            return load_slip_table(file)
        except ConfigError as error:
            raise ConfigError(str(error).replace(str(file), "the table")) from None
