"""The HTTP side: page, health, figures, the model that is served and its replacement; and the WebSockets."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any

from fastapi import Body, FastAPI, HTTPException, Request, Response, WebSocket
from fastapi.responses import FileResponse, PlainTextResponse
from pydantic import BaseModel, ConfigDict, Field

from pipelines.models.model_files import TerrainModel
from pipelines.reporting.json_file import as_json
from pipelines.serve.connection import POLICY, Connection
from pipelines.serve.guard import bearer, foreign, token_fits
from pipelines.serve.hub import Hub
from pipelines.serve.messages import served_content
from pipelines.serve.watch import watch
from pipelines.serve.wire import plain
from terrain import __version__
from terrain.control.slip_table import SlipTable, load_slip_table
from terrain.errors import ConfigError, TerrainError

PAGE = Path(__file__).parent / "page"
ASSETS = Path(__file__).parents[1] / "report" / "assets"
PAGE_FILES: Mapping[str, str] = {
    "page.js": "text/javascript",
    "page.css": "text/css",
    "uplot.js": "text/javascript",
    "uplot.css": "text/css",
    "icon.svg": "image/svg+xml",
}
OPEN = ("/", "/health", "/ready", *(f"/page/{name}" for name in PAGE_FILES))
"""Paths that need no token: they tell nothing of robots."""

LARGEST_TABLE = 262_144
SECURITY = {
    "Content-Security-Policy": "default-src 'self'; frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
}


class ModelChoice(BaseModel):
    """A model to serve."""

    model_config = ConfigDict(extra="forbid")

    uri: Annotated[
        str, Field(min_length=1, max_length=1000, description="models:/NAME@champion or a model folder")
    ]


class ServedNow(BaseModel):
    """What is served; ``number`` rises with each replacement."""

    number: int
    model: str | None
    classes: list[str]
    table: str


class Readiness(BaseModel):
    """Whether robots can be served, and what is not as it should be."""

    ready: bool
    sessions: int
    trouble: dict[str, str]


def make_app(hub: Hub, token: str, load: Callable[[str], TerrainModel], *, loopback: bool) -> FastAPI:
    """Return the application.

    Parameters
    ----------
    hub : of the sessions
    token : that is required; empty for none
    load : returns a model by its URI; raises ``ModelError``
    loopback : whether only this machine is listened to
    """
    app = FastAPI(
        title="Terrain service",
        version=__version__,
        description="Terrain and target slip of robots, live. Robots connect to the WebSocket /robots.",
        docs_url=None,  # it loads scripts of other hosts
        redoc_url=None,
    )
    _add_guard(app, token, loopback=loopback)
    _add_page(app)
    _add_state(app, hub)
    _add_replacement(app, hub, load)
    _add_sockets(app, hub, token, loopback=loopback)
    return app


def _add_guard(app: FastAPI, token: str, *, loopback: bool) -> None:
    @app.middleware("http")
    async def guard(request: Request, call_next: Callable[[Request], Awaitable[Response]]) -> Response:
        if reason := foreign(request.headers, loopback=loopback):
            response: Response = PlainTextResponse(f"{reason}\n", 403)
        elif request.url.path not in OPEN and not token_fits(token, bearer(request.headers)):
            response = PlainTextResponse("a token is required (Authorization: Bearer)\n", 401)
        else:
            response = await call_next(request)
        response.headers.update(SECURITY)
        return response


def _add_page(app: FastAPI) -> None:
    @app.get("/", include_in_schema=False)
    async def page() -> FileResponse:
        return FileResponse(PAGE / "index.html", media_type="text/html")

    @app.get("/page/{name}", include_in_schema=False)
    async def page_file(name: str) -> FileResponse:
        if name not in PAGE_FILES:
            raise HTTPException(404, "there is no such file")
        return FileResponse(
            (ASSETS if name.startswith("uplot") else PAGE) / name, media_type=PAGE_FILES[name]
        )


def _add_state(app: FastAPI, hub: Hub) -> None:
    @app.get("/health")
    async def health() -> dict[str, str]:
        """Say that the process runs."""
        return {"status": "ok", "version": __version__}

    @app.get("/ready", responses={503: {"model": Readiness}})
    async def ready(response: Response) -> Readiness:
        """Say whether robots can be served."""
        if hub.closing:
            response.status_code = 503
        return Readiness(ready=not hub.closing, sessions=len(hub.sessions), trouble=dict(hub.trouble))

    @app.get("/metrics", response_class=PlainTextResponse)
    async def metrics() -> PlainTextResponse:
        """Return the figures of the service in Prometheus' text form."""
        return PlainTextResponse(hub.metrics.text(), media_type="text/plain; version=0.0.4; charset=utf-8")

    @app.get("/model")
    async def model() -> dict[str, Any]:
        """Return the card of the model that is served: how it was trained, on what, and how well it did."""
        served = hub.served
        card = {} if served.model is None else as_json(served.model.info)
        return {"served": served_content(served), "card": plain(card)}

    @app.get("/sessions")
    async def sessions() -> list[dict[str, Any]]:
        """Return the robots that are connected."""
        return [
            {
                "session": opened.name,
                "robot": opened.chain.request.robot,
                "control": opened.chain.request.control,
                "terrain": opened.chain.belief.terrain or None,
                "recording": opened.chain.recording,
                "dropped": opened.chain.dropped,
            }
            for opened in hub.sessions.values()
        ]


def _add_replacement(app: FastAPI, hub: Hub, load: Callable[[str], TerrainModel]) -> None:
    replacing = asyncio.Lock()

    @app.put("/model")
    async def replace_model(choice: ModelChoice) -> ServedNow:
        """Serve another model: all robots at once, or none; no sample is lost."""
        async with replacing:
            try:
                found = await asyncio.to_thread(load, choice.uri)
                served = hub.swap(found, choice.uri, hub.served.table)
            except TerrainError as error:
                raise HTTPException(409, str(error)) from None
        return ServedNow(**served_content(served))

    @app.put("/table")
    async def replace_table(
        text: Annotated[str, Body(media_type="application/yaml", max_length=LARGEST_TABLE)],
    ) -> ServedNow:
        """Serve another table of target slips, given as its YAML: all robots at once, or none."""
        async with replacing:
            try:
                table = await asyncio.to_thread(_table_of, text)
                served = hub.swap(hub.served.model, hub.served.model_name, table)
            except TerrainError as error:
                raise HTTPException(409, str(error)) from None
        return ServedNow(**served_content(served))


def _add_sockets(app: FastAPI, hub: Hub, token: str, *, loopback: bool) -> None:
    async def admitted(socket: WebSocket) -> bool:
        reason = foreign(socket.headers, loopback=loopback)
        if reason:
            await socket.close(POLICY, reason)
        else:
            await socket.accept()
        return not reason

    @app.websocket("/robots")
    async def robots(socket: WebSocket) -> None:
        if await admitted(socket):
            await Connection(socket, hub, token, bearer(socket.headers)).serve()

    @app.websocket("/watch")
    async def watchers(socket: WebSocket) -> None:
        if await admitted(socket):
            await watch(socket, hub, token, bearer(socket.headers))


def _table_of(text: str) -> SlipTable:
    """Return the table of a YAML text; ``ConfigError`` where it is none."""
    with TemporaryDirectory() as folder:
        file = Path(folder) / "table.yaml"
        file.write_text(text, encoding="utf-8")
        try:
            return load_slip_table(file)
        except ConfigError as error:
            raise ConfigError(str(error).replace(str(file), "the table")) from None
